"""Belief rollouts: against plain NumPy references for three models, their costs, and scores of diverged plans."""

from dataclasses import replace

import numpy as np
import pytest
from reference.plants import DRAG
from tables import table

from agents.planning.belief_rollout import compile_belief_rollout
from agents.planning.d_optimality import NominalSystem, compile_d_optimality
from agents.planning.energy_limited_plan import compile_energy_limited_plan
from agents.planning.plan_objective import PlanObjective
from duffing_env.experiment_config import SimulatedExperiment
from duffing_env.tracks.differential_equation_tracks import ContinuousExperiment
from estimator.belief import Belief
from estimator.compilation.simd import LANES
from estimator.engine.expected_update import DIVERGED_SCORE, compile_expected_update
from estimator.models.difference_equation import difference
from estimator.models.duffing import duffing
from estimator.models.model import Model
from estimator.models.pendulum import PENDULUM
from estimator.priors import weak_prior

DECAY = Model("decay", {"x": "V"}, {"rate": "1"}, noise=("1",), outputs={"y": "x"}, rates=("u - rate*x",))


def duffing_rates(z, p, u):
    """The rates of Eq. (1), and their derivatives by the state and by the coefficients."""
    (x, v), (stiffness, cubic, damping, gain) = z, p
    rates = np.array([v, gain * u - damping * v - stiffness * x - cubic * x**3])
    by_state = np.array([[0.0, 1.0], [-stiffness - 3 * cubic * x**2, -damping]])
    return rates, by_state, np.array([[0.0] * 4, [-x, -(x**3), -v, u]])


def pendulum_rates(z, p, u):
    (q, w), (gravity, friction, torque) = z, p
    rates = np.array([w, torque * u - friction * w - gravity * np.sin(q)])
    by_state = np.array([[0.0, 1.0], [-gravity * np.cos(q), -friction]])
    return rates, by_state, np.array([[0.0] * 3, [-np.sin(q), -w, u]])


def drag_rates(z, p, u):
    (x, v), (stiffness, drag, gain) = z, p
    by_state = np.array([[0.0, 1.0], [-stiffness, -2 * drag * np.abs(v)]])
    return (
        np.array([v, gain * u - stiffness * x - drag * v * np.abs(v)]),
        by_state,
        np.array([[0.0] * 3, [-x, -v * np.abs(v), u]]),
    )


def runge_kutta(slope, start, h):
    """A step of order 4 from ``start``; ``slope(value, stage)`` of stages 0 to 3."""
    k1 = slope(start, 0)
    k2 = slope(start + h / 2 * k1, 1)
    k3 = slope(start + h / 2 * k2, 2)
    return start + h / 6 * (k1 + 2 * k2 + 2 * k3 + slope(start + h * k3, 3))


