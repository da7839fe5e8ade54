"""D-optimality of a sequence of inputs and its exact gradient, compiled for any model, for planners and oracles.

The criterion is ½ log det(Λ + F(u)) [nats], with F the Fisher information of the model's coefficients along the
response without noise (`estimator.inference.fisher_information`) and Λ the prior precision, less a penalty where the
first sensor's signal x exceeds a limit L:

    J(u) = ½ log det(Λ + F(u)) - ρ Σ_t max(0, |x_t| / L - 1)²

The engine generates the gradient by the adjoint method: a pass forward stores the state before every sample, a pass
backward differentiates.

A *start* is the state before the first sample: the rows of a path, that is the states, the filter's covariance V of
them (upper triangle) and their sensitivities Z to the coefficients (row by row), then the older inputs that the first
sample depends on, the newest first. All zeros is at rest.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from estimator.compilation.array_operations import copy_scaled, fill
from estimator.compilation.simd import jit, jit_closure, kernel
from estimator.engine.information_gradient import compile_adjoint
from estimator.engine.storage_layout import n_older_inputs
from estimator.models.model import Model
from estimator.support.array_types import FloatArray

#: Multiple of the limit at which a trajectory ends: difference equations diverge.
DIVERGED_RATIO = 1.2


class NominalSystem(NamedTuple):
    """The system at which a criterion is evaluated.

    Attributes:
        coefficients: (K,) of the model.
        precision: (K, K) Λ.
        noises: variances of the process noise and of each sensor
            (`estimator.inference.fisher_information.noise_variances`).
    """

    coefficients: FloatArray
    precision: FloatArray
    noises: tuple[float, ...]


class GradientWorkspace(NamedTuple):
    """Memory of one evaluation.

    Attributes:
        tape: (T, size) the state before every sample.
        output_signal: (T,) the first sensor's signal.
        F: (K, K) Λ + F; its lower triangle becomes the Cholesky factor.
        G: (K, K) its inverse.
        gradient: (T,) ∂J/∂u.
    """

    tape: FloatArray
    output_signal: FloatArray
    F: FloatArray
    G: FloatArray
    gradient: FloatArray


class DOptimality(NamedTuple):
    """Compiled functions of one model and interpolation of the input.

    Attributes:
        start_size: numbers in a start.
        n_path: rows of a path among them.
        workspace: ``workspace(T)`` makes a `GradientWorkspace` for up to T samples.
        criterion: ``criterion(nominal, limit, penalty, start, u, workspace)`` returns J(u) [nats] of inputs (T,), and
            the peak of |x|. A trajectory that diverges (`DIVERGED_RATIO`) counts up to that sample.
        criterion_and_gradient: the same, and fills in ``workspace.gradient``.
        input_at: ``input_at(start, u, t)`` returns the input at sample t, which may lie before the first.
        path_functions: of `estimator.engine.information_gradient.compile_adjoint`.
    """

    start_size: int
    n_path: int
    workspace: Any
    criterion: Any
    criterion_and_gradient: Any
    input_at: Any
    path_functions: Any


@cache
def compile_d_optimality(model: Model, degree: int = 0) -> DOptimality:
    """Compile the criterion of a model and its gradient.

    Args:
        model: the equation.
        degree: of the input's polynomial over a sample: 0 held, 1 linear.
    """
    path_functions = compile_adjoint(model, degree)
    begin, coefficients_of, lay, step, back = (
        path_functions.begin,
        path_functions.coefficients,
        path_functions.input_coefficients,
        path_functions.step,
        path_functions.backward,
    )
    gather, seed, n_path, n_tape = (
        path_functions.add_information,
        path_functions.seed_adjoint,
        path_functions.n_path,
        path_functions.n_tape,
    )
    k, n_older = model.n_coefficients, max(n_older_inputs(model, degree).values())
    compile_key = f"{model.name}_{model.digest}_{degree}"

    @jit_closure(compile_key)
    def workspace(samples):
        return GradientWorkspace(
            np.empty((samples, n_tape)), np.empty(samples), np.empty((k, k)), np.empty((k, k)), np.empty(samples)
        )

    @jit_closure(compile_key)
    def input_at(start, u, t):
        if t >= 0:
            return u[t]
        return start[n_path - 1 - t] if n_older >= -t else 0.0

    @jit_closure(compile_key)
    def simulate(nominal, limit, start, u, memory):
        """Simulate the inputs; return the number of samples, the peak of |x|, and Σ max(0, |x| / L - 1)²."""
        tape, output_signal, noises = memory.tape, memory.output_signal, nominal.noises
        C = coefficients_of(nominal.coefficients)
        P, F = begin(start)
        peak, excess, steps = 0.0, 0.0, 0
        for t in range(len(u)):
            U = lay(u[t], input_at(start, u, t - 1), input_at(start, u, t - 2))
            P, F, x, _ = step(P, F, C, U, noises, tape, t)
            output_signal[t] = x
            magnitude = abs(x)
            steps = t + 1
            peak = max(peak, magnitude)
            over = max(0.0, magnitude / limit - 1.0)
            excess += over * over
            if not magnitude < DIVERGED_RATIO * limit:
                break
        gather(F, nominal.precision, memory.F)
        return steps, peak, excess

    @kernel(variant=compile_key)
    def criterion(nominal, limit, penalty, start, u, memory):
        _, peak, excess = simulate(nominal, limit, start, u, memory)
        return half_log_det(memory.F) - penalty * excess, peak

    @kernel(variant=compile_key)
    def criterion_and_gradient(nominal, limit, penalty, start, u, memory):
        steps, peak, excess = simulate(nominal, limit, start, u, memory)
        value = half_log_det(memory.F)
        invert_from_cholesky(memory.F, memory.G)
        tape, output_signal, gradient, noises = memory.tape, memory.output_signal, memory.gradient, nominal.noises
        C = coefficients_of(nominal.coefficients)
        fill(gradient, 0.0)
        G, H = seed(memory.G)
        for t in range(steps - 1, -1, -1):
            over = max(0.0, abs(output_signal[t]) / limit - 1.0)
            output_slope = -2.0 * penalty * over * (1.0 if output_signal[t] > 0.0 else -1.0) / limit
            U = lay(u[t], input_at(start, u, t - 1), input_at(start, u, t - 2))
            G, slope_now, slope_last, slope_older = back(G, H, C, U, noises, output_slope, tape, t)
            gradient[t] += slope_now
            if n_older > 0 and t > 0:
                gradient[t - 1] += slope_last
            if n_older > 1 and t > 1:
                gradient[t - 2] += slope_older
        return value - penalty * excess, peak

    return DOptimality(n_path + n_older, n_path, workspace, criterion, criterion_and_gradient, input_at, path_functions)


@jit
def half_log_det(A):
    """½ log det of a symmetric positive definite matrix; its Cholesky factor overwrites the lower triangle.

    Minus infinity where it is not positive definite.
    """
    total = 0.0
    for j in range(len(A)):
        for k in range(j):
            total_jk = A[j, k]
            for i in range(k):
                total_jk -= A[j, i] * A[k, i]
            A[j, k] = total_jk / A[k, k]
        pivot = A[j, j]
        for i in range(j):
            pivot -= A[j, i] * A[j, i]
        if not pivot > 0.0:
            return -np.inf
        A[j, j] = math.sqrt(pivot)
        total += math.log(A[j, j])
    return total


@jit
def invert_from_cholesky(L, inverse):
    """Fill in the inverse of L Lᵀ, from the lower triangle of L."""
    size = len(L)
    column = np.empty(size)
    for j in range(size):
        fill(column, 0.0)
        column[j] = 1.0
        solve_from_cholesky(L, column)
        for i in range(size):
            inverse[i, j] = column[i]


@jit
def solve_from_cholesky(L, rhs):
    """Solve L Lᵀ x = rhs in place, from as many rows of the lower triangle of L as rhs has."""
    size = len(rhs)
    for i in range(size):
        total = rhs[i]
        for k in range(i):
            total -= L[i, k] * rhs[k]
        rhs[i] = total / L[i, i]
    for i in range(size - 1, -1, -1):
        total = rhs[i]
        for k in range(i + 1, size):
            total -= L[k, i] * rhs[k]
        rhs[i] = total / L[i, i]


@jit
def factorise_information(information, factor):
    """Fill in the factor M of an information M Mᵀ; zeros where the information is singular."""
    copy_scaled(factor, 1.0, information)
    if half_log_det(factor) == -np.inf:
        for row in range(len(factor)):
            fill(factor[row], 0.0)
