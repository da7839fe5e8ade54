"""The planner: what it imagines against the structured update's twin, its limits, its batches and its goals."""

import sys
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest

import duffing_env
from agents.design import Known, designer
from agents.policies import make_policy
from agents.policies.imagination import LAYOUT, imagine, judge
from agents.policies.planner import Planner
from agents.policies.pursuit import pursuit, record_places
from estimator.lanes import LANES
from estimator.models.difference import difference

sys.path.append(str(Path(__file__).parents[1] / "estimator"))
from twins import Moments, random_prior, structured_step

JOINT = [0, 1, 3, 4, 5, 6]  # of the twin's seven quantities, those that the planner follows
CERTAIN = 1e12  # shape of a noise precision that does not move


def known_noises(prior, q, r):
    return Moments(prior.mean, prior.cov, (CERTAIN, CERTAIN * q), (CERTAIN, CERTAIN * r))


def block_of(beliefs):
    """A block whose lane j holds the j-th belief."""
    W = np.zeros((len(LAYOUT), LANES))
    for j, belief in enumerate(beliefs):
        W[0, j], W[1, j] = belief.mean[:2]
        cov = belief.cov[np.ix_(JOINT, JOINT)]
        W[2:23, j] = cov[np.triu_indices(6)]
    return W


def expected_log_det(belief, u, q, r, walk=(0.0,) * 4):
    """The twin's belief after inputs u whose outputs are as predicted, and ½ log det of its coefficients."""
    for value in u:
        belief = Moments(belief.mean, belief.cov + np.diag([0.0, 0.0, 0.0, *walk]), belief.gamma, belief.xi)
        x, last, _, t1, t2, t3, eta = belief.mean
        y = t1 * x + t2 * x**3 + t3 * last + eta * value
        belief, _ = structured_step(known_noises(belief, q, r), value, y, 1)
    return belief, 0.5 * np.linalg.slogdet(belief.cov[3:, 3:])[1]


def roll_out(track, n, seed=0, steps=None, options=None, **planner):
    """Inputs and outputs (steps, n) [V] of a planner, NaN after an episode's end, and how many ended early."""
    envs = gym.make_vec(track, num_envs=n, vectorization_mode="vector_entry_point", **(options or {}))
    policy = make_policy("efe", envs, seed=seed, **planner)
    observations, _ = envs.reset(seed=0)
    state, start, running = None, np.ones(n, dtype=bool), np.ones(n, dtype=bool)
    inputs, outputs, early = [], [], 0
    for _ in range(steps or envs.unwrapped.horizon):
        actions, state = policy.predict(observations, state, start)
        observations, _, terminated, truncated, _ = envs.step(actions)
        start = terminated | truncated
        inputs.append(np.where(running, envs.unwrapped.max_input * actions[:, 0], np.nan))
        outputs.append(np.where(running, envs.unwrapped.experiment.max_output * observations[:, 19], np.nan))
        early += int((running & terminated).sum())
        running &= ~start
    return np.array(inputs), np.array(outputs), early


@pytest.mark.parametrize(("walk", "to_come"), [((0.0,) * 4, 0.0), ((1e-6, 2e-4, 3e-6, 4e-6), 1.0)])
def test_imagination_is_the_structured_update_of_what_is_expected(walk, to_come):
    rng = np.random.default_rng(0)
    q, r = 0.01**2, 0.02**2
    first = random_prior(rng)
    uniform = (*first.mean[3:], q, r, 0.5, 2.0, *walk, 3.0, 0.1, 4.0)
    u = rng.normal(0.0, 0.1, (6, LANES))
    factor = to_come * np.tril(rng.normal(0.0, 30.0, (4, 4)))
    W = block_of([first] * LANES)
    for inputs in u:
        W[LAYOUT["u"]] = inputs
        imagine(W.reshape(-1), *uniform)
    judge(W.reshape(-1), *factor[np.tril_indices(4)])
    for j in range(0, LANES, 7):
        twin, _ = expected_log_det(first, u[:, j], q, r, walk)
        information = np.linalg.inv(twin.cov[3:, 3:]) + factor @ factor.T
        np.testing.assert_allclose(W[:2, j], twin.mean[:2], rtol=1e-9)
        expected = twin.cov[np.ix_(JOINT, JOINT)][np.triu_indices(6)]
        np.testing.assert_allclose(W[2:23, j], expected, rtol=1e-6, atol=1e-12)
        assert W[LAYOUT["score"], j] + W[LAYOUT["cost"], j] == pytest.approx(
            0.5 * np.linalg.slogdet(information)[1], abs=1e-6
        )


