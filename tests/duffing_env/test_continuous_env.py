"""The tracks on Eq. (1): against their twin, and what its docstring promises."""

import copy
import pickle

import gymnasium as gym
import numba
import numpy as np
import pytest
from checkers import assert_checkers_are_content
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from twin import TwinContinuousEnv, assert_env_follows_twin, to_rates

from duffing_env.batch import spawn_seeds
from duffing_env.continuous import ContinuousEnv
from duffing_env.rewards import REWARDS
from duffing_env.vector_env import ContinuousVectorEnv
from estimator.belief import Belief

TRACK = "duffing_env/Amplitude-v1"
# Random inputs end about half of such episodes at the limit, the others at the horizon.
BOTH_ENDS = {"horizon": 20, "max_output": 0.2}
ESTIMATORS = [
    {"estimator": "ode"},
    {"estimator": "nlarx"},
    {"estimator": "nlarx", "factorisation": "mean_field"},
]


def random_actions(steps, rows, seed=0):
    return np.random.default_rng(seed).uniform(-1.2, 1.2, (steps, rows, 1)).astype(np.float32)


def test_the_fisher_information_is_refused_to_an_equation_that_the_plant_does_not_obey():
    with pytest.raises(ValueError, match="reward must not be 'fisher' for estimator='nlarx'"):
        ContinuousEnv(reward="fisher", estimator="nlarx")


#: Left to the evidence, because a kernel is seconds of compilation: what a free energy and a free run are is tested on
#: the difference equation, and so is what rewards read of its beliefs.
EVIDENCE = {"ode": ("free_energy", "simulation_error", "fisher", "expected_free_energy")}
EVIDENCE["nlarx"] = EVIDENCE["ode"]
PAIRS = [
    pytest.param(options, reward, marks=[pytest.mark.slow] * (reward in EVIDENCE[options["estimator"]]))
    for options in ESTIMATORS
    for reward in REWARDS
    if not (reward == "fisher" and options["estimator"] == "nlarx")  # refused, as tested above
]


@pytest.mark.parametrize(("options", "reward"), PAIRS, ids=str)
def test_env_follows_its_twin(options, reward):
    options = {**options, "horizon": 60}
    env = ContinuousEnv(reward=reward, **options)
    assert assert_env_follows_twin(env, TwinContinuousEnv(3, **options), reward, 3) == [(False, True)] * 2


@pytest.mark.parametrize(
    "options",
    [
        pytest.param({"horizon": 7, "iterations": 1}, marks=pytest.mark.slow),  # a kernel of its own
        {"max_output": 0.15, "horizon": 64},
        {"max_input": 0.03, "process_noise": 2e-3, "measurement_noise": 1e-5, "horizon": 64},
        pytest.param({"spread": 0.8, "iterations": 5, "horizon": 64}, marks=pytest.mark.slow),
    ],
    ids=str,
)
def test_env_follows_its_twin_with_other_options(options):
    endings = assert_env_follows_twin(ContinuousEnv(**options), TwinContinuousEnv(1, **options), "information_gain", 1)
    assert len(endings) == 2


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_rows_are_single_environments(mode):
    envs = ContinuousVectorEnv(5, autoreset_mode=mode, **BOTH_ENDS)
    singles = SyncVectorEnv([lambda: ContinuousEnv(**BOTH_ENDS)] * 5, autoreset_mode=mode)
    observations, _ = envs.reset(seed=7)
    expected, _ = singles.reset(seed=spawn_seeds(7, 5))
    np.testing.assert_array_equal(observations, expected)
    ended = np.zeros(2, dtype=int)
    for actions in random_actions(100, 5):
        told, expected = envs.step(actions), singles.step(actions)
        for mine, theirs in zip(told[:4], expected[:4], strict=True):
            np.testing.assert_array_equal(mine, theirs)
        ended += told[2].sum(), told[3].sum()
        finished = told[2] | told[3]
        endings = told[4]["final_info"] if finished.any() and mode == AutoresetMode.SAME_STEP else told[4]
        for row in np.flatnonzero(finished):
            assert isinstance(endings["belief"][row], Belief)
            if mode != AutoresetMode.SAME_STEP:  # there the single environment is in its next episode already
                assert endings["belief"][row] == singles.envs[row].belief
                assert endings["truth"][row] == singles.envs[row].truth
        if mode == AutoresetMode.DISABLED and finished.any():
            envs.reset(options={"reset_mask": finished})
            singles.reset(options={"reset_mask": finished})
    assert (ended > 3).all()


@pytest.mark.parametrize("options", ESTIMATORS, ids=str)
def test_rows_do_not_depend_on_their_number_nor_on_threads(options):
    actions = random_actions(50, 70)
    # Blocks are dealt to threads in one way for all estimators; every parallel kernel is seconds of compilation.
    threads = min(2, numba.config.NUMBA_NUM_THREADS) if options["estimator"] == "ode" else 1
    batches = [(70, 1), (70, threads), (33, 1)]
    told = []
    for rows, n in batches:
        envs = ContinuousVectorEnv(rows, threads=n, **BOTH_ENDS, **options)
        told.append([envs.reset(seed=5)[0], *(part for each in actions for part in envs.step(each[:rows])[:4])])
    for one, two, fewer in zip(*told, strict=True):
        np.testing.assert_array_equal(one, two)
        np.testing.assert_array_equal(one[:33], fewer)


def test_the_plant_does_not_depend_on_the_estimator():
    outputs = []
    for options in ESTIMATORS:
        envs = ContinuousVectorEnv(4, **options)
        envs.reset(seed=0)
        told = []
        for actions in random_actions(40, 4):
            envs.step(actions)
            told.append(envs._batch.quantity("Y_y"))
        outputs.append(told)
    np.testing.assert_array_equal(outputs[0], outputs[1])
    np.testing.assert_array_equal(outputs[0], outputs[2])


