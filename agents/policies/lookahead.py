"""`lookahead`: what the features of foresight say by themselves, without a network. Nothing in it is learned."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from agents.policies.foresight import CommonForesight
from agents.policies.imagined import FEATURES
from agents.policies.learned import observation_of
from estimator.checks import numbers
from estimator.parameters import FloatArray

#: Which features say how much more a push up brings than one down, and no push than the better of these.
UP, NONE = (FEATURES.index(f"best_{way}_whole") for way in ("up", "none"))


def rule(features: npt.NDArray[np.float32]) -> FloatArray:
    """The choices (n,) of what brings most, by features (n, len(FEATURES)): 1 for up, 0 for none, -1 for down.

    Example:
        >>> import numpy as np
        >>> seen = np.zeros((3, len(FEATURES)), dtype=np.float32)
        >>> seen[:, UP], seen[:, NONE] = [1.0, -1.0, 1.0], [-1.0, -1.0, 0.5]
        >>> rule(seen).tolist()
        [1.0, -1.0, 0.0]
    """
    return np.where(features[:, NONE] > 0.0, 0.0, np.where(features[:, UP] >= 0.0, 1.0, -1.0))


class Lookahead:
    """The push whose best way to go on teaches most, or none; where the energy is limited, the best burst.

    It reads the beliefs of an environment, as `agents.policies.foresight.CommonForesight` does, so `predict` must be
    called between its steps, with its observations.

    Args:
        env: the unwrapped environment, single or vector.
        seed: without effect: nothing in it is random.

    Raises:
        ValueError: for an environment that is not one of duffing_env, holds its actions for several samples, or shows
            another observation than the posterior.
    """

    def __init__(self, env: Any, seed: int = 0) -> None:
        self._foresight = CommonForesight(env)
        if (shown := observation_of(env)) != "posterior":
            raise ValueError(
                f"env must show the observation 'posterior' for lookahead, but shows {shown!r}; leave out the option "
                "observation"
            )

    def predict(
        self,
        observation: npt.ArrayLike,
        state: Any = None,
        episode_start: npt.ArrayLike | None = None,
        deterministic: bool = False,
    ) -> tuple[npt.NDArray[np.float32], Any]:
        """The action (n, 1) for observations (n, features), or (1,) for one observation; the state is handed on unused.

        Raises:
            ValueError: for observations of another shape or of other environments, or that are not finite.
        """
        seen, size = numbers("observation", observation).astype(np.float32), self._foresight.observation_size
        if seen.ndim not in (1, 2) or seen.shape[-1] != size:
            raise ValueError(f"observation must have {size} entries, but has shape {seen.shape}")
        if not np.isfinite(seen).all():
            raise ValueError(f"observation must be finite, but is {seen[~np.isfinite(seen)][0]} somewhere")
        view = self._foresight.look(np.atleast_2d(seen))
        return view.act(rule(view.features)).reshape(*seen.shape[:-1], 1), state
