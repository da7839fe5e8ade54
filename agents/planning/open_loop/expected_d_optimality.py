"""Expected D-optimality of inputs over sampled systems, and its gradient, compiled across lanes.

    J(u) = mean_k [½ log det(Λ + F_k(u)) - ρ Σ_t max(0, |x_k(t)| / L - 1)²]

Term k is `agents.planning.d_optimality`'s criterion for a system with its own coefficients, start, noises and
disturbances. Each lane follows one system (`estimator.engine.information_gradient_simd`).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from itertools import combinations_with_replacement
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from agents.planning.d_optimality import DIVERGED_RATIO, half_log_det, invert_from_cholesky
from estimator.compilation.array_operations import fill
from estimator.compilation.simd import LANES, jit_closure, kernel
from estimator.engine.information_gradient_simd import compile_lane_adjoint
from estimator.engine.storage_layout import input_row, input_rows, linearised_filter_rows, n_older_inputs
from estimator.models.model import Model
from estimator.support.array_types import FloatArray


class SampledSystems(NamedTuple):
    """Systems sampled from a belief, as compiled code takes them.

    Attributes:
        coefficients: (S, K).
        path_starts: (S, size) starts of their paths (`agents.planning.d_optimality`).
        noises: (S, 1 + sensors) variances.
        input_disturbances: (S, T) process noise, as an addition to the input.
        precision: (K, K) prior precision of the coefficients.
    """

    coefficients: FloatArray
    path_starts: FloatArray
    noises: FloatArray
    input_disturbances: FloatArray
    precision: FloatArray


class LaneWorkspace(NamedTuple):
    """Memory of one evaluation.

    Attributes:
        W: a block of paths.
        A: a block of their adjoints.
        tape: (T, size) the state of the block before every sample.
        inputs: (2 + T, LANES) of every system, after the two before the first.
        output_signal: (T, LANES) the first sensor's signal.
        steps: (LANES,) number of samples that were followed.
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
    steps: npt.NDArray[np.int64]
    seeds: FloatArray
    F: FloatArray
    G: FloatArray
    gradient: FloatArray


class ExpectedDOptimality(NamedTuple):
    """Compiled functions of one model and interpolation of the input.

    Attributes:
        workspace: ``workspace(T)`` makes a `LaneWorkspace` for up to T samples.
        criterion_and_gradient: ``criterion_and_gradient(systems, limit, penalty, u, workspace)`` returns J(u) [nats] of
            inputs (T,), and fills in ``workspace.gradient``. A system that diverges (`DIVERGED_RATIO`) counts up to
            that sample.
    """

    workspace: Callable[[int], LaneWorkspace]
    criterion_and_gradient: Callable[..., float]


class _Layout(NamedTuple):
    """Offsets of rows and sizes of a block of paths.

    Attributes:
        F: of the information; C: of the coefficients; U: of the inputs; Q: of the noises.
        SHOWN: of the first sensor's signal.
        LIVE: of the flag of a path that is followed.
        size: numbers in a block.
        n_tape: numbers of a sample on the tape.
        n_path: rows of a path.
        n_inputs: inputs over a sample that the model depends on.
        n_older: inputs before the first sample that it depends on.
        k: coefficients.
        entries: of the upper triangle of the information.
        n_noises: process noise and sensors.
        is_linear_input: whether the input goes linearly from one value to the next.
        rows: (entries,) row of each entry.
        columns: (entries,) column of each entry.
    """

    F: int
    C: int
    U: int
    Q: int
    SHOWN: int
    LIVE: int
    size: int
    n_tape: int
    n_path: int
    n_inputs: int
    n_older: int
    k: int
    entries: int
    n_noises: int
    is_linear_input: bool
    rows: npt.NDArray[np.int64]
    columns: npt.NDArray[np.int64]


@cache
def _layout(model: Model, degree: int) -> _Layout:
    """The layout of a model; numbers are counted over all lanes."""
    lane_paths = compile_lane_adjoint(model, degree)
    at = {name: row * LANES for name, row in lane_paths.layout.items()}
    first = next(iter(model.coefficients))
    k = model.n_coefficients
    rows, columns = np.array(list(combinations_with_replacement(range(k), 2))).T.copy()
    return _Layout(
        F=at[f"INFORMATION_{first}_{first}"],
        C=at[first],
        U=at[input_row(next(iter(model.inputs)), 0)],
        Q=at["PROCESS_VARIANCE"],
        SHOWN=at[f"Y_PRED_{next(iter(model.outputs))}"],
        LIVE=at["IS_COUNTED"],
        size=len(lane_paths.layout) * LANES,
        n_tape=lane_paths.n_tape,
        n_path=len(linearised_filter_rows(model)),
        n_inputs=len(input_rows(model, degree)),
        n_older=max(n_older_inputs(model, degree).values()),
        k=k,
        entries=k * (k + 1) // 2,
        n_noises=1 + model.n_outputs,
        is_linear_input=model.is_continuous and degree == 1,
        rows=rows,
        columns=columns,
    )


