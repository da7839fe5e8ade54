"""How results are printed and written: tables, JSON files, and the versions that they were made with."""

from __future__ import annotations

import json
import platform
import textwrap
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from estimator.checks import printable
from estimator.files import check_place, write_atomically

#: Of a table for the manual [characters].
_WIDEST = 10_000


def show(*parts: Any, width: int = 100) -> None:
    """Print texts and tables, as wide as the terminal but at least so many characters.

    A table for the manual is as wide as its cells.
    """
    from rich.box import MARKDOWN
    from rich.console import Console
    from rich.measure import Measurement

    console = Console(highlight=False, markup=False, emoji=False)
    width = max(console.width, width)
    for part in parts:
        is_whole = getattr(part, "box", None) is MARKDOWN
        options = console.options.update(max_width=_WIDEST)
        console.width = max(width, Measurement.get(console, options, part).maximum) if is_whole else width
        console.print(printable(part, "\n") if isinstance(part, str) else part)


@contextmanager
def spinner(what: str) -> Iterator[Callable[[str], None]]:
    """A spinner on stderr, and what tells it a new text."""
    from rich.console import Console
    from rich.text import Text

    with Console(stderr=True).status(what) as status:
        yield lambda text: status.update(Text(printable(text)))


def table(titles: Sequence[str], rows: Iterable[Sequence[str]], *, markdown: bool = False, title: str = "") -> Any:
    """A table of texts for `show`: the first column to the left, the others to the right, titles broken before cells.

    Args:
        titles: of the columns.
        rows: their cells.
        markdown: whether the manual is to take the table as it is.
        title: above the table.
    """
    from rich.box import MARKDOWN, SIMPLE_HEAD
    from rich.table import Table

    made = Table(
        box=MARKDOWN if markdown else SIMPLE_HEAD, show_edge=markdown, padding=(0, 1) if markdown else (0, 1, 0, 0),
        title=title or None,
    )  # fmt: skip
    cells = [[printable(cell, "\n") for cell in row] for row in rows]
    for place, text in enumerate(titles):
        below = "\n".join(cell for row in cells for cell in row[place : place + 1]).splitlines()
        width = max([10, *map(len, below)])
        broken = (textwrap.fill(line, width, break_long_words=False) for line in text.splitlines())
        heading = text if markdown else "\n".join(broken)
        made.add_column(heading, justify="left" if markdown or place == 0 else "right", no_wrap=markdown)
    for row in cells:
        made.add_row(*row)
    return made


def write_json(path: Path, content: Any) -> None:
    """Write a JSON file in one piece; a number that is not finite, as null.

    Raises:
        OSError: where it cannot be written.
    """
    write_atomically(path, json.dumps(finite(content), indent=2, ensure_ascii=False, allow_nan=False) + "\n")


def finite(content: Any) -> Any:
    """What JSON can hold: a number that is not finite becomes null."""
    if isinstance(content, dict):
        return {key: finite(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [finite(value) for value in content]
    return None if isinstance(content, float) and not np.isfinite(content) else content


def check_file(name: str, path: Path | None) -> None:
    """Refuse a folder where a file is to be written, and where none can be, before the work begins.

    Raises:
        IsADirectoryError: naming the argument.
        OSError: naming the path, where it cannot be written.
    """
    if path is None:
        return
    if path.is_dir():
        raise IsADirectoryError(f"{name} must be a file, but is the folder {path}; name a file in it")
    check_place(path)


def check_folder(name: str, path: Path) -> None:
    """Refuse a file where a folder is to be, and where none can be written to, before the work begins.

    Raises:
        NotADirectoryError: naming the argument.
        OSError: naming the path, where nothing can be written.
    """
    for place in (path, *path.parents):
        if place.exists() and not place.is_dir():
            raise NotADirectoryError(f"{name} must be a folder, but {place} is a file; name another place")
    check_place(path)


#: What the numbers of a result depend on.
PACKAGES = ("duffing-env", "gymnasium", "numpy", "numba", "scipy")


def versions(*packages: str) -> dict[str, str]:
    """Of Python, of `PACKAGES`, and of these packages."""
    return {"python": platform.python_version(), **{name: version(name) for name in (*PACKAGES, *packages)}}
