"""Observations, rewards, priors and ranges of one's own."""

import gymnasium as gym
import numba
import numpy as np
import pytest
from playing import assert_refused, random_actions, roll_out
from specimens import all_that_is_given

from duffing_env.belief_arrays import Beliefs
from duffing_env.env import DuffingEnv
from duffing_env.vector_env import DuffingVectorEnv
from estimator.models.difference_equation import difference
from estimator.priors import silverbox_prior
from estimator.rigs.physical_parameters import coefficients_of
from estimator.rigs.units import Scales

PARAMETERS = ("m", "c", "a", "b")


def gain(before, after, u, y, truth):
    """A custom reward that equals the information gain."""
    return 0.5 * (np.linalg.slogdet(before.coefficients_cov)[1] - np.linalg.slogdet(after.coefficients_cov)[1])


@numba.njit
def compiled(before, after, u, y, truth):
    """The same reward, compiled for one environment."""
    return after.mean[0] + before.noises[0] + u + y + truth.m + truth.b


def test_the_compiled_reward_is_the_other():
    first, second = (
        roll_out(DuffingVectorEnv(40, reward=reward), random_actions(20, 40))
        for reward in (all_that_is_given, compiled)
    )
    for one, other in zip(first[1:], second[1:], strict=True):
        np.testing.assert_allclose(one[1], other[1], rtol=1e-15)


def test_a_reward_gets_what_happened():
    seen = []

    def spy(*given):
        seen.append(given)
        return np.zeros(3)

    envs = DuffingVectorEnv(3, reward=spy)
    envs.reset(seed=0)
    for actions in random_actions(4, 3):
        records = envs.records
        observations, *_ = envs.step(actions)
        before, after, u, y, truth = seen[-1]
        np.testing.assert_array_equal(before.records, records)
        np.testing.assert_array_equal(after.records, envs.records)
        np.testing.assert_allclose(u / 0.15, observations[:, 18], rtol=1e-6)
        np.testing.assert_allclose(y / 0.6, observations[:, 19], rtol=1e-6)
        assert truth == envs.truth
        for row in range(3):
            for name in ("mean", "cov", "coefficients_mean", "coefficients_cov", "noises"):
                np.testing.assert_array_equal(getattr(after, name)[row], getattr(envs.belief(row), name))


def test_the_information_gain_once_more():
    theirs, ours = (DuffingVectorEnv(7, reward=reward) for reward in ("information_gain", gain))
    for one, other in zip(
        roll_out(theirs, random_actions(60, 7))[1:], roll_out(ours, random_actions(60, 7))[1:], strict=True
    ):
        np.testing.assert_allclose(other[1], one[1], rtol=0, atol=1e-9)
        np.testing.assert_array_equal(other[0], one[0])


def test_what_is_paid_for_a_held_action_is_for_all_its_samples():
    envs, plain = (DuffingVectorEnv(4, reward=all_that_is_given, hold=hold, horizon=9) for hold in (3, 1))
    envs.reset(seed=0)
    plain.reset(seed=0)
    before = Beliefs(difference(), envs.records)
    actions = random_actions(1, 4)[0]
    _, rewards, *_ = envs.step(actions)
    for _ in range(3):
        observations, *_ = plain.step(actions)
    u, y = 0.15 * observations[:, 18], plain._batch.row_values("Y_y")
    after = Beliefs(difference(), plain.records)
    expected = after.mean[:, 0] + before.noises[:, 0] + u + y + plain.truth.m + plain.truth.b
    np.testing.assert_allclose(rewards, expected, rtol=1e-6)


def test_a_sample_that_breaks_the_belief_pays_nothing():
    envs = DuffingVectorEnv(8, max_output=1e300, spread=0.9, horizon=60, reward=all_that_is_given)
    steps = roll_out(envs, random_actions(200, 8), 7)[1:]
    diverged = np.array([step[4]["diverged"] for step in steps])
    rewards = np.array([step[1] for step in steps])
    assert diverged.sum() > 3
    assert not rewards[diverged].any()
    assert np.isfinite(rewards).all()


def test_history_shows_the_last_inputs_and_outputs():
    plain, env = DuffingEnv(), DuffingEnv(observation="history", history=4)
    shown = [plain.reset(seed=3)[0]]
    first, _ = env.reset(seed=3)
    np.testing.assert_array_equal(first, [0.0] * 8 + [1.0, 1.0])
    for action in random_actions(6, 1)[:, 0]:
        shown.append(plain.step(action)[0])
        seen, *_ = env.step(action)
    expected = np.concatenate([np.array(shown[-4:])[:, 18:20].ravel(), shown[-1][20:]])
    np.testing.assert_array_equal(seen, expected)
    np.testing.assert_array_equal(env.reset()[0], first)


