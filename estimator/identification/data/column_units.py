"""Names of columns: the units in them."""

from __future__ import annotations

import re
from pathlib import Path

from estimator.identification.data.column_words import first_word, role_in_name
from estimator.rigs.units import conversion_factor, normalise_unit

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
    "sekunden": 1.0,
    "secondes": 1.0,
    "segundos": 1.0,
    "secondi": 1.0,
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
    if role_in_name(name):  # the A of Channel A is no unit
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
    if unit is None and first_word(name) in SECONDS_OF_TIME_UNIT and whole != "t":
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
