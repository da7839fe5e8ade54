"""Baseline ``shield``: pushes along the velocity, within the networks' shield, without learning."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from agents.policies.networks.feature_encoder import FeatureEncoder
from agents.policies.networks.feature_names import FEATURE_NAMES
from agents.predict_argument_checks import check_observation_finite, check_observation_size
from estimator.support.argument_checks import to_float_array

_VELOCITY = FEATURE_NAMES.index("velocity")


class ShieldBaseline:
    """Push along the velocity of the first sensor, as hard as the shield allows.

    It has the shield of trained networks (`agents.policies.networks.rollout_features`), and is their baseline.

    Args:
        env: the unwrapped environment, single or vector, whose prior, limits and noises the shield takes.
        seed: without effect: nothing in it is random.

    Raises:
        ValueError: as `FeatureEncoder.of`.
    """

    def __init__(self, env: Any, seed: int = 0) -> None:
        self._encoder = FeatureEncoder.of(env, with_observation=False)

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
        observations = to_float_array("observation", observation).astype(np.float32)
        check_observation_size(observations, self._encoder.observation_size)
        check_observation_finite(observations)
        features = self._encoder(np.atleast_2d(observations))
        pushes = np.where(features.values[:, _VELOCITY] >= 0.0, 1.0, -1.0)
        return features.to_actions(pushes).reshape(*observations.shape[:-1], 1), state
