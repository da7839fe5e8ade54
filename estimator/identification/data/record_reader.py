"""Records as a user has them: arrays, or CSV and MAT files; with gaps, and clipped samples that are found."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from estimator.identification.data.duplicate_samples import find_shared_samples
from estimator.identification.data.record import Record
from estimator.identification.data.record_cleaning import (
    MIN_PIECE_OUTPUTS,
    observed_values,
    split_at_missing_inputs,
)
from estimator.identification.data.record_files import read_record_file
from estimator.rigs.rig import Rig
from estimator.rigs.units import MAGNITUDE_BOUNDS
from estimator.support.argument_checks import to_finite_series

#: Outputs in all records, at least: fewer identify nothing.
_MIN_OUTPUTS = 50

#: Some record has the rig's sampling step to this part of it.
_STEP_TOLERANCE = 0.02


def read_records(source: Any, rig: Rig) -> list[Record]:
    """Records from a pair (u, y), a file name, or a list of these.

    Where no input varies the records are of a free decay, and inputs are 0.

    A record is cut in two where an input is missing; clipped outputs are taken as missing. Pieces of fewer than 8
    outputs are left out, but not a whole record. A record may not be given twice, also with other outputs missing, nor
    may records or the pieces of one share samples (`estimator.identification.data.duplicate_samples.find_shared_samples`): these would count twice.

    Args:
        source: what the caller has; to a pair of arrays the times of its samples [s] may be added, which may be uneven.
        rig: whose sampling step a file's times must have, and whose units and kind of output the names of its columns.

    Raises:
        ValueError: naming the record, and in a file the line, and what is wrong.
        FileNotFoundError: if there is no such file.
    """
    if isinstance(source, str | Path) or _is_array_pair(source):
        source = [source]
    if isinstance(source, Mapping) or not isinstance(source, Iterable):
        raise ValueError(f"records must be a list of pairs (u, y) or file names, but are {source!r:.60}; pass [(u, y)]")
    listed = list(source)
    if not listed:
        raise ValueError("records must hold at least one pair (u, y) or file name, but are empty")
    pieces_of_all, uncut_records = list[Record](), list[Record]()
    for number, one in enumerate(listed):
        name = f"record {number}"
        if isinstance(one, str | Path):
            given_here = read_record_file(one, rig)
        elif _is_array_pair(one):
            given_here = [_record_from_arrays(name, one, rig.step)]
        else:
            raise ValueError(
                f"{name} must be a pair (u, y) or a file name, but is {one!r:.60}; pass (u, y) as one tuple"
            )
        for record in given_here:
            name, u, y = record.name, record.u, record.y
            if len(u) != len(y):
                raise ValueError(
                    f"u and y of {name} must have one length, but have {len(u)} and {len(y)}; cut the longer"
                )
            for part, values in (("u", u), ("y", y)):
                for k in np.flatnonzero(np.abs(values) > MAGNITUDE_BOUNDS[1])[:1]:
                    raise ValueError(
                        f"{part} of {name} must be within ±{MAGNITUDE_BOUNDS[1]:g}, but at sample {k} is {values[k]:g}; leave it "
                        "empty (NaN) where it is missing, or choose another unit"
                    )
            uncut_records.append(record)
            if first := next(
                (earlier.name for earlier in uncut_records[:-1] if _have_same_samples(earlier, record)), None
            ):
                raise ValueError(f"{name} must be a record of its own, but has the samples of {first}; leave one out")
            pieces = split_at_missing_inputs(record)
            if not pieces:
                count = int((np.isfinite(u) & np.isfinite(y)).sum())
                raise ValueError(
                    f"{name} must have {MIN_PIECE_OUTPUTS} outputs or more between missing inputs, but of its {len(u)} samples "
                    f"{count} have both input and output; add samples, or leave it out"
                )
            pieces_of_all += pieces
    steps = [float(np.median(np.diff(one.times))) for one in uncut_records if one.times is not None]
    if len(steps) == len(uncut_records) and all(abs(step / rig.step - 1) > _STEP_TOLERANCE for step in steps):
        raise ValueError(
            f"{uncut_records[0].name}: times are {steps[0]:.6g} s apart, but the step is {rig.step:.6g} s; mend one of them"
        )
    count = sum(int(np.isfinite(one.y).sum()) for one in pieces_of_all)
    if count < _MIN_OUTPUTS:
        raise ValueError(f"records must have at least {_MIN_OUTPUTS} outputs in all, but have {count}; add samples")
    if overlap := find_shared_samples([(one.u, one.y) for one in pieces_of_all]):
        raise ValueError(
            f"{pieces_of_all[overlap.later].name} must have samples of its own, but from its sample {overlap.begin_later} on has "
            f"those of {pieces_of_all[overlap.earlier].name} from sample {overlap.begin_earlier} on; leave them out of one"
        )
    if all(np.ptp(values) == 0 for one in pieces_of_all if len(values := observed_values(one.y))):
        raise ValueError("y must vary, but is constant in all records; excite the system")
    if all(np.ptp(one.u) == 0 for one in pieces_of_all):  # a constant force is one of the offsets
        return [replace(one, u=np.zeros(len(one.u))) for one in pieces_of_all]
    return pieces_of_all


def _is_array_pair(one: Any) -> bool:
    return isinstance(one, tuple) and len(one) in (2, 3) and not any(isinstance(part, str | Path) for part in one)


def _record_from_arrays(name: str, arrays: tuple[Any, ...], step: float) -> Record:
    """A record from arrays: (u, y), or (u, y, times)."""
    u, y = (
        to_finite_series(f"{part} of {name}", values, allow_nan=True)
        for part, values in zip("uy", arrays[:2], strict=True)
    )
    if len(arrays) == 2:
        return Record(name, u, y)
    times = to_finite_series(f"times of {name}", arrays[2])
    if len(times) != len(u):
        raise ValueError(f"times of {name} must be as many as u, {len(u)}, but are {len(times)}; cut the longer")
    for k in np.flatnonzero(np.diff(times) <= 0)[:1]:
        raise ValueError(f"times of {name} must grow, but {times[k + 1]:.9g} s comes after {times[k]:.9g} s; sort them")
    even = np.ptp(times - step * np.arange(len(times))) < 0.01 * step
    return Record(name, u, y, times=None if even else times, step=float(np.median(np.diff(times))))


def _have_same_samples(one: Record, other: Record) -> bool:
    """Whether inputs are the same, and all outputs that both have."""
    if not np.array_equal(one.u, other.u, equal_nan=True):
        return False
    both = np.isfinite(one.y) & np.isfinite(other.y)
    return int(both.sum()) >= MIN_PIECE_OUTPUTS and np.array_equal(one.y[both], other.y[both])
