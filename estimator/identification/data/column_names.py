"""Names of columns: find time, input and output of a table, and their units, by the names."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import NamedTuple

from estimator.rigs.units import conversion_factor, normalise_unit

#: First words of the names of input columns, in lower case.
_INPUT_WORDS = ("u", "input", "force", "f", "in", "drive", "excitation")

#: Kind of an output to the first words of its columns.
WORDS_OF_SENSOR_KIND = {
    "displacement": ("displacement", "disp", "position", "pos"),
    "velocity": ("velocity", "vel", "v"),
    "acceleration": ("acceleration", "acc", "a"),
}

#: First words of the names of output columns.
_OUTPUT_WORDS = (
    "y",
    "output",
    "out",
    "response",
    "x",
    *(word for words in WORDS_OF_SENSOR_KIND.values() for word in words),
)

#: First words of the names of time columns.
_TIME_WORDS = ("t", "time", "timestamp", "datetime", "zeit", "seconds", "sec", "msec")

#: Unit of time to seconds.
SECONDS_OF_TIME_UNIT = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "μs": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0}
SECONDS_OF_TIME_UNIT |= {
    "sec": 1.0,
    "secs": 1.0,
    "second": 1.0,
    "seconds": 1.0,
    "msec": 1e-3,
    "usec": 1e-6,
    "milliseconds": 1e-3,
}

#: Prefixes of SI units, as a regular expression.
_SI_PREFIX = "[kmMµμun]?"

#: Units that a name may end with, without brackets: ``force_N``, ``x/mm``.
_BARE_UNIT_PATTERN = re.compile(
    rf"{_SI_PREFIX}(N|V|A|Pa|g|m)|lbf?|in|ft|cm|dm|{_SI_PREFIX}m/s(\^?2|²|/s)?|mps2?"
    rf"|{_SI_PREFIX}V/V|{_SI_PREFIX}N[ ·*]?m|rad|deg|°"
)

#: Words for no unit.
_NO_UNIT = ("", "-")


def first_word(name: str) -> str:
    """The first word of a column's name, in lower case."""
    words = "".join(c if c.isalpha() else " " for c in name.lower()).split()
    return words[0] if words else ""


def is_input_or_output(name: str) -> bool:
    """Whether the name of a column is usual for an input or an output."""
    return first_word(name) in (*_INPUT_WORDS, *_OUTPUT_WORDS)


def unit_in_name(name: str) -> str | None:
    """The unit in the name of a column; None without one.

    Example:
        >>> [unit_in_name(name) for name in ("force [N]", "Time/ms", "v_mm/s", "Time in ms", "t {s}", "CH1", "x_rel")]
        ['N', 'ms', 'mm/s', 'ms', 's', None, None]
    """
    if found := re.search(r"(?:\[\s*([^\]]+?)\s*\]|\(\s*([^)]+?)\s*\)|\{\s*([^}]+?)\s*\}|<\s*([^>]+?)\s*>)\s*$", name):
        return next(group for group in found.groups() if group)
    # The unit of v_m/s is m/s, not s.
    patterns = [r"\s+in\s+(\S+)\s*$", r"[^\W_](?:_+|\s+)(\S+/\S+)\s*$", r"\w\s*/\s*(\S.*?)\s*$"]
    if first_word(name) in (*_TIME_WORDS, *_INPUT_WORDS, *_OUTPUT_WORDS):  # the A of Channel A is no unit
        patterns.append(r"[^\W_](?:_+|\s+)(\S+)\s*$")
    found = next((one for one in (re.search(p, name) for p in patterns) if one and is_unit(one.group(1))), None)
    return found.group(1) if found else None


def name_without_unit(name: str) -> str:
    """The name of a column without its unit.

    Example:
        >>> [name_without_unit(name) for name in ("force [N]", "Time/ms", "CH1")]
        ['force', 'Time', 'CH1']
    """
    unit = unit_in_name(name)
    return (
        name.strip() if unit is None else re.sub(r"(?:\s+in\s+|[\s_/\[({<])*$", "", name[: name.rindex(unit)]).strip()
    )


def name_with_unit(name: str, unit: str) -> str:
    """The name of a column whose numbers have a unit: unchanged, unless the name holds another unit.

    Example:
        >>> name_with_unit("Weg [mm]", "mm"), name_with_unit("Weg [mm]", "m"), name_with_unit("Weg", "m")
        ('Weg [mm]', 'Weg [m]', 'Weg')
    """
    current_unit = unit_in_name(name)
    return (
        name
        if current_unit is None or unit == "1" or conversion_factor(current_unit, unit) == 1.0
        else f"{name_without_unit(name)} [{unit}]"
    )


def is_unit(word: str) -> bool:
    """Whether a word, with or without brackets, is a unit or a word for no unit."""
    inner = re.sub(r"^[\[({<]\s*(.*?)\s*[\])}>]$", r"\1", word.strip())
    known = (
        inner.lower() in (*_NO_UNIT, "none")
        or inner in SECONDS_OF_TIME_UNIT
        or bool(_BARE_UNIT_PATTERN.fullmatch(inner))
    )
    return known or inner != word.strip()


