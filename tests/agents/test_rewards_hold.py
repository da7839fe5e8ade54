"""Rewards cannot be exploited: they rank inputs as the errors of an independent estimator do."""

import gymnasium as gym
import numpy as np
import pytest
from scipy import signal, stats

from duffing_env.batch import spawn_seeds
from estimator import SILVERBOX_SAMPLING_STEP
from estimator.inference.fisher_information import cramer_rao, fisher_information
from estimator.inference.maximum_a_posteriori import maximum_a_posteriori
from estimator.models.difference_equation import difference
from estimator.priors import silverbox_prior
from estimator.rigs.physical_parameters import coefficients_of, to_physical

TRACK, SYSTEMS, SAMPLES = "duffing_env/Amplitude-v0", 16, 256
TIME = SILVERBOX_SAMPLING_STEP * np.arange(SAMPLES)
NOISES = (5e-4, 5e-4)
MODEL = difference()
PRIOR = silverbox_prior(MODEL)


def bank(rng):
    """240 fixed inputs (240, SAMPLES) in parts of the limit: sines, squares, binary noises, multisines, chirps."""
    inputs = []
    for _ in range(48):
        size, frequency = rng.uniform(0.1, 1.0, 5), rng.uniform(15, 200, 2)
        inputs.append(size[0] * np.sin(2 * np.pi * frequency[0] * TIME))
        inputs.append(size[1] * signal.square(2 * np.pi * frequency[1] * TIME))
        hold = rng.integers(1, 9)
        inputs.append(size[2] * np.repeat(rng.choice([-1.0, 1.0], SAMPLES), hold)[:SAMPLES])
        low, high = np.sort(rng.uniform(10, 250, 2))
        tones = np.arange(low, high + 5, 5)
        waves = np.cos(2 * np.pi * (tones[:, None] * TIME + rng.uniform(0, 1, (len(tones), 1)))).sum(axis=0)
        inputs.append(size[3] * waves / np.abs(waves).max())
        inputs.append(size[4] * signal.chirp(TIME, high, TIME[-1], low))
    return np.array(inputs)


@pytest.fixture(scope="module")
def played():
    """Every input of the bank on the same systems and noise: rewards by name, and what was seen."""
    inputs = bank(np.random.default_rng(0))
    rows = len(inputs) * SYSTEMS
    envs = gym.make_vec(TRACK, num_envs=rows, vectorization_mode="vector_entry_point", reward="fisher")
    envs.reset(seed=spawn_seeds(0, SYSTEMS) * len(inputs))
    truth = envs.truth
    actions = np.repeat(inputs, SYSTEMS, axis=0).astype(np.float32)
    u, y = np.full((2, rows, SAMPLES), np.nan)
    returns = {name: np.zeros(rows) for name in ("fisher", "information_gain", "log_posterior_gain")}
    running, precisions = np.ones(rows, dtype=bool), np.full((rows, 2), np.nan)
    for t in range(SAMPLES):
        observations, rewards, terminated, truncated, infos = envs.step(actions[:, t : t + 1])
        u[running, t], y[running, t] = 0.15 * observations[running, 18], 0.6 * observations[running, 19]
        for name, of_step in (("fisher", rewards), *((name, infos[name]) for name in list(returns)[1:])):
            returns[name][running] += of_step[running]
        precisions[running] = observations[running, 14:16]
        running &= ~(terminated | truncated)
    return truth, u, y, {name: values.reshape(-1, SYSTEMS) for name, values in returns.items()}, precisions


def test_rewards_rank_inputs_as_an_auditor_s_errors_do(played):
    truth, u, y, returns, _ = played
    fit = maximum_a_posteriori(MODEL, u, y, PRIOR, *NOISES)
    estimates = to_physical(MODEL, fit.mean)
    true = np.stack([truth.m, truth.c, truth.a, truth.b], axis=-1)
    errors = np.log(np.abs(estimates / true - 1) + 1e-9).reshape(-1, SYSTEMS, 4).mean(axis=(1, 2))
    for name in ("information_gain", "log_posterior_gain", "fisher"):
        rank = stats.spearmanr(returns[name].mean(axis=1), -errors).statistic
        assert rank >= 0.8, name


def test_no_posterior_is_smaller_than_the_cramer_rao_bound(played):
    truth, u, y, returns, _ = played
    prior = np.linalg.inv(PRIOR.coefficients_cov)
    parameters = {name: getattr(truth, name) for name in MODEL.physical}
    information = fisher_information(MODEL, coefficients_of(MODEL, parameters), u, *NOISES, y=y)
    gains = 0.5 * (-np.linalg.slogdet(cramer_rao(information, prior))[1] + np.linalg.slogdet(prior)[1])
    # Of one episode the information along its outputs is one draw; over the systems the excess must vanish.
    excess = returns["information_gain"] - gains.reshape(-1, SYSTEMS)
    assert excess.mean() < 0.05
    assert np.quantile(excess.mean(axis=1), 0.99) < 0.3


def test_no_input_drives_the_noise_precisions_away(played):
    *_, precisions = played
    # In nats from the truth, where the priors are centred: the two noises trade a factor, and no more.
    assert np.abs(precisions).max() < np.log(30)
    assert np.median(np.abs(precisions)) < np.log(2)
