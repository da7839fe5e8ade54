"""Text files of instruments: columns of time, input and output, found by the names above the numbers."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from estimator.identification.data.column_names import (
    WORDS_OF_SENSOR_KIND,
    append_unit,
    first_word,
    is_input_or_output,
    is_unit,
    locate_columns,
    seconds_per_time_unit,
    unit_in_name,
)
from estimator.identification.data.text_fields import (
    DECIMAL_COMMA_SEPARATORS,
    parse_number,
    parse_timestamp,
    read_text,
)
from estimator.rigs.rig import Channel
from estimator.rigs.units import conversion_factor, sensor_kind_of_unit
from estimator.support.array_types import FloatArray

#: Times may be off an even grid by this part of a step, or by their last digit, and are even all the same.
_EVENNESS_TOLERANCE = 0.005

#: Steps of a table count as alike within this fraction of the usual step.
REGULAR_STEP_TOLERANCE = 0.05

#: Fraction of steps that are alike, from which a jump of whole steps means lost lines.
MIN_REGULAR_FRACTION = 0.8

#: A step is no longer than this many usual ones; what is longer is a gap.
_MAX_STEP_FACTOR = 3.0

#: Lines that show where the numbers begin.
_N_FIRST_ROWS = 3


@dataclass(frozen=True, eq=False)
class TextTable:
    """A CSV file.

    Attributes:
        path: of the file.
        names: of its columns, as they stand there; empty where it has numbers alone.
        columns: (C, T) numbers; NaN where one is missing.
        lines: (T,) of the file.
        time_column: which column is the time; None where there is none.
        input_column: which column is the input; None in a free decay.
        output_column: which column is the output.
        has_timestamps: whether the times were dates or times of day, and are seconds from the first on.
    """

    path: Path
    names: tuple[str, ...]
    columns: FloatArray
    lines: npt.NDArray[np.int64]
    time_column: int | None
    input_column: int | None
    output_column: int
    has_timestamps: bool = False

    @property
    def inputs(self) -> FloatArray:
        """(T,) inputs; 0 where there is no column of them."""
        return (
            np.zeros(self.columns.shape[1])
            if self.input_column is None
            else np.asarray(self.columns[self.input_column])
        )

    def step(self) -> float | None:
        """Usual sampling step [s], of the time column; None where there is none.

        Times are those of the lines that have an input, and may leap where an input is missing: there a record is cut.

        Raises:
            ValueError: for times that are missing or do not grow, or in a unit that is unknown.
        """
        if self.time_column is None:
            return None
        time, later = self._times_and_pairs()
        steps = time[later] - time[later - 1]
        usual = float(np.median(steps))
        alike = np.abs(steps - usual) < REGULAR_STEP_TOLERANCE * usual
        return float(steps[alike if alike.mean() > MIN_REGULAR_FRACTION else steps < _MAX_STEP_FACTOR * usual].mean())

    def times(self, step: float) -> FloatArray | None:
        """(T,) times [s] of the lines, where these are not ``step`` apart; None where they are, or there are none.

        Times are even where they are on a grid of that step up to their last digit. Lines without an input have none.

        Raises:
            ValueError: as `step`.
        """
        usual_step = self.step()
        if usual_step is None:
            return None
        time, later = self._times_and_pairs()
        begins = np.setdiff1d(np.flatnonzero(np.isfinite(self.inputs)), later)
        ends = np.append(begins[1:], len(time))
        digit = self._time_resolution(time)
        for begin, end in zip(begins, ends, strict=True):
            part = time[begin:end][np.isfinite(self.inputs[begin:end])]
            deviation = part - part[0] - step * np.arange(len(part))
            if np.ptp(deviation) > 2 * _EVENNESS_TOLERANCE * step + 1.01 * digit:
                return time
        return None

    def _times_and_pairs(self) -> tuple[FloatArray, npt.NDArray[np.intp]]:
        """(T,) times [s], and the lines that have an input as the line before them has."""
        assert self.time_column is not None
        unit = (
            seconds_per_time_unit(self.path, self.names[self.time_column])
            if self.names and not self.has_timestamps
            else 1.0
        )
        time, driven = self.columns[self.time_column] * unit, np.isfinite(self.inputs)
        for k in np.flatnonzero(driven & np.isnan(time))[:1]:
            raise ValueError(
                f"{self._location(k)}: there must be a time beside the input, but there is none; fill it in, or remove "
                f"the column of times"
            )
        later = np.flatnonzero(driven[1:] & driven[:-1]) + 1
        if not len(later):
            raise ValueError(
                f"{self.path} must have two samples in a row with time and input, but has none; add samples"
            )
        for k in later[time[later] <= time[later - 1]][:1]:
            raise ValueError(
                f"{self._location(k)}: times must grow, but {time[k]:.9g} s comes after {time[k - 1]:.9g} s; mend the "
                f"line, or set records apart by an empty row"
            )
        return time, later

    def _time_resolution(self, time: FloatArray) -> float:
        """What the last digit of the times is worth [s]: the largest power of ten of which all are multiples."""
        seen = time[np.isfinite(time)]
        seen = seen - seen[0]
        for digits in range(-2, 13):
            if np.abs(seen * 10.0**digits - np.round(seen * 10.0**digits)).max() < 1e-3 * max(
                1.0, 10.0 ** (digits - 9)
            ):
                return float(10.0**-digits)
        return 0.0

    def _location(self, row: np.int64) -> str:
        """The file, and the line of a row."""
        return f"{self.path}, line {self.lines[row]}"

    def unit(self, column: int) -> str | None:
        """What stands in brackets behind the name of a column, as N in ``force [N]``; None where nothing does."""
        return unit_in_name(self.names[column]) if self.names else None

    def has_known_name(self, column: int) -> bool:
        """Whether the name of a column says what it is; also where there are no names."""
        return not self.names or is_input_or_output(self.names[column])

    def output_kind(self) -> str | None:
        """What the name of the output, or else its unit, says that it is: a displacement, for one; or None.

        Raises:
            ValueError: where name and unit say different things.
        """
        word, unit = (
            first_word(self.names[self.output_column]) if self.names else "",
            self.unit(self.output_column) or "",
        )
        named = next((kind for kind, words in WORDS_OF_SENSOR_KIND.items() if word in words), None)
        told = sensor_kind_of_unit(unit)
        if named and told and named != told:
            raise ValueError(
                f"{self.path}: unit of {self.names[self.output_column]!r:.60} must be of a kind with the name, {named}, but tells "
                f"{told}; mend one of them"
            )
        return named or told

    def signals_in_rig_units(self, input_channel: Channel, output_channel: Channel) -> tuple[FloatArray, FloatArray]:
        """(T,) inputs and outputs in the units of the channels of a rig: a column in mm is scaled where the rig has m.

        Raises:
            ValueError: naming the column, for the unit of another quantity, or another kind of output. A pure number,
                1, contradicts nothing.
        """
        word = first_word(self.names[self.output_column]) if self.names else ""
        kind = next(
            (one for one, words in WORDS_OF_SENSOR_KIND.items() if word in words and len(word) > 1), output_channel.kind
        )
        if kind != output_channel.kind:
            raise ValueError(
                f"{self.path}: {self.names[self.output_column]!r:.60} must be the rig's kind of output, {output_channel.kind}, but is called "
                f"{kind}; mend one of them"
            )
        return self.inputs * self._unit_factor(self.input_column, input_channel), self.columns[
            self.output_column
        ] * self._unit_factor(self.output_column, output_channel)

    def _unit_factor(self, column: int | None, channel: Channel) -> float:
        """From the unit of a column to that of its channel; 1 where one of them says none."""
        unit = None if column is None else self.unit(column)
        if not unit or channel.unit == "1":
            return 1.0
        factor = conversion_factor(unit, channel.unit)
        if factor is None:
            raise ValueError(
                f"{self.path}: {self.names[column or 0]!r:.60} must be in the rig's unit, {channel.unit}, but is in "
                f"{unit}; convert the column, or write its unit into the rig"
            )
        return factor


def read_table(path: Path, input_name: str | None = None, output_name: str | None = None) -> TextTable:
    """Read a text file as instruments write it, such as CSV or LabVIEW's .lvm.

    Fields stand between commas, or semicolons or tabs (then 0,5 is a number, in a file without points), or blanks.
    Empty ones are missing, and NaN, NA, N/A, null, none or - in them; ∞ and inf are over range. Lines that begin with #
    are passed over; one of separators alone sets records apart. The line above the numbers may hold names, such as
    ``u,y``, ``time [ms],force [N],x [mm]`` or ``time_ms,force_N,x_mm``; or names stand above a line of units, such as
    ``ms,N,mm``. Lines before these are passed over. Of numbers alone there are the columns u and y, or time in seconds,
    u and y. A column in a unit of time, or of dates or times of day, is the time, whatever its name.

    Args:
        path: of the file.
        input_name: name of the input's column; one of the usual names where it is None.
        output_name: of the output's, likewise.

    Raises:
        ValueError: naming the file, the line and what is wrong.
    """
    lines = read_text(path).splitlines()
    numbered_lines = [(k, line) for k, line in enumerate(lines, 1) if line.strip() and not line.startswith("#")]
    if numbered_lines and (
        separator_line := re.fullmatch(r"\s*\"?sep=(.)\"?\s*", numbered_lines[0][1])
    ):  # a spreadsheet's
        numbered_lines.pop(0)
    separator = (
        separator_line.group(1)
        if numbered_lines and separator_line
        else _guess_separator([line for _, line in numbered_lines])
    )
    line_numbers, fields = (
        [k for k, _ in numbered_lines],
        _split_fields([line for _, line in numbered_lines], separator),
    )
    first = _find_first_row(fields, separator)
    if first is None:
        raise ValueError(f"{path} must hold numbers, but holds none")
    width = len(fields[first])
    names, units = _read_headings(path, fields[:first], line_numbers, width, separator)
    regular = _parse_regular_rows([line for _, line in numbered_lines[first:]], separator, width)
    rows = _parse_rows(path, fields[first:], line_numbers[first:], separator) if regular is None else regular
    columns, stamped = _timestamps_to_seconds(path, rows, line_numbers[first:], names)
    names = tuple(append_unit(path, name, unit) for name, unit in zip(names, units, strict=True)) if units else names
    places = locate_columns(path, names, len(columns), input_name, output_name, stamped)
    return TextTable(path, names, columns, np.array(line_numbers[first:]), *places, has_timestamps=places[0] in stamped)


def _guess_separator(lines: Sequence[str]) -> str | None:
    """What stands between the fields, of the last lines, which hold numbers; None for blanks."""
    last = "".join(lines[-2:])
    return next((mark for mark in "\t;," if mark in last), None)


def _split_fields(lines: Sequence[str], separator: str | None) -> list[list[str]]:
    """The fields of each line; empty ones at the end of all lines are left out."""
    if separator is None:
        return [line.split() for line in lines]
    return list(csv.reader(lines, delimiter=separator))


def _is_number_row(words: Sequence[str], separator: str | None) -> bool:
    """Whether a line holds numbers, and nothing else that is not missing."""
    values = [parse_number(word, separator) for word in words]
    return any(value is not None and math.isfinite(value) for value in values) and all(
        value is not None or parse_timestamp(word) for word, value in zip(words, values, strict=True)
    )


def _find_first_row(fields: Sequence[Sequence[str]], separator: str | None) -> int | None:
    """Where the numbers begin: the first of some lines in a row that hold numbers, in as many columns."""
    for k, words in enumerate(fields):
        following = [one for one in fields[k : k + 2 * _N_FIRST_ROWS] if any(word.strip() for word in one)][
            :_N_FIRST_ROWS
        ]
        alike = all(len(one) == len(words) and _is_number_row(one, separator) for one in following)
        if len(following) > 1 and _is_number_row(words, separator) and alike:
            return k
    # A file of few lines, or with a bad one among the first.
    return next((k for k, words in enumerate(fields) if _is_number_row(words, separator)), None)


def _read_headings(
    path: Path, fields: Sequence[list[str]], line_numbers: Sequence[int], width: int, separator: str | None
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names and units above the numbers, in ``width`` columns; empty where there are none.

    Raises:
        ValueError: for a line above the numbers that is neither.
    """
    headings = list[tuple[list[str], int]]()
    for words, line in zip(reversed(fields), reversed(line_numbers[: len(fields)]), strict=True):
        stripped = [word.strip() for word in words]
        while len(stripped) > width and not stripped[-1]:
            stripped.pop()
        values = [parse_number(word, separator) for word in stripped]
        if any(value is not None and not math.isnan(value) for value in values):
            if not headings and len(stripped) == width:
                bad = stripped[values.index(None)] if None in values else stripped[0]
                raise ValueError(f"{path}, line {line}: {bad!r:.40} must be a number; {_number_remedy(bad)}")
            break
        headings.append((stripped, line))
        if len(headings) == 1 and len(stripped) == width and all(map(is_unit, stripped)):
            continue
        break
    if not headings:
        return (), ()
    (words, line), *above = headings
    units: tuple[str, ...] = ()
    if above and len(above[0][0]) >= width:
        units, (words, line) = tuple(words), above[0]
    if len(words) < width:
        raise ValueError(f"{path}, line {line}: must have {width} names, but has {len(words)}; mend the line")
    return tuple(words[:width]), units


