"""Signals that end a run in order: the input is zeroed, and what was measured is kept."""

from __future__ import annotations

import signal
import threading
from types import FrameType
from typing import Any

#: What ends a run. After a signal the command's exit status is 128 + its number.
SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))

#: A call that a signal finds the program in is left by force after so many seconds.
_PATIENCE = 1.0


class Stopped(BaseException):
    """A signal came."""

    def __init__(self, signum: int) -> None:
        super().__init__(signal.Signals(signum).name)
        self.signum = signum


class Stopper:
    """Catches signals while it is entered, in the main thread.

    A signal is noticed by `check`, between two commands to the plant, so that none is cut in two. A command or a
    policy that does not come back within a second is interrupted.
    """

    def __init__(self) -> None:
        self._came: int | None = None
        self._former: dict[int, Any] = {}

    def __enter__(self) -> Stopper:
        if threading.current_thread() is threading.main_thread():
            self._former = {signum: signal.signal(signum, self._note) for signum in SIGNALS}
            if hasattr(signal, "setitimer"):
                self._former[signal.SIGALRM] = signal.signal(signal.SIGALRM, self._force)
        return self

    def __exit__(self, *reason: object) -> None:
        self._calm()
        for signum, handler in self._former.items():
            signal.signal(signum, handler)

    def check(self) -> None:
        """Raise `Stopped` where a signal came."""
        if self._came is not None:
            self._calm()
            raise Stopped(self._came)

    def ignore(self) -> None:
        """From now on no signal is noticed: the input is being zeroed."""
        self._calm()
        for signum in self._former:
            signal.signal(signum, signal.SIG_IGN)

    def _note(self, signum: int, frame: FrameType | None) -> None:
        self._came = signum
        if hasattr(signal, "setitimer"):
            signal.setitimer(signal.ITIMER_REAL, _PATIENCE)

    def _force(self, signum: int, frame: FrameType | None) -> None:
        if self._came is not None:
            raise Stopped(self._came)

    def _calm(self) -> None:
        if self._former and hasattr(signal, "setitimer"):
            signal.setitimer(signal.ITIMER_REAL, 0.0)
