"""Cleaning of recorded signals: gaps, lost lines, clipped and over-range outputs."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from estimator.identification.data.record import Record
from estimator.identification.data.sensor_faults import find_stale_outputs
from estimator.identification.data.text_tables import MIN_REGULAR_FRACTION, REGULAR_STEP_TOLERANCE
from estimator.support.array_types import FloatArray

#: An end of the range counts as a stop after this many visits of the output.
_MIN_CLIPPING_VISITS = 3

#: Samples at a stop, per sample at the next level, at least.
_MIN_CLIPPING_RATIO = 4

#: Outputs in a piece of a record, at least.
MIN_PIECE_OUTPUTS = 8


def observed_values(values: FloatArray) -> FloatArray:
    return values[np.isfinite(values)]


def split_at_missing_inputs(record: Record) -> list[Record]:
    """Pieces between missing inputs, without what has no output, and with what is clipped taken out."""
    is_clipped = find_clipped_outputs(record.y)
    is_over_range = np.zeros(len(record.y), dtype=np.bool_) if record.is_over_range is None else record.is_over_range
    missing = np.isnan(record.y) & ~is_over_range
    is_clipped = is_clipped | is_over_range
    y = np.where(is_clipped, np.nan, record.y)
    stale_outputs = find_stale_outputs(y)
    y = np.where(stale_outputs.is_stale, np.nan, y)
    pieces = []
    for piece in _true_runs(np.isfinite(record.u)):
        seen = np.flatnonzero(np.isfinite(y[piece]))
        if len(seen) < MIN_PIECE_OUTPUTS:
            continue
        part = slice(piece.start, piece.start + seen[-1] + 1)
        times = None if record.times is None else record.times[part].copy()
        counts = int(is_clipped[part].sum()), int(missing[part].sum())
        name = f"{record.name}, from sample {piece.start}" if piece.start else record.name
        pieces.append(
            replace(
                record,
                name=name,
                u=record.u[part].copy(),
                y=y[part].copy(),
                n_clipped=counts[0],
                n_missing=counts[1],
                times=times,
                is_over_range=None,
                n_stale=int(stale_outputs.is_stale[part].sum()),
                n_bursts=stale_outputs.n_bursts,
                samples_per_value=stale_outputs.samples_per_value,
            )
        )
    return pieces


def _true_runs(flags: npt.NDArray[np.bool_]) -> Iterator[slice]:
    """Where flags are set, one after another."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    for begin, end in edges.reshape(-1, 2):
        yield slice(int(begin), int(end))


def find_clipped_outputs(y: FloatArray) -> npt.NDArray[np.bool_]:
    """(T,) whether an output stands at a stop: the largest or smallest value, which several outputs have exactly.

    Few samples in a period leave one in a row there. A converter's coarse levels are no stop: the next level is met
    almost as often. Nor is a start at rest: the signal comes to a stop again.
    """
    found = np.zeros(len(y), dtype=np.bool_)
    levels = np.sort(observed_values(y))
    levels = levels[np.diff(levels, prepend=-np.inf) > 0]
    if len(levels) < 10:
        return found
    for end_level, next_level in ((levels[-1], levels[-2]), (levels[0], levels[1])):
        visits = np.count_nonzero(np.diff(np.concatenate([[False], y == end_level]).astype(np.int8)) == 1)
        if visits >= _MIN_CLIPPING_VISITS and np.count_nonzero(y == end_level) > _MIN_CLIPPING_RATIO * np.count_nonzero(
            y == next_level
        ):
            found |= y == end_level
    return found


def mask_over_range(
    name: str, u: FloatArray, y: FloatArray, times: FloatArray | None = None, step: float = 0.0
) -> Record:
    """A record of a file, without what is over range, and with the lines that its times say were lost."""
    is_over_range = np.isinf(y)
    u, y = np.where(np.isfinite(u), u, np.nan), np.where(np.isfinite(y), y, np.nan)
    if times is not None:
        u, y, is_over_range, times = _insert_lost_lines(u, y, is_over_range, times, step)
    return Record(name, u, y, is_over_range=is_over_range, times=times)


def _insert_lost_lines(
    u: FloatArray, y: FloatArray, is_over_range: npt.NDArray[np.bool_], times: FloatArray, step: float
) -> tuple[FloatArray, FloatArray, npt.NDArray[np.bool_], FloatArray | None]:
    """With a missing line wherever even times leap by whole steps; times are None where they are then even."""
    steps = np.diff(times)
    usual = np.nanmedian(steps)
    steps_per_line = np.round(steps / usual)
    is_regular = np.abs(steps - np.maximum(steps_per_line, 1) * usual) < REGULAR_STEP_TOLERANCE * usual
    if (
        not np.isfinite(steps).all()
        or np.mean(np.abs(steps - usual) < REGULAR_STEP_TOLERANCE * usual) < MIN_REGULAR_FRACTION
        or not is_regular.all()
    ):
        return u, y, is_over_range, times
    places = np.concatenate([[0], np.cumsum(np.maximum(steps_per_line, 1)).astype(np.intp)])
    wide = lambda values, fill: np.full(places[-1] + 1, fill, dtype=values.dtype)  # noqa: E731
    filled = []
    for values, fill in ((u, np.nan), (y, np.nan), (is_over_range, False)):
        one = wide(values, fill)
        one[places] = values
        filled.append(one)
    even = abs(float(np.mean(steps[steps_per_line <= 1])) / step - 1) < 0.01
    grid = times[0] + usual * np.arange(places[-1] + 1)
    return filled[0], filled[1], filled[2], None if even else grid
