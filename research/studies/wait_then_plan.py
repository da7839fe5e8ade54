"""Baseline of `ppo/drift`, without learning: wait until the mass has jumped, then play the planner.

    python evaluate.py --env Drift-v0 --systems 128 --policies
        research.studies.wait_then_plan:WaitThenPlan ppo/drift efe

The mass of Drift-v0 jumps at a random sample, and before sample 390. The policy pushes one way until then, so that the
oscillator rests, and plays the planner afterwards.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from agents.planning.model_probe import observation_layout
from agents.policies import make_policy

#: Samples of an episode before the planner starts.
WAIT_SAMPLES = 390


class WaitThenPlan:
    """Push up for `WAIT_SAMPLES` samples, then play `efe`.

    Args:
        env: an environment of Drift-v0, single or vector.
        seed: of the planner.
    """

    def __init__(self, env: Any, seed: int) -> None:
        self._planner, self._horizon = make_policy("efe", env, seed=seed), env.unwrapped.horizon
        self._time_left = observation_layout(env.unwrapped.experiment.model).time_left

    def predict(
        self,
        observation: npt.ArrayLike,
        state: Any = None,
        episode_start: npt.ArrayLike | None = None,
        deterministic: bool = False,
    ) -> tuple[npt.NDArray[np.float32], Any]:
        """The actions, as `agents.policies.Policy`; the state is the planner's."""
        waits = (1.0 - np.asarray(observation)[..., self._time_left, None]) * self._horizon < WAIT_SAMPLES - 0.5
        if waits.all():
            return waits.astype(np.float32), None
        planned, state = self._planner.predict(observation, state, episode_start, deterministic)
        return np.where(waits, np.float32(1.0), planned), state
