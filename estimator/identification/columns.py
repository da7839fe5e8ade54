"""Columns of a table: which are time, input and output, and in what unit, by their names."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from pathlib import Path

from estimator.units import conversion, plain

#: Names of columns, in lower case, up to the first character that is not a letter.
_INPUTS = ("u", "input", "force", "f", "in", "drive", "excitation")
#: Kind of an output to the words that name it.
KINDS = {
    "displacement": ("displacement", "disp", "position", "pos"),
    "velocity": ("velocity", "vel", "v"),
    "acceleration": ("acceleration", "acc", "a"),
}
_OUTPUTS = ("y", "output", "out", "response", "x", *(word for words in KINDS.values() for word in words))
_TIMES = ("t", "time", "timestamp", "datetime", "zeit", "seconds", "sec", "msec")

#: What a time column may be in [s].
SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "μs": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0}
SECONDS |= {"sec": 1.0, "secs": 1.0, "second": 1.0, "seconds": 1.0, "msec": 1e-3, "usec": 1e-6, "milliseconds": 1e-3}

#: Units that a name may end with, without brackets: ``force_N``, ``x/mm``.
_PREFIX = "[kmMµμun]?"
_UNITS = re.compile(
    rf"{_PREFIX}(N|V|A|Pa|g|m)|lbf?|in|ft|cm|dm|{_PREFIX}m/s(\^?2|²|/s)?|mps2?|{_PREFIX}V/V|{_PREFIX}N[ ·*]?m|rad|deg|°"
)

#: What stands in place of a unit where there is none.
_NONE = ("", "-")


def word_of(name: str) -> str:
    """The first word of a column's name, in lower case."""
    words = "".join(c if c.isalpha() else " " for c in name.lower()).split()
    return words[0] if words else ""


def is_channel(name: str) -> bool:
    """Whether a column is called as an input or an output is."""
    return word_of(name) in (*_INPUTS, *_OUTPUTS)


def unit_of(name: str) -> str | None:
    """The unit that the name of a column holds; None where it holds none.

    Example:
        >>> [unit_of(name) for name in ("force [N]", "Time/ms", "v_mm/s", "Time in ms", "t {s}", "CH1", "x_rel")]
        ['N', 'ms', 'mm/s', 'ms', 's', None, None]
    """
    if found := re.search(r"(?:\[\s*([^\]]+?)\s*\]|\(\s*([^)]+?)\s*\)|\{\s*([^}]+?)\s*\}|<\s*([^>]+?)\s*>)\s*$", name):
        return next(group for group in found.groups() if group)
    # Of v_m/s the unit is m/s, and not s.
    patterns = [r"\s+in\s+(\S+)\s*$", r"[^\W_](?:_+|\s+)(\S+/\S+)\s*$", r"\w\s*/\s*(\S.*?)\s*$"]
    if word_of(name) in (*_TIMES, *_INPUTS, *_OUTPUTS):  # and not Channel A
        patterns.append(r"[^\W_](?:_+|\s+)(\S+)\s*$")
    found = next((one for one in (re.search(p, name) for p in patterns) if one and is_unit(one.group(1))), None)
    return found.group(1) if found else None


def bare(name: str) -> str:
    """The name of a column without the unit behind it.

    Example:
        >>> [bare(name) for name in ("force [N]", "Time/ms", "CH1")]
        ['force', 'Time', 'CH1']
    """
    unit = unit_of(name)
    return (
        name.strip() if unit is None else re.sub(r"(?:\s+in\s+|[\s_/\[({<])*$", "", name[: name.rindex(unit)]).strip()
    )


def headed(name: str, unit: str) -> str:
    """The name of a column of numbers in a unit: as it is, unless it says another one.

    Example:
        >>> headed("Weg [mm]", "mm"), headed("Weg [mm]", "m"), headed("Weg", "m")
        ('Weg [mm]', 'Weg [m]', 'Weg')
    """
    own = unit_of(name)
    return name if own is None or unit == "1" or conversion(own, unit) == 1.0 else f"{bare(name)} [{unit}]"


