"""Imagination: against plain NumPy references for three models, its costs, and what lost numbers are worth."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from agents.planner.design import Known, designer
from agents.planner.imagination import Terms, mind
from agents.planner.pursuit import pursuit
from agents.planner.search import search
from duffing_env.continuous import ContinuousExperiment
from duffing_env.experiment import SimulatedExperiment
from estimator.belief import Belief
from estimator.engine.imagination import LOST, imagination
from estimator.lanes import LANES
from estimator.models.difference import difference
from estimator.models.duffing import duffing
from estimator.models.model import Model
from estimator.models.pendulum import PENDULUM
from estimator.priors import weak_prior

DECAY = Model("decay", {"x": "V"}, {"rate": "1"}, noise=("1",), outputs={"y": "x"}, rates=("u - rate*x",))


def duffing_rates(z, p, u):
    """The rates of Eq. (1), and their derivatives by the state."""
    (x, v), (stiffness, cubic, damping, gain) = z, p
    rates = np.array([v, gain * u - damping * v - stiffness * x - cubic * x**3])
    return rates, np.array([[0.0, 1.0], [-stiffness - 3 * cubic * x**2, -damping]])


def pendulum_rates(z, p, u):
    (q, w), (gravity, friction, torque) = z, p
    rates = np.array([w, torque * u - friction * w - gravity * np.sin(q)])
    return rates, np.array([[0.0, 1.0], [-gravity * np.cos(q), -friction]])


def integrate(rates, z, p, inputs):
    """State and covariance N that unit white noise brings, by two Runge-Kutta steps of a sample.

    The input goes linearly from the first of two numbers to the second; N' = A N + N Aᵀ + diag(0, 3).
    """

    def slope(both, u):
        move, A = rates(both[:2], p, u)
        N = both[2:].reshape(2, 2)
        return np.concatenate([move, (A @ N + N @ A.T + np.diag([0.0, 3.0])).ravel()])

    both = np.concatenate([z, np.zeros(4)])
    for s in range(2):
        u = [inputs[0] + (s + part) / 2 * (inputs[1] - inputs[0]) for part in (0.0, 0.5, 1.0)]
        k1 = slope(both, u[0])
        k2 = slope(both + k1 / 4, u[1])
        k3 = slope(both + k2 / 4, u[1])
        k4 = slope(both + k3 / 2, u[2])
        both = both + (k1 + 2 * k2 + 2 * k3 + k4) / 12
    return both[:2], both[2:].reshape(2, 2)


def paper_next(z, p, inputs):
    moved = np.array([p[0] * z[0] + p[1] * z[0] ** 3 + p[2] * z[1] + p[3] * inputs[1], z[0]])
    return moved, np.diag([1.0, 0.0])


def slopes(move, z, p, inputs):
    """∂(next state)/∂(state, coefficients), by central differences."""
    both, columns = np.concatenate([z, p]), []
    for i in range(len(both)):
        h = 1e-5 * max(1.0, abs(both[i]))
        up, down = both.copy(), both.copy()
        up[i] += h
        down[i] -= h
        ends = [move(b[: len(z)], b[len(z) :], inputs)[0] for b in (up, down)]
        columns.append((ends[0] - ends[1]) / (2 * h))
    return np.array(columns).T


#: Model, degree of its input, a sample of its motion, and the states that its sensors show.
CASES = {
    "paper": (difference(), 0, paper_next, (0,)),
    "duffing": (duffing(), 1, lambda z, p, u: integrate(duffing_rates, z, p, u), (0,)),
    "pendulum": (PENDULUM, 0, lambda z, p, u: integrate(pendulum_rates, z, p, (u[1], u[1])), (0, 1)),
}


def random_belief(model, rng):
    """A belief near those of the tracks: states a third of their sizes, coefficients with a few percent."""
    centers = {
        "difference": [1.8, -0.4, -0.93, 0.38],
        "duffing": [0.45, 1.4, 0.07, 0.4],
        "pendulum": [0.037, 0.002, 0.0075],
    }
    n, mean = model.n_states, np.array(centers[model.name])
    scale = np.concatenate([np.full(n, 0.02), 0.03 * np.abs(mean)])
    factor = np.eye(len(scale)) + 0.3 * np.tril(rng.normal(0, 1, (len(scale), len(scale))), -1)
    cov = np.outer(scale, scale) * (factor @ factor.T)
    state = rng.uniform(0.1, 0.3, n) * [1, *([0.5] * (n - 1))]
    xi = [(3.0, 3.0 * 0.02**2)] * model.n_outputs
    return Belief.of(model, np.concatenate([state, mean]), cov, (2.0, 2.0 * 0.01**2), xi)


def expected(case, belief, u, last, walk):
    """The belief's mean and covariance after inputs u (T,) whose outputs are as predicted."""
    model, _, move, seen = CASES[case]
    n = model.n_states
    mean, cov = belief.mean, belief.cov
    for value in u:
        cov = cov + np.diag([*np.zeros(n), *walk])
        inputs = (last, value)
        S = np.eye(len(mean))
        S[:n] = slopes(move, mean[:n], mean[n:], inputs)
        noise = np.zeros_like(cov)
        moved, noise[:n, :n] = move(mean[:n], mean[n:], inputs)
        cov = S @ cov @ S.T + 0.01**2 * noise
        mean = np.concatenate([moved, mean[n:]])
        for k in seen:
            gain = cov[:, k] / (cov[k, k] + 0.02**2)
            cov = cov - np.outer(gain, cov[k])
        last = value
    return mean, cov


