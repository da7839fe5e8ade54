"""A roll-out buffer for PPO that normalises advantages separately in each part of an episode."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from stable_baselines3.common.buffers import RolloutBuffer

from agents.policies.networks.feature_names import FEATURE_NAMES

_TIME_LEFT_INDEX = FEATURE_NAMES.index("time_left")

#: Bins of time, in each of which advantages are normalised.
_N_TIME_BINS = 16

#: Largest advantage after the normalisation [standard deviations]; larger ones are clipped.
_MAX_ADVANTAGE = 4.0


class TimeNormalisedRolloutBuffer(RolloutBuffer):
    """A buffer of features whose advantages have mean 0 and standard deviation 1 in each of 16 bins of time.

    Early in an episode the noises become known, which changes returns by nats, whatever the actions; later, actions
    change returns by hundredths. A normalisation over the whole roll-out would make these later advantages negligible.
    """

    def compute_returns_and_advantage(self, last_values: torch.Tensor, dones: np.ndarray[Any, Any]) -> None:
        """As of the base class, then normalise the advantages; the returns stay as they are."""
        super().compute_returns_and_advantage(last_values, dones)
        order = np.argsort(-self.observations[..., _TIME_LEFT_INDEX], axis=None, kind="stable")
        advantages = self.advantages.reshape(-1)
        for time_bin in np.array_split(order, _N_TIME_BINS):
            if len(time_bin) > 1:
                binned = advantages[time_bin]
                advantages[time_bin] = np.clip(
                    (binned - binned.mean()) / (binned.std() + 1e-8), -_MAX_ADVANTAGE, _MAX_ADVANTAGE
                )
