"""Handling of SIGINT, SIGTERM and SIGHUP: a run or a training ends in order, and its data are kept."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

#: Signals that end a run; the exit status of the command is then 128 + the signal's number.
STOP_SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))

#: Time after a signal at which a call that has not returned is interrupted [s].
_CALL_PATIENCE = 1.0


class Interrupted(BaseException):
    """A signal interrupted the work.

    Args:
        signum: number of the signal.
        resume_hint: how to go on with the work.
    """

    def __init__(self, signum: int, resume_hint: str = "") -> None:
        super().__init__(signal.Signals(signum).name)
        self.signum, self.resume_hint = signum, resume_hint


class InterruptHandler:
    """Catches signals while it is entered, in the main thread.

    `raise_if_interrupted` notices a signal between two commands to a plant, so that no command is cut in two. A command
    or a policy that does not return within ``patience`` seconds after a signal is interrupted.
    """

    def __init__(self, patience: float = _CALL_PATIENCE) -> None:
        self._patience = patience
        self._signum: int | None = None
        self._old_handlers: dict[int, signal.Handlers | Callable[[int, FrameType | None], Any] | int | None] = {}

    def __enter__(self) -> InterruptHandler:
        if threading.current_thread() is threading.main_thread():
            self._old_handlers = {signum: signal.signal(signum, self._on_signal) for signum in STOP_SIGNALS}
            if hasattr(signal, "setitimer"):
                self._old_handlers[signal.SIGALRM] = signal.signal(signal.SIGALRM, self._on_timeout)
        return self

    def __exit__(self, *reason: object) -> None:
        self._cancel_timer()
        for signum, handler in self._old_handlers.items():
            signal.signal(signum, handler)

    @property
    def is_requested(self) -> bool:
        """Whether a signal came."""
        return self._signum is not None

    def raise_if_interrupted(self, resume_hint: str = "") -> None:
        """Raise `Interrupted` with this hint where a signal came."""
        if self._signum is not None:
            self._cancel_timer()
            raise Interrupted(self._signum, resume_hint)

    def ignore_signals(self) -> None:
        """Ignore signals from now on, while the input is being zeroed."""
        self._cancel_timer()
        for signum in self._old_handlers:
            signal.signal(signum, signal.SIG_IGN)

    def _on_signal(self, signum: int, frame: FrameType | None) -> None:
        self._signum = signum
        if hasattr(signal, "setitimer"):
            signal.setitimer(signal.ITIMER_REAL, self._patience)

    def _on_timeout(self, signum: int, frame: FrameType | None) -> None:
        if self._signum is not None:
            raise Interrupted(self._signum)

    def _cancel_timer(self) -> None:
        if self._old_handlers and hasattr(signal, "setitimer"):
            signal.setitimer(signal.ITIMER_REAL, 0.0)


@contextmanager
def add_resume_hint(make_hint: Callable[[str], str]) -> Iterator[None]:
    """Add a hint to the `Interrupted` of the work within; ``make_hint`` gets the hint that it has already."""
    try:
        yield
    except (KeyboardInterrupt, Interrupted) as interruption:
        signum, previous_hint = (
            (interruption.signum, interruption.resume_hint)
            if isinstance(interruption, Interrupted)
            else (signal.SIGINT, "")
        )
        raise Interrupted(signum, make_hint(previous_hint)) from interruption


@contextmanager
def raise_on_sigterm() -> Iterator[None]:
    """Let SIGTERM raise `Interrupted` in the main thread, as Ctrl-C raises KeyboardInterrupt."""

    def stop(signum: int, frame: FrameType | None) -> None:
        raise Interrupted(signum)

    is_main = threading.current_thread() is threading.main_thread()
    old_handler = signal.signal(signal.SIGTERM, stop) if is_main else None
    try:
        yield
    finally:
        if is_main:
            signal.signal(signal.SIGTERM, old_handler)