def terms(model, **others):
    values = {"amplitude": 0.15, "slew": np.inf, "limit": 10.0, "margin": 2.0, "walk": np.zeros(model.n_coefficients)}
    return Terms(**{**values, "scales": np.ones(model.n_states), **others})


def block_after(model, degree, belief, u, told, last=0.0):
    """The block of a mind after inputs u (T, LANES), and the mind."""
    found = mind(model, degree)
    W = np.zeros(found.size)
    found.fill(W, belief.record.copy(), np.array([last, 0.0]))
    for inputs in u:
        W[found.u : found.u + LANES] = inputs
        found.advance(W, belief.record.copy(), told)
    return W.reshape(-1, LANES), found


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("walks", [False, True])
def test_imagination_is_the_plain_recursion(case, walks):
    model, degree, *_ = CASES[case]
    rng = np.random.default_rng(0)
    belief = random_belief(model, rng)
    k, n = model.n_coefficients, model.n_states
    walk = walks * (0.01 * np.abs(belief.coefficients_mean)) ** 2
    u = rng.normal(0.0, 0.3, (6, LANES))
    W, found = block_after(model, degree, belief, u, terms(model, walk=walk), last=0.1)
    factor = np.tril(rng.normal(0.0, 30.0, (k, k)))
    place = imagination(model, degree).layout
    found.appraise(W.reshape(-1), factor, 0.5)
    for j in range(0, LANES, 11):
        mean, cov = expected(case, belief, u[:, j], 0.1, walk)
        np.testing.assert_allclose(W[:n, j], mean[:n], rtol=1e-9)
        upper = np.triu_indices(n + k)
        got = np.empty_like(cov)
        got[upper] = W[n : n + len(upper[0]), j]
        got.T[upper] = got[upper]
        # The reference's slopes are differences of second order.
        std = np.sqrt(np.diag(cov))
        np.testing.assert_allclose(got / np.outer(std, std), cov / np.outer(std, std), atol=1e-6)
        nats = 0.5 * np.linalg.slogdet(np.linalg.inv(cov[n:, n:]) + 0.25 * factor @ factor.T)[1]
        assert W[place["SCORE"], j] + W[place["COST"], j] == pytest.approx(nats, abs=1e-5)


@pytest.mark.parametrize("firm", [0.0, 1.0])
@pytest.mark.parametrize("limit", [0.05, 0.15])
@pytest.mark.parametrize("case", CASES)
def test_the_cost_is_price_goal_and_what_is_within_the_margin_or_beyond_the_limit(case, limit, firm):
    model, degree, *_ = CASES[case]
    belief = random_belief(model, np.random.default_rng(1))
    told = terms(model, limit=limit, price=3.0, goal=0.1, goal_weight=4.0, shaken=5.0, firm=firm)
    W, _ = block_after(model, degree, belief, np.full((1, LANES), 0.1), told)
    place = imagination(model, degree).layout
    shown, variance = W[place["SHOWN"], 0], W[place["SPREAD"], 0]
    # Five times what process noise does in a sample comes to it; but at most half of the limit is kept from it.
    deviation = np.sqrt(variance + 5.0 * 0.01**2)
    within = abs(shown) + min(2.0 * deviation, 0.5 * limit) - limit
    assert within > 0
    yielding = 0.05 * (within / deviation) ** 4 + 1e4 * max(0.0, abs(shown) / limit - 1.0)
    cost = 1e4 * within / limit if firm else yielding
    cost += 3.0 * 0.1**2 + 4.0 * ((shown - 0.1) ** 2 + variance - 0.02**2)
    np.testing.assert_allclose(W[place["COST"]], cost, rtol=1e-9)


def test_the_worth_of_a_whole_plan_is_what_imagination_says_too():
    # Kalman's separation of state and parameters: -½ log det C_H of the joint recursion is ½ log det(Λ + F).
    model = difference()
    belief = random_belief(model, np.random.default_rng(2))
    found = designer(model)
    precision, start = np.empty((4, 4)), np.empty(found.start_size)
    pursuit(model).begin(belief.record.copy(), precision, start)
    known = Known(belief.coefficients_mean, precision, (0.01**2, 0.02**2))
    u = np.random.default_rng(3).normal(0.0, 0.05, 8)
    value, _ = found.worth(known, 1e3, 0.0, start, u, found.memory(8))
    W, found = block_after(model, 0, belief, np.repeat(u[:, None], LANES, axis=1), terms(model, limit=1e3))
    found.appraise(W.reshape(-1), np.zeros((4, 4)), 1.0)
    assert value == pytest.approx(W[imagination(model).layout["SCORE"], 0], abs=1e-6)


