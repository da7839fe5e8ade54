"""How far work is, told on stderr: a bar on a terminal, elsewhere a line now and then."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext

from estimator.checks import printable

#: Seconds until the first line where stderr is no terminal, and at least between two.
EVERY = 5.0

#: Longest line [characters].
WIDTH = 80

#: Seconds between two looks of a terminal.
_REDRAWN = 0.2

#: Is told the share of the work that is done, 0 to 1, and what it is at.
Tell = Callable[..., None]


def untold(share: float, at: str = "") -> None:
    """A `Tell` that keeps it to itself."""


@contextmanager
def progress(what: str = "") -> Iterator[Tell]:
    """Show how far the work within is, with the time that is left at the pace so far.

    Lines come 5 s apart at first, then ever less often; short work says nothing.

    Args:
        what: is being done.

    Yields:
        What is to be told ``(share, at)``, from any thread: the share that is done, 0 to 1, and a few words.
    """
    is_terminal = sys.stderr is not None and sys.stderr.isatty()
    with _bar() if is_terminal else nullcontext(_line) as show:
        yield _Teller(what, show, _REDRAWN if is_terminal else EVERY, not is_terminal)


class _Teller:
    """Passes on what is told, seldom enough."""

    def __init__(self, what: str, show: Callable[[float, str], None], every: float, slows: bool) -> None:
        self._what, self._show, self._every, self._slows = what, show, every, slows
        self._began = time.monotonic()
        self._next = self._began + (every if slows else 0.0)
        self._begun: float | None = None

    def __call__(self, share: float, at: str = "") -> None:
        now = time.monotonic()
        if self._begun is None:  # work that is gone on with has begun before
            self._begun = share
        if now < self._next:
            return
        passed = now - self._began
        self._next = now + max(self._every, passed / 4 if self._slows else 0.0)
        done = share - self._begun
        left = f", {duration(passed * (1 - share) / done)} left" if done > 0 else ""
        said = f"{self._what} {math.floor(100 * share)} %{left}".strip() + (f": {printable(at)}" if at else "")
        self._show(share, said if len(said) <= WIDTH else f"{said[: WIDTH - 3]}...")


def duration(seconds: float) -> str:
    """In whole seconds, minutes or hours.

    Example:
        >>> duration(3.2), duration(160.0), duration(10000.0)
        ('3 s', '3 min', '3 h')
    """
    for size, unit in ((3600, "h"), (60, "min")):
        if seconds > 2 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{seconds:.0f} s"


def _line(share: float, said: str) -> None:
    print(said, file=sys.stderr, flush=True)


@contextmanager
def _bar() -> Iterator[Callable[[float, str], None]]:
    """A bar that vanishes in the end."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    console = Console(stderr=True)
    console.width = min(WIDTH, console.width)
    columns = BarColumn(12), TextColumn("{task.description}", markup=False)
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task("", total=1.0)
        yield lambda share, said: bar.update(task, completed=share, description=said[: console.width - 14])
