"""An input that drives the plant out of its range must not pay: it ends with less return than no input at all."""

import gymnasium as gym
import numpy as np
import pytest

from duffing_env.batch import spawn_seeds
from duffing_env.rewards.named_rewards import REWARDS
from estimator import SILVERBOX_SAMPLING_STEP

TRACK, SYSTEMS, SAMPLES = "duffing_env/Amplitude-v0", 8, 256
LEARNABLE = [name for name in REWARDS if name != "free_energy"]  # the foil rewards what is known already
LIMITS = STANDARD, RAISED, NONE = 0.6, 1e3, 1e300
WORTH = -10.0
TIME = SILVERBOX_SAMPLING_STEP * np.arange(SAMPLES)


def bank():
    """Full inputs (n, SAMPLES) that pump: squares and sines about the resonances, chirps through them, long pulses."""
    squares = [np.sign(np.sin(2 * np.pi * f * TIME + 1e-9)) for f in (55, 65, 75, 85, 95)]
    sines = [np.sin(2 * np.pi * f * TIME) for f in (60, 75, 90)]
    chirps = [
        np.sin(2 * np.pi * (low + (high - low) * TIME / TIME[-1] / 2) * TIME) for low, high in ((0, 200), (130, 40))
    ]
    return np.array([*squares, *sines, *chirps, np.ones(SAMPLES)])


def returns(reward, max_output, **options):
    """Returns and early ends (inputs + 2, SYSTEMS) of the bank, of feedback along the velocity, and of zero input."""
    inputs = bank()
    count = len(inputs) + 2
    envs = gym.make_vec(
        TRACK, num_envs=count * SYSTEMS, vectorization_mode="vector_entry_point",
        reward=reward, max_output=max_output, **options,
    )  # fmt: skip
    envs.reset(seed=spawn_seeds(0, SYSTEMS) * count)
    returned = np.zeros(count * SYSTEMS)
    ended, running = returned > 0, returned == 0
    for t in range(SAMPLES):
        states = envs.unwrapped.records[-2 * SYSTEMS : -SYSTEMS]
        push = np.where(states[:, 0] < states[:, 1], -1.0, 1.0)
        actions = np.concatenate([np.repeat(inputs[:, t], SYSTEMS), push, np.zeros(SYSTEMS)])
        _, rewards, terminated, truncated, _ = envs.step(actions[:, None].astype(np.float32))
        returned[running] += rewards[running]
        ended |= running & terminated
        running &= ~(terminated | truncated)
    return returned.reshape(count, SYSTEMS), ended.reshape(count, SYSTEMS)


@pytest.mark.parametrize("reward", LEARNABLE)
def test_a_blow_up_returns_less_than_no_input_where_that_is_asked_for(reward):
    for limit in LIMITS:
        returned, ended = returns(reward, limit, terminated_return=WORTH)
        assert ended.sum() >= SYSTEMS
        assert ended[-2].all()
        assert not ended[-1].any()
        worse = returned < returned[-1]
        assert worse[ended].all(), limit
        np.testing.assert_allclose(returned[ended], WORTH, rtol=0, atol=1e-9)


def test_it_does_so_where_the_reward_is_paid_at_the_end():
    returned, ended = returns("information_gain", RAISED, terminated_return=WORTH, terminal=True)
    assert ended[-2].all()
    np.testing.assert_array_equal(returned[ended], WORTH)


def test_what_was_gained_before_the_end_is_kept_otherwise():
    # The figures of `duffing_env.rewards.named_rewards`.
    returned, ended = returns("information_gain", STANDARD)
    assert ended[-2].all()
    assert returned[-2].mean() == pytest.approx(15.2, abs=0.05)
    assert returned[-1].mean() == pytest.approx(2.4, abs=0.05)
    returned, ended = returns("information_gain", RAISED)
    assert ended[-2].all()
    assert returned[-2].mean() == pytest.approx(23.5, abs=0.05)


@pytest.mark.parametrize("reward", LEARNABLE)
def test_the_registered_tracks_end_at_their_limit_and_never_diverge(reward):
    """Therefore none of their figures depends on the reward of a diverged step."""
    inputs = np.repeat(bank(), SYSTEMS, axis=0)
    envs = gym.make_vec(TRACK, num_envs=len(inputs), vectorization_mode="vector_entry_point", reward=reward)
    envs.reset(seed=0)
    ended = 0
    for t in range(SAMPLES):
        _, _, terminated, _, infos = envs.step(inputs[:, t : t + 1].astype(np.float32))
        ended += terminated.sum()
        assert not infos["diverged"].any()
    assert ended > 50
