"""Tests of a user's model: everything works from its declaration of a few lines alone."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from reference.plants import VAN_DER_POL
from scipy import stats
from stable_baselines3.common.env_checker import check_env as check_sb3

import duffing_env  # noqa: F401 - registers the tracks
from agents.policies import make_policy
from duffing_env.batch import spawn_seeds
from duffing_env.tracks.model_env import ModelEnv, ModelVectorEnv

OPTIONS = {
    "system": VAN_DER_POL,
    "mean": {"stiffness": 0.4, "friction": 0.2, "gain": 0.3},
    "spread": 0.2,
    "process_noise": 2e-3,
    "measurement_noise": 2e-3,
    "horizon": 128,
    "max_input": 0.5,
    "max_output": 6.0,
}


@pytest.mark.filterwarnings("ignore:.*different from the unwrapped version.*", "ignore:.*spec.*")
def test_it_is_an_environment_for_gymnasium_and_stable_baselines3():
    check_env(ModelEnv(**OPTIONS), skip_render_check=True)
    check_sb3(ModelEnv(**OPTIONS))


def test_a_single_environment_is_a_row_of_many():
    envs, env = ModelVectorEnv(40, **OPTIONS), ModelEnv(**OPTIONS)
    rng = np.random.default_rng(0)
    observations, _ = envs.reset(seed=5)
    single, _ = env.reset(seed=spawn_seeds(5, 40)[33])
    np.testing.assert_array_equal(single, observations[33])
    for _ in range(60):
        actions = rng.uniform(-1, 1, (40, 1)).astype(np.float32)
        observations, rewards, *_ = envs.step(actions)
        single, reward, *_ = env.step(actions[33])
        np.testing.assert_array_equal(single, observations[33])
        assert reward == rewards[33]


def test_its_intervals_hold_the_truth():
    envs = ModelVectorEnv(1000, **OPTIONS)
    envs.reset(seed=1)
    rng = np.random.default_rng(1)
    for _ in range(128):
        *_, infos = envs.step(rng.uniform(-1, 1, (1000, 1)).astype(np.float32))
    beliefs, truth = infos["belief"], envs.truth
    means = np.array([belief.coefficients_mean for belief in beliefs])
    stds = np.sqrt([np.diag(belief.coefficients_cov) for belief in beliefs])
    held = np.abs(means - np.stack([truth[c] for c in VAN_DER_POL.coefficients], axis=1)) <= stats.norm.ppf(0.95) * stds
    assert 0.87 < held.mean() < 0.93


def test_the_planner_plays_it_and_learns_more_than_chance():
    gains = {}
    for name in ("efe", "uniform"):
        envs = gym.make_vec(
            "duffing_env/WienerHammerstein-v0", num_envs=8, vectorization_mode="vector_entry_point", **OPTIONS
        )
        policy = make_policy(name, envs)
        observations, _ = envs.reset(seed=0)
        state, total = None, np.zeros(8)
        for _ in range(128):
            actions, state = policy.predict(observations, state)
            observations, rewards, terminated, *_ = envs.step(actions)
            assert not terminated.any()
            total += rewards
        gains[name] = total.mean()
    assert gains["efe"] > gains["uniform"] + 0.5
