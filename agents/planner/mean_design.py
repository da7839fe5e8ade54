"""The mean worth of inputs over many systems, and its gradient: what blocks climb, which are planned for a belief.

    J(u) = mean_k [½ log det(Λ + F_k(u)) - ρ Σ_t max(0, |x_k(t)| / L - 1)²]

Each term is that of `agents.planner.design`, for a system with coefficients, a start, noises and disturbances of its
own. As many systems as there are lanes are followed side by side (`estimator.engine.gradient_lanes`).
"""

from __future__ import annotations

from functools import cache
from itertools import combinations_with_replacement
from typing import Any, NamedTuple

import numpy as np

from agents.planner.design import LOST, half_log_det, invert
from estimator.arrays import fill
from estimator.engine.feeding import older_inputs
from estimator.engine.gradient_lanes import paths
from estimator.engine.rows import input_rows, path_names
from estimator.lanes import LANES, kernel, part
from estimator.models.model import Model
from estimator.parameters import FloatArray


class Systems(NamedTuple):
    """Drawn systems, as compiled code takes them.

    Attributes:
        coefficients: (S, K).
        starts: (S, size) what their paths start with (`agents.planner.design`).
        noises: (S, 1 + sensors) variances.
        shakes: (S, T) what process noise adds to the input.
        precision: (K, K) what is known of the coefficients before.
    """

    coefficients: FloatArray
    starts: FloatArray
    noises: FloatArray
    shakes: FloatArray
    precision: FloatArray


