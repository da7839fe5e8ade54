"""Cleaning of recorded signals: gaps, lost lines, and clipped, stale or over-range outputs."""

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


def split_at_missing_inputs(record: Record) -> list[Record]:
    """The pieces of a record between missing inputs, up to their last outputs, with bad outputs as missing.

    Bad outputs are clipped, over range or stale. Pieces of fewer than `MIN_PIECE_OUTPUTS` outputs are dropped.
    """
    is_clipped = find_clipped_outputs(record.y)
    is_over_range = np.zeros(len(record.y), dtype=np.bool_) if record.is_over_range is None else record.is_over_range
    is_missing = np.isnan(record.y) & ~is_over_range
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

        name = f"{record.name}, from sample {piece.start}" if piece.start else record.name
        pieces.append(
            replace(
                record,
                name=name,
                u=record.u[part].copy(),
                y=y[part].copy(),
                n_clipped=int(is_clipped[part].sum()),
                n_missing=int(is_missing[part].sum()),
                times=times,
                is_over_range=None,
                n_stale=int(stale_outputs.is_stale[part].sum()),
                n_bursts=stale_outputs.n_bursts,
                samples_per_value=stale_outputs.samples_per_value,
            )
        )
    return pieces


def _true_runs(flags: npt.NDArray[np.bool_]) -> Iterator[slice]:
    """The runs of set flags, in order."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    for begin, end in edges.reshape(-1, 2):
        yield slice(int(begin), int(end))


def find_clipped_outputs(y: FloatArray) -> npt.NDArray[np.bool_]:
    """(T,) whether an output is clipped: at the largest or smallest value, which the signal reaches again and again.

    A fast motion may have one sample at the stop per visit. Two signals are not clipped: one on the coarse levels of a
    converter, which has the next level almost as often, and one that starts at rest, which visits its level once.
    """
    found = np.zeros(len(y), dtype=np.bool_)
    levels = np.sort(y[np.isfinite(y)])
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
    """The record of a file, with infinite values as missing, and with a missing line for each lost one.

    Args:
        name: name of the record.
        u: (T,) inputs.
        y: (T,) outputs; an infinite one is over range.
        times: (T,) times of the samples [s], which show lost lines; None where they are even.
        step: sampling step of the rig [s].
    """
    is_over_range = np.isinf(y)
    u, y = np.where(np.isfinite(u), u, np.nan), np.where(np.isfinite(y), y, np.nan)
    if times is not None:
        u, y, is_over_range, times = _insert_lost_lines(u, y, is_over_range, times, step)
    return Record(name, u, y, is_over_range=is_over_range, times=times)


def _insert_lost_lines(
    u: FloatArray, y: FloatArray, is_over_range: npt.NDArray[np.bool_], times: FloatArray, step: float
) -> tuple[FloatArray, FloatArray, npt.NDArray[np.bool_], FloatArray | None]:
    """Add a missing line for each whole step by which even times jump; the times are None if they are even then."""
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
    count = int(places[-1]) + 1
    new_u, new_y, new_flags = np.full(count, np.nan), np.full(count, np.nan), np.zeros(count, dtype=np.bool_)
    new_u[places], new_y[places], new_flags[places] = u, y, is_over_range
    even = abs(float(np.mean(steps[steps_per_line <= 1])) / step - 1) < 0.01
    grid = times[0] + usual * np.arange(count)
    return new_u, new_y, new_flags, None if even else grid
