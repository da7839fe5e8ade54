"""Time rows in rounds, every row once in each, so that a busy moment of the machine affects all of them."""

import math
import os
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any

#: Cores that this process may use.
CORES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1

#: Shortest run of a row [s]: the clock and an interrupt are then errors below a percent.
LONG_ENOUGH = 0.25

#: Pause before a run [s]: spinning threads of the row before stop within milliseconds and free the cores.
SETTLING = 0.02

#: Units of work per second.
_RATES = ("env-steps/s", "flop/s", "op/s")

#: Units of time or memory per work: factor from seconds, or MiB.
_COSTS = {"ns/env-step": 1e9, "µs/sample": 1e6, "µs/decision": 1e6, "s": 1.0, "MiB": 1.0}


@dataclass(frozen=True)
class Row:
    """A row to time.

    Attributes:
        name: name, unique within its section.
        unit: ``env-steps/s`` and other rates are work per second; ``µs/sample`` and other costs seconds per work.
        run: does its smallest unit of work ``count`` times; returns seconds and work.
        at_least: shortest run [s]; with 0 the row is neither warmed up nor repeated within a run.
    """

    name: str
    unit: str
    run: Callable[[int], tuple[float, float]]
    at_least: float = LONG_ENOUGH


@dataclass(frozen=True)
class Result:
    """The times of a row.

    Attributes:
        name: name of the row.
        unit: unit of the values.
        values: one for each repetition, in order; empty where the row could not run.
        reason: why the row could not run.
    """

    name: str
    unit: str
    values: tuple[float, ...] = ()
    reason: str = ""

    @property
    def median(self) -> float:
        """NaN where the row could not run."""
        return statistics.median(self.values) if self.values else math.nan

    def to_dict(self) -> dict[str, Any]:
        """For the JSON file."""
        if not self.values:
            return {"name": self.name, "unit": self.unit, "not_available": self.reason}
        summary = {"median": self.median, "min": min(self.values), "max": max(self.values)}
        return {"name": self.name, "unit": self.unit, **summary, "values": list(self.values)}


@dataclass
class _Course:
    """A row and its values so far."""

    row: Row
    count: int = 1
    values: list[float] = field(default_factory=list)
    reason: str = ""


def measure(
    rows: Sequence[Row], repetitions: int, on_row: Callable[[str], None] = lambda name: None
) -> dict[str, Result]:
    """Time rows in turns: warm all of them up, then ``repetitions`` rounds, each beginning at another row.

    A row that raises an error is left out of further rounds, and its result has the reason.

    Args:
        rows: rows to time.
        repetitions: rounds, at least 1.
        on_row: called with each row's name before its turn.

    Returns:
        Name to result, in the order of ``rows``.
    """
    if repetitions < 1:
        raise ValueError(f"repetitions must be at least 1, but is {repetitions}")
    if len({row.name for row in rows}) < len(rows):
        raise ValueError(f"rows must have different names, but are {[row.name for row in rows]}")
    courses = [_Course(row) for row in rows]
    for course in courses:
        if course.row.at_least > 0:
            on_row(f"warm-up: {course.row.name}")
            _attempt(course, _calibrate)
    for round_ in range(repetitions):
        first = round_ * len(courses) // repetitions
        for course in courses[first:] + courses[:first]:
            if not course.reason:
                on_row(f"{round_ + 1}/{repetitions}: {course.row.name}")
                _attempt(course, _run_once)
    return {
        c.row.name: Result(c.row.name, c.row.unit, () if c.reason else tuple(c.values), c.reason) for c in courses
    }  # fmt: skip


def _attempt(course: _Course, action: Callable[[_Course], None]) -> None:
    time.sleep(SETTLING)
    try:
        action(course)
    except Exception as error:
        course.reason = f"{type(error).__name__}: {error}"


def _calibrate(course: _Course) -> None:
    """Compile by a first run; then lengthen the run until it lasts long enough."""
    course.row.run(1)
    seconds, _ = course.row.run(1)
    while seconds < course.row.at_least:
        course.count = math.ceil(course.count * min(50.0, 1.2 * course.row.at_least / max(seconds, 1e-9)))
        seconds, _ = course.row.run(course.count)


def _run_once(course: _Course) -> None:
    seconds, work = course.row.run(course.count)
    course.values.append(work / seconds if course.row.unit in _RATES else _COSTS[course.row.unit] * seconds / work)


def timed(action: Callable[[int], float]) -> Callable[[int], tuple[float, float]]:
    """Make a row's ``run`` from a function that works and returns the amount of work."""

    def run(count: int) -> tuple[float, float]:
        started = time.perf_counter()
        work = action(count)
        return time.perf_counter() - started, work

    return run


def later(make: Callable[[], Callable[[int], Any]]) -> Callable[[int], Any]:
    """Make a row's ``run``, or an argument of `timed`, whose set-up runs at its first call."""
    made = cache(make)
    return lambda count: made()(count)
