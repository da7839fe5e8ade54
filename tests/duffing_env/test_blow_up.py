"""An input that drives the plant out of its range must not pay: it ends with less return than no input at all."""

import gymnasium as gym
import numpy as np
import pytest

from duffing_env.batch import spawn_seeds
from duffing_env.rewards import REWARDS
from estimator import SAMPLING_STEP

TRACK, SYSTEMS, SAMPLES = "duffing_env/Amplitude-v0", 8, 256
LEARNABLE = [name for name in REWARDS if name != "free_energy"]  # the foil rewards what is known already
LIMITS = {"standard": 0.6, "raised": 1e3, "none": 1e300}
PENALTY = -10.0
TIME = SAMPLING_STEP * np.arange(SAMPLES)


def bank():
    """Full inputs (n, SAMPLES) that pump: squares and sines about the resonances, chirps through them, long pulses."""
    squares = [np.sign(np.sin(2 * np.pi * f * TIME + 1e-9)) for f in (55, 65, 75, 85, 95)]
    sines = [np.sin(2 * np.pi * f * TIME) for f in (60, 75, 90)]
    chirps = [np.sin(2 * np.pi * (low + (high - low) * TIME / TIME[-1] / 2) * TIME) for low, high in ((0, 200), (130, 40))]
    return np.array([*squares, *sines, *chirps, np.ones(SAMPLES)])


def returns(reward, max_output, **options):
    """Returns (inputs, SYSTEMS) of the bank and of feedback, which ended by termination, and those of no input (SYSTEMS,)."""
    inputs = bank()
    rows = (len(inputs) + 2) * SYSTEMS
    envs = gym.make_vec(
        TRACK, num_envs=rows, vectorization_mode="vector_entry_point", reward=reward, max_output=max_output, **options
    )
    observations, _ = envs.reset(seed=spawn_seeds(0, SYSTEMS) * (len(inputs) + 2))
    told, ended, running = np.zeros(rows), np.zeros(rows, dtype=bool), np.ones(rows, dtype=bool)
    push = np.ones(SYSTEMS)
    for t in range(SAMPLES):
        actions = np.concatenate([np.repeat(inputs[:, t], SYSTEMS), push, np.zeros(SYSTEMS)])
        observations, rewards, terminated, truncated, _ = envs.step(actions[:, None].astype(np.float32))
        feedback = slice(-2 * SYSTEMS, -SYSTEMS)
        push = np.where(observations[feedback, 16] < observations[feedback, 17], -1.0, 1.0)  # along the velocity
        told[running] += rewards[running]
        ended |= running & terminated
        running &= ~(terminated | truncated)
    told, ended = told.reshape(-1, SYSTEMS), ended.reshape(-1, SYSTEMS)
    assert not ended[-1].any()
    return told[:-1], ended[:-1], told[-1]


if __name__ == "__main__":
    for reward in REWARDS:
        for name, limit in LIMITS.items():
            for kw in ({}, {"terminated_return": PENALTY}, {"terminated_return": PENALTY, "terminal": True}):
                told, ended, rest = returns(reward, limit, **kw)
                fb = told[-1]
                if not kw: print(f"{reward:22s} {name:9s} ended {ended.mean():.2f} feedback ended {ended[-1].mean():.2f} mean return of ended {told[ended].mean():9.2f} [{told[ended].min():.2f} {told[ended].max():.2f}], feedback {fb.mean():.2f}, rest {rest.mean():.2f} [{rest.min():.2f}], worse than rest {(told < rest)[ended].mean():.2f}", flush=True)
                else: print("      with", kw, "worse", (told < rest)[ended].mean(), "range", told[ended].min(), told[ended].max(), flush=True)