@pytest.mark.parametrize("options", ESTIMATORS, ids=str)
def test_checkers_of_gymnasium_and_stable_baselines3_do_not_even_warn(options):
    assert_checkers_are_content(lambda: gym.make(TRACK, **{"noise_hypotheses": 1, **options}))


def test_the_first_observation_says_that_nothing_is_known_yet():
    env = gym.make(TRACK)
    observation, _ = env.reset(seed=0)
    np.testing.assert_allclose(observation[[*range(8), *range(14, 20)]], 0.0, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(observation[20:], 1.0)


def test_gains_sum_to_the_change_of_the_belief():
    env = ContinuousEnv(reward="parameter_error", horizon=100)
    prior = env.belief
    for seed in range(5):
        env.reset(seed=seed)
        steps = [env.step(action) for action in random_actions(100, 1, seed)]
        final, truth = env.belief, env.truth
        gained = sum(step[4]["information_gain"] for step in steps)
        assert gained == pytest.approx(prior.entropy() - final.entropy(), rel=1e-9)
        told = sum(step[4]["log_posterior_gain"] for step in steps)
        coefficients = to_rates(truth)
        assert told == pytest.approx(final.log_prob(coefficients) - prior.log_prob(coefficients), rel=1e-7)
        true = np.array([truth.m, truth.c, truth.a, truth.b])
        error = [np.minimum(np.abs(belief.physical()[0] / true - 1), 1).mean() for belief in (prior, final)]
        assert sum(step[1] for step in steps) == pytest.approx(error[0] - error[1], abs=1e-9)


def test_beliefs_are_calibrated_and_those_of_the_difference_equation_are_not():
    # 200 episodes: the squared distance of the truth from the mean, in standard deviations, is 4 on average.
    distances = {}
    for estimator in ("ode", "nlarx"):
        envs = ContinuousVectorEnv(200, estimator=estimator, max_output=2.0)
        envs.reset(seed=0)
        for actions in np.clip(random_actions(256, 200), -1, 1):
            envs.step(actions)
        told = []
        for row in range(200):
            belief = envs.belief(row)
            mean, cov = belief.physical()
            true = np.array([getattr(envs.truth, name)[row] for name in ("m", "c", "a", "b")])
            deviation, relative = mean / true - 1, cov / np.outer(true, true)
            told.append(deviation @ np.linalg.solve(relative, deviation))
        distances[estimator] = np.mean(told)
    assert 3.2 < distances["ode"] < 4.8
    assert distances["nlarx"] > 100


# Every reward that has a kernel of its own is seconds of compilation, and the judgement is the same.
@pytest.mark.parametrize(
    "reward", [pytest.param(name, marks=[pytest.mark.slow] * (name in EVIDENCE["ode"])) for name in REWARDS]
)
@pytest.mark.parametrize(
    ("name", "value"),
    [("X_x", np.nan), ("X_x", np.inf), ("X_v", np.inf), ("X_x", 1e70), ("stiffness", 1e300), ("stiffness", -1e5)],
)
def test_numbers_that_are_not_finite_end_the_episode_flagged(reward, name, value):
    env = ContinuousEnv(reward=reward)
    env.reset(seed=0)
    env.step([0.7])
    batch = env.unwrapped._batch
    batch._blocks[0, batch._place[name], 0] = value
    before = env.belief
    observation, received, terminated, truncated, info = env.step([0.5])
    if not info["diverged"]:  # a soft spring that pushes is a number, if a bad one
        assert name == "stiffness"
        return
    assert (received, terminated, truncated) == (0.0, True, False)
    assert env.belief == before
    assert observation in env.observation_space
    env.reset()
    assert np.isfinite(env.step([0.5])[1])


@pytest.mark.slow  # a kernel of its own, for a free energy
@pytest.mark.parametrize(
    "options",
    [{"max_output": 1e6, "max_input": 1e3}, {"spread": 0.999}, {"spread": 1e-6}, {"process_noise": 1.0},
     {"process_noise": 1e-9}, {"measurement_noise": 1e-9}, {"measurement_noise": 10.0}, {"noise_shape": 1e-3}],
    ids=str,
)  # fmt: skip
def test_observations_stay_in_their_space_and_rewards_finite(options):
    envs = ContinuousVectorEnv(32, reward="free_energy", **options)
    envs.reset(seed=0)
    for actions in random_actions(300, 32):
        observations, rewards, _, _, infos = envs.step(actions)
        assert observations in envs.observation_space
        assert np.isfinite([rewards, infos["information_gain"], infos["log_posterior_gain"]]).all()


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))], ids=["copy", "pickle"])
def test_copies_made_within_an_episode_continue_alike(copied):
    env = ContinuousEnv()
    env.reset(seed=0)
    for action in random_actions(5, 1):
        env.step(action)
    twin = copied(env)
    for action in random_actions(20, 1, seed=1):
        first, second = env.step(action), twin.step(action)
        np.testing.assert_array_equal(first[0], second[0])
        assert first[1] == second[1]


def test_an_episode_is_drawn_with_the_maps_of_its_estimator():
    from duffing_env.rendering import _physical_moments

    env = gym.make(TRACK, render_mode="rgb_array", horizon=5)
    env.reset(seed=0)
    env.step(np.float32([0.5]))
    assert env.render().shape[-1] == 3
    belief = env.unwrapped.belief
    means, stds = _physical_moments([belief])
    mean, cov = belief.physical()
    np.testing.assert_allclose(means[:, 0], mean, rtol=1e-14)
    np.testing.assert_allclose(stds[:, 0], np.sqrt(np.diag(cov)), rtol=1e-14)