def seconds_per_time_unit(path: Path, name: str) -> float:
    """Seconds per unit of a time column.

    Args:
        path: the file, for messages.
        name: name of the column.

    Raises:
        ValueError: for a name with an unknown unit.
    """
    unit, whole = unit_in_name(name), name.strip().lower()
    if unit is None and first_word(name) in SECONDS_OF_TIME_UNIT and whole not in _TIME_WORDS[:1]:
        unit = first_word(name)
    if unit is None:
        rest = re.sub(r"^[^\W_]+", "", whole).strip(" _-/.:")
        if not rest or rest in ("value", "stamp", "base", "axis"):
            return 1.0
        unit = rest
    if unit not in SECONDS_OF_TIME_UNIT:
        units = ", ".join(list(SECONDS_OF_TIME_UNIT)[:8])
        raise ValueError(
            f"{path}: the unit of the times must be one of {units}, but {name!r:.60} has {unit!r:.40}; rename the "
            f"column, such as 'time [ms]'"
        )
    return SECONDS_OF_TIME_UNIT[unit]


def append_unit(path: Path, name: str, unit: str) -> str:
    """The name of a column with the unit from the line below.

    Args:
        path: the file, for messages.
        name: name of the column.
        unit: the unit, with or without brackets.

    Raises:
        ValueError: where the name has another unit.
    """
    current_unit, unit_below = unit_in_name(name), re.sub(r"^[\[({<]\s*(.*?)\s*[\])}>]$", r"\1", unit.strip())
    if (
        current_unit
        and unit_below.lower() not in (*_NO_UNIT, "none")
        and normalise_unit(current_unit) != normalise_unit(unit_below)
    ):
        raise ValueError(f"{path}: {name!r:.60} must have one unit, but {unit_below!r:.40} stands below; mend one")
    return name if current_unit or unit_below.lower() in (*_NO_UNIT, "none") else f"{name} [{unit_below}]"


class ColumnIndices(NamedTuple):
    """Indices of the columns of a table.

    Attributes:
        time: column of the times; None without one.
        input: column of the inputs; None in a free decay.
        output: column of the outputs.
    """

    time: int | None
    input: int | None
    output: int


def locate_columns(
    path: Path,
    names: Sequence[str],
    count: int,
    input_name: str | None,
    output_name: str | None,
    timestamp_columns: Collection[int] = (),
) -> ColumnIndices:
    """Find the columns of time, input and output.

    Where no usual name decides, the remaining columns are input and output, in this order.

    Args:
        path: the file, for messages.
        names: names of its columns; empty where it has none.
        count: number of its columns.
        input_name: name of the input's column; None: one of the usual names.
        output_name: name of the output's column; None: one of the usual names.
        timestamp_columns: columns of dates or times of day.

    Raises:
        ValueError: where a column is missing, or several are possible.
    """
    if not names:
        if input_name or output_name:
            raise ValueError(
                f"{path} must name its columns, because the rig names them, but has numbers alone; add the names as a "
                f"first line, or remove column from the rig"
            )
        if count not in (2, 3):
            raise ValueError(f"{path} must have two columns, u and y, or three with the time, but has {count}")
        return ColumnIndices(None, 0, 1) if count == 2 else ColumnIndices(0, 1, 2)
    requested = [
        _locate_named_column(path, names, wish, table)
        for wish, table in ((input_name, "input"), (output_name, "output"))
    ]
    if requested[0] and requested[0] == requested[1]:
        raise ValueError(
            f"{path} must have two columns, but the rig names {input_name!r} for input and output; mend one"
        )
    remaining = [k for k in range(len(names)) if [k] not in requested]
    time = [k for k in remaining if k in timestamp_columns] or [
        k for k in remaining if names[k].strip().lower() == "x_value"
    ]
    time = time or [k for k in remaining if first_word(names[k]) in _TIME_WORDS]
    u, y = (
        [k for k in remaining if k not in time and first_word(names[k]) in known]
        for known in (_INPUT_WORDS, _OUTPUT_WORDS)
    )
    u, y = requested[0] or u, requested[1] or y
    time = time or [k for k in remaining if unit_in_name(names[k]) in SECONDS_OF_TIME_UNIT]
    rest = [k for k in remaining if k not in (*time, *u, *y)]
    if len(rest) == (not u) + (not y):  # in the usual order
        u, y = u or rest[:1], y or rest[-1:]
    if not u and len(y) == 1 and len(time) == 1 and not rest:
        return ColumnIndices(time[0], None, y[0])
    if len(u) != 1 or len(y) != 1 or len(time) > 1:
        raise ValueError(
            f"{path} must have one column of inputs and one of outputs, such as 'u,y', but has {list(names)}; rename "
            f"the input to {_join_words(_INPUT_WORDS)}, and the output to {_join_words(_OUTPUT_WORDS)}; or name them, "
            f"as column = '...' in the rig's [input] and [output], or by --input and --output of duffing-env rig init"
        )
    return ColumnIndices(time[0] if time else None, u[0], y[0])


def _locate_named_column(path: Path, names: Sequence[str], requested: str | None, table: str) -> list[int]:
    """The index of the column that a rig names, in a list; an empty list where it names none."""
    if requested is None:
        return []
    # The name in the file, with or without its unit; else the same name with another unit.
    requested_name = requested.strip().lower()
    found = [
        k for k, name in enumerate(names) if requested_name in (name.strip().lower(), name_without_unit(name).lower())
    ]
    found = found or [
        k for k, name in enumerate(names) if name_without_unit(requested).lower() == name_without_unit(name).lower()
    ]
    if len(found) != 1:
        raise ValueError(
            f"{path} must have one column {requested!r:.60}, which the rig's [{table}] names, but has {list(names)}; "
            f"mend one of them"
        )
    return found


def _join_words(words: Sequence[str]) -> str:
    return f"{', '.join(words[:-1])} or {words[-1]}"
