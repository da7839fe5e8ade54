"""Taking turns: in an environment, which two threads at once would confuse, and on Numba's threads."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from functools import wraps
from typing import Any, TypeVar

Method = TypeVar("Method", bound=Callable[..., Any])


#: The process whose threads have stepped: they do not live on in its children.
_process: int | None = None

_turn = threading.Lock()


def in_turn(method: Method) -> Method:
    """Refuse a call of a method while another call that is in turn has not returned; nothing has changed then.

    The object has a list ``_turn`` of one entry, which a call takes out and puts back: a lock that can be copied.

    Raises:
        RuntimeError: for the second call.
    """

    @wraps(method)
    def called(self: Any, *args: Any, **kwargs: Any) -> Any:
        try:
            token = self._turn.pop()
        except IndexError:
            raise RuntimeError(
                f"{method.__name__} must wait until the last call of this environment has returned, but another thread "
                "called it meanwhile; give each thread an environment of its own"
            ) from None
        try:
            return method(self, *args, **kwargs)
        finally:
            self._turn.append(token)

    return called  # type: ignore[return-value]


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
