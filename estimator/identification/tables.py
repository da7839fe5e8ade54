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

from estimator.parameters import FloatArray
from estimator.rig import Channel

#: Names of columns, in lower case, up to the first character that is not a letter.
_INPUTS = ("u", "input", "force", "f", "in", "drive", "excitation")
#: Kind of an output to the words that name it.
_KINDS = {
    "displacement": ("displacement", "disp", "position", "pos"),
    "velocity": ("velocity", "vel", "v"),
    "acceleration": ("acceleration", "acc", "a"),
}
_OUTPUTS = ("y", "output", "out", "response", "x", *(word for words in _KINDS.values() for word in words))
_TIMES = ("t", "time")

#: Units that only one kind of output has.
_UNITS = {"displacement": r"[mµμun]?m|cm|in", "velocity": r"[^/]+/s", "acceleration": r".+/s(²|\^?2|/s)|m?g"}

#: What a time column may be in [s].
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "μs": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0}

#: What stands for a missing number, in lower case.
_MISSING = ("", "na", "n/a", "#n/a", "null", "none", "-")

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

    def step(self) -> float | None:
        """Sampling step [s], of the time column; None where there is none.

        Times are those of the lines that have an input, and may leap where an input is missing: there a record is cut.

        Raises:
            ValueError: for times that are missing, do not grow, are unevenly spaced, or in a unit that is unknown.
        """
        if self.time is None:
            return None
        unit = self.unit(self.time) or "s"
        if unit not in _SECONDS:
            raise ValueError(f"{self.path}: times must be in one of {', '.join(_SECONDS)}, but are in {unit!r:.40}")
        time, driven = self.columns[self.time] * _SECONDS[unit], np.isfinite(self.columns[self.u])
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
        return _unit(self.names[place]) if self.names else None

    def kind(self) -> str | None:
        """What the name of the output, or else its unit, says that it is: a displacement, for one; or None.

        Raises:
            ValueError: where name and unit say different things.
        """
        word, unit = _word(self.names[self.y]) if self.names else "", self.unit(self.y) or ""
        named = next((kind for kind, words in _KINDS.items() if word in words), None)
        told = next((kind for kind, units in _UNITS.items() if re.fullmatch(units, unit)), None)
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
            if unit and channel.unit != "1" and _plain(unit) != _plain(channel.unit):
                raise ValueError(
                    f"{self.path}: {self.names[place]!r:.60} must be in the rig's unit, {channel.unit}, but is in "
                    f"{unit}; convert the column, or write its unit into the rig"
                )
        word = _word(self.names[self.y]) if self.names else ""
        kind = next((one for one, words in _KINDS.items() if word in words and len(word) > 1), sink.kind)
        if kind != sink.kind:
            raise ValueError(
                f"{self.path}: {self.names[self.y]!r:.60} must be the rig's kind of output, {sink.kind}, but is called "
                f"{kind}; mend one of them"
            )


