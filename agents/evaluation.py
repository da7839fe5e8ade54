"""What policies are worth: any number of them, on the same systems and the same noise."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from scipy import stats

from agents.policies import make_policy
from duffing_env.silverbox import load_record, record_available
from duffing_env.vector_env import DuffingVectorEnv
from estimator import NLARX, Belief
from estimator.belief import RecordBelief

FloatArray = npt.NDArray[np.float64]

#: Half width of a central 90 % interval in standard deviations.
_NINETY = float(stats.norm.ppf(0.95))


@dataclass(frozen=True)
class Evaluation:
    """What happened under one policy, system by system.

    Attributes:
        policy: its name.
        metrics: name of a metric to its value for each system (systems,); see `agents.leaderboard.METRICS`.
        curve: (horizon + 1, systems) gain of log posterior of the truth over the samples [nats].
        inputs: (horizon, systems) inputs [V], NaN after the end of an episode.
        outputs: (horizon, systems) outputs [V], likewise.
    """

    policy: str
    metrics: dict[str, FloatArray]
    curve: FloatArray
    inputs: FloatArray
    outputs: FloatArray


def evaluate(
    policies: Sequence[str],
    env_id: str = "duffing_env/Amplitude-v0",
    systems: int = 256,
    seed: int = 0,
    options: dict[str, Any] | None = None,
    on_policy: Callable[[str], None] | None = None,
) -> list[Evaluation]:
    """Evaluate policies on common random numbers: the same oscillators and the same noise for all of them.

    Learned policies act by their mean. An episode that a limit ends counts with what was known by then. The arrow
    error is that of the difference equation identified on the track's twin (``plant_spread=0``) in a free run over the
    real arrow record. It is left out without the record, and on environments that do not simulate a plant. So it is for
    the differential equation: the simulated plant has no offsets, and those of the circuit, 8 mV at the input, would be
    nearly all of its error (5.3 mV for the twin itself).

    Args:
        policies: names or run folders, see `agents.policies.make_policy`; at least one.
        env_id: a registered track.
        systems: number of systems, at least 2.
        seed: of systems and noise; and of the policies' own randomness.
        options: of the environment.
        on_policy: called with each policy's name before its turn.

    Raises:
        ValueError: for no policies, an unknown one, fewer than two systems, or options that the track does not take.
    """
    if not policies:
        raise ValueError("policies must name at least one policy, but names none; pass e.g. uniform")
    if systems < 2:
        raise ValueError(f"systems must be at least 2, but is {systems}; intervals need more than one")
    options = dict(options or {})
    evaluations = []
    for name in policies:
        if on_policy is not None:
            on_policy(name)
        evaluation, beliefs = _roll_out(name, env_id, systems, seed, options)
        if record_available() and "Replay" not in env_id and isinstance(beliefs[0], Belief):
            _, beliefs = _roll_out(name, env_id, systems, seed, {**options, "plant_spread": 0.0})
            evaluation.metrics["arrow_rmse"] = _arrow_errors(beliefs)
        evaluations.append(evaluation)
    return evaluations


def _roll_out(
    name: str, env_id: str, systems: int, seed: int, options: dict[str, Any]
) -> tuple[Evaluation, list[RecordBelief]]:
    """One episode of every system, and the belief that it ended with."""
    envs = gym.make_vec(env_id, num_envs=systems, vectorization_mode="vector_entry_point", **options)
    assert isinstance(envs, DuffingVectorEnv)
    policy = make_policy(name, envs, seed=seed)
    observations, _ = envs.reset(seed=seed)
    prior = envs.belief(0)
    truth = envs.truth
    horizon = envs.horizon
    curve = np.zeros((horizon + 1, systems))
    inputs = np.full((horizon, systems), np.nan)
    outputs = np.full((horizon, systems), np.nan)
    beliefs: list[RecordBelief] = [prior] * systems
    ended_early = np.zeros(systems)
    running = np.ones(systems, dtype=np.bool_)
    state, episode_start = None, np.ones(systems, dtype=np.bool_)
    for t in range(horizon):
        actions, state = policy.predict(observations, state, episode_start, deterministic=True)
        observations, _, terminated, truncated, infos = envs.step(actions)
        curve[t + 1] = curve[t] + np.where(running, infos["log_posterior_gain"], 0.0)
        inputs[t, running] = envs.max_input * np.clip(actions[running, 0], -1, 1)
        outputs[t, running] = envs.experiment.max_output * observations[running, 19]
        finished = running & (terminated | truncated)
        for row in np.flatnonzero(finished):
            beliefs[row] = infos["belief"][row]
        ended_early[finished & terminated] = 1.0
        running &= ~finished
        episode_start = terminated | truncated
        if not running.any():
            curve[t + 2 :] = curve[t + 1]
            break
    envs.close()
    metrics = {
        "information_gain": np.array([prior.entropy() - belief.entropy() for belief in beliefs]),
        "log_posterior_gain": curve[-1],
        **_parameter_metrics(beliefs, truth),
        "ended_early": ended_early,
        "input_power": np.nanmean(inputs**2, axis=0),
    }
    return Evaluation(name, metrics, curve, inputs, outputs), beliefs


def _parameter_metrics(beliefs: list[RecordBelief], truth: Any) -> dict[str, FloatArray]:
    """Relative errors of m, c, a, b, and the share of the four coefficients that their 90 % intervals cover."""
    true_physical = np.stack([truth.m, truth.c, truth.a, truth.b], axis=-1)
    true_coefficients = beliefs[0].coefficients_of(truth)
    estimates = np.array([belief.physical()[0] for belief in beliefs])
    errors = np.abs(estimates / true_physical - 1)
    means = np.array([belief.coefficients_mean for belief in beliefs])
    stds = np.array([np.sqrt(np.diag(belief.coefficients_cov)) for belief in beliefs])
    covered = np.abs(means - true_coefficients) <= _NINETY * stds
    return {
        **{f"error_{name}": errors[:, i] for i, name in enumerate("mcab")},
        "coverage": covered.mean(axis=1),
    }


def _arrow_errors(beliefs: Sequence[RecordBelief]) -> FloatArray:
    """Root mean square error [V] of free runs over the real arrow record; inf where a run diverges."""
    arrow = load_record().arrow
    model = NLARX(input_delay=1)
    errors = np.empty(len(beliefs))
    for i, belief in enumerate(beliefs):
        simulated = model.simulate(belief.coefficients_mean, arrow.u, arrow.y[:2])
        with np.errstate(invalid="ignore", over="ignore"):
            error = np.sqrt(np.mean((simulated - arrow.y)[2:] ** 2))
        errors[i] = error if np.isfinite(error) else np.inf
    return errors