def test_the_cost_is_price_goal_and_what_is_beyond_the_limit():
    rng = np.random.default_rng(1)
    q, r = 0.01**2, 0.02**2
    belief = random_prior(rng)
    W = block_of([belief] * LANES)
    W[LAYOUT["u"]] = 0.1
    imagine(W.reshape(-1), *belief.mean[3:], q, r, 0.05, 2.0, 0.0, 0.0, 0.0, 0.0, 3.0, 0.1, 4.0)
    x, last, _, t1, t2, t3, eta = belief.mean
    predicted = t1 * x + t2 * x**3 + t3 * last + eta * 0.1
    slope = np.array([t1 + 3 * t2 * x**2, t3, 0.0, x, x**3, last, 0.1])
    variance = slope @ belief.cov @ slope + q
    beyond = abs(predicted) + 2.0 * np.sqrt(variance + r) - 0.05
    assert beyond > 0
    expected = 1e4 * beyond / 0.05 + 3.0 * 0.1**2 + 4.0 * ((predicted - 0.1) ** 2 + variance)
    np.testing.assert_allclose(W[LAYOUT["cost"]], expected, rtol=1e-9)


def test_the_worth_of_a_whole_plan_is_what_imagination_says_too():
    # Kalman's separation of state and parameters: -½ log det C_H of the joint recursion is ½ log det(Λ + F).
    rng = np.random.default_rng(2)
    q, r = 0.01**2, 0.02**2
    belief = known_noises(random_prior(rng), q, r)
    found, record, places = designer(difference()), belief.to_record(), record_places()
    mean, start, precision = record[places.mean], np.zeros(found.start_size), np.empty((4, 4))
    pursuit(difference()).begin(mean, record[places.cov], precision, start)
    u = rng.normal(0.0, 0.05, 8)
    value, _ = found.worth(Known(mean[2:].copy(), precision, (q, r)), 1e3, 0.0, start, u, found.memory(8))
    assert value == pytest.approx(-expected_log_det(belief, u, q, r)[1], abs=1e-6)


@pytest.mark.parametrize("track", ["duffing_env/Amplitude-v0", "duffing_env/Power-v0"])
def test_rows_do_not_depend_on_the_batch(track):
    few, _, _ = roll_out(track, 2, seed=3, steps=20)
    many, _, _ = roll_out(track, 5, seed=3, steps=20)
    np.testing.assert_array_equal(few, many[:, :2])


def test_the_seed_is_that_of_the_search():
    first, _, _ = roll_out("duffing_env/Amplitude-v0", 2, seed=3, steps=20)
    assert not np.array_equal(first, roll_out("duffing_env/Amplitude-v0", 2, seed=4, steps=20)[0])


def test_no_limit_is_violated_and_the_inputs_are_at_theirs():
    inputs, outputs, early = roll_out("duffing_env/Short-v0", 64)
    assert early == 0
    assert np.abs(outputs).max() > 0.55
    assert np.abs(inputs).max() <= np.float32(0.15)
    assert np.mean(np.abs(inputs) > 0.149) > 0.7


def test_a_slew_limit_cuts_nothing_that_was_planned():
    inputs, outputs, early = roll_out("duffing_env/Short-v0", 4, options={"max_slew": 0.06})
    changes = np.abs(np.diff(inputs, axis=0, prepend=0.0))
    assert early == 0
    assert changes.max() <= 0.06 * (1 + 1e-6)
    assert np.mean(changes > 0.059) > 0.3
    assert np.abs(outputs).max() > 0.5


