"""The choice of columns: which is the time, the input and the output, by request, names, units, or else their order."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

from estimator.identification.data.column_units import SECONDS_OF_TIME_UNIT, name_without_unit, unit_in_name
from estimator.identification.data.column_words import first_word, role_in_name
from estimator.rigs.units import normalise_unit, to_si_unit

#: Quantity to the SI units that show it, in their normalised spelling.
_UNITS_OF_QUANTITY = {
    "force": ("N", "Nm"),
    "electric": ("V", "A"),
    "motion": ("m", "m/s", "m/s2", "rad", "rad/s", "rad/s2"),
}

#: Quantity of a unit to its place among inputs: of two columns the one of the higher place is the input.
_INPUT_RANK = {"force": 1, "electric": 0, None: 0, "motion": -1}

#: How to name the columns, for messages.
_REMEDY = (
    "name both by --input and --output of duffing-env rig init, or as column = '...' in the rig's [input] and [output]"
)

#: What decided to its words in a sentence.
_REASONS = {
    "request": "as named",
    "name": "by their names",
    "unit": "by their units",
    "order": "by their order alone, because neither names nor units decide: check this",
}


@dataclass(frozen=True)
class ColumnChoice:
    """The columns of a table.

    Attributes:
        time: index of the times' column; None without one.
        input: index of the inputs' column; None in a free decay.
        output: index of the outputs' column.
        reason: what decided last: ``request``, ``name``, ``unit`` or ``order``.
    """

    time: int | None
    input: int | None
    output: int
    reason: str


@dataclass(frozen=True)
class ColumnNames:
    """Names of the columns of a record, for a sentence.

    Attributes:
        input: name of the input's column; None in a free decay.
        output: name of the output's column.
        reason: as of `ColumnChoice`.
    """

    input: str | None
    output: str
    reason: str

    def sentence(self, kind: str, is_kind_known: bool = True) -> str:
        """Which column is what, and why.

        Args:
            kind: kind of the output.
            is_kind_known: whether the rig, a name or a unit states the kind.

        Example:
            >>> ColumnNames("Spannung [V]", "Weg [mm]", "name").sentence("displacement")
            'Input: Spannung [V]; output: Weg [mm], a displacement (by their names).'
        """
        article = "" if is_kind_known else "taken as "
        article += "an" if kind[0] in "aeiou" else "a"
        source = self.input or "none, a free decay"
        return f"Input: {source:.60}; output: {self.output:.60}, {article} {kind} ({_REASONS[self.reason]})."


def choose_columns(
    path: Path,
    names: Sequence[str],
    count: int,
    input_name: str | None,
    output_name: str | None,
    timestamp_columns: Collection[int] = (),
) -> ColumnChoice:
    """Choose the columns of time, input and output.

    A requested name decides, then the words of a name (`estimator.identification.data.column_words`), then the unit:
    a force is an input, a motion is an output, and a voltage or a current is the input beside a motion. Where neither
    names nor units decide, the remaining two columns are input and output, in this order.

    Args:
        path: the file, for messages.
        names: names of its columns; empty where it has none.
        count: number of its columns.
        input_name: name of the input's column; None: not known.
        output_name: name of the output's column; None: not known.
        timestamp_columns: columns of dates or times of day.

    Raises:
        ValueError: where a column is missing, several are possible, or names and units contradict each other.
    """
    if not names:
        return _choose_without_names(path, count, bool(input_name or output_name))
    requested = {
        role: _find_requested(path, names, wish, role)
        for role, wish in (("input", input_name), ("output", output_name))
    }
    if requested["input"] and requested["input"] == requested["output"]:
        raise ValueError(
            f"{path} must have two columns, but the rig names {input_name!r} for input and output; mend one"
        )
    remaining = [k for k in range(len(names)) if [k] not in requested.values()]
    time = _find_times(names, remaining, timestamp_columns)
    named = {role: _find_named(names, [k for k in remaining if k not in time], role) for role in requested}
    u, y = (requested[role] or named[role] for role in ("input", "output"))
    reason = "request" if all(requested.values()) else "name"
    time = time or [k for k in remaining if unit_in_name(names[k]) in SECONDS_OF_TIME_UNIT]
    rest = [k for k in remaining if k not in (*time, *u, *y)]
    if not (u and y) and rest:
        u, y, reason = _choose_by_unit_or_order(path, names, u, y, rest)
    rest = [k for k in rest if k not in (*u, *y)]
    if not u and len(y) == 1 and len(time) == 1 and not rest:
        return ColumnChoice(time[0], None, y[0], reason)
    if len(u) != 1 or len(y) != 1 or len(time) > 1:
        raise ValueError(
            f"{path} must have one column of inputs and one of outputs, such as 'u,y', but has {list(names)}; rename "
            f"the input to u, input or force, and the output to y, output or displacement; or {_REMEDY}"
        )
    if not any(requested.values()):
        _check_units(path, names[u[0]], names[y[0]], reason)
    return ColumnChoice(time[0] if time else None, u[0], y[0], reason)


def _choose_without_names(path: Path, count: int, is_requested: bool) -> ColumnChoice:
    """The columns of a table without names: input and output, or time, input and output."""
    if is_requested:
        raise ValueError(
            f"{path} must name its columns, because the rig names them, but has numbers alone; add the names as a "
            f"first line, or remove column from the rig"
        )
    if count not in (2, 3):
        raise ValueError(f"{path} must have two columns, u and y, or three with the time, but has {count}")
    return ColumnChoice(None, 0, 1, "order") if count == 2 else ColumnChoice(0, 1, 2, "order")


def _find_times(names: Sequence[str], remaining: Sequence[int], timestamp_columns: Collection[int]) -> list[int]:
    """The columns that are times by their values or names."""
    stamped = [k for k in remaining if k in timestamp_columns]
    stamped = stamped or [k for k in remaining if names[k].strip().lower() == "x_value"]
    return stamped or [k for k in remaining if role_in_name(names[k]) == "time"]


def _find_named(names: Sequence[str], remaining: Sequence[int], role: str) -> list[int]:
    """The columns whose names state a role; of several those whose first words do, such as y beside late_output."""
    found = [k for k in remaining if role_in_name(names[k]) == role]
    by_first_word = [k for k in found if role_in_name(first_word(names[k])) == role]
    return by_first_word if len(found) > 1 and by_first_word else found


def _choose_by_unit_or_order(
    path: Path, names: Sequence[str], u: list[int], y: list[int], rest: list[int]
) -> tuple[list[int], list[int], str]:
    """Input and output where a name states one of them at most, and what decided; an empty list where nothing does."""
    quantities = {k: _quantity(names[k]) for k in rest}

    def of(wanted: str) -> list[int]:
        return [k for k in rest if quantities[k] == wanted]

    if u or y or len(rest) != 2:
        if len(rest) == 1 and (u or y):
            u, y = u or rest, y or rest
            is_shown = _INPUT_RANK[_quantity(names[u[0]])] > _INPUT_RANK[_quantity(names[y[0]])]
            return u, y, "unit" if is_shown else "name"
        if len(rest) == 1:  # one column beside the times may be a free decay
            return u, of("motion"), "unit"
        by_unit_u, by_unit_y = u or of("force") or of("electric"), y or of("motion")
        return (by_unit_u, by_unit_y, "unit") if len(by_unit_u) == len(by_unit_y) == 1 else (u, y, "name")
    first, second = rest
    ranks = [_INPUT_RANK[quantities[k]] for k in rest]
    if ranks[0] == ranks[1] != 0:
        role = "input" if ranks[0] > 0 else "output"
        raise ValueError(
            f"{path} must have one column of inputs and one of outputs, but by their units {names[first]!r:.60} and "
            f"{names[second]!r:.60} are both an {role}, and no name decides; {_REMEDY}"
        )
    if ranks[0] == ranks[1]:
        return [first], [second], "order"
    return ([first], [second], "unit") if ranks[0] > ranks[1] else ([second], [first], "unit")


def _quantity(name: str) -> str | None:
    """The quantity that the unit in a name shows; None where it shows none."""
    unit = unit_in_name(name)
    bare = normalise_unit(to_si_unit(unit)[1]) if unit else ""
    return next((quantity for quantity, units in _UNITS_OF_QUANTITY.items() if bare in units), None)


def _check_units(path: Path, input_name: str, output_name: str, reason: str) -> None:
    """Refuse a choice by names that the units contradict: they show the input and the output in reverse."""
    ranks = [_INPUT_RANK[_quantity(name)] for name in (input_name, output_name)]
    # Names of both outweigh one unit: the base of an oscillator may be the input.
    if ranks[0] < 0 < ranks[1] or (ranks[0] < ranks[1] and not _are_both_named(input_name, output_name)):
        raise ValueError(
            f"{path} must have names and units of columns that agree, but by names {input_name!r:.60} is the input and "
            f"{output_name!r:.60} the output, and by units the reverse; mend the names, or {_REMEDY}"
        )


def _are_both_named(input_name: str, output_name: str) -> bool:
    return role_in_name(input_name) == "input" and role_in_name(output_name) == "output"


def _find_requested(path: Path, names: Sequence[str], requested: str | None, role: str) -> list[int]:
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
        similar = [name for name in names if requested_name in name.lower()]
        hint = f"write {name_without_unit(similar[0])!r:.60}" if len(similar) == 1 else "mend one of them"
        raise ValueError(
            f"{path} must have one column {requested!r:.60}, which --{role} or the rig's [{role}] names, but has "
            f"{list(names)}; {hint}"
        )
    return found
