"""Records from arrays, CSV files or MAT files, checked, cleaned and cut at missing inputs: `read_records`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from estimator.identification.data.duplicate_samples import find_shared_samples
from estimator.identification.data.record import Record
from estimator.identification.data.record_cleaning import MIN_PIECE_OUTPUTS, split_at_missing_inputs
from estimator.identification.data.record_files import read_record_file
from estimator.rigs.rig import Rig
from estimator.rigs.units import MAGNITUDE_BOUNDS
from estimator.support.argument_checks import to_finite_series

#: Outputs in all records, at least: fewer identify nothing.
_MIN_OUTPUTS = 50

#: Relative difference of the sampling step that one record at least must keep to.
_STEP_TOLERANCE = 0.02


def read_records(source: Any, rig: Rig) -> list[Record]:
    """Records from a pair (u, y), a file name, or a list of these.

    A record is cut where an input is missing; clipped outputs count as missing. Pieces of fewer than 8 outputs are
    dropped, but no whole record is. Where no input varies, the records are free decays, with inputs of 0.

    No record may be given twice, also not with other outputs missing, and no two records or pieces may share samples
    (`estimator.identification.data.duplicate_samples.find_shared_samples`): shared samples would count twice.

    Args:
        source: the records; a pair of arrays may have the times of its samples [s] as a third, which may be uneven.
        rig: the rig, whose sampling step the times of a file must have, and whose units and kind of output the names of
            its columns.

    Raises:
        ValueError: naming the record, in a file the line, and the fault.
        FileNotFoundError: for a file that does not exist.
    """
    if isinstance(source, str | Path) or _is_array_pair(source):
        source = [source]
    if isinstance(source, Mapping) or not isinstance(source, Iterable):
        raise ValueError(f"records must be a list of pairs (u, y) or file names, but are {source!r:.60}; pass [(u, y)]")
    sources = list(source)
    if not sources:
        raise ValueError("records must hold at least one pair (u, y) or file name, but are empty")
    whole_records, pieces = list[Record](), list[Record]()
    for number, one in enumerate(sources):
        for record in _records_from_source(f"record {number}", one, rig):
            _check_signals(record)
            _check_is_new(record, whole_records)
            whole_records.append(record)
            pieces += _pieces(record)
    _check_steps(whole_records, rig.step)
    count = sum(int(np.isfinite(one.y).sum()) for one in pieces)
    if count < _MIN_OUTPUTS:
        raise ValueError(_too_few_outputs_message(whole_records, pieces, count, rig))
    _check_overlap(pieces)
    if all(np.ptp(observed) == 0 for one in pieces if len(observed := one.y[np.isfinite(one.y)])):
        raise ValueError("y must vary, but is constant in all records; excite the system")
    if all(np.ptp(one.u) == 0 for one in pieces):  # a constant force is one of the offsets
        return [replace(one, u=np.zeros(len(one.u))) for one in pieces]
    return pieces


def _records_from_source(name: str, source: Any, rig: Rig) -> list[Record]:
    """The records of a file, or the record of a pair of arrays, whole."""
    if isinstance(source, str | Path):
        return read_record_file(source, rig)
    if _is_array_pair(source):
        return [_record_from_arrays(name, source, rig.step)]
    raise ValueError(f"{name} must be a pair (u, y) or a file name, but is {source!r:.60}; pass (u, y) as one tuple")


def _check_signals(record: Record) -> None:
    """Refuse inputs and outputs of different lengths or of a magnitude beyond all units."""
    name, u, y = record.name, record.u, record.y
    if len(u) != len(y):
        raise ValueError(f"u and y of {name} must have one length, but have {len(u)} and {len(y)}; cut the longer")
    limit = MAGNITUDE_BOUNDS[1]
    for part, values in (("u", u), ("y", y)):
        for k in np.flatnonzero(np.abs(values) > limit)[:1]:
            raise ValueError(
                f"{part} of {name} must be within ±{limit:g}, but at sample {k} is {values[k]:g}; leave it empty (NaN) "
                f"where it is missing, or choose another unit"
            )


def _check_is_new(record: Record, earlier_records: Sequence[Record]) -> None:
    """Refuse a record that was given before."""
    for earlier in earlier_records:
        if _have_same_samples(earlier, record):
            raise ValueError(
                f"{record.name} must be a record of its own, but has the samples of {earlier.name}; leave one out"
            )


def _pieces(record: Record) -> list[Record]:
    """The pieces of a record between missing inputs, at least one."""
    pieces = split_at_missing_inputs(record)
    if not pieces:
        count = int((np.isfinite(record.u) & np.isfinite(record.y)).sum())
        raise ValueError(
            f"{record.name} must have {MIN_PIECE_OUTPUTS} outputs or more between missing inputs, but of its "
            f"{len(record.u)} samples {count} have both input and output; add samples, or leave it out"
        )
    return pieces


def _check_steps(records: Sequence[Record], step: float) -> None:
    """Refuse records whose times all contradict the sampling step of the rig."""
    steps = [float(np.median(np.diff(one.times))) for one in records if one.times is not None]
    if len(steps) == len(records) and all(abs(one / step - 1) > _STEP_TOLERANCE for one in steps):
        raise ValueError(
            f"{records[0].name}: times are {steps[0]:.6g} s apart, but the step is {step:.6g} s; mend one of them"
        )


def _too_few_outputs_message(records: Sequence[Record], pieces: Sequence[Record], count: int, rig: Rig) -> str:
    """What is missing in records with too few outputs, and why: repeated values are typical of an input."""
    message = f"records must have at least {_MIN_OUTPUTS} outputs in all, but have {count}"
    facts = ("are empty", "n_missing"), ("are clipped", "n_clipped"), ("repeat the output before", "n_stale")
    causes = [f"{n} {verb}" for verb, field in facts if (n := sum(getattr(one, field) for one in pieces))]
    sentences = list(dict.fromkeys(one.columns.sentence(rig.output.kind) for one in records if one.columns))
    if not causes:
        return f"{message}; add samples"
    total = sum(len(one.y) for one in records)
    question = f", or name the columns if these are wrong: {sentences[0]}" if sentences else ""
    return f"{message}: of {total} outputs {', '.join(causes)} and count as missing; add samples{question}"


def _check_overlap(pieces: Sequence[Record]) -> None:
    """Refuse pieces that share samples."""
    if overlap := find_shared_samples([(one.u, one.y) for one in pieces]):
        later, earlier = pieces[overlap.later].name, pieces[overlap.earlier].name
        raise ValueError(
            f"{later} must have samples of its own, but its samples from {overlap.begin_later} on are samples "
            f"of {earlier} from sample {overlap.begin_earlier} on; leave them out of one"
        )


def _is_array_pair(one: Any) -> bool:
    """Whether it is (u, y) or (u, y, times)."""
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
        raise ValueError(
            f"times of {name} must increase, but {times[k + 1]:.9g} s comes after {times[k]:.9g} s; sort them"
        )
    even = np.ptp(times - step * np.arange(len(times))) < 0.01 * step
    return Record(name, u, y, times=None if even else times, step=float(np.median(np.diff(times))))


def _have_same_samples(one: Record, other: Record) -> bool:
    """Whether two records have the same inputs, and the same outputs where both have one."""
    if not np.array_equal(one.u, other.u, equal_nan=True):
        return False
    both = np.isfinite(one.y) & np.isfinite(other.y)
    return int(both.sum()) >= MIN_PIECE_OUTPUTS and np.array_equal(one.y[both], other.y[both])
