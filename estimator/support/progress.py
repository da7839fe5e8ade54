"""How far work is, told on stderr: a bar on a terminal, elsewhere a line now and then."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext

from estimator.support.argument_checks import mask_control_codes

#: Seconds until the first line where stderr is no terminal, and at least between two.
REPORT_INTERVAL = 5.0

#: Longest line [characters].
MAX_LINE_WIDTH = 80

#: Seconds between two looks of a terminal.
_REDRAW_INTERVAL = 0.2

#: Is told the share of the work that is done, 0 to 1, and what it is at.
ProgressCallback = Callable[..., None]


def ignore_progress(share: float, current_step: str = "") -> None:
    """A `ProgressCallback` that keeps it to itself."""


@contextmanager
def show_progress(title: str = "") -> Iterator[ProgressCallback]:
    """Show how far the work within is, with the time that is left at the pace so far.

    Lines come 5 s apart at first, then ever less often; short work says nothing.

    Args:
        title: is being done.

    Yields:
        What is to be told ``(share, at)``, from any thread: the share that is done, 0 to 1, and a few words.
    """
    is_terminal = sys.stderr is not None and sys.stderr.isatty()
    with _terminal_bar() if is_terminal else nullcontext(_print_line) as display:
        yield _ThrottledProgress(title, display, _REDRAW_INTERVAL if is_terminal else REPORT_INTERVAL, not is_terminal)


class _ThrottledProgress:
    """Passes on what is told, seldom enough."""

    def __init__(self, title: str, display: Callable[[float, str], None], interval: float, slows_down: bool) -> None:
        self._title, self._show, self._interval, self._slows_down = title, display, interval, slows_down
        self._start_time = time.monotonic()
        self._next_time = self._start_time + (interval if slows_down else 0.0)
        self._first_share: float | None = None

    def __call__(self, share: float, current_step: str = "") -> None:
        now = time.monotonic()
        if self._first_share is None:  # work that is gone on with has begun before
            self._first_share = share
        if now < self._next_time:
            return
        elapsed = now - self._start_time
        self._next_time = now + max(self._interval, elapsed / 4 if self._slows_down else 0.0)
        done = share - self._first_share
        left = f", {format_duration(elapsed * (1 - share) / done)} left" if done > 0 else ""
        line = f"{self._title} {math.floor(100 * share)} %{left}".strip() + (
            f": {mask_control_codes(current_step)}" if current_step else ""
        )
        self._show(share, line if len(line) <= MAX_LINE_WIDTH else f"{line[: MAX_LINE_WIDTH - 3]}...")


def format_duration(seconds: float) -> str:
    """In whole seconds, minutes or hours.

    Example:
        >>> format_duration(3.2), format_duration(160.0), format_duration(10000.0)
        ('3 s', '3 min', '3 h')
    """
    for size, unit in ((3600, "h"), (60, "min")):
        if seconds > 2 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{seconds:.0f} s"


def _print_line(share: float, line: str) -> None:
    print(line, file=sys.stderr, flush=True)


@contextmanager
def _terminal_bar() -> Iterator[Callable[[float, str], None]]:
    """A bar that vanishes in the end."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    console = Console(stderr=True)
    console.width = min(MAX_LINE_WIDTH, console.width)
    columns = BarColumn(12), TextColumn("{task.description}", markup=False)
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task("", total=1.0)
        yield lambda share, said: bar.update(task, completed=share, description=said[: console.width - 14])
