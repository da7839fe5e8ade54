"""Columns of a table: which are time, input and output, and in what unit, by their names."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from pathlib import Path

from estimator.rigs.units import conversion_factor, normalise_unit

#: Names of columns, in lower case, up to the first character that is not a letter.
_INPUT_WORDS = ("u", "input", "force", "f", "in", "drive", "excitation")
#: Kind of an output to the words that name it.
WORDS_OF_SENSOR_KIND = {
    "displacement": ("displacement", "disp", "position", "pos"),
    "velocity": ("velocity", "vel", "v"),
    "acceleration": ("acceleration", "acc", "a"),
}
_OUTPUT_WORDS = (
    "y",
    "output",
    "out",
    "response",
    "x",
    *(word for words in WORDS_OF_SENSOR_KIND.values() for word in words),
)
_TIME_WORDS = ("t", "time", "timestamp", "datetime", "zeit", "seconds", "sec", "msec")

#: What a time column may be in [s].
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

#: Units that a name may end with, without brackets: ``force_N``, ``x/mm``.
_SI_PREFIX = "[kmMµμun]?"
_BARE_UNIT_PATTERN = re.compile(
    rf"{_SI_PREFIX}(N|V|A|Pa|g|m)|lbf?|in|ft|cm|dm|{_SI_PREFIX}m/s(\^?2|²|/s)?|mps2?|{_SI_PREFIX}V/V|{_SI_PREFIX}N[ ·*]?m|rad|deg|°"
)

#: What stands in place of a unit where there is none.
_NO_UNIT = ("", "-")


def first_word(name: str) -> str:
    """The first word of a column's name, in lower case."""
    words = "".join(c if c.isalpha() else " " for c in name.lower()).split()
    return words[0] if words else ""


def is_input_or_output(name: str) -> bool:
    """Whether a column is called as an input or an output is."""
    return first_word(name) in (*_INPUT_WORDS, *_OUTPUT_WORDS)


def unit_in_name(name: str) -> str | None:
    """The unit that the name of a column holds; None where it holds none.

    Example:
        >>> [unit_in_name(name) for name in ("force [N]", "Time/ms", "v_mm/s", "Time in ms", "t {s}", "CH1", "x_rel")]
        ['N', 'ms', 'mm/s', 'ms', 's', None, None]
    """
    if found := re.search(r"(?:\[\s*([^\]]+?)\s*\]|\(\s*([^)]+?)\s*\)|\{\s*([^}]+?)\s*\}|<\s*([^>]+?)\s*>)\s*$", name):
        return next(group for group in found.groups() if group)
    # Of v_m/s the unit is m/s, and not s.
    patterns = [r"\s+in\s+(\S+)\s*$", r"[^\W_](?:_+|\s+)(\S+/\S+)\s*$", r"\w\s*/\s*(\S.*?)\s*$"]
    if first_word(name) in (*_TIME_WORDS, *_INPUT_WORDS, *_OUTPUT_WORDS):  # and not Channel A
        patterns.append(r"[^\W_](?:_+|\s+)(\S+)\s*$")
    found = next((one for one in (re.search(p, name) for p in patterns) if one and is_unit(one.group(1))), None)
    return found.group(1) if found else None


def name_without_unit(name: str) -> str:
    """The name of a column without the unit behind it.

    Example:
        >>> [name_without_unit(name) for name in ("force [N]", "Time/ms", "CH1")]
        ['force', 'Time', 'CH1']
    """
    unit = unit_in_name(name)
    return (
        name.strip() if unit is None else re.sub(r"(?:\s+in\s+|[\s_/\[({<])*$", "", name[: name.rindex(unit)]).strip()
    )


