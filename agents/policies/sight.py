"""What beliefs look like with foresight, and the actions that choices stand for in sight of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from estimator.parameters import FloatArray

#: How hard the drive pushes, in parts of what the oscillator moves by itself in two samples: at action 0, which swings
#: it up, and what an action of 1 adds; an action of -1 brakes.
_DRIVE, _DRIVE_SPAN = 0.06, 0.1


@dataclass(frozen=True)
class Sight:
    """What n observations look like with foresight.

    Attributes:
        features: (n, features) float32 what the network sees.
        safe: (n, 3) whether a push up, none, a push down need not lead beyond the limit.
        signs: (n,) -1.0 where the observation was turned over.
        motions: (n,) the input that is all of the motion, upright; zeros where no action is a drive.
        shares: (n, 2) how much of a push up, and of one down, is played.
    """

    features: npt.NDArray[np.float32]
    safe: npt.NDArray[np.bool_]
    signs: FloatArray
    motions: FloatArray
    shares: FloatArray


def acted(
    choices: npt.ArrayLike, view: Sight, motions: FloatArray | None, max_input: float, push: npt.ArrayLike = 1.0
) -> npt.NDArray[np.float32]:
    """The actions (n, 1) of choices (n,), that drive along ``motions`` (n,) where there are any, by at most a ``push``.

    Of a push no more is played than its share. One in whose direction no way is left within the limit becomes none or a
    push the other way.
    """
    chosen, most = np.clip(np.asarray(choices, dtype=np.float64), -1.0, 1.0), np.asarray(push)
    rise, fall = most * view.shares.T
    if motions is not None:
        chosen = (_DRIVE + _DRIVE_SPAN * chosen) * motions / max_input
    chosen = np.clip(chosen, -fall, rise)
    up, none, down = view.safe.T
    chosen = np.where((chosen > 0) & ~up, np.where(none, 0.0, -fall), chosen)
    chosen = np.where((chosen < 0) & ~down, np.where(none, 0.0, rise), chosen)
    chosen = np.where((chosen == 0) & ~none, np.where(up, rise, -fall), chosen)
    actions: npt.NDArray[np.float32] = (chosen * view.signs).astype(np.float32)[:, None]
    return actions
