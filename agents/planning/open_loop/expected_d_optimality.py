"""The mean worth of inputs over many systems, and its gradient: what blocks climb, which are planned for a belief.

    J(u) = mean_k [½ log det(Λ + F_k(u)) - ρ Σ_t max(0, |x_k(t)| / L - 1)²]

Each term is that of `agents.planning.d_optimality`, for a system with coefficients, a start, noises and disturbances of its
own. As many systems as there are lanes are followed side by side (`estimator.engine.adjoint_simd`).
"""

from __future__ import annotations

from functools import cache
from itertools import combinations_with_replacement
from typing import Any, NamedTuple

import numpy as np

from agents.planning.d_optimality import DIVERGED_RATIO, half_log_det, invert_from_cholesky
from estimator.compilation.array_operations import fill
from estimator.compilation.simd import LANES, jit_closure, kernel
from estimator.engine.adjoint_simd import compile_lane_adjoint
from estimator.engine.input_hold import n_older_inputs
from estimator.engine.storage_layout import filter_state_rows, input_rows
from estimator.models.model import Model
from estimator.support.array_types import FloatArray


class SampledSystems(NamedTuple):
    """Drawn systems, as compiled code takes them.

    Attributes:
        coefficients: (S, K).
        path_starts: (S, size) what their paths start with (`agents.planning.d_optimality`).
        noises: (S, 1 + sensors) variances.
        input_disturbances: (S, T) what process noise adds to the input.
        precision: (K, K) what is known of the coefficients before.
    """

    coefficients: FloatArray
    path_starts: FloatArray
    noises: FloatArray
    input_disturbances: FloatArray
    precision: FloatArray


class LaneWorkspace(NamedTuple):
    """What climbing writes on.

    Attributes:
        W: a block of paths; A: one of their adjoints.
        tape: (T, size) what every sample began with.
        inputs: (2 + T, LANES) of every system, after the two before the first.
        output_signal: (T, LANES) the first sensor's signal.
        steps: (LANES,) samples that were followed.
        seeds: (entries, LANES) ∂J/∂F, upper triangle.
        F: (K, K) Λ + F of a system, and its factor.
        G: (K, K) the inverse.
        gradient: (T,) ∂J/∂u.
    """

    W: FloatArray
    A: FloatArray
    tape: FloatArray
    inputs: FloatArray
    output_signal: FloatArray
    steps: Any
    seeds: FloatArray
    F: FloatArray
    G: FloatArray
    gradient: FloatArray


class ExpectedDOptimality(NamedTuple):
    """Compiled functions of one model and interpolation of the input.

    Attributes:
        workspace: ``workspace(T)``, a `LaneWorkspace` for up to T samples.
        criterion_and_gradient: ``criterion_and_gradient(systems, limit, penalty, u, workspace)``: J(u) [nats] of inputs (T,), and fills in
            ``workspace.gradient``. A system that is lost (`LOST`) counts what it told until then.
    """

    workspace: Any
    criterion_and_gradient: Any


