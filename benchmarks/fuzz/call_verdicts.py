"""Calls with fuzzed arguments and their verdicts: a result, a clear error, or a fault."""

import pickle
import re
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from gymnasium.error import Error as GymnasiumError
from numba.core import event

#: A longer call is a hang [s]. Compilation does not count.
PATIENCE = 10.0

#: Words of a clear message from this project, from Gymnasium, or from Python about arguments.
_CLEAR = re.compile(
    r"\bmust\b|\bis no option\b|\bgoes? (with|together)\b|unexpected keyword argument|required positional argument"
    r"|\bis out of date\b|no hyperparameter|\bis for\b"
)


@dataclass(frozen=True)
class Call:
    """A call to try.

    Attributes:
        what: name in the table of faults.
        function: calls with the fuzzed arguments.
        names: names of arguments; a clear message has one of them.
        state: returns the state that a failed call must not change.
        sound: says what is wrong with a result; empty where nothing is.
        given: arguments to print with a fault.
    """

    what: str
    function: Callable[[], Any]
    names: tuple[str, ...]
    state: Callable[[], Any] | None = None
    sound: Callable[[Any], str] = lambda result: ""
    given: Any = None


class Judge:
    """Tries calls and counts the verdicts.

    Attributes:
        tally: ``counts`` by verdict, ``faults`` by verdict and call, and the first of the ``examples`` of each fault.
    """

    def __init__(self) -> None:
        self.tally: dict[str, Any] = {"counts": Counter(), "faults": Counter(), "examples": {}}
        self._compiling = event.TimingListener()
        event.register("numba:compile", self._compiling)

    def judge(self, call: Call) -> None:
        """Try a call and count its verdict."""
        before = pickle.dumps(call.state()) if call.state else b""
        began = time.perf_counter() - self._compiled()
        kind, fault, example = "result", "", ""
        try:
            if wrong := call.sound(call.function()):
                kind, fault = "unsound result", f"{call.what}: {wrong}"
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
        """Time that Numba has compiled so far [s]."""
        return float(self._compiling.duration) if self._compiling.done else 0.0


def _kind_of(error: Exception, names: tuple[str, ...]) -> str:
    """``clear error`` where the error is of a documented type and its message names an argument and what is wrong."""
    message = str(error)
    known = isinstance(error, ValueError | TypeError | FileNotFoundError | GymnasiumError)
    named = any(name in message for name in names)
    return "clear error" if known and named and _CLEAR.search(message) else "unclear error"
