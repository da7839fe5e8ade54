"""Table tests: one item, in which every row passes or fails by itself."""

import inspect
from collections.abc import Callable, Iterable
from functools import wraps
from typing import Any

import pytest


def table(names: str | tuple[str, ...], rows: Iterable[Any]) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """As `pytest.mark.parametrize`, but for rows that take milliseconds: they are one test, with a subtest each.

    Fixtures are shared by all rows, but each has a ``tmp_path`` and a ``monkeypatch`` of its own.
    """
    names, rows = (names,) if isinstance(names, str) else names, list(rows)

    def decorate(test: Callable[..., None]) -> Callable[..., None]:
        given = inspect.signature(test).parameters
        fixtures = [parameter for name, parameter in given.items() if name not in (*names, "subtests")]

        @wraps(test)
        def each_row(*, subtests: Any, **shared: Any) -> None:
            for i, row in enumerate(rows):
                values = dict(zip(names, (row,) if len(names) == 1 else row, strict=True))
                if "subtests" in given:  # of another table
                    values["subtests"] = subtests
                if "tmp_path" in shared:
                    values["tmp_path"] = shared["tmp_path"] / str(i)
                    values["tmp_path"].mkdir()
                with subtests.test(f"{i}: {row!r}"[:100]), pytest.MonkeyPatch.context() as patch:
                    if "monkeypatch" in shared:
                        values["monkeypatch"] = patch
                    test(**shared | values)

        keyword = inspect.Parameter.KEYWORD_ONLY
        found = [parameter.replace(kind=keyword) for parameter in fixtures]
        each_row.__signature__ = inspect.Signature([*found, inspect.Parameter("subtests", keyword)])  # type: ignore[attr-defined]
        return each_row

    return decorate
