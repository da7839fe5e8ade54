"""CSV files: columns of time, input and output, found by the names in the first line."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from estimator.identification.columns import KINDS, SECONDS, chosen, plain, unit_of, with_unit, word_of
from estimator.parameters import FloatArray
from estimator.rig import Channel
from estimator.units import kind_of

#: What stands for a missing number, in lower case.
_MISSING = ("", "na", "n/a", "#n/a", "null", "none", "-")

#: What separates fields in files whose numbers may have a decimal comma.
_WITH_COMMAS = (";", "\t")

#: Steps of a time column may be uneven by so much, which rounding does.
_UNEVEN = 0.2


@dataclass(frozen=True, eq=False)
class Table:
    """A CSV file.

    Attributes:
        path: of the file.
        names: of its columns, as they stand there; empty where it has numbers alone.
        columns: (C, T) numbers; NaN where one is missing.
        lines: (T,) of the file.
        time: which column is the time; None where there is none.
        u: which column is the input.
        y: which column is the output.
    """

    path: Path
    names: tuple[str, ...]
    columns: FloatArray
    lines: npt.NDArray[np.int64]
    time: int | None
    u: int
    y: int

    def check_step(self, step: float) -> None:
        """Refuse times that are not a sampling step [s] apart, to 1 %; `step` says what else."""
        own = self.step()
        if own is not None and abs(own / step - 1) > 0.01:
            raise ValueError(
                f"{self.path}: times are {own:.6g} s apart, but the step is {step:.6g} s; mend one of them"
            )

    def step(self) -> float | None:
        """Sampling step [s], of the time column; None where there is none.

        Times are those of the lines that have an input, and may leap where an input is missing: there a record is cut.

        Raises:
            ValueError: for times that are missing, do not grow, are unevenly spaced, or in a unit that is unknown.
        """
        if self.time is None:
            return None
        unit = self.unit(self.time) or "s"
        if unit not in SECONDS:
            raise ValueError(f"{self.path}: times must be in one of {', '.join(SECONDS)}, but are in {unit!r:.40}")
        time, driven = self.columns[self.time] * SECONDS[unit], np.isfinite(self.columns[self.u])
        for k in np.flatnonzero(driven & np.isnan(time))[:1]:
            raise ValueError(
                f"{self._line(k)}: there must be a time beside the input, but there is none; fill it in, or remove "
                f"the column of times"
            )
        later = np.flatnonzero(driven[1:] & driven[:-1]) + 1
        if not len(later):
            raise ValueError(
                f"{self.path} must have two samples in a row with time and input, but has none; add samples"
            )
        steps = time[later] - time[later - 1]
        for k in later[steps <= 0][:1]:
            raise ValueError(
                f"{self._line(k)}: times must grow, but {time[k]:.9g} s comes after {time[k - 1]:.9g} s; mend the "
                f"line, or set records apart by an empty row"
            )
        usual = np.median(steps)
        for k in later[np.abs(steps - usual) > _UNEVEN * usual][:1]:
            raise ValueError(
                f"{self._line(k)}: samples must be evenly spaced, by {usual:.6g} s, but this one comes "
                f"{time[k] - time[k - 1]:.6g} s after the last; give every lost sample a line with empty fields, or "
                f"resample"
            )
        return float(steps.mean())

    def _line(self, row: np.int64) -> str:
        """The file, and the line of a row."""
        return f"{self.path}, line {self.lines[row]}"

    def unit(self, place: int) -> str | None:
        """What stands in brackets behind the name of a column, as N in ``force [N]``; None where nothing does."""
        return unit_of(self.names[place]) if self.names else None

    def kind(self) -> str | None:
        """What the name of the output, or else its unit, says that it is: a displacement, for one; or None.

        Raises:
            ValueError: where name and unit say different things.
        """
        word, unit = word_of(self.names[self.y]) if self.names else "", self.unit(self.y) or ""
        named = next((kind for kind, words in KINDS.items() if word in words), None)
        told = kind_of(unit)
        if named and told and named != told:
            raise ValueError(
                f"{self.path}: unit of {self.names[self.y]!r:.60} must be of a kind with the name, {named}, but tells "
                f"{told}; mend one of them"
            )
        return named or told

    def check(self, source: Channel, sink: Channel) -> None:
        """Refuse names of columns that contradict the channels of a rig; a pure number, 1, contradicts nothing.

        Raises:
            ValueError: naming the column, for another unit, or another kind of output.
        """
        for place, channel in ((self.u, source), (self.y, sink)):
            unit = self.unit(place)
            if unit and channel.unit != "1" and plain(unit) != plain(channel.unit):
                raise ValueError(
                    f"{self.path}: {self.names[place]!r:.60} must be in the rig's unit, {channel.unit}, but is in "
                    f"{unit}; convert the column, or write its unit into the rig"
                )
        word = word_of(self.names[self.y]) if self.names else ""
        kind = next((one for one, words in KINDS.items() if word in words and len(word) > 1), sink.kind)
        if kind != sink.kind:
            raise ValueError(
                f"{self.path}: {self.names[self.y]!r:.60} must be the rig's kind of output, {sink.kind}, but is called "
                f"{kind}; mend one of them"
            )


def read_table(path: Path, source: str | None = None, sink: str | None = None) -> Table:
    """Read a CSV file.

    Fields stand between commas, or semicolons or tabs (then 0,5 is a number, in a file without points), or blanks.
    Empty ones are missing, and NaN, NA, N/A, null, none or - in them. Lines that begin with # are passed over; one of
    separators alone sets records apart. The first line may hold names, such as ``u,y`` or ``time [ms],force [N],x
    [mm]``, and the next one units, such as ``ms,N,mm``; of numbers alone there are the columns u and y, or time in
    seconds, u and y. A column in a unit of time is the time, whatever its name.

    Args:
        path: of the file.
        source: name of the input's column; one of the usual names where it is None.
        sink: of the output's, likewise.

    Raises:
        ValueError: naming the file, the line and what is wrong.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} must be text in UTF-8, but is not: {error}; save it as CSV UTF-8") from error
    kept = [(k, line) for k, line in enumerate(text.splitlines(), 1) if line.strip() and not line.startswith("#")]
    numbers, lines = [number for number, _ in kept], [line for _, line in kept]
    separator = _separator(lines)
    rows, places = list[list[float]](), list[int]()
    names: tuple[str, ...] = ()
    units: tuple[str, ...] = ()
    width, mark = 0, ""
    for place, words in enumerate(_fields(lines, separator)):
        number = numbers[place]
        if not any(word.strip() for word in words):
            if rows:
                rows.append([math.nan] * width)
                places.append(place)
            continue
        values = [_number(word, separator) for word in words]
        if not width and None in values:
            names, width = tuple(word.strip() for word in words), len(words)
            continue
        width = width or len(words)
        if len(words) != width:
            where, remedy = ("", "mend the line")
            if not rows:
                where, remedy = " as the names", "begin lines before the names with #, or mend the line"
            raise ValueError(f"{path}, line {number}: must have {width} columns{where}, but has {len(words)}; {remedy}")
        if None in values and not rows and not units and not any(map(_told, values)):
            units = tuple(words)
            continue
        if None in values:
            bad = words[values.index(None)]
            remedy = _remedy(bad) if rows else "begin lines before the names with #, or mend the line"
            raise ValueError(f"{path}, line {number}: {bad!r:.40} must be a number; {remedy}")
        for word in words if separator in _WITH_COMMAS else ():
            mark = mark or next((one for one in ",." if one in word), "")
            if mark and {",": ".", ".": ","}[mark] in word:
                raise ValueError(
                    f"{path}, line {number}: {word!r:.40} must have the decimal mark {mark!r} alone, as before; leave "
                    f"out marks of thousands"
                )
        regular = None if rows else _regular(lines[place:], separator, width)
        if regular is not None:
            rows, places = regular, list(range(place, len(lines)))
            break
        rows.append([value for value in values if value is not None])
        places.append(place)
    if not rows:
        raise ValueError(f"{path} must hold numbers, but holds none")
    if units:
        pairs = zip(names, units, strict=True)
        names = tuple(with_unit(path, name, unit) if _number(unit) is None else name for name, unit in pairs)
    columns = np.array(rows).T
    return Table(path, names, columns, np.array(numbers)[places], *chosen(path, names, len(columns), source, sink))


