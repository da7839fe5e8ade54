"""Records from MATLAB files, read in a separate process."""

from __future__ import annotations

import io
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from estimator.identification.data.column_choice import ColumnNames
from estimator.identification.data.record import Record
from estimator.identification.data.record_cleaning import mask_over_range
from estimator.rigs.rig import Rig
from estimator.support.argument_checks import to_finite_series
from estimator.support.optional_dependencies import require_packages

#: Longest time to read a file [s]: a damaged file may never end.
_MAT_TIMEOUT = 300.0

#: Program that reads a MAT file in a separate process, because SciPy's reader crashes at some damaged files.
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


def read_mat_records(path: Path, rig: Rig) -> list[Record]:
    """The records of a MAT file: one, or one for each column of its variables.

    Raises:
        ValueError: naming the file and the fault.
        ModuleNotFoundError: for a file of version 7.3 without h5py.
    """
    names = (rig.only_input.column or "u", rig.output.column or "y")
    with path.open("rb") as file:
        if file.read(10) == b"MATLAB 7.3":
            require_packages("h5py")
    # With -P the program imports no file beside the record, such as a numpy.py.
    command = [sys.executable, "-P", "-W", "ignore", "-c", _MAT_READER, str(path), *names]
    try:
        done = subprocess.run(command, capture_output=True, timeout=_MAT_TIMEOUT)
    except subprocess.TimeoutExpired as error:
        raise ValueError(
            f"{path} must be a MAT file that can be read within {_MAT_TIMEOUT:g} s, but was not; save u and y anew"
        ) from error
    if done.returncode != 0:
        lines = done.stderr.decode(errors="replace").strip().splitlines() or ["the reader crashed"]
        raise ValueError(f"{path} must be a sound MAT file, but is not: {lines[-1]:.200}")
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
    columns = ColumnNames(*names, "request" if rig.only_input.column and rig.output.column else "name")
    u, y = (np.asarray(held[name]) for name in names)
    if u.ndim <= 1 and y.ndim <= 1:
        first, second = (to_finite_series(f"{name} of {path}", held[name], allow_nan=True) for name in names)
        return [replace(mask_over_range(str(path), first, second), columns=columns)]
    n_records = max(one.shape[1] if one.ndim == 2 else 1 for one in (u, y))
    if (
        u.ndim > 2
        or y.ndim > 2
        or len(u) != len(y)
        or any(one.ndim == 2 and one.shape[1] != n_records for one in (u, y))
    ):
        raise ValueError(
            f"{path} must hold {names[0]} and {names[1]} of shapes (T,) or (T, n), for n records, but holds {u.shape} "
            f"and {y.shape}; transpose or cut them"
        )
    found = []
    for k in range(n_records):
        name = f"{path}, column {k + 1}"
        pair = [one if one.ndim == 1 else one[:, k] for one in (u, y)]
        first, second = (
            to_finite_series(f"{n} of {name}", one, allow_nan=True) for n, one in zip(names, pair, strict=True)
        )
        found.append(replace(mask_over_range(name, first, second), columns=columns))
    return found