def read_table(path: Path, source: str | None = None, sink: str | None = None) -> Table:
    """Read a CSV file.

    Args:
        path: of the file.
        source: name of the input's column; where it is None, or the file has none of it, one of the usual names.
        sink: of the output's, likewise.

    Fields stand between commas, or semicolons or tabs (then 0,5 is a number), or blanks. Empty ones are missing, and
    NaN, NA, N/A, null, none or - in them. Lines that begin with # are passed over; one of separators alone sets records
    apart. The first line may hold names, such as ``u,y`` or ``time [ms],force [N],x [mm]``, and the next one units,
    such as ``ms,N,mm``; of numbers alone there are the columns u and y, or time in seconds, u and y. A column in a unit
    of time is the time, whatever its name.

    Raises:
        ValueError: naming the file, the line and what is wrong.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} must be text in UTF-8, but is not: {error}; save it as CSV again") from error
    kept = [(k, line) for k, line in enumerate(text.splitlines(), 1) if line.strip() and not line.startswith("#")]
    numbers, lines = [number for number, _ in kept], [line for _, line in kept]
    separator = _separator(lines)
    rows, places = list[list[float]](), list[int]()
    names: tuple[str, ...] = ()
    units: tuple[str, ...] = ()
    width = 0
    for place, words in enumerate(_fields(lines, separator)):
        number = numbers[place]
        if not any(word.strip() for word in words):
            if rows:
                rows.append([math.nan] * width)
                places.append(place)
            continue
        values = [_number(word) for word in words]
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
            raise ValueError(f"{path}, line {number}: {bad!r:.40} must be a number; leave it empty where it is missing")
        regular = None if rows else _regular(lines[place:], separator, width)
        if regular is not None:
            rows, places = regular, list(range(place, len(lines)))
            break
        rows.append([value for value in values if value is not None])
        places.append(place)
    if not rows:
        raise ValueError(f"{path} must hold numbers, but holds none")
    if units:
        names = tuple(
            f"{name} [{unit.strip()}]" if _number(unit) is None else name
            for name, unit in zip(names, units, strict=True)
        )
    columns = np.array(rows).T
    return Table(path, names, columns, np.array(numbers)[places], *_chosen(path, names, len(columns), source, sink))


def _separator(lines: Sequence[str]) -> str | None:
    """What stands between the fields; None for blanks."""
    first = "".join(lines[:2])
    return next((mark for mark in "\t;," if mark in first), None)


def _fields(lines: Sequence[str], separator: str | None) -> Iterator[list[str]]:
    """The fields of each line."""
    if separator is None:
        yield from (line.split() for line in lines)
        return
    for words in csv.reader(lines, delimiter=separator):
        yield words if separator == "," else [word.replace(",", ".") for word in words]


def _regular(lines: Sequence[str], separator: str | None, width: int) -> list[list[float]] | None:
    """The numbers of lines that hold nothing but finite ones, in many times less time; None of other lines."""
    mended = lines if separator in (",", None) else [line.replace(",", ".") for line in lines]
    try:
        values = np.loadtxt(mended, delimiter=separator, comments=None, ndmin=2)
    except ValueError:
        return None
    return values.tolist() if values.shape[1] == width and np.isfinite(values).all() else None


def _number(word: str) -> float | None:
    """The number that a field holds, NaN where it is missing; None where it is no finite number."""
    if word.strip().lower() in _MISSING:
        return math.nan
    try:
        value = float(word)
    except ValueError:
        return None
    return None if math.isinf(value) else value


def _told(value: float | None) -> bool:
    """Whether a field holds a number that is not missing."""
    return value is not None and not math.isnan(value)


def _word(name: str) -> str:
    words = "".join(c if c.isalpha() else " " for c in name.lower()).split()
    return words[0] if words else ""


def _is(name: str, wish: str | None) -> bool:
    """Whether a column is the one that is wished, with or without the unit behind its name."""
    plain = re.sub(r"\s*[\[(][^\])]*[\])]\s*$", "", name)
    return wish is not None and wish.strip().lower() in (name.strip().lower(), plain.strip().lower())


def _unit(name: str) -> str | None:
    found = re.search(r"[\[(]\s*([^\])]+?)\s*[\])]\s*$", name)
    return found.group(1) if found else None


def _plain(unit: str) -> str:
    """A unit in one way of writing."""
    for written, plain in (("µ", "u"), ("μ", "u"), ("²", "2"), ("^", ""), ("·", " "), ("*", " ")):
        unit = unit.replace(written, plain)
    return unit.replace(" ", "")


def _listed(words: Sequence[str]) -> str:
    return f"{', '.join(words[:-1])} or {words[-1]}"


def _chosen(
    path: Path, names: Sequence[str], count: int, source: str | None, sink: str | None
) -> tuple[int | None, int, int]:
    """Places of time (or None), input and output."""
    if not names:
        if count not in (2, 3):
            raise ValueError(f"{path} must have two columns, u and y, or three with the time, but has {count}")
        return (None, 0, 1) if count == 2 else (0, 1, 2)
    wished = [[k for k, name in enumerate(names) if _is(name, wish)] for wish in (source, sink)]
    free = [k for k in range(len(names)) if [k] not in wished]
    time, u, y = ([k for k in free if _word(names[k]) in known] for known in (_TIMES, _INPUTS, _OUTPUTS))
    u, y = wished[0] or u, wished[1] or y
    time = time or [k for k, name in enumerate(names) if _unit(name) in _SECONDS]
    if len(u) != 1 or len(y) != 1 or len(time) > 1:
        raise ValueError(
            f"{path} must have one column of inputs and one of outputs, such as 'u,y', but has {list(names)}; rename: "
            f"an input is called {_listed(_INPUTS)}, an output {_listed(_OUTPUTS)}; or write the names as column = "
            f"'...' into the rig's [input] and [output]"
        )
    return (time[0] if time else None), u[0], y[0]