def _parse_rows(
    path: Path, fields: Sequence[list[str]], line_numbers: Sequence[int], separator: str | None
) -> list[list[Any]]:
    """Numbers, or stamps, of each line.

    Raises:
        ValueError: naming the line, for a field that is neither, or another number of them.
    """
    width, decimal_mark, rows = len(fields[0]), "", list[list[Any]]()
    for line, words in zip(line_numbers, fields, strict=True):
        if not any(word.strip() for word in words):
            rows.append([math.nan] * width)
            continue
        if len(words) > width and not any(word.strip() for word in words[width:]):
            words = words[:width]
        if len(words) != width:
            raise ValueError(f"{path}, line {line}: must have {width} columns, but has {len(words)}; mend the line")
        row = [
            value if (value := parse_number(word, separator)) is not None else parse_timestamp(word) for word in words
        ]
        if None in row:
            bad = words[row.index(None)]
            raise ValueError(f"{path}, line {line}: {bad!r:.40} must be a number; {_number_remedy(bad)}")
        for word, field in zip(words, row, strict=True) if separator in DECIMAL_COMMA_SEPARATORS else ():
            if isinstance(field, tuple):
                continue
            decimal_mark = decimal_mark or next((one for one in ",." if one in word), "")
            if decimal_mark and {",": ".", ".": ","}[decimal_mark] in word:
                raise ValueError(
                    f"{path}, line {line}: {word!r:.40} must have the decimal mark {decimal_mark!r} alone, as before; leave "
                    f"out marks of thousands"
                )
        rows.append(row)
    return rows


