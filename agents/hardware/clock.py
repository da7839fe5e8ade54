"""Clocks of a run: the machine's, and one that jumps, for simulated plants."""

from __future__ import annotations

import time
from typing import Protocol

#: The operating system wakes a process so late [s]: the rest is waited for awake.
_BUSY_WAIT = 3e-4

#: No sleep is longer [s], so that a signal is noticed.
_MAX_SLEEP = 0.05


class Clock(Protocol):
    """Seconds from an unknown beginning."""

    def now(self) -> float:
        """The time."""
        ...

    def wait(self, until: float) -> None:
        """Return at this time, or at once where it has passed; earlier where a signal came."""


class RealClock:
    """The machine's monotonic clock."""

    def now(self) -> float:
        """The time."""
        return time.perf_counter()

    def wait(self, until: float) -> None:
        """Sleep, and be awake a little before the time."""
        while (remaining := until - time.perf_counter()) > 0:
            if remaining > _BUSY_WAIT:
                time.sleep(min(remaining - _BUSY_WAIT, _MAX_SLEEP))


class JumpingClock:
    """A clock that jumps to the time that is waited for: a run takes as long as its computations, and none is late."""

    def __init__(self) -> None:
        self._now = 0.0

    def now(self) -> float:
        """The time."""
        return self._now

    def wait(self, until: float) -> None:
        """Jump."""
        self._now = max(self._now, until)
