"""Actions that are held for several samples. That these are repeated actions, to the bit, is in tests/contract."""

from itertools import pairwise

import gymnasium as gym
import numpy as np
import pytest
from rounding import U32

from duffing_env.env import DuffingEnv
from duffing_env.tracks.silverbox_replay import ReplayExperiment
from duffing_env.vector_env import DuffingVectorEnv

TRACK = "duffing_env/Amplitude-v0"


def test_the_horizon_counts_samples():
    env = gym.make(TRACK, hold=5, horizon=22, max_input=1e-3)
    observation, _ = env.reset(seed=0)
    left = [observation[20]]
    truncated = False
    while not truncated:
        observation, _, _, truncated, _ = env.step([0.5])
        left.append(observation[20])
    np.testing.assert_allclose(left, 1 - np.array([0, 5, 10, 15, 20, 22]) / 22, rtol=2 * U32)
    assert env.spec.max_episode_steps == 5
    # A limit of steps is one of actions.
    envs = gym.make_vec(TRACK, num_envs=2, max_episode_steps=3, hold=5, max_input=1e-3)
    envs.reset(seed=0)
    assert [envs.step(np.zeros((2, 1)))[3].tolist() for _ in range(3)] == [[False] * 2, [False] * 2, [True] * 2]


def test_limits_hold_for_every_sample():
    envs = DuffingVectorEnv(3, hold=8, max_slew=0.02, max_rms=0.05, horizon=64)
    single = DuffingEnv(hold=8, max_slew=0.02, max_rms=0.05, horizon=64)
    envs.reset(seed=0)
    single.reset(seed=0)
    inputs, apply = [], single._apply_sample
    single._apply_sample = lambda action: (apply(action), inputs.append(single._batch.row_values("INPUT_u")[0]))
    for _ in range(8):
        envs.step(np.ones((3, 1), dtype=np.float32))
        single.step([1.0])
    np.testing.assert_allclose(np.diff([0.0, *inputs[:5]]), 0.02, rtol=1e-12)
    assert np.abs(np.diff(inputs)).max() <= 0.15
    assert np.sum(np.square(inputs)) <= 64 * 0.05**2 * (1 + 1e-12)
    np.testing.assert_array_equal(envs._batch.row_values("ENERGY_SPENT"), single._batch.row_values("ENERGY_SPENT")[0])


def test_every_sample_is_drawn():
    env = DuffingEnv(hold=3, horizon=8, render_mode="rgb_array")
    env.reset(seed=0)
    frames = [env.render()]
    for count in (3, 6, 8):
        env.step([0.5])
        assert env._renderer._samples == count
        frames.append(env.render())
    assert not any(np.array_equal(a, b) for a, b in pairwise(frames))


@pytest.mark.usefixtures("record")
def test_a_record_is_not_held():
    with pytest.raises(ValueError, match=r"hold must be 1 for a record, .* but is 2"):
        ReplayExperiment(hold=2)
