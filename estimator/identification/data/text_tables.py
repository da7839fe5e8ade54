"""Text tables of instruments, such as CSV files: columns of time, input and output, found by names and units."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from estimator.identification.data.column_choice import ColumnNames, choose_columns
from estimator.identification.data.column_units import append_unit, seconds_per_time_unit, unit_in_name
from estimator.identification.data.column_words import sensor_kind_in_name
from estimator.identification.data.table_rows import (
    TableValue,
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

#: Deviation of even times from their grid, at most [steps]; their last digit is allowed besides.
_EVENNESS_TOLERANCE = 0.005

#: Steps of a table count as alike within this fraction of the usual step.
REGULAR_STEP_TOLERANCE = 0.05

#: Fraction of steps that are alike, from which a jump of whole steps means lost lines.
MIN_REGULAR_FRACTION = 0.8

#: Longest step that is no gap, in usual steps.
_MAX_STEP_FACTOR = 3.0


@dataclass(frozen=True, eq=False)
class TextTable:
    """The content of a text table.

    Attributes:
        path: the file.
        names: names of the columns, as the file has them; empty where it has numbers alone.
        columns: (C, T) numbers; NaN where one is missing.
        lines: (T,) line numbers in the file.
        time_column: index of the time's column; None without one.
        input_column: index of the input's column; None in a free decay.
        output_column: index of the output's column.
        reason: what decided which column is what (`estimator.identification.data.column_choice.ColumnChoice`).
        has_timestamps: whether the times were dates or times of day, and are seconds from the first on.
    """

    path: Path
    names: tuple[str, ...]
    columns: FloatArray
    lines: npt.NDArray[np.int64]
    time_column: int | None
    input_column: int | None
    output_column: int
    reason: str
    has_timestamps: bool = False

    @property
    def inputs(self) -> FloatArray:
        """(T,) inputs; 0 without a column of inputs."""
        return (
            np.zeros(self.columns.shape[1])
            if self.input_column is None
            else np.asarray(self.columns[self.input_column])
        )

    def step(self) -> float | None:
        """Usual sampling step of the time column [s]; None without one.

        Lines with an input count. Their times may jump where an input is missing, because a record is cut there.

        Raises:
            ValueError: for times that are missing, do not increase, or have an unknown unit.
        """
        if self.time_column is None:
            return None
        time, later = self._times_and_pairs()
        steps = time[later] - time[later - 1]
        usual = float(np.median(steps))
        alike = np.abs(steps - usual) < REGULAR_STEP_TOLERANCE * usual
        return float(steps[alike if alike.mean() > MIN_REGULAR_FRACTION else steps < _MAX_STEP_FACTOR * usual].mean())

    def times(self, step: float) -> FloatArray | None:
        """(T,) times of the lines [s]; None without a time column, or where the times are ``step`` seconds apart.

        Even times are on a grid of that step up to their last digit. Lines without an input do not count.

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
        """(T,) times [s], and the indices of the lines that have an input, as has the line before."""
        assert self.time_column is not None
        unit = (
            seconds_per_time_unit(self.path, self.names[self.time_column])
            if self.names and not self.has_timestamps
            else 1.0
        )
        time, driven = self.columns[self.time_column] * unit, np.isfinite(self.inputs)
        for k in np.flatnonzero(driven & np.isnan(time))[:1]:
            raise ValueError(
                f"{self._location(k)}: the input must have a time, but has none; fill it in, or remove the column of "
                f"times"
            )
        later = np.flatnonzero(driven[1:] & driven[:-1]) + 1
        if not len(later):
            raise ValueError(
                f"{self.path} must have two samples in a row with time and input, but has none; add samples"
            )
        for k in later[time[later] <= time[later - 1]][:1]:
            raise ValueError(
                f"{self._location(k)}: times must increase, but {time[k]:.9g} s comes after {time[k - 1]:.9g} s; mend "
                f"the line, or separate the records by an empty row"
            )
        return time, later

    def _time_resolution(self, time: FloatArray) -> float:
        """Resolution of the times [s]: the largest power of ten of which all are multiples."""
        seen = time[np.isfinite(time)]
        seen = seen - seen[0]
        for digits in range(-2, 13):
            if np.abs(seen * 10.0**digits - np.round(seen * 10.0**digits)).max() < 1e-3 * max(
                1.0, 10.0 ** (digits - 9)
            ):
                return float(10.0**-digits)
        return 0.0

    def _location(self, row: np.int64) -> str:
        """The file and the line of a row, for messages."""
        return f"{self.path}, line {self.lines[row]}"

    def unit(self, column: int) -> str | None:
        """The unit in the name of a column, such as N in ``force [N]``; None without one."""
        return unit_in_name(self.names[column]) if self.names else None

    def column_names(self) -> ColumnNames:
        """The names of the columns of input and output; their places in a table without names."""
        input_name, output_name = (
            None if k is None else self.names[k] if self.names else f"column {k + 1}"
            for k in (self.input_column, self.output_column)
        )
        return ColumnNames(input_name, str(output_name), self.reason)

    def output_kind(self) -> str | None:
        """The kind of the output by its name, or else by its unit; None where neither decides.

        Raises:
            ValueError: where name and unit contradict each other.
        """
        named = sensor_kind_in_name(self.names[self.output_column]) if self.names else None
        measured = sensor_kind_of_unit(self.unit(self.output_column) or "")
        if named and measured and named != measured:
            raise ValueError(
                f"{self.path}: the unit of {self.names[self.output_column]!r:.60} must fit its name, a {named}, but is "
                f"the unit of a {measured}; mend one of them"
            )
        return named or measured

    def signals_in_rig_units(self, input_channel: Channel, output_channel: Channel) -> tuple[FloatArray, FloatArray]:
        """(T,) inputs and outputs in the units of the rig's channels; a column in mm is converted if the rig has m.

        Raises:
            ValueError: naming the column, for a unit of another quantity, or another kind of output. A channel that is
                a pure number, 1, takes any unit.
        """
        named = sensor_kind_in_name(self.names[self.output_column], min_letters=2) if self.names else None
        kind = named or output_channel.kind
        if kind != output_channel.kind:
            raise ValueError(
                f"{self.path}: {self.names[self.output_column]!r:.60} must be the rig's kind of output, "
                f"{output_channel.kind}, but is called {kind}; mend one of them"
            )
        return self.inputs * self._unit_factor(self.input_column, input_channel), self.columns[
            self.output_column
        ] * self._unit_factor(self.output_column, output_channel)

    def _unit_factor(self, column: int | None, channel: Channel) -> float:
        """Factor from the unit of a column to the unit of its channel; 1 where one of them has none."""
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
    """Read a text file of an instrument, such as CSV or LabVIEW's .lvm.

    Commas, semicolons, tabs or blanks separate the fields. With semicolons or tabs, in a file without points, 0,5 is
    a number. Empty fields, NaN, NA, N/A, null, none and - are missing; ∞ and inf are over range. Lines that begin
    with # are skipped; a line of separators alone starts a new record. The line above the numbers may hold names:
    ``u,y``, ``time [ms],force [N],x [mm]`` or ``time_ms,force_N,x_mm``; or a line of names stands above a line of
    units, such as ``ms,N,mm``. Lines above these are skipped. Numbers without names are the columns u and y, or time in
    seconds, u and y. A column in a unit of time, or of dates or times of day, is the time, whatever its name.
    `estimator.identification.data.column_choice.choose_columns` says which column is what.

    Args:
        path: the file.
        input_name: name of the input's column; None: one of the usual names.
        output_name: name of the output's column; None: one of the usual names.

    Raises:
        ValueError: naming the file, the line and the fault.
    """
    lines = read_text(path).splitlines()
    numbered_lines = [(k, line) for k, line in enumerate(lines, 1) if line.strip() and not line.startswith("#")]
    separator = None
    if numbered_lines and (found := re.fullmatch(r"\s*\"?sep=(.)\"?\s*", numbered_lines[0][1])):  # of a spreadsheet
        numbered_lines.pop(0)
        separator = found.group(1)
    line_numbers, texts = [k for k, _ in numbered_lines], [line for _, line in numbered_lines]
    separator = separator or guess_separator(texts)
    fields = split_fields(texts, separator)
    first = find_first_row(fields, separator)
    if first is None:
        raise ValueError(f"{path} must hold numbers, but holds none")
    width = len(fields[first])
    names, units = read_headings(path, fields[:first], line_numbers, width, separator)
    rows: list[list[TableValue]] | list[list[float]] | None = parse_regular_rows(texts[first:], separator, width)
    if rows is None:
        rows = parse_rows(path, fields[first:], line_numbers[first:], separator)
    columns, stamped = timestamps_to_seconds(path, rows, line_numbers[first:], names)
    names = tuple(append_unit(path, name, unit) for name, unit in zip(names, units, strict=True)) if units else names
    choice = choose_columns(path, names, len(columns), input_name, output_name, stamped)
    return TextTable(
        path, names, columns, np.array(line_numbers[first:]), choice.time, choice.input, choice.output, choice.reason,
        choice.time in stamped,
    )  # fmt: skip
