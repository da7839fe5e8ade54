"""The worth of a sequence of inputs, and its exact gradient, compiled for any model: what oracle and planner climb.

The worth is ½ log det(Λ + F(u)) in nats, with F the Fisher information of the model's coefficients along the response
without noise (`estimator.information`) and Λ what is known before, less a penalty where the first sensor's signal x
goes beyond a limit L:

    J(u) = ½ log det(Λ + F(u)) - ρ Σ_t max(0, |x_t| / L - 1)²

The gradient is the reverse derivative of this arithmetic, which the engine generates: one pass forward that keeps what
every step begins with, one backward.

A *start* is what a step begins with: the rows of a path, that is the states, the filter's covariance V of them (upper
triangle) and their sensitivities Z to the coefficients (row by row), then the older inputs that the first sample
depends on, the newest first. All zeros is at rest.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from estimator.arrays import copy_scaled, fill
from estimator.engine.feeding import older_inputs
from estimator.engine.gradient import pieces
from estimator.lanes import jit, kernel, part
from estimator.models.model import Model
from estimator.parameters import FloatArray

#: A trajectory is followed no further than to this many times the limit: a difference equation blows up.
LOST = 1.2


class Known(NamedTuple):
    """What a worth is taken at.

    Attributes:
        coefficients: (K,) the model's.
        precision: (K, K) Λ.
        noises: variances of the process noise and of each sensor's (`estimator.information.variances`).
    """

    coefficients: FloatArray
    precision: FloatArray
    noises: tuple[float, ...]


class Memory(NamedTuple):
    """What climbing writes on.

    Attributes:
        tape: (T, size) what every sample began with.
        shown: (T,) the first sensor's signal.
        F: (K, K) Λ + F, whose lower triangle becomes its factor.
        G: (K, K) its inverse.
        gradient: (T,) ∂J/∂u.
    """

    tape: FloatArray
    shown: FloatArray
    F: FloatArray
    G: FloatArray
    gradient: FloatArray


class Designer(NamedTuple):
    """Compiled functions of one model and interpolation of the input.

    Attributes:
        start_size: numbers in a start.
        n_path: of these, the rows of a path.
        memory: ``memory(T)``, a `Memory` for up to T samples.
        worth: ``worth(known, limit, penalty, start, u, memory)``: J(u) [nats] of inputs (T,), and the peak of |x|. A
            trajectory that is lost (`LOST`) counts what it told until then.
        climb: as ``worth``, and fills in ``memory.gradient``.
        earlier: ``earlier(start, u, t)``: the input at sample t, which may lie before the first.
        code: `estimator.engine.gradient.pieces`, for those who follow a path themselves.
    """

    start_size: int
    n_path: int
    memory: Any
    worth: Any
    climb: Any
    earlier: Any
    code: Any


@cache
def designer(model: Model, degree: int = 0) -> Designer:
    """The worth of inputs to a model, and its gradient.

    Args:
        model: the equation.
        degree: of the input's polynomial over a sample: 0 held, 1 linear.
    """
    code = pieces(model, degree)
    begin, coefficients_of, lay, step, back = code.begin, code.coefficients, code.lay, code.step, code.back
    gather, seed, n_path, n_tape = code.gather, code.seed, code.n_path, code.n_tape
    k, older = model.n_coefficients, older_inputs(model, degree)
    kind = f"{model.name}_{model.digest}_{degree}"

    @part(kind)
    def memory(samples):
        return Memory(
            np.empty((samples, n_tape)), np.empty(samples), np.empty((k, k)), np.empty((k, k)), np.empty(samples)
        )

    @part(kind)
    def earlier(start, u, t):
        if t >= 0:
            return u[t]
        return start[n_path - 1 - t] if older >= -t else 0.0

    @part(kind)
    def roll(known, limit, start, u, memory):
        """Follow the inputs; gives the steps that were followed, the peak of |x|, and Σ max(0, |x| / L - 1)²."""
        tape, shown, noises = memory.tape, memory.shown, known.noises
        C = coefficients_of(known.coefficients)
        P, F = begin(start)
        peak, excess, steps = 0.0, 0.0, 0
        for t in range(len(u)):
            U = lay(u[t], earlier(start, u, t - 1), earlier(start, u, t - 2))
            P, F, x, _ = step(P, F, C, U, noises, tape, t)
            shown[t] = x
            size = abs(x)
            steps = t + 1
            peak = max(peak, size)
            over = max(0.0, size / limit - 1.0)
            excess += over * over
            if not size < LOST * limit:
                break
        gather(F, known.precision, memory.F)
        return steps, peak, excess

    @kernel(kind=kind)
    def worth(known, limit, penalty, start, u, memory):
        _, peak, excess = roll(known, limit, start, u, memory)
        return half_log_det(memory.F) - penalty * excess, peak

    @kernel(kind=kind)
    def climb(known, limit, penalty, start, u, memory):
        steps, peak, excess = roll(known, limit, start, u, memory)
        value = half_log_det(memory.F)
        invert(memory.F, memory.G)
        tape, shown, gradient, noises = memory.tape, memory.shown, memory.gradient, known.noises
        C = coefficients_of(known.coefficients)
        fill(gradient, 0.0)
        G, H = seed(memory.G)
        for t in range(steps - 1, -1, -1):
            over = max(0.0, abs(shown[t]) / limit - 1.0)
            pushed = -2.0 * penalty * over * (1.0 if shown[t] > 0.0 else -1.0) / limit
            U = lay(u[t], earlier(start, u, t - 1), earlier(start, u, t - 2))
            G, by_now, by_last, by_older = back(G, H, C, U, noises, pushed, tape, t)
            gradient[t] += by_now
            if older > 0 and t > 0:
                gradient[t - 1] += by_last
            if older > 1 and t > 1:
                gradient[t - 2] += by_older
        return value - penalty * excess, peak

    return Designer(n_path + older, n_path, memory, worth, climb, earlier, code)


@jit
def half_log_det(A):
    """½ log det of a symmetric positive definite matrix, whose lower triangle is overwritten by its factor.

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
def invert(L, inverse):
    """The inverse of L Lᵀ, from the lower triangle of L."""
    size = len(L)
    column = np.empty(size)
    for j in range(size):
        fill(column, 0.0)
        column[j] = 1.0
        solve(L, column)
        for i in range(size):
            inverse[i, j] = column[i]


@jit
def solve(L, x):
    """Solve L Lᵀ x = given x in place, from the lower triangle of L, of as many rows as x has."""
    size = len(x)
    for i in range(size):
        total = x[i]
        for k in range(i):
            total -= L[i, k] * x[k]
        x[i] = total / L[i, i]
    for i in range(size - 1, -1, -1):
        total = x[i]
        for k in range(i + 1, size):
            total -= L[k, i] * x[k]
        x[i] = total / L[i, i]


@jit
def factorise(information, M):
    """The factor M of an information M Mᵀ; zeros where there is none, or it tells nothing of a coefficient."""
    copy_scaled(M, 1.0, information)
    if half_log_det(M) == -np.inf:
        for row in range(len(M)):
            fill(M[row], 0.0)
