"""Records as a user has them: arrays, or CSV and MAT files; with gaps, and clipped samples that are found."""

from __future__ import annotations

import io
import subprocess
import sys
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from estimator.identification.data.duplicate_samples import find_shared_samples
from estimator.identification.data.sensor_faults import find_stale_outputs
from estimator.identification.data.text_tables import MIN_REGULAR_FRACTION, REGULAR_STEP_TOLERANCE, read_table
from estimator.rigs.rig import Rig
from estimator.rigs.units import MAGNITUDE_BOUNDS
from estimator.support.argument_checks import to_finite_series
from estimator.support.array_types import FloatArray
from estimator.support.file_io import check_readable_file
from estimator.support.optional_dependencies import require_packages

#: No file of a record is larger [bytes].
_MAX_FILE_BYTES = 2**30

#: A file of that size is read in less [s]; a damaged one might be read for ever.
_MAT_TIMEOUT = 300.0

#: An end of the range counts as a stop after this many visits of the output.
_MIN_CLIPPING_VISITS = 3

#: Samples at a stop, per sample at the next level, at least.
_MIN_CLIPPING_RATIO = 4

#: Outputs in all records, at least: fewer identify nothing.
_MIN_OUTPUTS = 50

#: Outputs in a piece of a record, at least.
_MIN_PIECE_OUTPUTS = 8


#: Reads a MAT file in a process of its own: SciPy's reader is ended by a segmentation fault at some damaged ones.
_MAT_READER = """
import io, sys
import numpy
path, *names = sys.argv[1:]
with open(path, "rb") as file:
    is_hdf5 = file.read(10) == b"MATLAB 7.3"
if is_hdf5:
    import h5py
    with h5py.File(path, "r") as file:
        held = {name: numpy.squeeze(numpy.asarray(file[name]).T) for name in names if name in file}
else:
    import scipy.io
    held = scipy.io.loadmat(path, squeeze_me=True, variable_names=names)
buffer = io.BytesIO()
numpy.savez(buffer, **{name: held[name] for name in names if name in held})
sys.stdout.buffer.write(buffer.getvalue())
"""

#: Some record has the rig's sampling step to this part of it.
_STEP_TOLERANCE = 0.02