def _separator(lines: Sequence[str]) -> str | None:
    """What stands between the fields; None for blanks."""
    first = "".join(lines[:2])
    return next((mark for mark in "\t;," if mark in first), None)


def _fields(lines: Sequence[str], separator: str | None) -> Iterator[list[str]]:
    """The fields of each line."""
    if separator is None:
        yield from (line.split() for line in lines)
        return
    yield from csv.reader(lines, delimiter=separator)


def _regular(lines: Sequence[str], separator: str | None, width: int) -> list[list[float]] | None:
    """The numbers of lines that hold nothing but finite ones, in many times less time; None of other lines."""
    if separator in _WITH_COMMAS and any("," in line for line in lines):
        if any("." in line for line in lines):
            return None
        lines = [line.replace(",", ".") for line in lines]
    try:
        values = np.loadtxt(lines, delimiter=separator, comments=None, ndmin=2)
    except ValueError:
        return None
    return values.tolist() if values.shape[1] == width and np.isfinite(values).all() else None


def _number(word: str, separator: str | None = None) -> float | None:
    """The number that a field holds, NaN where it is missing; None where it is no finite number."""
    if word.strip().lower() in _MISSING:
        return math.nan
    if "_" in word:  # Python's
        return None
    if separator in _WITH_COMMAS:
        word = word.replace(",", ".")
    try:
        value = float(word)
    except ValueError:
        return None
    return None if math.isinf(value) else value


def _remedy(bad: str) -> str:
    """What to do about a field that is no number."""
    if {",", "."} <= set(bad):
        return "leave out marks of thousands"
    if re.fullmatch(r"\s*[-+]?\d+,\d+\s*", bad):
        return "beside decimal commas let semicolons or tabs separate the fields"
    return "leave it empty where it is missing"


def _told(value: float | None) -> bool:
    """Whether a field holds a number that is not missing."""
    return value is not None and not math.isnan(value)
