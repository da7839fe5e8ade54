"""Observations, rewards, priors and ranges of one's own."""

import gymnasium as gym
import numba
import numpy as np
import pytest
from checkers import assert_checkers_are_content
from gymnasium.vector import AutoresetMode
from test_vector_env import BOTH_ENDS, PARAMETERS, play_beside_singles, random_actions, roll_out

from duffing_env.env import DuffingEnv
from duffing_env.own import Beliefs
from duffing_env.vector_env import DuffingVectorEnv
from estimator.models.difference import difference
from estimator.physical import coefficients_of
from estimator.priors import silverbox_prior
from estimator.units import Scales

TRACK = "duffing_env/Amplitude-v0"


def means(beliefs):
    """An observation: what is believed of the coefficients, and the logarithms of their standard deviations."""
    stds = np.sqrt(np.diagonal(beliefs.coefficients_cov, axis1=1, axis2=2))
    return np.concatenate([beliefs.coefficients_mean, np.log(stds)], axis=1)


def gain(before, after, u, y, truth):
    """A reward: the information gain, once more."""
    return 0.5 * (np.linalg.slogdet(before.coefficients_cov)[1] - np.linalg.slogdet(after.coefficients_cov)[1])


def told(before, after, u, y, truth):
    """A reward that uses all it is told."""
    return after.mean[:, 0] + before.noises[:, 0] + u + y + truth.m + truth["b"]


@numba.njit
def compiled(before, after, u, y, truth):
    """The same, for one environment."""
    return after.mean[0] + before.noises[0] + u + y + truth.m + truth.b


OWN = [
    {"observation": "history", "history": 5},
    {"observation": "privileged"},
    {"observation": means, "reward": gain},
    {"reward": told, "input_cost": 0.1},
    {"reward": compiled, "hold": 3},
    {"observation": "history", "history": 3, "hold": 3, "reward": told},
]


@pytest.mark.parametrize("options", OWN, ids=range(len(OWN)))
@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_rows_are_single_environments(mode, options):
    steps = play_beside_singles(5, 80, mode=mode, **BOTH_ENDS, **options)
    ended = np.array([(step[2].sum(), step[3].sum()) for step in steps]).sum(axis=0)
    assert (ended > 3).all()


@pytest.mark.parametrize("options", OWN[:4], ids=range(4))
def test_checkers_of_gymnasium_and_stable_baselines3_do_not_even_warn(options):
    space = gym.make(TRACK, **options).observation_space
    assert space.dtype == np.float32
    assert np.isfinite([space.low, space.high]).all()
    assert_checkers_are_content(lambda: gym.make(TRACK, **options))


def test_the_compiled_reward_is_the_other():
    first, second = (
        roll_out(DuffingVectorEnv(40, reward=reward), random_actions(20, 40)) for reward in (told, compiled)
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


def test_a_sample_that_breaks_the_belief_pays_nothing():
    steps = play_beside_singles(8, 200, max_output=1e300, spread=0.9, horizon=60, reward=told)
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


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"observation": "all"}, r"observation must be one of \['posterior', .*\] or a function, but is 'all'"),
        (
            {"observation": lambda beliefs: beliefs.mean[0]},
            r"observation must give finite numbers of shape \(n, entries\)",
        ),
        ({"observation": lambda beliefs: np.zeros((len(beliefs.mean), 0))}, r"finite numbers of shape \(n, entries\)"),
        ({"history": 0}, "history must be a whole number from 1"),
        (
            {"reward": gain, "terminal": True},
            "terminal and terminated_return must be left out with a reward of one's own",
        ),
        ({"mean": {"k": 1.0}}, r"mean must give some of the parameters \['m', 'c', 'a', 'b'\], but is"),
        ({"mean": {"m": -1.0}}, r"mean\['m'\] must be a number from"),
        ({"prior": 3}, "prior must be an estimator.Belief or None, but is 3"),
        ({"prior": silverbox_prior(difference("linear"))}, "prior must be of the model 'difference.*', but is of"),
    ],
)
def test_bad_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        DuffingEnv(**options)


def test_an_observation_keeps_its_number_of_entries():
    width = 3
    env = DuffingEnv(observation=lambda beliefs: np.zeros((len(beliefs.mean), width)))
    env.reset(seed=0)
    width = 4
    with pytest.raises(ValueError, match="observation must give as many entries every time, but gave 3 at first and 4"):
        env.step([0.5])


@pytest.mark.parametrize("given", [0.0, np.full(3, np.nan), np.zeros((3, 1))], ids=str)
def test_a_reward_that_is_none_is_refused(given):
    envs = DuffingVectorEnv(3, reward=lambda *told: given)
    envs.reset(seed=0)
    with pytest.raises(ValueError, match="reward must give 3 finite numbers for 3 environments, but gave"):
        envs.step(np.zeros((3, 1)))


def test_a_prior_of_ones_own_is_where_episodes_start():
    prior = silverbox_prior()
    steps = play_beside_singles(3, 40, prior=prior, horizon=15)
    assert np.isfinite([step[0] for step in steps]).all()
    env = DuffingEnv(prior=prior)
    env.reset(seed=0)
    np.testing.assert_array_equal(env.belief.record, prior.record)
    mean_field = DuffingEnv(prior=prior, factorisation="mean_field")
    assert mean_field.belief == prior.factorised("mean_field")


def test_oscillators_are_drawn_about_a_mean_of_ones_own():
    usual, moved = (DuffingVectorEnv(200, mean=mean) for mean in (None, {"b": 1.0, "m": 1e-5}))
    usual.reset(seed=0)
    moved.reset(seed=0)
    for name in PARAMETERS:
        low, high = moved.truth[name].min(), moved.truth[name].max()
        middle = {"b": 1.0, "m": 1e-5}.get(name, usual.experiment.center[name])
        assert 0.7 * middle <= low < 0.72 * middle
        assert 1.28 * middle < high <= 1.3 * middle
    means, covs = Beliefs(difference(), moved.records).physical()
    for row in (0, 7):
        mean, cov = moved.belief(row).physical()
        np.testing.assert_allclose(means[row], mean)
        np.testing.assert_allclose(covs[row], cov)
    assert moved.belief(0) != usual.belief(0)


@pytest.mark.parametrize(
    ("track", "name"),
    [
        ("Amplitude-v0", "observation"),
        ("Amplitude-v0", "reward"),
        ("Amplitude-v1", "estimator"),
        ("Rig-v0", "factorisation"),
        ("SilverboxReplay-v0", "nonlinear"),
        ("SilverboxReplay-v0", "data"),
    ],
)
def test_an_array_is_no_name(track, name):
    value = 1.0 if name == "data" else np.ones(3)
    with pytest.raises(ValueError, match=f"{name} must be "):
        gym.make(f"duffing_env/{track}", **{name: value})


def test_what_is_no_seed_and_no_options_is_refused():
    envs = DuffingVectorEnv(3)
    with pytest.raises(ValueError, match="seed must be a whole number or 3 of them"):
        envs.reset(seed=np.array(3))
    with pytest.raises(ValueError, match="options of reset must be a dict or None"):
        envs.reset(options=np.array(3))
