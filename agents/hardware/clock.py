"""Clocks of a run: the machine's monotonic clock, and a clock that jumps, for simulated plants."""

from __future__ import annotations

import time
from typing import Protocol

#: Last part of a wait that is spent awake [s]: the operating system wakes a process late by about this much.
_BUSY_WAIT = 3e-4

#: Longest sleep [s], so that a signal is noticed.
_MAX_SLEEP = 0.05


class Clock(Protocol):
    """A time in seconds since an arbitrary origin."""

    def now(self) -> float:
        """The time."""
        ...

    def wait(self, until: float) -> None:
        """Return at this time, or at once where it has passed, or earlier where a signal came."""


class RealClock:
    """The machine's monotonic clock."""

    def now(self) -> float:
        """The time."""
        return time.perf_counter()

    def wait(self, until: float) -> None:
        """Sleep until shortly before the time, and wait the rest awake."""
        while (remaining := until - time.perf_counter()) > 0:
            if remaining > _BUSY_WAIT:
                time.sleep(min(remaining - _BUSY_WAIT, _MAX_SLEEP))


class JumpingClock:
    """A clock that jumps to the end of each wait: a run takes as long as its computations, and no tick is late."""

    def __init__(self) -> None:
        self._now = 0.0

    def now(self) -> float:
        """The time."""
        return self._now

    def wait(self, until: float) -> None:
        """Jump to the time, if it lies ahead."""
        self._now = max(self._now, until)