def _compile_key(model: Model, degree: int) -> str:
    return f"{model.name}_{model.digest}_{degree}"


@cache
def _compile_loading(model: Model, degree: int) -> tuple[Any, Any, Any]:
    """``workspace``, ``load_systems`` and ``load_inputs``."""
    layout, compile_inner = _layout(model, degree), jit_closure(_compile_key(model, degree))
    # Numba takes closed-over integers as constants, so each has a name of its own.
    C, U, Q, LIVE, size, n_tape, n_path = (
        layout.C, layout.U, layout.Q, layout.LIVE, layout.size, layout.n_tape, layout.n_path
    )  # fmt: skip
    n_inputs, n_older, k, entries, n_noises, is_linear_input = (
        layout.n_inputs, layout.n_older, layout.k, layout.entries, layout.n_noises, layout.is_linear_input
    )  # fmt: skip

    @compile_inner
    def workspace(samples):
        lanes = np.empty((2 + samples, LANES)), np.empty((samples, LANES)), np.empty(LANES, np.int64)
        matrices = np.empty((entries, LANES)), np.empty((k, k)), np.empty((k, k))
        return LaneWorkspace(
            np.empty(size), np.empty(size), np.empty((samples, n_tape)), *lanes, *matrices, np.empty(samples)
        )

    @compile_inner
    def load_systems(systems, first, u, memory):
        """Load the systems from the first on; lanes beyond the last one repeat it."""
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
        """Load the inputs over sample t."""
        W, inputs = memory.W, memory.inputs
        for j in range(LANES):
            if is_linear_input:
                W[U + j], W[U + LANES + j] = inputs[1 + t, j], inputs[2 + t, j] - inputs[1 + t, j]
            else:
                for a in range(n_inputs):
                    W[U + a * LANES + j] = inputs[2 + t - a, j]

    return workspace, load_systems, load_inputs


@cache
def _compile_lane_criterion(model: Model, degree: int) -> Any:
    """``lane_criterion(precision, j, memory)``."""
    layout = _layout(model, degree)
    F, entries, rows, columns = layout.F, layout.entries, layout.rows, layout.columns

    @jit_closure(_compile_key(model, degree))
    def lane_criterion(precision, j, memory):
        """The information of the system in lane j [nats], and its slopes by F."""
        W, matrix, G = memory.W, memory.F, memory.G
        for e in range(entries):
            matrix[columns[e], rows[e]] = precision[columns[e], rows[e]] + W[F + e * LANES + j]
        value = half_log_det(matrix)
        invert_from_cholesky(matrix, G)
        for e in range(entries):
            # ∂J/∂F is half the inverse; an entry beside the diagonal stands for two.
            memory.seeds[e, j] = (0.5 if rows[e] == columns[e] else 1.0) * G[columns[e], rows[e]]
        return value

    return lane_criterion


@cache
def _compile_passes(model: Model, degree: int) -> tuple[Any, Any]:
    """``sum_criteria`` and ``add_gradients``: the passes forward and backward in time."""
    layout, compile_inner = _layout(model, degree), jit_closure(_compile_key(model, degree))
    lane_paths = compile_lane_adjoint(model, degree)
    follow, back = lane_paths.forward, lane_paths.backward
    _, _, load_inputs = _compile_loading(model, degree)
    lane_criterion = _compile_lane_criterion(model, degree)
    F, U, SHOWN, LIVE, n_path, n_inputs, entries, is_linear_input = (
        layout.F, layout.U, layout.SHOWN, layout.LIVE, layout.n_path, layout.n_inputs, layout.entries,
        layout.is_linear_input,
    )  # fmt: skip

    @compile_inner
    def sum_criteria(systems, limit, penalty, n_used, samples, memory):
        """The sum of the criteria of the first ``n_used`` lanes."""
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

    return sum_criteria, add_gradients


@cache
def compile_expected_d_optimality(model: Model, degree: int = 0) -> ExpectedDOptimality:
    """Compile the criterion of a model; arguments as `agents.planning.d_optimality.compile_d_optimality`."""
    workspace, load_systems, _ = _compile_loading(model, degree)
    sum_criteria, add_gradients = _compile_passes(model, degree)

    @kernel(variant=_compile_key(model, degree))
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
