"""Newton steps on a whole plan of inputs, with the cost of leading near the limit in their model.

Near a limit, every change of one input alone makes a plan worse: all later outputs lead beyond the limit, or away from
it. So the first inputs u of a plan change together, by a model of its score,

    J(u + d) ≈ J(u) + gᵀ d - K Σ_h w_h [max(0, z_h + Z_hᵀ d)⁴ - max(0, z_h)⁴] - ½ λ |d|²

with z_h the standard deviations by which the output of move h is within its margin (`agents.planning.belief_rollout`),
Z_h its derivative, w_h the discount's weight, and g the derivative of the information. Derivatives are finite
differences: each lane of a block rolls out the plan with one input perturbed. The smaller λ, the longer the step. For
one λ after another, the next step is the last one after one more Newton iteration, within the largest input. The steps
are then evaluated.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from agents.planning.belief_rollout import MARGIN_COST
from agents.planning.d_optimality import half_log_det, solve_from_cholesky
from estimator.compilation.array_operations import copy, fill
from estimator.compilation.simd import LANES, jit

#: First inputs of a plan that change together; later ones are planned anew before they are played.
_MAX_CHANGED_INPUTS = 20

#: Number of steps.
_N_STEPS = 16

#: Ratio of λ from step to step.
_DAMPING_RATIO = 1.6

#: Step that g alone takes with the last λ, in parts of the largest input.
_MAX_STEP = 2.0

#: Perturbation of an input for finite differences, in parts of the largest.
_DIFFERENCE_FRACTION = 1e-3

#: Standard deviations from the margin beyond which outputs are left out of the model.
_MAX_MODELLED_EXCESS = 12.0


class CandidateBatch(NamedTuple):
    """Candidate plans, one in each lane, and their evaluation.

    Attributes:
        candidates: (LANES, horizon) the plans.
        scores: (LANES,) of the plans [nats].
        margin_excess: (horizon, LANES) standard deviations by which a move's output is within its margin.
        weights: (horizon,) of the discount.
        plan: (horizon,) the plan that was perturbed.
        perturbations: (`_MAX_CHANGED_INPUTS`,) of its inputs; lane i + 1 has input i perturbed.
    """

    candidates: Any
    scores: Any
    margin_excess: Any
    weights: Any
    plan: Any
    perturbations: Any


@jit
def empty_candidate_batch(horizon):
    """Memory for plans of ``horizon`` moves."""
    candidates, margin_excess = np.empty((LANES, horizon)), np.empty((horizon, LANES))
    return CandidateBatch(
        candidates, np.empty(LANES), margin_excess, np.empty(horizon), np.empty(horizon), np.empty(_MAX_CHANGED_INPUTS)
    )


@jit
def fill_finite_differences(batch, plan, n_moves, amplitude):
    """Put the plan into the first lane, and copies with one input perturbed towards 0 into the lanes after it.

    Returns the first free lane.
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
    """Put the perturbed plan after each of the steps into the first lanes; return the first free lane."""
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
                # The score contains the cost of the margin; g does not.
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
        # Inputs held by the amplitude limit stay; the free ones are packed to the front.
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