def test_privileged_shows_the_true_coefficients():
    envs = DuffingVectorEnv(5, observation="privileged")
    seen, _ = envs.reset(seed=0)
    prior = envs.belief(0)
    true = coefficients_of(difference(), envs.truth, Scales())
    deviation = (true - prior.coefficients_mean) / np.sqrt(np.diag(prior.coefficients_cov))
    np.testing.assert_allclose(seen[:, 22:], np.clip(deviation, -10, 10), rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(seen[:, :22], DuffingVectorEnv(5).reset(seed=0)[0])


BAD = [
    ({"observation": "all"}, "observation must be one of ['posterior', "),
    ({"observation": "all"}, " or a function, but is 'all'"),
    ({"observation": lambda beliefs: beliefs.mean[0]}, "observation must give finite numbers of shape (n, entries)"),
    ({"observation": lambda beliefs: np.zeros((len(beliefs.mean), 0))}, "finite numbers of shape (n, entries)"),
    ({"history": 0}, "history must be a whole number from 1"),
    ({"reward": gain, "terminal": True}, "terminal and terminated_return must be left out where reward is a function"),
    ({"mean": {"k": 1.0}}, "mean must give some of the parameters ['m', 'c', 'a', 'b'], but is"),
    ({"mean": {"m": -1.0}}, "mean['m'] must be a number from"),
    ({"prior": 3}, "prior must be an estimator.Belief or None, but is 3"),
    ({"prior": silverbox_prior(difference("linear"))}, "prior must be of the model 'difference"),
]
#: Arrays in place of names.
NO_NAMES = [
    ("Amplitude-v0", "observation", np.ones(3)),
    ("Amplitude-v0", "reward", np.ones(3)),
    ("Amplitude-v1", "estimator", np.ones(3)),
    ("Rig-v0", "factorisation", np.ones(3)),
    ("SilverboxReplay-v0", "nonlinear", np.ones(3)),
    ("SilverboxReplay-v0", "data", 1.0),
]


def test_bad_options_are_refused():
    assert_refused((lambda options=options: DuffingEnv(**options), message) for options, message in BAD)
    assert_refused(
        (lambda track=track, given=given: gym.make(f"duffing_env/{track}", **given), f"{name} must be ")
        for track, name, value in NO_NAMES
        for given in ({name: value},)
    )


def test_an_observation_keeps_its_number_of_entries():
    width = 3
    env = DuffingEnv(observation=lambda beliefs: np.zeros((len(beliefs.mean), width)))
    env.reset(seed=0)
    width = 4
    with pytest.raises(
        ValueError, match="observation must always give the same number of entries, but gave 3 at first and 4"
    ):
        env.step([0.5])


def test_a_function_that_is_no_reward_is_refused():
    def step_with(given):
        envs = DuffingVectorEnv(3, reward=lambda *arguments: given)
        envs.reset(seed=0)
        envs.step(np.zeros((3, 1)))

    message = "reward must give 3 finite numbers for 3 environments, but gave"
    assert_refused((lambda given=given: step_with(given), message) for given in (0.0, [np.nan] * 3, np.zeros((3, 1))))


def test_a_prior_of_ones_own_is_where_episodes_start():
    prior = silverbox_prior()
    envs = DuffingVectorEnv(3, prior=prior, horizon=15)
    for observations, *_ in roll_out(envs, random_actions(20, 3)):
        assert np.isfinite(observations).all()
    env = DuffingEnv(prior=prior)
    env.reset(seed=0)
    np.testing.assert_array_equal(env.belief.record, prior.record)
    mean_field = DuffingEnv(prior=prior, factorisation="mean_field")
    assert mean_field.belief == prior.with_factorisation("mean_field")


def test_oscillators_are_drawn_about_a_mean_of_ones_own():
    usual, moved = (DuffingVectorEnv(200, mean=mean) for mean in (None, {"b": 1.0, "m": 1e-5}))
    usual.reset(seed=0)
    moved.reset(seed=0)
    for name in PARAMETERS:
        low, high = moved.truth[name].min(), moved.truth[name].max()
        middle = {"b": 1.0, "m": 1e-5}.get(name, usual.experiment.nominal_parameters[name])
        assert 0.7 * middle <= low < 0.72 * middle
        assert 1.28 * middle < high <= 1.3 * middle
    means, covs = Beliefs(difference(), moved.records).physical()
    for row in (0, 7):
        mean, cov = moved.belief(row).physical()
        np.testing.assert_allclose(means[row], mean)
        np.testing.assert_allclose(covs[row], cov)
    assert moved.belief(0) != usual.belief(0)