def test_what_has_blown_up_is_lost_and_leaves_the_other_plans_alone():
    model = difference()
    belief = SimulatedExperiment().believed
    u = np.full((40, LANES), 0.01)
    u[:, 5] = 50.0  # far beyond where the difference equation is stable
    W, found = block_after(model, 0, belief, u, terms(model))
    place = imagination(model, 0).layout
    found.appraise(W.reshape(-1), np.zeros((4, 4)), 1.0)
    assert W[place["SCORE"], 5] == LOST
    others = np.delete(W[place["SCORE"]], 5)
    np.testing.assert_array_equal(others, others[0])
    assert others[0] > 0


def test_two_runge_kutta_steps_are_enough_to_plan_with(monkeypatch):
    """The nats of plans of Eq. (1) are those with sixteen steps within 0.03, and their differences within 0.01."""
    model = replace(duffing(), substeps=16)
    belief = ContinuousExperiment().believed
    u = np.random.default_rng(2).choice([-0.15, 0.15], (24, LANES))
    scores = []
    for substeps in (2, 16):
        monkeypatch.setattr("estimator.engine.imagination.SUBSTEPS", substeps)
        asked = model if substeps == 16 else duffing()
        W, found = block_after(asked, 1, belief, u, terms(asked))
        found.appraise(W.reshape(-1), np.zeros((4, 4)), 1.0)
        scores.append(W[imagination(asked, 1).layout["SCORE"]])
    errors = scores[0] - scores[1]
    assert 0 < np.abs(errors).max() < 0.03
    assert errors.std() < 0.01


def test_older_inputs_move_on():
    model = difference("three-tap")
    rng = np.random.default_rng(3)
    mean = rng.normal(0.0, 0.2, model.n_coefficients)
    belief = weak_prior(model, mean, 1e-4 * np.eye(model.n_coefficients))
    u = rng.normal(0.0, 0.1, (5, LANES))
    for lag in (0, 1):
        found = mind(model, 0, lag)
        W = np.zeros(found.size)
        found.fill(W, belief.record.copy(), np.array([0.3, -0.2]))
        x, before = [0.0, 0.0], [0.3, -0.2]
        for inputs in u:
            W[found.u : found.u + LANES] = inputs
            found.advance(W, belief.record.copy(), terms(model))
            taps = [inputs[0], *before] if lag == 0 else [*before, before[1]]
            phi = [x[0], x[0] ** 3, x[1], *taps, 1.0]
            x, before = [float(mean @ phi), x[0]], [inputs[0], before[0]]
            np.testing.assert_allclose(W.reshape(-1, LANES)[:2, 0], x, rtol=1e-12)


def test_one_state_is_enough():
    belief = weak_prior(DECAY, [0.5], [[0.01]])
    W, found = block_after(DECAY, 0, belief, np.full((3, LANES), 0.1), terms(DECAY))
    found.appraise(W.reshape(-1), np.zeros((1, 1)), 1.0)
    assert W[imagination(DECAY, 0).layout["SCORE"], 0] > -0.5 * np.log(0.01)


@pytest.mark.parametrize(("model", "degree", "lag"), [(difference(), 2, 0), (difference(), 0, 2), (duffing(), 1, 1)])
def test_what_has_no_meaning_is_refused(model, degree, lag):
    with pytest.raises(ValueError, match="degree and lag must be 0 or 1"):
        imagination(model, degree, lag)


@pytest.mark.parametrize("left", [4, 200])
def test_no_plan_of_whole_pushes_is_worth_more_than_the_one_that_is_found(left):
    case, horizon = "paper", 4
    model = CASES[case][0]
    # What is known after one move, two and four counts; a plan to the end is worth what is known there.
    weights = np.array([1.0, 1.0, 0.0, 1.0]) if left > horizon else np.array([0.0, 0.0, 0.0, 1.0])
    for seed in range(4):
        rng = np.random.default_rng(seed)
        belief = random_belief(model, rng)
        rate = 0.1 * np.linalg.inv(belief.coefficients_cov)
        rates, plans, words = rate[None].copy(), np.zeros((1, horizon)), rng.integers(1, 2**63, (1, 4), dtype=np.uint64)
        arguments = belief.record[None].copy(), np.array([left]), horizon, 60, terms(model), np.zeros((1, 2))
        search(model).plan(*arguments, plans, rates, words, np.empty(1), np.empty(1, dtype=np.int64))

        def worth(inputs, belief=belief, rate=rate):
            known = []
            for t in range(horizon):
                cov = expected(case, belief, inputs[: t + 1], 0.0, np.zeros(4))[1][2:, 2:]
                known.append(0.5 * np.linalg.slogdet(np.linalg.inv(cov) + (left - t - 1) * rate)[1])
            return weights @ known

        best = max(worth(inputs) for inputs in itertools.product((-0.15, 0.0, 0.15), repeat=horizon))
        assert worth(plans[0]) >= best - 1e-4