def test_the_budget_is_spent_and_not_exceeded():
    inputs, _, early = roll_out("duffing_env/Power-v0", 4)
    assert early == 0
    energy = (inputs**2).sum(axis=0) / (256 * 0.0222**2)
    assert np.all(energy <= 1 + 1e-4)
    assert np.all(energy > 0.98)


def test_under_a_budget_plans_follow_the_differential_equation_too():
    options = {"max_rms": 0.0222, "horizon": 128}
    inputs, _, early = roll_out("duffing_env/Continuous-v0", 4, options=options)
    assert early == 0
    energy = (inputs**2).sum(axis=0) / (128 * 0.0222**2)
    assert np.all(energy <= 1 + 1e-4)
    assert np.all(energy > 0.95)
    # A burst: half of the energy within a third of the time.
    windows = [(inputs[t : t + 43] ** 2).sum(axis=0) for t in range(86)]
    assert np.all(np.max(windows, axis=0) > 0.5 * (inputs**2).sum(axis=0))


def test_looking_ahead_teaches_more_than_myopia_and_a_goal_keeps_still():
    far, _, _ = roll_out("duffing_env/Short-v0", 4, options={"max_output": 0.3})
    _, still, _ = roll_out("duffing_env/Short-v0", 4, goal_std=1e-3)
    _, loud, _ = roll_out("duffing_env/Short-v0", 4)
    assert np.abs(still).max() < 0.2 * np.abs(loud).max()
    cheap, _, _ = roll_out("duffing_env/Short-v0", 4, input_cost=1e6)
    assert np.nanmean(cheap**2) < 0.1 * np.nanmean(far**2)


def test_single_environments_are_planned_for_as_rows_are():
    batch, _, _ = roll_out("duffing_env/Amplitude-v0", 1, steps=10)
    envs = gym.make_vec("duffing_env/Amplitude-v0", num_envs=1, vectorization_mode="vector_entry_point")
    env = gym.make("duffing_env/Amplitude-v0")
    policy, state = make_policy("efe", env), None
    observation, _ = env.reset(seed=duffing_env.batch.spawn_seeds(0, 1)[0])
    for expected in batch[:, 0]:
        action, state = policy.predict(observation, state)
        assert action.shape == (1,)
        assert 0.15 * action[0] == pytest.approx(expected)
        observation, *_ = env.step(action)
    envs.close()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"horizon": 0}, "horizon must be a whole number"),
        ({"rounds": 1.5}, "rounds must be a whole number"),
        ({"risk": 0.0}, "risk must be a probability"),
        ({"input_cost": float("inf")}, "input_cost must be 0 or more and finite"),
        ({"goal_std": 0.0}, "goal_std must be positive"),
        ({"horizn": 3}, "horizn=3 is no option of policy 'efe'"),
    ],
)
def test_errors_name_the_argument(options, words):
    with pytest.raises(ValueError, match=words):
        make_policy("efe", gym.make("duffing_env/Amplitude-v0"), **options)


def test_a_planner_needs_an_environment_of_its_own():
    with pytest.raises(ValueError, match="env must be an environment of duffing_env"):
        make_policy("efe")
    with pytest.raises(ValueError, match="env must be an environment of duffing_env"):
        Planner(SimpleNamespace(max_input=0.1))
    policy = make_policy("efe", gym.make("duffing_env/Amplitude-v0"))
    with pytest.raises(ValueError, match="planner's own 1 environments"):
        policy.predict(np.zeros((3, 22)))


def test_a_plan_of_the_whole_episode_has_neither_goal_nor_cost():
    env = gym.make("duffing_env/Power-v0")
    with pytest.raises(ValueError, match="pass a horizon"):
        make_policy("efe", env, input_cost=1.0)
    assert make_policy("efe", env, horizon=4, input_cost=1.0).horizon == 4
