"""Calls, and what comes of them: a result, a clear error, or a fault."""

from __future__ import annotations

import pickle
import re
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from gymnasium.error import Error as GymnasiumError
from numba.core import event

#: Longer is a hang [s]; compilation is not counted.
PATIENCE = 10.0

#: How a message of this project, of Gymnasium, or of Python about a call's arguments, says what is wrong.
_CLEAR = re.compile(
    r"\bmust\b|\bis no option\b|\bgoes? (with|together)\b|unexpected keyword argument|required positional argument"
    r"|\bis out of date\b|no hyperparameter|\bis for\b"
)


@dataclass(frozen=True)
class Call:
    """Something to try.

    Attributes:
        what: is called, for the table of faults.
        function: does it.
        names: of the arguments, one of which a clear message has.
        state: gives what a failed call must not change.
        sound: whether a result is one; says what is wrong with it, or nothing.
        given: arguments, to show with a fault.
    """

    what: str
    function: Callable[[], Any]
    names: tuple[str, ...]
    state: Callable[[], Any] | None = None
    sound: Callable[[Any], str] = lambda result: ""
    given: Any = None


@dataclass
class Tally:
    """How many calls ended in which way, and some of the faults, by what they are."""

    counts: Counter[str] = field(default_factory=Counter)
    faults: Counter[str] = field(default_factory=Counter)
    examples: dict[str, str] = field(default_factory=dict)

    def add(self, kind: str, fault: str = "", example: str = "") -> None:
        """Count an outcome; a fault with its first example."""
        self.counts[kind] += 1
        if fault:
            self.faults[f"{kind}: {fault}"] += 1
            self.examples.setdefault(f"{kind}: {fault}", example[:400])


class _Compiling(event.Listener):
    """Adds up the seconds that Numba compiles."""

    def __init__(self) -> None:
        self.seconds, self._depth, self._since = 0.0, 0, 0.0

    def on_start(self, event: Any) -> None:
        """A function begins to be compiled."""
        if self._depth == 0:
            self._since = time.perf_counter()
        self._depth += 1

    def on_end(self, event: Any) -> None:
        """It has been."""
        self._depth -= 1
        if self._depth == 0:
            self.seconds += time.perf_counter() - self._since


class Judge:
    """Tries calls, and counts."""

    def __init__(self) -> None:
        self.tally = Tally()
        self._compiling = _Compiling()
        event.register("numba:compile", self._compiling)

    def judge(self, call: Call) -> None:
        """Try a call."""
        before = pickle.dumps(call.state()) if call.state else b""
        began, compiled = time.perf_counter(), self._compiling.seconds
        kind, fault, example = "result", "", ""
        try:
            fault = call.sound(call.function())
            kind, fault = ("unsound result", f"{call.what}: {fault}") if fault else ("result", "")
        except MemoryError:
            kind, fault = "crash", f"{call.what}: MemoryError"
        except Exception as error:
            kind, example = _kind_of(error, call.names), f"{type(error).__name__}: {error}"
            fault = "" if kind == "clear error" else f"{call.what}: {type(error).__name__}"
            if call.state and pickle.dumps(call.state()) != before:
                kind, fault = "state changed", f"{call.what}: {type(error).__name__}"
        if time.perf_counter() - began - (self._compiling.seconds - compiled) > PATIENCE:
            kind, fault = "hang", call.what
        self.tally.add(kind, fault, f"{example} {call.given!r}" if fault else "")


def _kind_of(error: Exception, names: tuple[str, ...]) -> str:
    """Whether an error is clear: of a kind that is promised, and names an argument."""
    message = str(error)
    known = isinstance(error, ValueError | TypeError | FileNotFoundError | GymnasiumError)
    named = any(name in message for name in names)
    return "clear error" if known and named and _CLEAR.search(message) else "unclear error"