def integrate(rates, z, p, inputs, steps):
    """A sample: the state by some Runge-Kutta steps, what is linear by one through begin, middle and end.

    The input goes linearly from the first of two numbers to the second. Gives the state, its slopes by state and
    coefficients, and the covariance N that unit white noise brings, of variance 3 in the second rate: Simpson's rule
    over where kicks in the first stage, in the two of the middle, and in the last one lead.
    """
    halves = np.linspace(inputs[0], inputs[1], 2 * steps + 1)  # of steps
    points = [z]
    for s in range(steps):
        u = halves[2 * s + np.array([0, 1, 1, 2])]
        points.append(runge_kutta(lambda at, stage, u=u: rates(at, p, u[stage])[0], points[-1], 1.0 / steps))
    linear = [rates(points[k], p, halves[2 * k])[1:] for k in (0, steps // 2, steps // 2, steps)]
    n, k = len(z), len(p)
    S = runge_kutta(lambda S, i: linear[i][0] @ S + np.hstack([np.zeros((n, n)), linear[i][1]]), np.eye(n, n + k), 1.0)
    kick = np.array([0.0, np.sqrt(3.0)])
    N = np.zeros((n, n))
    for stages, weight in (((0,), 1 / 6), ((1, 2), 4 / 6), ((3,), 1 / 6)):
        moved = runge_kutta(lambda at, i, where=stages: linear[i][0] @ at + kick * (i in where), np.zeros(n), 1.0)
        N += np.outer(moved, moved) / weight
    return points[-1], S, N


def paper_next(z, p, inputs):
    moved = np.array([p[0] * z[0] + p[1] * z[0] ** 3 + p[2] * z[1] + p[3] * inputs[1], z[0]])
    slopes = np.array([[p[0] + 3 * p[1] * z[0] ** 2, p[2], z[0], z[0] ** 3, z[1], inputs[1]], [1.0] + [0.0] * 5])
    return moved, slopes, np.diag([1.0, 0.0])


#: Model, degree of its input, a sample of its motion, and the states that its sensors show.
CASES = {
    "paper": (difference(), 0, paper_next, (0,)),
    "duffing": (duffing(), 1, lambda z, p, u: integrate(duffing_rates, z, p, u, 4), (0,)),
    "drag": (DRAG, 1, lambda z, p, u: integrate(drag_rates, z, p, u, 4), (0,)),
    "pendulum": (PENDULUM, 0, lambda z, p, u: integrate(pendulum_rates, z, p, (u[1], u[1]), 2), (0, 1)),
}


def random_belief(model, rng):
    """A belief near the tracks' beliefs: states at a third of their sizes, coefficients with a few percent."""
    centers = {
        "difference": [1.8, -0.4, -0.93, 0.38],
        "duffing": [0.45, 1.4, 0.07, 0.4],
        "drag": [0.45, 0.2, 0.4],
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
    """The belief's mean and covariance after inputs u (T,) whose outputs are as predicted.

    The last value is the variance that the first sensor's previous output adds to the prediction of its last one.
    """
    model, _, move, seen = CASES[case]
    n = model.n_states
    mean, cov, surprise = belief.mean, belief.cov, 0.0
    gain, spread = np.zeros(len(mean)), 0.0
    for value in u:
        cov = cov + np.diag([*np.zeros(n), *walk])
        inputs = (last, value)
        S = np.eye(len(mean))
        noise = np.zeros_like(cov)
        moved, S[:n], noise[:n, :n] = move(mean[:n], mean[n:], inputs)
        surprise = (S @ gain)[seen[0]] ** 2 * spread
        cov = S @ cov @ S.T + 0.01**2 * noise
        mean = np.concatenate([moved, mean[n:]])
        for k in seen:
            gain_of_k, spread_of_k = cov[:, k] / (cov[k, k] + 0.02**2), cov[k, k] + 0.02**2
            cov = cov - np.outer(gain_of_k, cov[k])
            gain, spread = (gain_of_k, spread_of_k) if k == seen[0] else (gain, spread)
        last = value
    return mean, cov, surprise


def terms(model, **others):
    values = {"amplitude": 0.15, "slew": np.inf, "limit": 10.0, "margin": 2.0, "walk": np.zeros(model.n_coefficients)}
    return PlanObjective(**{**values, "scales": np.ones(model.n_states), **others})


def block_after(model, degree, belief, u, objective, last=0.0):
    """The block of a belief rollout after inputs u (T, LANES), and the rollout."""
    found = compile_belief_rollout(model, degree)
    W = np.zeros(found.size)
    found.load_belief(W, belief.record.copy(), np.array([last, 0.0]))
    for inputs in u:
        W[found.input_row : found.input_row + LANES] = inputs
        found.advance(W, belief.record.copy(), objective)
    return W.reshape(-1, LANES), found


@pytest.mark.parametrize("case", CASES)
@table("walks", [False, True])
def test_a_belief_rollout_equals_the_plain_recursion(case, walks):
    model, degree, *_ = CASES[case]
    rng = np.random.default_rng(0)
    belief = random_belief(model, rng)
    k, n = model.n_coefficients, model.n_states
    walk = walks * (0.01 * np.abs(belief.coefficients_mean)) ** 2
    u = rng.normal(0.0, 0.3, (6, LANES))
    W, found = block_after(model, degree, belief, u, terms(model, walk=walk), last=0.1)
    factor = np.tril(rng.normal(0.0, 30.0, (k, k)))
    place = compile_expected_update(model, degree).layout
    found.evaluate(W.reshape(-1), factor, 0.5)
    for j in range(0, LANES, 11):
        mean, cov, surprise = expected(case, belief, u[:, j], 0.1, walk)
        if not walks and model.n_outputs == 1:
            assert W[place["PENDING_VARIANCE"], j] == pytest.approx(surprise, rel=1e-9)
        np.testing.assert_allclose(W[:n, j], mean[:n], rtol=1e-9)
        upper = np.triu_indices(n + k)
        got = np.empty_like(cov)
        got[upper] = W[n : n + len(upper[0]), j]
        got.T[upper] = got[upper]
        std = np.sqrt(np.diag(cov))
        np.testing.assert_allclose(got / np.outer(std, std), cov / np.outer(std, std), atol=1e-9)
        nats = 0.5 * np.linalg.slogdet(np.linalg.inv(cov[n:, n:]) + 0.25 * factor @ factor.T)[1]
        assert W[place["SCORE"], j] + W[place["COST"], j] == pytest.approx(nats, abs=1e-8)


@pytest.mark.parametrize("case", CASES)
@table("firm", [0.0, 1.0])
@table("limit", [0.05, 0.15])
def test_the_cost_is_price_goal_and_what_is_within_the_margin_or_beyond_the_limit(case, limit, firm):
    model, degree, *_ = CASES[case]
    belief = random_belief(model, np.random.default_rng(1))
    objective = terms(
        model, limit=limit, input_weight=3.0, goal=0.1, goal_weight=4.0, accumulated_noise=5.0, hard_margin=firm
    )
    W, _ = block_after(model, degree, belief, np.full((1, LANES), 0.1), objective)
    place = compile_expected_update(model, degree).layout
    shown, variance = W[place["Y_PRED"], 0], W[place["S_PRED"], 0]
    assert W[place["PENDING_VARIANCE"], 0] == 0.0  # the output before the first sample has been seen
    # The margin contains five times the process noise of a sample, and is at most half of the limit.
    deviation = np.sqrt(variance + 5.0 * 0.01**2)
    within = abs(shown) + min(2.0 * deviation, 0.5 * limit) - limit
    assert within > 0
    yielding = 0.05 * (within / deviation) ** 4 + 1e4 * max(0.0, abs(shown) / limit - 1.0)
    cost = 1e4 * within / limit if firm else yielding
    cost += 3.0 * 0.1**2 + 4.0 * ((shown - 0.1) ** 2 + variance - 0.02**2)
    np.testing.assert_allclose(W[place["COST"]], cost, rtol=1e-9)
    np.testing.assert_allclose(W[place["NEAR"]], (1 - firm) * within / deviation, rtol=1e-9)


@table("reach", [0.0, 0.05, -0.05, 10.0])
def test_the_previous_output_is_compensated_by_a_harder_braking_input(reach):
    model = duffing()
    belief = random_belief(model, np.random.default_rng(1))
    objective = terms(model, limit=1.0, margin=3.0, recoverable_step=reach)
    u = np.stack([np.full(LANES, 0.1), np.linspace(-0.15, 0.15, LANES)])
    W, _ = block_after(model, 0, belief, u, objective)
    place = compile_expected_update(model, 0).layout
    shown, alone, surprise = (W[place[row]] for row in ("Y_PRED", "S_PRED", "PENDING_VARIANCE"))
    assert (surprise > 0).all()
    # The input that brakes hardest is -0.15 where the sensor shows more than 0 and rises with the input.
    hardest = np.where(shown > 0, -0.15, 0.15) * (-1 if reach < 0 else 1)
    spared = np.abs(reach * (u[1] - hardest))
    wide = np.maximum(3.0 * np.sqrt(alone), 3.0 * np.sqrt(alone + surprise) - spared)
    np.testing.assert_allclose(W[place["MARGIN"]], np.minimum(wide, 0.5), rtol=1e-9)
    assert (wide < 0.5).any()


def test_the_score_of_a_whole_plan_equals_the_belief_rollouts():
    # Kalman's separation of state and parameters: -½ log det C_H of the joint recursion is ½ log det(Λ + F).
    model = difference()
    belief = random_belief(model, np.random.default_rng(2))
    found = compile_d_optimality(model)
    precision, start = np.empty((4, 4)), np.zeros(found.start_size)
    compile_energy_limited_plan(model).start_from_belief(belief.record.copy(), precision, start)
    known = NominalSystem(belief.coefficients_mean, precision, (0.01**2, 0.02**2))
    u = np.random.default_rng(3).normal(0.0, 0.05, 8)
    value, _ = found.criterion(known, 1e3, 0.0, start, u, found.workspace(8))
    W, found = block_after(model, 0, belief, np.repeat(u[:, None], LANES, axis=1), terms(model, limit=1e3))
    found.evaluate(W.reshape(-1), np.zeros((4, 4)), 1.0)
    assert value == pytest.approx(W[compile_expected_update(model).layout["SCORE"], 0], abs=1e-6)


def test_a_diverged_plan_is_lost_and_leaves_the_others_unchanged():
    model = difference()
    belief = SimulatedExperiment().prior_belief
    u = np.full((40, LANES), 0.01)
    u[:, 5] = 50.0  # far beyond where the difference equation is stable
    W, found = block_after(model, 0, belief, u, terms(model))
    place = compile_expected_update(model, 0).layout
    found.evaluate(W.reshape(-1), np.zeros((4, 4)), 1.0)
    assert W[place["SCORE"], 5] == DIVERGED_SCORE
    others = np.delete(W[place["SCORE"]], 5)
    np.testing.assert_array_equal(others, others[0])
    assert others[0] > 0


def test_an_output_of_a_fast_oscillation_is_predicted_within_the_noise():
    """Four integration steps are enough and two are not, for 0.6 V with five samples per period and 0.5 mV of noise."""
    stiffness, cubic = 0.9, 3.5
    p, x = np.array([stiffness, cubic, 0.08, 0.54]), np.linspace(-0.6, 0.6, 61)
    v = np.sqrt(np.maximum(0.0, stiffness * (0.6**2 - x**2) + cubic / 2 * (0.6**4 - x**4)))

    def output(state, steps):
        return integrate(duffing_rates, state, p, (0.0, 0.0), steps)[0][0]

    errors = {
        steps: max(abs(output(state, steps) - output(state, 64)) for state in np.stack([x, v], axis=1))
        for steps in (2, 4)
    }
    assert errors[4] < 0.25e-3
    assert errors[2] > 1.5e-3


def test_few_steps_are_enough_to_plan_with():
    """Plans of Eq. (1) gain as much as with sixteen exact steps within 0.06 nat, and differ alike within 0.02."""
    belief, fine = ContinuousExperiment().prior_belief, replace(duffing(), substeps=16)
    u = np.random.default_rng(2).choice([-0.15, 0.15], (24, LANES))
    W, found = block_after(duffing(), 0, belief, u, terms(duffing()))
    found.evaluate(W.reshape(-1), np.zeros((4, 4)), 1.0)
    exact, precision = compile_d_optimality(fine), np.empty((4, 4))
    start, (shape, rate, xi_shape, xi_rate) = np.zeros(exact.start_size), belief.record[-4:]
    compile_energy_limited_plan(fine).start_from_belief(belief.record.copy(), precision, start)
    known = NominalSystem(belief.coefficients_mean, precision, (rate / shape, xi_rate / xi_shape))
    nats = [exact.criterion(known, 1e3, 0.0, start, u[:, j].copy(), exact.workspace(24))[0] for j in range(LANES)]
    errors = W[compile_expected_update(duffing(), 0).layout["SCORE"]] - nats
    assert 0 < np.abs(errors).max() < 0.06
    assert errors.std() < 0.02


def test_older_inputs_move_on():
    model = difference("three-tap")
    rng = np.random.default_rng(3)
    mean = rng.normal(0.0, 0.2, model.n_coefficients)
    belief = weak_prior(model, mean, 1e-4 * np.eye(model.n_coefficients))
    u = rng.normal(0.0, 0.1, (5, LANES))
    for lag in (0, 1):
        found = compile_belief_rollout(model, 0, lag)
        W = np.zeros(found.size)
        found.load_belief(W, belief.record.copy(), np.array([0.3, -0.2]))
        x, before = [0.0, 0.0], [0.3, -0.2]
        for inputs in u:
            W[found.input_row : found.input_row + LANES] = inputs
            found.advance(W, belief.record.copy(), terms(model))
            taps = [inputs[0], *before] if lag == 0 else [*before, before[1]]
            phi = [x[0], x[0] ** 3, x[1], *taps, 1.0]
            x, before = [float(mean @ phi), x[0]], [inputs[0], before[0]]
            np.testing.assert_allclose(W.reshape(-1, LANES)[:2, 0], x, rtol=1e-12)


def test_one_state_is_enough():
    belief = weak_prior(DECAY, [0.5], [[0.01]])
    W, found = block_after(DECAY, 0, belief, np.full((3, LANES), 0.1), terms(DECAY))
    found.evaluate(W.reshape(-1), np.zeros((1, 1)), 1.0)
    assert W[compile_expected_update(DECAY, 0).layout["SCORE"], 0] > -0.5 * np.log(0.01)


@table(("model", "degree", "lag"), [(difference(), 2, 0), (difference(), 0, 2), (duffing(), 1, 1)])
def test_meaningless_arguments_are_refused(model, degree, lag):
    with pytest.raises(ValueError, match="degree and lag must be 0 or 1"):
        compile_expected_update(model, degree, lag)
