"""The threads of Numba with which a batch steps its blocks."""

from __future__ import annotations

import os
import threading
from contextlib import AbstractContextManager, nullcontext

#: Process that has stepped with Numba's threads, which its children do not inherit.
_threaded_process: int | None = None

_threading_lock = threading.Lock()


def numba_thread_context(n_threads: int) -> AbstractContextManager[object] | None:
    """The context in which Numba may step with ``n_threads`` threads; None where it may not.

    It may not in the child of a process that has stepped with threads; one thread then gives the same results. The
    threading layer ``workqueue`` ends the process if two Python threads enter it at once, so there they wait.
    """
    import numba

    global _threaded_process
    _threaded_process = _threaded_process or os.getpid()
    if _threaded_process != os.getpid():
        return None
    numba.set_num_threads(n_threads)
    return _threading_lock if numba.threading_layer() == "workqueue" else nullcontext()
