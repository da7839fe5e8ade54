"""Progress of long work on stderr: a bar on a terminal, elsewhere a line from time to time."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext
from typing import TypeVar

from estimator.support.argument_checks import mask_control_codes

Task = TypeVar("Task")

#: Shortest time to the first line and between lines, where stderr is no terminal [s].
REPORT_INTERVAL = 5.0

#: Longest line [characters].
MAX_LINE_WIDTH = 80

#: Shortest time between two updates of a terminal [s].
_REDRAW_INTERVAL = 0.2

#: Function that receives the share of the work that is done, 0 to 1, and the current step in a few words.
ProgressCallback = Callable[..., None]


def ignore_progress(share: float, current_step: str = "") -> None:
    """A `ProgressCallback` that prints nothing."""


@contextmanager
def show_progress(title: str = "") -> Iterator[ProgressCallback]:
    """Show the progress of the work in the context, with the remaining time at the pace so far.

    Lines are 5 s apart at first, and later farther apart; short work prints nothing.

    Args:
        title: name of the work.

    Yields:
        A `ProgressCallback`, for any thread: ``(share, current_step)``.
    """
    is_terminal = sys.stderr is not None and sys.stderr.isatty()
    with _terminal_bar() if is_terminal else nullcontext(_print_line) as display:
        yield _ThrottledProgress(title, display, _REDRAW_INTERVAL if is_terminal else REPORT_INTERVAL, not is_terminal)


class _ThrottledProgress:
    """A `ProgressCallback` that displays at most one line per interval.

    Args:
        title: name of the work.
        display: function that displays a share and a line.
        interval: time between two lines [s].
        slows_down: whether the interval grows to a quarter of the elapsed time.
    """

    def __init__(self, title: str, display: Callable[[float, str], None], interval: float, slows_down: bool) -> None:
        self._title, self._show, self._interval, self._slows_down = title, display, interval, slows_down
        self._start_time = time.monotonic()
        self._next_time = self._start_time + (interval if slows_down else 0.0)
        self._first_share: float | None = None

    def __call__(self, share: float, current_step: str = "") -> None:
        now = time.monotonic()
        if self._first_share is None:  # resumed work does not start from 0
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
    """A time in whole seconds, minutes or hours.

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
    """A bar that disappears at the end."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    console = Console(stderr=True)
    console.width = min(MAX_LINE_WIDTH, console.width)
    columns = BarColumn(12), TextColumn("{task.description}", markup=False)
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task("", total=1.0)
        yield lambda share, line: bar.update(task, completed=share, description=line[: console.width - 14])


def iterate_with_progress(tasks: Iterable[tuple[str, Task]]) -> Iterator[Task]:
    """Yield the tasks of (name, task), one after the other, while `show_progress` shows the name of the current one."""
    tasks = list(tasks)
    with show_progress() as on_progress:
        for done, (name, task) in enumerate(tasks):
            on_progress(done / len(tasks), name)
            yield task
