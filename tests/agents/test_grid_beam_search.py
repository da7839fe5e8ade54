"""The best path through the grid of states, and the width of the beam."""

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from agents.evaluation.track_batch import make_track_batch
from agents.planning.grid_beam_search import (
    _N_BISECTIONS,
    _PRUNE_GAP,
    SearchProblem,
    compile_grid_beam_search,
    score_threshold,
)
from agents.planning.plan_mutations import INPUT_FRACTIONS, next_uniform
from agents.planning.plan_objective import objective_at
from agents.policies import make_policy
from estimator.belief import covariance_indices
from estimator.compilation.simd import LANES
from estimator.engine.expected_update import DIVERGED_SCORE


@settings(deadline=None)
@given(arrays(float, st.integers(1, 200), elements=st.floats(-1.0, 1.0)), st.integers(1, 64))
def test_the_beam_keeps_no_more_paths_than_its_width(scores, most):
    enough = score_threshold(scores, most)
    assert scores.max() - _PRUNE_GAP <= enough <= scores.max()
    followed = np.sum(scores >= enough)
    assert followed <= most or enough == scores.max()
    # A bit lower there would be too many, unless all that are not hopeless have a place.
    lower = np.sum(scores >= enough - 1.01 * _PRUNE_GAP * 0.5**_N_BISECTIONS)
    assert lower > most or np.sum(scores >= scores.max() - _PRUNE_GAP) <= most


def test_lost_paths_are_kept_when_there_are_no_others():
    assert score_threshold(np.full(5, DIVERGED_SCORE), 3) == DIVERGED_SCORE


def test_the_beam_keeps_the_best_paths():
    scores = np.random.default_rng(0).permutation(np.arange(400) * 1e-3)
    np.testing.assert_array_equal(
        np.sort(scores[scores >= score_threshold(scores, 96)])[-90:], np.arange(310, 400) * 1e-3
    )


@pytest.mark.parametrize("seed", range(2))
def test_the_best_path_equals_plain_numpy(seed):
    envs = make_track_batch("duffing_env/Output-v0", 1, {})
    actions = np.random.default_rng(seed).choice([-0.4, 0.4], (24, 1, 1)).astype(np.float32)
    envs.reset(seed=seed)
    for action in actions:
        envs.step(action)
    planner = make_policy("efe", envs)
    terms, belief = objective_at(planner.objective, 60), envs.belief(0)
    rate = 1e-3 * np.linalg.inv(belief.coefficients_cov)
    lasts = terms.amplitude * actions[:-3:-1, 0, 0].astype(float)
    sizes = 30, 3, 5, LANES, LANES // 4
    task = SearchProblem(belief.record, 60, 14, 1, terms, lasts, np.linalg.cholesky(rate), *sizes, np.nan, 1.0)
    stream = np.random.SFC64(seed).state["state"]["state"]
    found = np.zeros(14)
    best_way(planner.model_view)(task, found, stream.copy())
    np.testing.assert_allclose(found, reference(belief, task, stream.copy()), atol=1e-15)


def best_way(view):
    """The beam search, for callers in Python."""
    memory, find = compile_grid_beam_search(*view)
    return numba.njit(lambda task, found, words: find(memory(task.n_moves, task.beam_width), task, found, words))


def reference(belief, task, words):
    """The best path through the grid of states of Eq. (2), with matrices and path by path."""
    terms, L = task.objective, task.objective.limit
    theta, offsets = belief.coefficients_mean, (next_uniform(words), next_uniform(words))
    q, r = belief.noises[1] / belief.noises[0], belief.noises[3] / belief.noises[2]

    def sample(z, P, u, gain, variance):
        moved = np.array([theta @ [z[0], z[0] ** 3, z[1], u], z[0]])
        S = np.eye(6)
        S[0] = [theta[0] + 3 * theta[1] * z[0] ** 2, theta[2], z[0], z[0] ** 3, z[1], u]
        S[1] = [1, 0, 0, 0, 0, 0]
        P = S @ P @ S.T
        P[0, 0] += q
        shaken = max((S @ gain)[0] ** 2 * variance, terms.accumulated_noise * q)
        variance = P[0, 0] + r
        gain, deviation = P[:, 0] / variance, np.sqrt(variance + shaken)
        # The compensation by braking harder than planned.
        spared = terms.recoverable_step * (terms.amplitude + u if moved[0] > 0 else terms.amplitude - u)
        margin = max(terms.margin * np.sqrt(variance), terms.margin * deviation - spared)
        near = max(0.0, abs(moved[0]) + min(margin, 0.5 * L) - L) / deviation
        cost = 1e4 / L * max(0.0, abs(moved[0]) - L) + 0.05 * near**4
        return moved, P - np.outer(gain, P[0]), gain, variance, cost

    def cell(z):
        where = [(z[i] / terms.scales[i] + 1) / 2 * (task.cells - 1) + offsets[i] for i in range(2)]
        return tuple(int(np.clip(w, 0, task.cells - 1)) for w in where)

    P = belief.record[covariance_indices(belief.model)]
    followed = [(belief.state_mean, P, np.zeros(6), 0.0, 0.0, [])]
    for h in range(task.n_moves):
        tried = (
            INPUT_FRACTIONS
            if h < task.n_moves_all_inputs
            else INPUT_FRACTIONS[:5]
            if h < task.n_moves_some_inputs
            else INPUT_FRACTIONS[:2]
        )
        entered = {}
        # In the order of the blocks, of which the first that leads into a cell and the first of equal ways count.
        for block in range(0, len(followed), LANES):
            for part in tried:
                for z, C, gain, variance, cost, inputs in followed[block : block + LANES]:
                    u = part * terms.amplitude
                    to, D, gained, spread, price = sample(z, C, u, gain, variance)
                    to_come = max(0, task.samples_left - h - 1) * task.information_factor @ task.information_factor.T
                    known = 0.5 * np.linalg.slogdet(np.linalg.inv(D[2:, 2:]) + to_come)[1]
                    score = known - cost - price
                    if score > entered.get(cell(to), (-np.inf,))[0]:
                        entered[cell(to)] = score, (to, D, gained, spread, cost + price, [*inputs, u])
        most = task.beam_width if h < task.n_moves_some_inputs else task.far_beam_width
        enough = score_threshold(np.array([score for score, _ in entered.values()]), most)
        kept = [found for found in entered.values() if found[0] >= enough][:most]
        followed = [way for _, way in kept]
    return followed[int(np.argmax([score for score, _ in kept]))][-1]