@dataclass(frozen=True, eq=False)
class Record:
    """One record.

    Attributes:
        name: of its file, or its number; of a later piece with the sample where it begins.
        u: (T,) inputs.
        y: (T,) outputs; NaN where one is missing or was clipped.
        n_clipped: outputs that were clipped, or over range.
        n_missing: outputs that were not there.
        n_stale: outputs that stood still while the oscillator moved, in bursts or because each was repeated, and were
            taken out.
        n_bursts: of these.
        samples_per_value: samples for which each output stood; 1 where none was repeated.
        times: (T,) of the samples [s], where these are not the rig's step apart.
        step: between most samples [s], as its own times say; None where it has none.
        is_over_range: (T,) whether an output was over range, in a record that is whole.
    """

    name: str
    u: FloatArray
    y: FloatArray
    n_clipped: int = 0
    n_missing: int = 0
    n_stale: int = 0
    n_bursts: int = 0
    samples_per_value: int = 1
    times: FloatArray | None = None
    step: float | None = None
    is_over_range: npt.NDArray[np.bool_] | None = field(default=None, repr=False)

    def times_in_steps(self, step: float) -> FloatArray:
        """(T,) times in sampling steps, from the first sample on."""
        if self.times is None:
            return np.arange(len(self.u), dtype=np.float64)
        return np.asarray((self.times - self.times[0]) / step)


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
            pieces = _split_at_missing_inputs(record)
            if not pieces:
                count = int((np.isfinite(u) & np.isfinite(y)).sum())
                raise ValueError(
                    f"{name} must have {_MIN_PIECE_OUTPUTS} outputs or more between missing inputs, but of its {len(u)} samples "
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
    if all(np.ptp(values) == 0 for one in pieces_of_all if len(values := _observed(one.y))):
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
    return int(both.sum()) >= _MIN_PIECE_OUTPUTS and np.array_equal(one.y[both], other.y[both])


def _observed(values: FloatArray) -> FloatArray:
    return values[np.isfinite(values)]


def _split_at_missing_inputs(record: Record) -> list[Record]:
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
        if len(seen) < _MIN_PIECE_OUTPUTS:
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
    levels = np.sort(_observed(y))
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


def read_record_file(path: str | Path, rig: Rig) -> list[Record]:
    """The records of a text or MAT file, whole: gaps are NaN, and so is what is over the range of the instrument.

    A text file is as `estimator.identification.data.text_tables.read_table` says; where its times are not the rig's step apart,
    the record has them. A MAT file, of version 7.3 too, holds the variables ``u`` and ``y``, or those that the rig
    names as columns: (T,), or (T, n) for n records.

    Raises:
        ValueError: naming the file, the line and what is wrong.
        FileNotFoundError: if there is no such file.
        ModuleNotFoundError: for a MAT file of version 7.3 without h5py.
    """
    file = check_readable_file(path, "record must be a text or MAT file, such as CSV", _MAX_FILE_BYTES)
    return _read_mat(file, rig) if file.suffix.lower() == ".mat" else [_read_text(file, rig)]


def _read_mat(path: Path, rig: Rig) -> list[Record]:
    names = (rig.input.column or "u", rig.output.column or "y")
    with path.open("rb") as file:
        if file.read(10) == b"MATLAB 7.3":
            require_packages("h5py")
    # With -P no file beside the record, such as a numpy.py, is taken for a module.
    command = [sys.executable, "-P", "-W", "ignore", "-c", _MAT_READER, str(path), *names]
    try:
        done = subprocess.run(command, capture_output=True, timeout=_MAT_TIMEOUT)
    except subprocess.TimeoutExpired as error:
        raise ValueError(
            f"{path} must be a MAT file that can be read within {_MAT_TIMEOUT:g} s, but was not; save u and y anew"
        ) from error
    if done.returncode != 0:
        told = done.stderr.decode(errors="replace").strip().splitlines() or ["the reader died of it"]
        raise ValueError(f"{path} must be a sound MAT file, but is not: {told[-1]:.200}")
    try:
        with np.load(io.BytesIO(done.stdout), allow_pickle=False) as arrays:
            held = {name: arrays[name] for name in arrays.files}
    except ValueError as error:
        raise ValueError(f"{path} must hold u and y as plain numbers, but does not: {error}") from error
    lacking = set(names) - set(held)
    if lacking:
        raise ValueError(
            f"{path} must hold the variables {names[0]} and {names[1]}, but lacks {' and '.join(sorted(lacking))}; "
            f"mend the names, there or as column = '...' in the rig's [input] and [output]"
        )
    u, y = (np.asarray(held[name]) for name in names)
    if u.ndim <= 1 and y.ndim <= 1:
        first, second = (to_finite_series(f"{name} of {path}", held[name], allow_nan=True) for name in names)
        return [_mask_over_range(str(path), first, second)]
    columns = max(one.shape[1] if one.ndim == 2 else 1 for one in (u, y))
    if u.ndim > 2 or y.ndim > 2 or len(u) != len(y) or any(one.ndim == 2 and one.shape[1] != columns for one in (u, y)):
        raise ValueError(
            f"{path} must hold {names[0]} and {names[1]} of shapes (T,) or (T, n), for n records, but holds {u.shape} "
            f"and {y.shape}; transpose or cut them"
        )
    found = []
    for k in range(columns):
        name = f"{path}, column {k + 1}"
        pair = [one if one.ndim == 1 else one[:, k] for one in (u, y)]
        first, second = (
            to_finite_series(f"{n} of {name}", one, allow_nan=True) for n, one in zip(names, pair, strict=True)
        )
        found.append(_mask_over_range(name, first, second))
    return found


def _read_text(path: Path, rig: Rig) -> Record:
    table = read_table(path, rig.input.column, rig.output.column)
    record = _mask_over_range(
        str(path), *table.signals_in_rig_units(rig.input, rig.output), table.times(rig.step), rig.step
    )
    return replace(record, step=table.step())


def _mask_over_range(
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


def standardised_innovations(y: FloatArray, forecast: FloatArray) -> FloatArray:
    """(n,) standardised innovations of the outputs that were seen."""
    with np.errstate(invalid="ignore"):
        values = (y - forecast[:, 0]) / np.sqrt(forecast[:, 1])
    return values[np.isfinite(values)]