def _timestamps_to_seconds(
    path: Path, rows: Sequence[Sequence[Any]], line_numbers: Sequence[int], names: Sequence[str]
) -> tuple[FloatArray, frozenset[int]]:
    """(C, T) columns, stamps as seconds from the first on, and which columns hold stamps.

    Raises:
        ValueError: for a column in which some fields are stamps and some numbers.
    """
    first = rows[0]
    if not any(isinstance(value, tuple) for row in rows[:1] for value in row):
        for line, row in zip(line_numbers, rows, strict=True):
            if any(isinstance(value, tuple) for value in row):
                raise ValueError(f"{path}, line {line}: must hold numbers as the lines before, but holds a time of day")
        return np.array(rows, dtype=np.float64).T, frozenset()
    timestamp_columns = frozenset(k for k, value in enumerate(first) if isinstance(value, tuple))
    columns = np.empty((len(first), len(rows)))
    for k in range(len(first)):
        before = days = 0
        for t, row in enumerate(rows):
            value = row[k]
            if k not in timestamp_columns or not isinstance(value, tuple):
                if isinstance(value, tuple) or (k in timestamp_columns and not math.isnan(value)):
                    name = names[k] if names else f"column {k + 1}"
                    raise ValueError(
                        f"{path}, line {line_numbers[t]}: {name!r:.40} must hold dates or times of day throughout, or "
                        f"numbers; mend the line"
                    )
                columns[k, t] = value
                continue
            whole, rest = value
            if whole < 86400 and before - whole > 43200:  # past midnight, without a date
                days += 86400
            before = whole
            columns[k, t] = (whole + days - first[k][0]) + (rest - first[k][1])
    return columns, timestamp_columns


def _parse_regular_rows(lines: Sequence[str], separator: str | None, width: int) -> list[list[float]] | None:
    """The numbers of lines that hold nothing but finite ones, in many times less time; None of other lines."""
    if separator in DECIMAL_COMMA_SEPARATORS and any("," in line for line in lines):
        if any("." in line for line in lines):
            return None
        lines = [line.replace(",", ".") for line in lines]
    try:
        values = np.loadtxt(lines, delimiter=separator, comments=None, ndmin=2)
    except ValueError:
        return None
    return values.tolist() if values.shape[1] == width and np.isfinite(values).all() else None


def _number_remedy(word: str) -> str:
    """What to do about a field that is no number."""
    if {",", "."} <= set(word):
        return "leave out marks of thousands"
    if re.fullmatch(r"\s*[-+]?\d+,\d+\s*", word):
        return "beside decimal commas let semicolons or tabs separate the fields"
    return "leave it empty where it is missing"
