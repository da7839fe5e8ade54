"""Signals that end a run, or a command, in order: the input is zeroed, and what was measured or learned is kept."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

#: What ends a run. After a signal the command's exit status is 128 + its number.
SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))

#: A call that a signal finds the program in is left by force after so many seconds.
_PATIENCE = 1.0


class Stopped(BaseException):
    """A signal came.

    Args:
        signum: its number.
        left: what is left of the work, and how to go on.
    """

    def __init__(self, signum: int, left: str = "") -> None:
        super().__init__(signal.Signals(signum).name)
        self.signum, self.left = signum, left


class Stopper:
    """Catches signals while it is entered, in the main thread.

    A signal is noticed by `check`, between two commands to the plant, so that none is cut in two. A command or a
    policy that does not come back within ``patience`` seconds is interrupted.
    """

    def __init__(self, patience: float = _PATIENCE) -> None:
        self._patience = patience
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

    @property
    def is_asked(self) -> bool:
        """Whether a signal came."""
        return self._came is not None

    def check(self, left: str = "") -> None:
        """Raise `Stopped` where a signal came; ``left`` says what is left."""
        if self._came is not None:
            self._calm()
            raise Stopped(self._came, left)

    def ignore(self) -> None:
        """From now on no signal is noticed: the input is being zeroed."""
        self._calm()
        for signum in self._former:
            signal.signal(signum, signal.SIG_IGN)

    def _note(self, signum: int, frame: FrameType | None) -> None:
        self._came = signum
        if hasattr(signal, "setitimer"):
            signal.setitimer(signal.ITIMER_REAL, self._patience)

    def _force(self, signum: int, frame: FrameType | None) -> None:
        if self._came is not None:
            raise Stopped(self._came)

    def _calm(self) -> None:
        if self._former and hasattr(signal, "setitimer"):
            signal.setitimer(signal.ITIMER_REAL, 0.0)


@contextmanager
def telling(left: Callable[[str], str]) -> Iterator[None]:
    """Let a signal that ends the work within say what is left of it: ``left`` makes that of what is said already."""
    try:
        yield
    except (KeyboardInterrupt, Stopped) as stopped:
        signum, said = (stopped.signum, stopped.left) if isinstance(stopped, Stopped) else (signal.SIGINT, "")
        raise Stopped(signum, left(said)) from stopped


@contextmanager
def stopped_by_sigterm() -> Iterator[None]:
    """Let SIGTERM raise `Stopped`, as Ctrl-C raises KeyboardInterrupt, in the main thread, which alone is told."""

    def stop(signum: int, frame: FrameType | None) -> None:
        raise Stopped(signum)

    is_main = threading.current_thread() is threading.main_thread()
    former = signal.signal(signal.SIGTERM, stop) if is_main else None
    try:
        yield
    finally:
        if is_main:
            signal.signal(signal.SIGTERM, former)
