"""Steps of a whole plan: against a plain NumPy reference, and what limits and margins do to them."""

import numpy as np
from tables import table

from agents.planning.newton_steps import empty_candidate_batch, fill_finite_differences, fill_newton_candidates

AMPLITUDE, STEPS, CHANGED = 0.15, 16, 20


def made(rng, horizon, teaching, near_at, sensitivities, weights):
    """A batch whose perturbed plans are scored by a linear information and the margin's cost, and the plan."""
    plan = rng.choice([-1.0, 1.0, 0.3], horizon) * AMPLITUDE
    plan[0] = 0.3 * AMPLITUDE  # one at least is free
    rivals = empty_candidate_batch(horizon)
    last = fill_finite_differences(rivals, plan, horizon, AMPLITUDE)
    assert last == min(horizon, CHANGED) + 1
    moved = rivals.candidates[:last] - plan
    rivals.margin_excess[:, :last] = near_at[:, None] + sensitivities @ moved.T
    rivals.weights[:] = weights
    cost = 0.05 * weights @ np.maximum(rivals.margin_excess[:, :last], 0.0) ** 4
    rivals.scores[:last] = moved @ teaching - cost
    return rivals, plan


def reference(plan, teaching, near_at, sensitivities, weights):
    """The steps (STEPS, n): one after the other an iteration of Newton's, within the amplitude."""
    n = min(len(plan), CHANGED)
    u, g, Z = plan[:n], teaching[:n], sensitivities[:, :n]
    K = 0.05 * weights
    at_plan = g - 4 * (K * np.maximum(near_at, 0.0) ** 3) @ Z
    held = (np.abs(u) >= AMPLITUDE) & (u * at_plan > 0)
    largest = np.abs(at_plan[~held]).max()
    d, found = np.zeros(n), []
    for s in range(STEPS):
        price = largest / (2.0 * AMPLITUDE) * 1.6 ** (STEPS - 1 - s)
        z = np.maximum(near_at + Z @ d, 0.0)
        slope = g - price * d - 4 * (K * z**3) @ Z
        curvature = price * np.eye(n) + 12 * (Z.T * (K * z**2)) @ Z
        free = ~((np.abs(u + d) >= AMPLITUDE) & ((u + d) * slope > 0))
        d = d.copy()
        d[free] += np.linalg.solve(curvature[np.ix_(free, free)], slope[free])
        d = np.clip(u + d, -AMPLITUDE, AMPLITUDE) - u
        found.append(d)
    return np.array(found)


def case(seed, horizon, near_at):
    rng = np.random.default_rng(seed)
    teaching = rng.normal(0.0, 3.0, horizon)
    sensitivities = np.tril(rng.normal(0.0, 40.0, (horizon, horizon)))
    weights = np.arange(horizon, 0, -1) // 8 + 1.0
    near = np.full(horizon, -50.0)  # out of reach
    near[: len(near_at)] = near_at
    rivals, plan = made(rng, horizon, teaching, near, sensitivities, weights)
    return rivals, plan, (teaching, near, sensitivities, weights)


@table("horizon", [1, 7, 40])
@table("seed", range(3))
def test_steps_are_those_of_newton(seed, horizon):
    near = np.random.default_rng(seed + 10).uniform(-3.0, 2.0, min(horizon, 12))
    rivals, plan, derivatives = case(seed, horizon, near)
    assert fill_newton_candidates(rivals, horizon, AMPLITUDE) == STEPS
    n = min(horizon, CHANGED)
    # Differences are of a thousandth of the amplitude, over which the cost's slope changes a bit.
    got, want = rivals.candidates[:STEPS, :n] - plan[:n], reference(plan, *derivatives)
    np.testing.assert_allclose(got, want, atol=0.02 * AMPLITUDE)
    np.testing.assert_array_equal(rivals.candidates[:STEPS, n:], np.tile(plan[n:], (STEPS, 1)))
    assert np.abs(rivals.candidates[:STEPS]).max() <= AMPLITUDE


def test_without_a_margin_a_step_is_as_long_as_its_price_allows():
    rivals, plan, (teaching, *_) = case(3, 20, [])
    assert fill_newton_candidates(rivals, 20, AMPLITUDE) == STEPS
    largest = np.abs(teaching[~((np.abs(plan) >= AMPLITUDE) & (plan * teaching > 0))]).max()
    for s in range(STEPS):
        price = largest / (2.0 * AMPLITUDE) * 1.6 ** (STEPS - 1 - s)
        want = np.clip(plan + teaching / price, -AMPLITUDE, AMPLITUDE)
        np.testing.assert_allclose(rivals.candidates[s], want, atol=1e-9)


def test_a_plan_that_nothing_can_improve_is_left():
    rivals = empty_candidate_batch(5)
    first = fill_finite_differences(rivals, np.full(5, AMPLITUDE), 5, AMPLITUDE)
    rivals.margin_excess[:], rivals.weights[:] = -50.0, 1.0
    rivals.scores[:first] = rivals.candidates[:first].sum(axis=1)  # all would have to be larger
    assert fill_newton_candidates(rivals, 5, AMPLITUDE) == 0


def test_numbers_that_are_not_finite_give_no_steps():
    rivals = empty_candidate_batch(5)
    fill_finite_differences(rivals, np.zeros(5), 5, AMPLITUDE)
    rivals.margin_excess[:], rivals.weights[:], rivals.scores[:] = -50.0, 1.0, np.inf
    rivals.scores[0] = 0.0
    assert fill_newton_candidates(rivals, 5, AMPLITUDE) == 0
