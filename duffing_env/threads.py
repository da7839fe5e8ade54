"""Numba's threads, which all environments of a process share."""

from __future__ import annotations

import os
import threading
from contextlib import AbstractContextManager, nullcontext

#: The process whose threads have stepped: they do not live on in its children.
_process: int | None = None

_turn = threading.Lock()


def use_threads(number: int) -> AbstractContextManager[object] | None:
    """The context in which Numba may step with so many threads; None where it may not.

    It may not in the child of a process that has: one thread then does it all, with the same results. One of Numba's
    threading layers can be entered by one Python thread at a time, and ends the process where two do: there they wait
    for each other.
    """
    import numba

    global _process
    _process = _process or os.getpid()
    if _process != os.getpid():
        return None
    numba.set_num_threads(number)
    return _turn if numba.threading_layer() == "workqueue" else nullcontext()
