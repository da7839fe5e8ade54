"""Text files of instruments: columns of time, input and output, found by the names above the numbers."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from estimator.identification.data.column_names import (
    WORDS_OF_SENSOR_KIND,
    append_unit,
    first_word,
    is_input_or_output,
    locate_columns,
    seconds_per_time_unit,
    unit_in_name,
)
from estimator.identification.data.table_rows import (
    find_first_row,
    guess_separator,
    parse_regular_rows,
    parse_rows,
    read_headings,
    split_fields,
    timestamps_to_seconds,
)
from estimator.identification.data.text_fields import read_text
from estimator.rigs.channel import Channel
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
        else guess_separator([line for _, line in numbered_lines])
    )
    line_numbers, fields = (
        [k for k, _ in numbered_lines],
        split_fields([line for _, line in numbered_lines], separator),
    )
    first = find_first_row(fields, separator)
    if first is None:
        raise ValueError(f"{path} must hold numbers, but holds none")
    width = len(fields[first])
    names, units = read_headings(path, fields[:first], line_numbers, width, separator)
    regular = parse_regular_rows([line for _, line in numbered_lines[first:]], separator, width)
    rows = parse_rows(path, fields[first:], line_numbers[first:], separator) if regular is None else regular
    columns, stamped = timestamps_to_seconds(path, rows, line_numbers[first:], names)
    names = tuple(append_unit(path, name, unit) for name, unit in zip(names, units, strict=True)) if units else names
    places = locate_columns(path, names, len(columns), input_name, output_name, stamped)
    return TextTable(path, names, columns, np.array(line_numbers[first:]), *places, has_timestamps=places[0] in stamped)
