"""Fuzzed calls and their verdicts: a result, a clear error, or a fault."""

import pickle
import re
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
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
        state: gives the part that a failed call must not change.
        sound: whether a result is one; says what is wrong with it, or nothing.
        given: arguments, to show with a fault.
    """

    what: str
    function: Callable[[], Any]
    names: tuple[str, ...]
    state: Callable[[], Any] | None = None
    sound: Callable[[Any], str] = lambda result: ""
    given: Any = None


class Judge:
    """Tries calls, and counts.

    Attributes:
        tally: ``counts`` of calls by the way they ended, ``faults`` by what they are, and their first ``examples``.
    """

    def __init__(self) -> None:
        self.tally: dict[str, Any] = {"counts": Counter(), "faults": Counter(), "examples": {}}
        self._compiling = event.TimingListener()
        event.register("numba:compile", self._compiling)

    def judge(self, call: Call) -> None:
        """Try a call."""
        before = pickle.dumps(call.state()) if call.state else b""
        began = time.perf_counter() - self._compiled()
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
        if time.perf_counter() - self._compiled() - began > PATIENCE:
            kind, fault = "hang", call.what
        self.tally["counts"][kind] += 1
        if fault:
            self.tally["faults"][f"{kind}: {fault}"] += 1
            self.tally["examples"].setdefault(f"{kind}: {fault}", f"{example} {call.given!r}"[:400])

    def _compiled(self) -> float:
        """Seconds that Numba has compiled so far."""
        return float(self._compiling.duration) if self._compiling.done else 0.0


def _kind_of(error: Exception, names: tuple[str, ...]) -> str:
    """Whether an error is clear: of a kind that is promised, and names an argument."""
    message = str(error)
    known = isinstance(error, ValueError | TypeError | FileNotFoundError | GymnasiumError)
    named = any(name in message for name in names)
    return "clear error" if known and named and _CLEAR.search(message) else "unclear error"