@cache
def compile_expected_d_optimality(model: Model, degree: int = 0) -> ExpectedDOptimality:
    """The mean worth of inputs over systems of a model; arguments as `agents.planning.d_optimality.compile_d_optimality`."""
    lane_paths = compile_lane_adjoint(model, degree)
    follow, back, n_tape, size = (
        lane_paths.forward,
        lane_paths.backward,
        lane_paths.n_tape,
        len(lane_paths.layout) * LANES,
    )
    at = {name: row * LANES for name, row in lane_paths.layout.items()}
    first_coefficient = next(iter(model.coefficients))
    F, C, U, Q = at[f"F_{first_coefficient}_{first_coefficient}"], at[first_coefficient], at["U_0"], at["Q"]
    SHOWN, LIVE = at[f"SHOWN_{next(iter(model.outputs))}"], at["LIVE"]
    n_path, n_inputs, k = len(filter_state_rows(model)), len(input_rows(model, degree)), model.n_coefficients
    entries, n_noises, n_older = k * (k + 1) // 2, 1 + model.n_outputs, n_older_inputs(model, degree)
    is_linear_input = model.is_continuous and degree == 1
    rows, columns = np.array(list(combinations_with_replacement(range(k), 2))).T.copy()
    compile_key = f"{model.name}_{model.digest}_{degree}"
    compile_inner = jit_closure(compile_key)

    @compile_inner
    def workspace(samples):
        lanes = np.empty((2 + samples, LANES)), np.empty((samples, LANES)), np.empty(LANES, np.int64)
        matrices = np.empty((entries, LANES)), np.empty((k, k)), np.empty((k, k))
        return LaneWorkspace(
            np.empty(size), np.empty(size), np.empty((samples, n_tape)), *lanes, *matrices, np.empty(samples)
        )

    @compile_inner
    def load_systems(systems, first, u, memory):
        """Lay out the systems from the first on; lanes beyond the last one follow it, too."""
        W, inputs = memory.W, memory.inputs
        fill(W, 0.0)
        for j in range(LANES):
            i = min(first + j, len(systems.coefficients) - 1)
            for a in range(n_path):
                W[a * LANES + j] = systems.path_starts[i, a]
            for a in range(k):
                W[C + a * LANES + j] = systems.coefficients[i, a]
            for a in range(n_noises):
                W[Q + a * LANES + j] = systems.noises[i, a]
            W[LIVE + j] = 1.0
            for a in range(2):
                inputs[1 - a, j] = systems.path_starts[i, n_path + a] if a < n_older else 0.0
            for t in range(len(u)):
                inputs[2 + t, j] = u[t] + systems.input_disturbances[i, t]

    @compile_inner
    def load_inputs(memory, t):
        """Lay out the inputs over sample t."""
        W, inputs = memory.W, memory.inputs
        for j in range(LANES):
            if is_linear_input:
                W[U + j], W[U + LANES + j] = inputs[1 + t, j], inputs[2 + t, j] - inputs[1 + t, j]
            else:
                for a in range(n_inputs):
                    W[U + a * LANES + j] = inputs[2 + t - a, j]

    @compile_inner
    def lane_criterion(precision, j, memory):
        """What the system in lane j has told, and how that grows with its F."""
        W, matrix, G = memory.W, memory.F, memory.G
        for e in range(entries):
            matrix[columns[e], rows[e]] = precision[columns[e], rows[e]] + W[F + e * LANES + j]
        value = half_log_det(matrix)
        invert_from_cholesky(matrix, G)
        for e in range(entries):
            # ∂J/∂F is half the inverse, and an entry beside the diagonal stands for two.
            memory.seeds[e, j] = (0.5 if rows[e] == columns[e] else 1.0) * G[columns[e], rows[e]]
        return value

    @compile_inner
    def sum_criteria(systems, limit, penalty, n_used, samples, memory):
        """The sum of what as many systems as are used tell, less what they are charged."""
        W, output_signal, steps, total = memory.W, memory.output_signal, memory.steps, 0.0
        for t in range(samples):
            load_inputs(memory, t)
            follow(W, memory.tape, t)
            for j in range(n_used):
                output_signal[t, j] = W[SHOWN + j]
                if W[LIVE + j] > 0.0:
                    over = max(0.0, abs(output_signal[t, j]) / limit - 1.0)
                    total -= penalty * over * over
                    if t + 1 == samples or not abs(output_signal[t, j]) < DIVERGED_RATIO * limit:
                        total += lane_criterion(systems.precision, j, memory)
                        W[LIVE + j], steps[j] = 0.0, t + 1
        return total

    @compile_inner
    def add_gradients(limit, penalty, n_used, samples, memory):
        """Add the slopes of that sum to the gradient."""
        W, A, output_signal, steps, gradient = memory.W, memory.A, memory.output_signal, memory.steps, memory.gradient
        fill(A, 0.0)
        for t in range(samples - 1, -1, -1):
            load_inputs(memory, t)
            for j in range(n_used):
                if steps[j] == t + 1:
                    W[LIVE + j] = 1.0
                    for a in range(n_path):
                        A[a * LANES + j] = 0.0
                    for e in range(entries):
                        A[F + e * LANES + j] = memory.seeds[e, j]
                over = max(0.0, abs(output_signal[t, j]) / limit - 1.0)
                A[SHOWN + j] = -2.0 * penalty * over * (1.0 if output_signal[t, j] > 0.0 else -1.0) / limit
            back(W, A, memory.tape, t)
            for j in range(n_used):
                if t < steps[j]:
                    if is_linear_input:
                        gradient[t] += A[U + LANES + j]
                        if t > 0:
                            gradient[t - 1] += A[U + j] - A[U + LANES + j]
                    else:
                        for a in range(min(n_inputs, t + 1)):
                            gradient[t - a] += A[U + a * LANES + j]

    @kernel(variant=compile_key)
    def criterion_and_gradient(systems, limit, penalty, u, memory):
        S, total, samples = len(systems.coefficients), 0.0, len(u)
        fill(memory.gradient, 0.0)
        for first in range(0, S, LANES):
            n_used = min(LANES, S - first)
            load_systems(systems, first, u, memory)
            total += sum_criteria(systems, limit, penalty, n_used, samples, memory)
            add_gradients(limit, penalty, n_used, samples, memory)
        for t in range(samples):
            memory.gradient[t] /= S
        return total / S

    return ExpectedDOptimality(workspace, criterion_and_gradient)
