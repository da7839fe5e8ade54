"""What beliefs look like with foresight, and the actions that choices stand for in sight of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from estimator.parameters import FloatArray


@dataclass(frozen=True)
class Sight:
    """What n observations look like with foresight.

    Attributes:
        features: (n, features) float32 what the network sees.
        safe: (n, 3) whether a push up, none, a push down need not lead beyond the limit.
        signs: (n,) -1.0 where the observation was turned over.
        shares: (n, 2) how much of a push up, and of one down, is played.
        pushes: (n,) how hard a push is, in parts of the largest.
        bursts: (n,) the first inputs of the best bursts, in parts of the largest and not turned over; None where the
            energy is not limited.
    """

    features: npt.NDArray[np.float32]
    safe: npt.NDArray[np.bool_]
    signs: FloatArray
    shares: FloatArray
    pushes: FloatArray
    bursts: FloatArray | None = None

    def act(self, choices: npt.ArrayLike) -> npt.NDArray[np.float32]:
        """The actions (n, 1) of choices (n,), each of them a part of a push.

        Of a push no more is played than its share. One in whose direction no way is left within the limit becomes none
        or a push the other way; where none is too little, it is played in full. Where there are bursts, a choice is how
        much harder to push than the best of them does: not at all at -1, and twice as hard at 1, but no harder than a
        push is.
        """
        up, none, down = self.safe.T
        chosen = np.clip(np.asarray(choices, dtype=np.float64), -1.0, 1.0)
        rise, fall = self.pushes * self.shares.T
        if self.bursts is not None:
            chosen = np.clip(self.signs * self.bursts * (1.0 + chosen), -self.pushes, self.pushes)
        else:
            chosen = np.clip(self.pushes * chosen, -fall, rise)
        chosen = np.where((chosen > 0) & ~up, np.where(none, 0.0, -fall), chosen)
        chosen = np.where((chosen < 0) & ~down, np.where(none, 0.0, rise), chosen)
        chosen = np.where((chosen == 0) & ~none, np.where(up, rise, -fall), chosen)
        chosen = np.where(none, chosen, np.where(chosen > 0, rise, -fall))
        actions: npt.NDArray[np.float32] = (chosen * self.signs).astype(np.float32)[:, None]
        return actions
