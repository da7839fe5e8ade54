"""Steps that improve a whole plan at once: the more it teaches, the nearer it leads to the limit.

Near a limit, whatever is changed of one input alone makes the plan worse, as all that follows leads beyond it, or away
from it. So the first inputs u of a plan are changed together, by a model of what the plan is worth,

    J(u + d) ≈ J(u) + gᵀ d - K Σ_h w_h [max(0, z_h + Z_hᵀ d)⁴ - max(0, z_h)⁴] - ½ λ |d|²

with z_h how many standard deviations the output of move h is within its margin (`agents.planning.belief_rollout`), Z_h its
derivative, w_h how much that counts, and g the derivative of what the plan teaches. Derivatives are differences: each
lane of a block imagines the plan with one input nudged. The smaller λ, the longer the step. For one λ after another,
the next step is the last one and an iteration of Newton's, within the largest input. Which step is best is then
imagined.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from agents.planning.belief_rollout import MARGIN_COST
from agents.planning.d_optimality import half_log_det, solve_from_cholesky
from estimator.compilation.array_operations import copy, fill
from estimator.compilation.simd import LANES, jit

#: Inputs of a plan that are changed together; later ones are planned again before they are played.
_MAX_CHANGED_INPUTS = 20

#: Steps; how much smaller λ becomes from step to step; and the last λ: with it g alone asks for at most this many times
#: the largest input that there is.
_N_STEPS, _DAMPING_RATIO, _MAX_STEP = 16, 1.6, 2.0

#: How far an input is nudged, in parts of the largest.
_DIFFERENCE_FRACTION = 1e-3

#: Outputs that are further from their margin than so many standard deviations are not in the model.
_MAX_MODELLED_EXCESS = 12.0


class CandidateBatch(NamedTuple):
    """Plans that compete, one in each lane, and what is known of them.

    Attributes:
        candidates: (LANES, horizon) the plans.
        scores: (LANES,) what they are worth.
        margin_excess: (horizon, LANES) standard deviations by which the output of a move is within its margin.
        weights: (horizon,) how much what a move teaches and costs counts.
        plan: (horizon,) the one that was nudged.
        perturbations: (`_MAX_CHANGED_INPUTS`,) of its inputs; that of input i is in lane i + 1.
    """

    candidates: Any
    scores: Any
    margin_excess: Any
    weights: Any
    plan: Any
    perturbations: Any


@jit
def empty_candidate_batch(horizon):
    """Memory for plans of so many moves."""
    candidates, margin_excess = np.empty((LANES, horizon)), np.empty((horizon, LANES))
    return CandidateBatch(
        candidates, np.empty(LANES), margin_excess, np.empty(horizon), np.empty(horizon), np.empty(_MAX_CHANGED_INPUTS)
    )


@jit
def fill_finite_differences(batch, plan, n_moves, amplitude):
    """Put the plan into the first lane, and with one input nudged towards its middle into each lane after it.

    Gives the first lane that is left.
    """
    candidates, n_changed = batch.candidates, min(n_moves, _MAX_CHANGED_INPUTS)
    copy(batch.plan, 0, plan, len(plan))
    copy(candidates[0], 0, plan, len(plan))
    for i in range(n_changed):
        batch.perturbations[i] = (
            -_DIFFERENCE_FRACTION * amplitude if plan[i] > 0.0 else _DIFFERENCE_FRACTION * amplitude
        )
        copy(candidates[i + 1], 0, plan, len(plan))
        candidates[i + 1, i] += batch.perturbations[i]
    return n_changed + 1


@jit
def fill_newton_candidates(batch, n_moves, amplitude):
    """Put the plan that was nudged, with one step each, into the first lanes; gives the first lane that is left."""
    candidates, scores, margin_excess, weights, plan, differences = batch
    n = min(n_moves, _MAX_CHANGED_INPUTS)
    g, d, slope = np.empty(n), np.zeros(n), np.empty(n)
    free, rows = np.empty(n, np.int64), np.empty(n_moves, np.int64)
    Z, H = np.empty((n_moves, n)), np.empty((n, n))
    max_slope, count = 0.0, 0
    for i in range(n):
        g[i] = (scores[i + 1] - scores[0]) / differences[i]
        if not (abs(plan[i]) >= amplitude and plan[i] * g[i] > 0.0):
            max_slope = max(max_slope, abs(g[i]))
    if not (max_slope > 0.0 and max_slope < np.inf):
        return 0
    for h in range(n_moves):
        if abs(margin_excess[h, 0]) < _MAX_MODELLED_EXCESS:
            rows[count] = h
            for i in range(n):
                Z[count, i] = (margin_excess[h, i + 1] - margin_excess[h, 0]) / differences[i] if i <= h else 0.0
                # The worth has what the margin costs in it; g is without.
                g[i] += 4.0 * MARGIN_COST * weights[h] * max(0.0, margin_excess[h, 0]) ** 3 * Z[count, i]
            count += 1
    for s in range(_N_STEPS):
        damping = max_slope / (amplitude * _MAX_STEP) * _DAMPING_RATIO ** (_N_STEPS - 1 - s)
        for i in range(n):
            slope[i] = g[i] - damping * d[i]
            fill(H[i], 0.0)
            H[i, i] = damping
        for r in range(count):
            z = margin_excess[rows[r], 0]
            for i in range(n):
                z += Z[r, i] * d[i]
            if z > 0.0:
                cost = MARGIN_COST * weights[rows[r]] * z * z
                for i in range(n):
                    slope[i] -= 4.0 * cost * z * Z[r, i]
                    for k in range(i + 1):
                        H[i, k] += 12.0 * cost * Z[r, i] * Z[r, k]
        # What the amplitude holds stays; the others move up to the front.
        m = 0
        for i in range(n):
            moved_input = plan[i] + d[i]
            if not (abs(moved_input) >= amplitude and moved_input * slope[i] > 0.0):
                free[m], slope[m] = i, slope[i]
                for k in range(m + 1):
                    H[m, k] = H[i, free[k]]
                m += 1
        if half_log_det(H[:m, :m]) > -np.inf:
            solve_from_cholesky(H, slope[:m])
            for a in range(m):
                i = free[a]
                d[i] = max(-amplitude, min(plan[i] + d[i] + slope[a], amplitude)) - plan[i]
        copy(candidates[s], 0, plan, len(plan))
        for i in range(n):
            candidates[s, i] = plan[i] + d[i]
    return _N_STEPS