def is_unit(word: str) -> bool:
    """Whether a word, which may stand in brackets, is a unit, or stands for none."""
    inner = re.sub(r"^[\[({<]\s*(.*?)\s*[\])}>]$", r"\1", word.strip())
    known = inner.lower() in (*_NONE, "none") or inner in SECONDS or bool(_UNITS.fullmatch(inner))
    return known or inner != word.strip()


def time_unit(path: Path, name: str) -> float:
    """Seconds in the unit of a column of times.

    Raises:
        ValueError: where the name holds more than the time, and no unit that is known.
    """
    unit, whole = unit_of(name), name.strip().lower()
    if unit is None and word_of(name) in SECONDS and whole not in _TIMES[:1]:
        unit = word_of(name)
    if unit is None:
        rest = re.sub(r"^[^\W_]+", "", whole).strip(" _-/.:")
        if not rest or rest in ("value", "stamp", "base", "axis"):
            return 1.0
        unit = rest
    if unit not in SECONDS:
        raise ValueError(
            f"{path}: the unit of the times must be one of {', '.join(list(SECONDS)[:8])}, but {name!r:.60} says "
            f"{unit!r:.40}; rename the column, such as 'time [ms]'"
        )
    return SECONDS[unit]


def with_unit(path: Path, name: str, unit: str) -> str:
    """The name of a column with the unit that stands below it, with or without brackets.

    Raises:
        ValueError: where the name has another.
    """
    own, below = unit_of(name), re.sub(r"^[\[({<]\s*(.*?)\s*[\])}>]$", r"\1", unit.strip())
    if own and below.lower() not in (*_NONE, "none") and plain(own) != plain(below):
        raise ValueError(f"{path}: {name!r:.60} must have one unit, but {below!r:.40} stands below; mend one")
    return name if own or below.lower() in (*_NONE, "none") else f"{name} [{below}]"


def chosen(
    path: Path,
    names: Sequence[str],
    count: int,
    source: str | None,
    sink: str | None,
    stamped: Collection[int] = (),
) -> tuple[int | None, int | None, int]:
    """Places of time (or None), input (None in a free decay) and output.

    Columns whose names say nothing are the input and the output in this order, where there are no others.

    Args:
        path: of the file.
        names: of its columns; empty where it names none.
        count: of its columns.
        source: name of the input's column; one of the usual names where it is None.
        sink: of the output's, likewise.
        stamped: columns of dates or times of day.

    Raises:
        ValueError: where no column has them, or several have.
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
    time = [k for k in free if k in stamped] or [k for k in free if names[k].strip().lower() == "x_value"]
    time = time or [k for k in free if word_of(names[k]) in _TIMES]
    u, y = ([k for k in free if k not in time and word_of(names[k]) in known] for known in (_INPUTS, _OUTPUTS))
    u, y = wished[0] or u, wished[1] or y
    time = time or [k for k in free if unit_of(names[k]) in SECONDS]
    rest = [k for k in free if k not in (*time, *u, *y)]
    if len(rest) == (not u) + (not y):  # in the usual order
        u, y = u or rest[:1], y or rest[-1:]
    if not u and len(y) == 1 and len(time) == 1 and not rest:
        return time[0], None, y[0]
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
    # The name as it stands there, or without its unit; or else the file has the same in another unit than the rig.
    wished = wish.strip().lower()
    found = [k for k, name in enumerate(names) if wished in (name.strip().lower(), bare(name).lower())]
    found = found or [k for k, name in enumerate(names) if bare(wish).lower() == bare(name).lower()]
    if len(found) != 1:
        raise ValueError(
            f"{path} must have one column {wish!r:.60}, which the rig's [{table}] names, but has {list(names)}; mend "
            f"one of them"
        )
    return found


def _listed(words: Sequence[str]) -> str:
    return f"{', '.join(words[:-1])} or {words[-1]}"