class Memory(NamedTuple):
    """What climbing writes on.

    Attributes:
        W: a block of paths; A: one of their adjoints.
        tape: (T, size) what every sample began with.
        inputs: (2 + T, LANES) of every system, after the two before the first.
        shown: (T, LANES) the first sensor's signal.
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
    shown: FloatArray
    steps: Any
    seeds: FloatArray
    F: FloatArray
    G: FloatArray
    gradient: FloatArray


class MeanDesigner(NamedTuple):
    """Compiled functions of one model and interpolation of the input.

    Attributes:
        memory: ``memory(T)``, a `Memory` for up to T samples.
        climb: ``climb(systems, limit, penalty, u, memory)``: J(u) [nats] of inputs (T,), and fills in
            ``memory.gradient``. A system that is lost (`LOST`) counts what it told until then.
    """

    memory: Any
    climb: Any


@cache
def mean_designer(model: Model, degree: int = 0) -> MeanDesigner:
    """The mean worth of inputs over systems of a model; arguments as `agents.planner.design.designer`."""
    found = paths(model, degree)
    follow, back, n_tape, size = found.follow, found.back, found.n_tape, len(found.layout) * LANES
    at = {name: row * LANES for name, row in found.layout.items()}
    told = next(iter(model.coefficients))
    F, C, U, Q = at[f"F_{told}_{told}"], at[told], at["U_0"], at["Q"]
    SHOWN, LIVE = at[f"SHOWN_{next(iter(model.outputs))}"], at["LIVE"]
    n_path, n_inputs, k = len(path_names(model)), len(input_rows(model, degree)), model.n_coefficients
    entries, n_noises, older = k * (k + 1) // 2, 1 + model.n_outputs, older_inputs(model, degree)
    is_line = model.is_continuous and degree == 1
    rows, columns = np.array(list(combinations_with_replacement(range(k), 2))).T.copy()
    kind = f"{model.name}_{model.digest}_{degree}"
    inner = part(kind)

    @inner
    def memory(samples):
        lanes = np.empty((2 + samples, LANES)), np.empty((samples, LANES)), np.empty(LANES, np.int64)
        matrices = np.empty((entries, LANES)), np.empty((k, k)), np.empty((k, k))
        return Memory(np.empty(size), np.empty(size), np.empty((samples, n_tape)), *lanes, *matrices, np.empty(samples))

    @inner
    def begin(systems, first, u, memory):
        """Lay out the systems from the first on; lanes beyond the last one follow it, too."""
        W, inputs = memory.W, memory.inputs
        fill(W, 0.0)
        for j in range(LANES):
            i = min(first + j, len(systems.coefficients) - 1)
            for a in range(n_path):
                W[a * LANES + j] = systems.starts[i, a]
            for a in range(k):
                W[C + a * LANES + j] = systems.coefficients[i, a]
            for a in range(n_noises):
                W[Q + a * LANES + j] = systems.noises[i, a]
            W[LIVE + j] = 1.0
            for a in range(2):
                inputs[1 - a, j] = systems.starts[i, n_path + a] if a < older else 0.0
            for t in range(len(u)):
                inputs[2 + t, j] = u[t] + systems.shakes[i, t]

    @inner
    def lay(memory, t):
        """Lay out the inputs over sample t."""
        W, inputs = memory.W, memory.inputs
        for j in range(LANES):
            if is_line:
                W[U + j], W[U + LANES + j] = inputs[1 + t, j], inputs[2 + t, j] - inputs[1 + t, j]
            else:
                for a in range(n_inputs):
                    W[U + a * LANES + j] = inputs[2 + t - a, j]

    @inner
    def appraise(precision, j, memory):
        """What the system in lane j has told, and how that grows with its F."""
        W, matrix, G = memory.W, memory.F, memory.G
        for e in range(entries):
            matrix[columns[e], rows[e]] = precision[columns[e], rows[e]] + W[F + e * LANES + j]
        value = half_log_det(matrix)
        invert(matrix, G)
        for e in range(entries):
            # ∂J/∂F is half the inverse, and an entry beside the diagonal stands for two.
            memory.seeds[e, j] = (0.5 if rows[e] == columns[e] else 1.0) * G[columns[e], rows[e]]
        return value

    @inner
    def forward(systems, limit, penalty, used, samples, memory):
        """The sum of what as many systems as are used tell, less what they are charged."""
        W, shown, steps, total = memory.W, memory.shown, memory.steps, 0.0
        for t in range(samples):
            lay(memory, t)
            follow(W, memory.tape, t)
            for j in range(used):
                shown[t, j] = W[SHOWN + j]
                if W[LIVE + j] > 0.0:
                    over = max(0.0, abs(shown[t, j]) / limit - 1.0)
                    total -= penalty * over * over
                    if t + 1 == samples or not abs(shown[t, j]) < LOST * limit:
                        total += appraise(systems.precision, j, memory)
                        W[LIVE + j], steps[j] = 0.0, t + 1
        return total

    @inner
    def backward(limit, penalty, used, samples, memory):
        """Add the slopes of that sum to the gradient."""
        W, A, shown, steps, gradient = memory.W, memory.A, memory.shown, memory.steps, memory.gradient
        fill(A, 0.0)
        for t in range(samples - 1, -1, -1):
            lay(memory, t)
            for j in range(used):
                if steps[j] == t + 1:
                    W[LIVE + j] = 1.0
                    for a in range(n_path):
                        A[a * LANES + j] = 0.0
                    for e in range(entries):
                        A[F + e * LANES + j] = memory.seeds[e, j]
                over = max(0.0, abs(shown[t, j]) / limit - 1.0)
                A[SHOWN + j] = -2.0 * penalty * over * (1.0 if shown[t, j] > 0.0 else -1.0) / limit
            back(W, A, memory.tape, t)
            for j in range(used):
                if t < steps[j]:
                    if is_line:
                        gradient[t] += A[U + LANES + j]
                        if t > 0:
                            gradient[t - 1] += A[U + j] - A[U + LANES + j]
                    else:
                        for a in range(min(n_inputs, t + 1)):
                            gradient[t - a] += A[U + a * LANES + j]

    @kernel(kind=kind)
    def climb(systems, limit, penalty, u, memory):
        S, total, samples = len(systems.coefficients), 0.0, len(u)
        fill(memory.gradient, 0.0)
        for first in range(0, S, LANES):
            used = min(LANES, S - first)
            begin(systems, first, u, memory)
            total += forward(systems, limit, penalty, used, samples, memory)
            backward(limit, penalty, used, samples, memory)
        for t in range(samples):
            memory.gradient[t] /= S
        return total / S

    return MeanDesigner(memory, climb)
