"""The reward ``simulation_error``: the test input stays within what the oscillators of the tracks can bear."""

import gymnasium as gym
import numpy as np
from twin import PARAMETERS, TwinContinuousEnv, TwinEnv, multisine

from duffing_env.rewards.simulation_error_reward import TEST_INPUT
from estimator import SILVERBOX_ODE_TWIN, SILVERBOX_TWIN, Parameters

SPREAD = 0.3


def corners(center):
    """The 16 oscillators at the corners of the range, and 100 within."""
    rng = np.random.default_rng(0)
    factors = [
        *np.array(np.meshgrid(*[[1 - SPREAD, 1 + SPREAD]] * 4)).reshape(4, -1).T,
        *rng.uniform(0.7, 1.3, (100, 4)),
    ]
    middle = np.array([getattr(center, name) for name in PARAMETERS])
    return [Parameters(zip("mcab", middle * factor, strict=True)) for factor in factors]


def test_the_test_input_is_a_schroeder_multisine():
    np.testing.assert_allclose(TEST_INPUT, multisine(), rtol=0, atol=1e-14)
    assert np.abs(TEST_INPUT).max() == 0.5
    lines = np.abs(np.fft.rfft(TEST_INPUT))
    np.testing.assert_allclose(lines[1:21], lines[1], rtol=1e-12)
    assert lines[21:].max() < 1e-12
    assert np.sqrt(np.mean(TEST_INPUT**2)) > 0.3  # a crest factor of 1.6


def test_no_oscillator_comes_near_its_limit():
    difference, continuous = TwinEnv(0), TwinContinuousEnv(0)
    peaks = []
    for center, twin in ((SILVERBOX_TWIN, difference), (SILVERBOX_ODE_TWIN, continuous)):
        for truth in corners(center):
            peaks.append(np.abs(twin.free_run(twin.to_coefficients(truth))).max())
    assert 0.2 < np.median(peaks) < max(peaks) < 0.4


def test_it_falls_with_what_is_learned_and_sums_to_at_most_one():
    envs = gym.make_vec(
        "duffing_env/Amplitude-v0", num_envs=64, vectorization_mode="vector_entry_point", reward="simulation_error"
    )
    envs.reset(seed=0)
    rng, rewards_paid, running = np.random.default_rng(0), [], np.ones(64, dtype=bool)
    for _ in range(256):
        _, rewards, terminated, truncated, _ = envs.step(rng.uniform(-1, 1, (64, 1)).astype(np.float32))
        rewards_paid.append(np.where(running, rewards, 0.0))
        running &= ~(terminated | truncated)
    sums = np.cumsum(rewards_paid, axis=0)
    assert np.abs(sums).max() <= 1
    assert (np.diff(sums[[0, 15, 63, 255]].mean(axis=1)) > 0).all()
    errors = envs._batch.row_values("SIMULATION_ERROR")
    assert sums[-1].mean() > 0.7
    assert ((errors >= 0) & (errors <= 1)).all()
