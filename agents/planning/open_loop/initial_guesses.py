"""Initial guesses of the optimisation of a block: a receding-horizon plan, a weaker copy of it, and noise."""

from __future__ import annotations

import math

import numpy as np

from agents.planning.receding_horizon import PlanSettings, compile_receding_horizon
from estimator.support.array_types import FloatArray

#: The second guess in parts of the first.
_WEAKER_PLAN_FRACTION = 0.6

#: Standard deviation of guesses of noise, in parts of the largest input.
_NOISE_STD_FRACTION = 0.3


def initial_guesses(
    settings: PlanSettings, record: FloatArray, n_samples: int, seed: int, n_noise_guesses: int = 2
) -> FloatArray:
    """Inputs (2 + noises, samples) from which `chance_constrained_block.optimise_block` starts.

    The first guess is the plan for a system at the belief's means. Its margin is the smallest of the episode's, and it
    counts on no output: `optimise_block` keeps the limits.

    Args:
        settings: of the planner.
        record: the belief, as `estimator.Belief` keeps it.
        n_samples: length of a guess.
        seed: of the search and the noise.
        n_noise_guesses: number of guesses of noise.
    """
    plan = np.zeros(n_samples)
    objective = settings.objective._replace(margin=float(np.min(settings.objective.margin)), recoverable_step=0.0)
    rng_state = np.random.SFC64(seed).state["state"]["state"]
    horizon = min(settings.horizon, n_samples)
    compile_receding_horizon(*settings.model_view).plan_known_system(
        record.copy(), 0, horizon, settings.rounds, objective, plan, rng_state
    )
    moves = np.random.default_rng(seed).standard_normal(
        (n_noise_guesses, math.ceil(n_samples / objective.hold_samples))
    )
    noise = _NOISE_STD_FRACTION * objective.amplitude * np.repeat(moves, objective.hold_samples, axis=1)[:, :n_samples]
    return np.clip(np.stack([plan, _WEAKER_PLAN_FRACTION * plan, *noise]), -objective.amplitude, objective.amplitude)
