"""Columns of a table: which are time, input and output, and in what unit, by their names."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

#: Names of columns, in lower case, up to the first character that is not a letter.
_INPUTS = ("u", "input", "force", "f", "in", "drive", "excitation")
#: Kind of an output to the words that name it.
KINDS = {
    "displacement": ("displacement", "disp", "position", "pos"),
    "velocity": ("velocity", "vel", "v"),
    "acceleration": ("acceleration", "acc", "a"),
}
_OUTPUTS = ("y", "output", "out", "response", "x", *(word for words in KINDS.values() for word in words))
_TIMES = ("t", "time")

#: What a time column may be in [s].
SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "μs": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0}

#: What stands in place of a unit where there is none.
_NONE = ("", "-")


def word_of(name: str) -> str:
    """The first word of a column's name, in lower case."""
    words = "".join(c if c.isalpha() else " " for c in name.lower()).split()
    return words[0] if words else ""


def unit_of(name: str) -> str | None:
    """What stands in brackets behind the name of a column, as N in ``force [N]``; None where nothing does."""
    found = re.search(r"[\[(]\s*([^\])]+?)\s*[\])]\s*$", name)
    return found.group(1) if found else None


def plain(unit: str) -> str:
    """A unit in one way of writing."""
    for written, usual in (("µ", "u"), ("μ", "u"), ("²", "2"), ("^", ""), ("·", " "), ("*", " ")):
        unit = unit.replace(written, usual)
    return unit.replace(" ", "")


def with_unit(path: Path, name: str, unit: str) -> str:
    """The name of a column with the unit that stands below it, with or without brackets.

    Raises:
        ValueError: where the name has another.
    """
    told, below = unit_of(name), re.sub(r"^[\[(]\s*(.*?)\s*[\])]$", r"\1", unit.strip())
    if told and below not in _NONE and plain(told) != plain(below):
        raise ValueError(f"{path}: {name!r:.60} must have one unit, but {below!r:.40} stands below; mend one")
    return name if told or below in _NONE else f"{name} [{below}]"


def chosen(
    path: Path, names: Sequence[str], count: int, source: str | None, sink: str | None
) -> tuple[int | None, int, int]:
    """Places of time (or None), input and output.

    Args:
        path: of the file.
        names: of its columns; empty where it names none.
        count: of its columns.
        source: name of the input's column; one of the usual names where it is None.
        sink: of the output's, likewise.

    Raises:
        ValueError: where they are not told, or not by one column each.
    """
    if not names:
        if source or sink:
            raise ValueError(
                f"{path} must name its columns, because the rig does, but has numbers alone; add them as a "
                f"first line, or leave column out of the rig"
            )
        if count not in (2, 3):
            raise ValueError(f"{path} must have two columns, u and y, or three with the time, but has {count}")
        return (None, 0, 1) if count == 2 else (0, 1, 2)
    wished = [_named(path, names, wish, table) for wish, table in ((source, "input"), (sink, "output"))]
    if wished[0] and wished[0] == wished[1]:
        raise ValueError(f"{path} must have two columns, but the rig names {source!r} for input and output; mend one")
    free = [k for k in range(len(names)) if [k] not in wished]
    time, u, y = ([k for k in free if word_of(names[k]) in known] for known in (_TIMES, _INPUTS, _OUTPUTS))
    u, y = wished[0] or u, wished[1] or y
    time = time or [k for k in free if unit_of(names[k]) in SECONDS]
    if len(u) != 1 or len(y) != 1 or len(time) > 1:
        raise ValueError(
            f"{path} must have one column of inputs and one of outputs, such as 'u,y', but has {list(names)}; rename: "
            f"an input is called {_listed(_INPUTS)}, an output {_listed(_OUTPUTS)}; or name them, as column = '...' in "
            f"the rig's [input] and [output], or by --input and --output of duffing-env rig init"
        )
    return (time[0] if time else None), u[0], y[0]


def _named(path: Path, names: Sequence[str], wish: str | None, table: str) -> list[int]:
    """The place of the column that a rig names, in a list; an empty one where it names none."""
    if wish is None:
        return []
    found = [k for k, name in enumerate(names) if _is(name, wish)]
    if len(found) != 1:
        raise ValueError(
            f"{path} must have one column {wish!r:.60}, which the rig's [{table}] names, but has {list(names)}; mend "
            f"one of them"
        )
    return found


def _is(name: str, wish: str) -> bool:
    """Whether a column is the one that is wished, with or without the unit behind its name."""
    bare = re.sub(r"\s*[\[(][^\])]*[\])]\s*$", "", name)
    return wish.strip().lower() in (name.strip().lower(), bare.strip().lower())


def _listed(words: Sequence[str]) -> str:
    return f"{', '.join(words[:-1])} or {words[-1]}"