def name_with_unit(name: str, unit: str) -> str:
    """The name of a column of numbers in a unit: as it is, unless it says another one.

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
    """Whether a word, which may stand in brackets, is a unit, or stands for none."""
    inner = re.sub(r"^[\[({<]\s*(.*?)\s*[\])}>]$", r"\1", word.strip())
    known = (
        inner.lower() in (*_NO_UNIT, "none")
        or inner in SECONDS_OF_TIME_UNIT
        or bool(_BARE_UNIT_PATTERN.fullmatch(inner))
    )
    return known or inner != word.strip()


def seconds_per_time_unit(path: Path, name: str) -> float:
    """Seconds in the unit of a column of times.

    Raises:
        ValueError: where the name holds more than the time, and no unit that is known.
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
        raise ValueError(
            f"{path}: the unit of the times must be one of {', '.join(list(SECONDS_OF_TIME_UNIT)[:8])}, but {name!r:.60} says "
            f"{unit!r:.40}; rename the column, such as 'time [ms]'"
        )
    return SECONDS_OF_TIME_UNIT[unit]


def append_unit(path: Path, name: str, unit: str) -> str:
    """The name of a column with the unit that stands below it, with or without brackets.

    Raises:
        ValueError: where the name has another.
    """
    current_unit, unit_below = unit_in_name(name), re.sub(r"^[\[({<]\s*(.*?)\s*[\])}>]$", r"\1", unit.strip())
    if (
        current_unit
        and unit_below.lower() not in (*_NO_UNIT, "none")
        and normalise_unit(current_unit) != normalise_unit(unit_below)
    ):
        raise ValueError(f"{path}: {name!r:.60} must have one unit, but {unit_below!r:.40} stands below; mend one")
    return name if current_unit or unit_below.lower() in (*_NO_UNIT, "none") else f"{name} [{unit_below}]"


def locate_columns(
    path: Path,
    names: Sequence[str],
    count: int,
    input_name: str | None,
    output_name: str | None,
    timestamp_columns: Collection[int] = (),
) -> tuple[int | None, int | None, int]:
    """Places of time (or None), input (None in a free decay) and output.

    Columns whose names say nothing are the input and the output in this order, where there are no others.

    Args:
        path: of the file.
        names: of its columns; empty where it names none.
        count: of its columns.
        input_name: name of the input's column; one of the usual names where it is None.
        output_name: of the output's, likewise.
        timestamp_columns: columns of dates or times of day.

    Raises:
        ValueError: where no column has them, or several have.
    """
    if not names:
        if input_name or output_name:
            raise ValueError(
                f"{path} must name its columns, because the rig does, but has numbers alone; add them as a "
                f"first line, or leave column out of the rig"
            )
        if count not in (2, 3):
            raise ValueError(f"{path} must have two columns, u and y, or three with the time, but has {count}")
        return (None, 0, 1) if count == 2 else (0, 1, 2)
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
        return time[0], None, y[0]
    if len(u) != 1 or len(y) != 1 or len(time) > 1:
        raise ValueError(
            f"{path} must have one column of inputs and one of outputs, such as 'u,y', but has {list(names)}; rename: "
            f"an input is called {_join_words(_INPUT_WORDS)}, an output {_join_words(_OUTPUT_WORDS)}; or name them, as column = '...' in "
            f"the rig's [input] and [output], or by --input and --output of duffing-env rig init"
        )
    return (time[0] if time else None), u[0], y[0]


def _locate_named_column(path: Path, names: Sequence[str], requested: str | None, table: str) -> list[int]:
    """The place of the column that a rig names, in a list; an empty one where it names none."""
    if requested is None:
        return []
    # The name as it stands there, or without its unit; or else the file has the same in another unit than the rig.
    requested_name = requested.strip().lower()
    found = [
        k for k, name in enumerate(names) if requested_name in (name.strip().lower(), name_without_unit(name).lower())
    ]
    found = found or [
        k for k, name in enumerate(names) if name_without_unit(requested).lower() == name_without_unit(name).lower()
    ]
    if len(found) != 1:
        raise ValueError(
            f"{path} must have one column {requested!r:.60}, which the rig's [{table}] names, but has {list(names)}; mend "
            f"one of them"
        )
    return found


def _join_words(words: Sequence[str]) -> str:
    return f"{', '.join(words[:-1])} or {words[-1]}"
