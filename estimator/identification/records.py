"""Records as a user has them: arrays, or CSV and MAT files; with gaps, and clipped samples that are found."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from estimator.checks import series
from estimator.parameters import FloatArray

#: Names of columns, in lower case, up to the first character that is no letter.
_INPUTS = ("u", "input", "force", "f", "in", "drive", "excitation")
_OUTPUTS = ("y", "output", "x", "displacement", "position", "velocity", "v", "acceleration", "a", "out", "response")
_TIMES = ("t", "time")

#: No file of a record is larger [bytes].
_LARGEST_FILE = 2**30

#: A level of the output is a stop where the signal comes to it this often, and so many times as often as to the next.
_OFTEN, _MORE = 3, 4

#: Fewer outputs identify nothing.
_FEWEST = 50


@dataclass(frozen=True, eq=False)
class Record:
    """One record.

    Attributes:
        name: of its file, or its number.
        u: (T,) inputs.
        y: (T,) outputs; NaN where one is missing or was clipped.
        clipped: outputs that were clipped.
        missing: outputs that were not there.
    """

    name: str
    u: FloatArray
    y: FloatArray
    clipped: int = 0
    missing: int = 0


def records_of(given: Any, step: float) -> list[Record]:
    """Records from a pair (u, y), a file name, or a list of these.

    A record is cut in two where an input is missing; clipped outputs are taken as missing.

    Args:
        given: what the caller has.
        step: sampling step of the rig [s], which a file's time column must have.

    Raises:
        ValueError: naming the record, and in a file the line, and what is wrong.
        FileNotFoundError: if there is no such file.
    """
    if isinstance(given, str | Path) or _is_pair(given):
        given = [given]
    try:
        listed = list(given)
    except TypeError as error:
        raise ValueError(f"records must be a list of pairs (u, y) or file names, but are {given!r:.60}") from error
    if not listed:
        raise ValueError("records must hold at least one pair (u, y) or file name, but are empty")
    found = []
    for number, one in enumerate(listed):
        name = str(one) if isinstance(one, str | Path) else f"record {number}"
        if isinstance(one, str | Path):
            u, y = read(one, step)
        elif _is_pair(one):
            u, y = (series(f"{part} of {name}", values, missing=True) for part, values in zip("uy", one, strict=True))
        else:
            raise ValueError(f"{name} must be a pair (u, y) or a file name, but is {one!r:.60}")
        if len(u) != len(y):
            raise ValueError(f"u and y of {name} must have one length, but have {len(u)} and {len(y)}; cut the longer")
        found += _cut(Record(name, u, y))
    if sum(int(np.isfinite(one.y).sum()) for one in found) < _FEWEST:
        raise ValueError(f"records must have at least {_FEWEST} outputs in all; add samples")
    for part in "uy":
        if all(np.ptp(values) == 0 for one in found if len(values := _seen(getattr(one, part)))):
            raise ValueError(f"{part} must vary, but is constant in all records; excite the system")
    return found


def _is_pair(one: Any) -> bool:
    return isinstance(one, tuple) and len(one) == 2 and not any(isinstance(part, str | Path) for part in one)


def _seen(values: FloatArray) -> FloatArray:
    return values[np.isfinite(values)]


def _cut(record: Record) -> list[Record]:
    """Pieces between missing inputs, without what has no output, and with what is clipped taken out."""
    stops = clipped(record.y)
    missing = np.isnan(record.y)
    y = np.where(stops, np.nan, record.y)
    pieces = []
    for piece in np.ma.clump_unmasked(np.ma.masked_invalid(record.u)):
        seen = np.flatnonzero(np.isfinite(y[piece]))
        if len(seen) < 8:
            continue
        part = slice(piece.start, piece.start + seen[-1] + 1)
        told = int(stops[part].sum()), int(missing[part].sum())
        pieces.append(replace(record, u=record.u[part].copy(), y=y[part].copy(), clipped=told[0], missing=told[1]))
    return pieces


def clipped(y: FloatArray) -> npt.NDArray[np.bool_]:
    """(T,) whether an output stands at a stop: the largest or smallest value, which several outputs have exactly.

    Few samples in a period leave one in a row there. A converter's coarse levels are no stop: the next level is met
    almost as often. Nor is a start at rest: the signal comes to a stop again.
    """
    found = np.zeros(len(y), dtype=np.bool_)
    levels = np.unique(_seen(y))
    if len(levels) < 10:
        return found
    for at, beside in ((levels[-1], levels[-2]), (levels[0], levels[1])):
        visits = np.count_nonzero(np.diff(np.concatenate([[False], y == at]).astype(np.int8)) == 1)
        if visits >= _OFTEN and np.count_nonzero(y == at) > _MORE * np.count_nonzero(y == beside):
            found |= y == at
    return found


def read(path: str | Path, step: float) -> tuple[FloatArray, FloatArray]:
    """Inputs and outputs of a CSV or MAT file.

    A CSV has a line of names, such as ``u,y`` or ``time,force,displacement``, or numbers alone: u and y, or time, u and
    y. An empty field is missing. A MAT file holds the variables ``u`` and ``y``.

    Raises:
        ValueError: naming the file, the line and what is wrong.
        FileNotFoundError: if there is no such file.
    """
    place = Path(path)
    if not place.exists():
        raise FileNotFoundError(f"record must be a CSV or MAT file, but there is no {place}")
    if not place.is_file() or place.stat().st_size > _LARGEST_FILE:
        raise ValueError(f"record must be a CSV or MAT file of at most 1 GiB, but {place} is none")
    return _read_mat(place) if place.suffix.lower() == ".mat" else _read_csv(place, step)


def _read_mat(path: Path) -> tuple[FloatArray, FloatArray]:
    from scipy.io import loadmat

    try:
        held = loadmat(path, squeeze_me=True, variable_names=("u", "y"))
    except Exception as error:  # whatever a file that is none makes of the reader
        raise ValueError(f"{path} must be a MAT file up to version 7.2, but is not: {error}") from error
    if not {"u", "y"} <= set(held):
        raise ValueError(f"{path} must hold the variables u and y, but does not; rename them, or write a CSV")
    return series(f"u of {path}", held["u"], missing=True), series(f"y of {path}", held["y"], missing=True)


def _read_csv(path: Path, step: float) -> tuple[FloatArray, FloatArray]:
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} must be text in UTF-8, but is not: {error}; save it as CSV again") from error
    lines = text.splitlines()
    separator = max(",;\t", key=lines[0].count) if lines else ","
    rows: list[list[float]] = []
    names: list[str] | None = None
    width = 0
    for number, words in enumerate(csv.reader(lines, delimiter=separator), 1):
        if not any(word.strip() for word in words) or words[0].startswith("#"):
            continue
        if not rows and names is None and any(_number(word) is None for word in words):
            names, width = [word.strip() for word in words], len(words)
            continue
        width = width or len(words)
        if len(words) != width:
            raise ValueError(f"{path}, line {number}: must have {width} columns, but has {len(words)}; mend the line")
        values = [_number(word) for word in words]
        if None in values:
            bad = words[values.index(None)]
            raise ValueError(f"{path}, line {number}: {bad!r:.40} must be a number; leave it empty where it is missing")
        rows.append([value for value in values if value is not None])
    if not rows:
        raise ValueError(f"{path} must hold numbers, but holds none")
    columns = np.array(rows).T
    time, u, y = _chosen(path, names, columns)
    if time is not None:
        _check_time(path, columns[time], step)
    return columns[u], columns[y]


def _number(word: str) -> float | None:
    """The number that a field holds, NaN where it is empty; None where it is no finite number."""
    if not word.strip():
        return math.nan
    try:
        value = float(word)
    except ValueError:
        return None
    return None if math.isinf(value) else value


def _chosen(path: Path, names: Sequence[str] | None, columns: FloatArray) -> tuple[int | None, int, int]:
    """Places of time (or None), input and output."""
    if names is None:
        if len(columns) not in (2, 3):
            raise ValueError(f"{path} must have two columns, u and y, or three with the time, but has {len(columns)}")
        return (None, 0, 1) if len(columns) == 2 else (0, 1, 2)
    words = ["".join(c if c.isalpha() else " " for c in name.lower()).split()[:1] for name in names]
    place = lambda known: [k for k, word in enumerate(words) if word and word[0] in known]  # noqa: E731
    time, u, y = place(_TIMES), place(_INPUTS), place(_OUTPUTS)
    if len(u) != 1 or len(y) != 1 or len(time) > 1:
        raise ValueError(
            f"{path} must have one column of inputs and one of outputs, such as 'u,y', but has {list(names)}; rename"
        )
    return (time[0] if time else None), u[0], y[0]


def _check_time(path: Path, time: FloatArray, step: float) -> None:
    steps = np.diff(time)
    if not np.isfinite(steps).all() or (steps <= 0).any():
        raise ValueError(f"{path}: times must be there and grow, but do not; mend the column, or remove it")
    median = float(np.median(steps))
    if (np.abs(steps - median) > 0.2 * median).any():
        raise ValueError(
            f"{path}: samples must be evenly spaced, but steps are {steps.min():.6g} to {steps.max():.6g} s"
        )
    if abs(median / step - 1) > 0.01:
        raise ValueError(
            f"{path}: times are {median:.6g} s apart, but the rig's step is {step:.6g} s; mend one of them"
        )


def residuals(y: FloatArray, forecast: FloatArray) -> FloatArray:
    """(n,) standardised innovations of the outputs that were seen."""
    with np.errstate(invalid="ignore"):
        values = (y - forecast[:, 0]) / np.sqrt(forecast[:, 1])
    return values[np.isfinite(values)]
