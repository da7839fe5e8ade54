"""One call at a time: an environment that two threads step at once would mix two steps into one."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar

Method = TypeVar("Method", bound=Callable[..., Any])


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
