"""`shield`: pushes along the velocity, bounded by the networks' shield. Nothing is learned."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from agents.asked import check_entries, check_finite
from agents.policies.features import NAMES, FeatureMap
from estimator.checks import numbers

_VELOCITY = NAMES.index("velocity")


class Shield:
    """Push along the velocity of the first sensor, as hard as the shield allows (`agents.policies.features`).

    A trained network is compared with it: both have the same shield.

    Args:
        env: the unwrapped environment, single or vector, whose prior, limits and noises it is to know.
        seed: without effect: nothing in it is random.

    Raises:
        ValueError: as `FeatureMap.of`.
    """

    def __init__(self, env: Any, seed: int = 0) -> None:
        self._map = FeatureMap.of(env, own=False)

    def predict(
        self,
        observation: npt.ArrayLike,
        state: Any = None,
        episode_start: npt.ArrayLike | None = None,
        deterministic: bool = False,
    ) -> tuple[npt.NDArray[np.float32], Any]:
        """The action (n, 1) for observations (n, features), or (1,) for one observation; the state is handed on unused.

        Raises:
            ValueError: for observations of another shape, or that are not finite.
        """
        seen = numbers("observation", observation).astype(np.float32)
        check_entries(seen, self._map.observation_size)
        check_finite(seen)
        features = self._map(np.atleast_2d(seen))
        pushes = np.where(features.values[:, _VELOCITY] >= 0.0, 1.0, -1.0)
        return features.act(pushes).reshape(*seen.shape[:-1], 1), state
