"""Advantages of PPO that count alike at every time of an episode."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from stable_baselines3.common.buffers import RolloutBuffer

from agents.policies.networks.feature_names import FEATURE_NAMES

_TIME_LEFT_INDEX = FEATURE_NAMES.index("time_left")

#: Stretches of time that advantages are normalised in; standard deviations that are kept at most.
_N_TIME_BINS, _MAX_ADVANTAGE = 16, 4.0


class TimeNormalisedRolloutBuffer(RolloutBuffer):
    """A buffer of features whose advantages have mean 0 and standard deviation 1 in each of 16 stretches of time.

    Early in an episode the noises become known, which moves returns by nats, whatever was done; later on, decisions
    move them by hundredths. Normalised over a whole roll-out, the first would drown the others.
    """

    def compute_returns_and_advantage(self, last_values: torch.Tensor, dones: np.ndarray[Any, Any]) -> None:
        """As of the base class; returns stay as they are."""
        super().compute_returns_and_advantage(last_values, dones)
        order = np.argsort(-self.observations[..., _TIME_LEFT_INDEX], axis=None, kind="stable")
        advantages = self.advantages.reshape(-1)
        for time_bin in np.array_split(order, _N_TIME_BINS):
            if len(time_bin) > 1:
                binned = advantages[time_bin]
                advantages[time_bin] = np.clip(
                    (binned - binned.mean()) / (binned.std() + 1e-8), -_MAX_ADVANTAGE, _MAX_ADVANTAGE
                )
