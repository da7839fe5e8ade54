"""What a run is to do: the settings of ``duffing-env run``."""

from __future__ import annotations

import math
from dataclasses import dataclass

#: Shortest time of silence that the watchdog is told [s].
_SHORTEST = 2.0


@dataclass(frozen=True)
class Plan:
    """What a run is to do.

    Attributes:
        policy: a signal or ``efe`` (`agents.make_policy`); sample by sample also any other policy.
        samples: of the run.
        block: samples of a block; None: sample by sample, against the clock.
        bound: of the probability that a block, or a whole signal, takes the output out of its range.
        listen: samples without input at the start, which tell where the rig stands.
        watchdog: seconds of silence after which the plant zeroes its input. None: 2, or 20 sampling steps if that is
            longer; and a block's length besides.
        no_watchdog: run on a plant that has none.
        stale: outputs in a row that are missing, or the same number again, which end the run; 0: never.
        seed: of the policy, and of the systems that are drawn from the belief.

    Raises:
        ValueError: naming the argument, the value and the remedy.
    """

    policy: str = "efe"
    samples: int = 256
    block: int | None = None
    bound: float = 0.05
    listen: int = 16
    watchdog: float | None = None
    no_watchdog: bool = False
    stale: int = 32
    seed: int = 0

    def __post_init__(self) -> None:
        least = {"samples": 1, "block": 8, "listen": 1, "stale": 0, "seed": 0}
        for name, low in least.items():
            value = getattr(self, name)
            if (name != "block" or value is not None) and (not isinstance(value, int) or value < low):
                raise ValueError(f"{name} must be a whole number of at least {low}, but is {value!r}")
        if not 0 < self.bound < 1:
            raise ValueError(f"bound must be a probability between 0 and 1, but is {self.bound!r}; 0.05 is usual")
        if self.watchdog is not None and not 0 < self.watchdog < math.inf:
            raise ValueError(f"watchdog must be positive, in seconds, but is {self.watchdog!r}")

    def silence(self, step: float) -> float | None:
        """Seconds that the watchdog is told; None for none."""
        if self.no_watchdog:
            return None
        return self.watchdog or max(_SHORTEST, 20 * step) + 2 * (self.block or 0) * step
