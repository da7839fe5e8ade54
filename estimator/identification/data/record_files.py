"""Records from CSV and MAT files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from estimator.identification.data.mat_files import read_mat_records
from estimator.identification.data.record import Record
from estimator.identification.data.record_cleaning import mask_over_range
from estimator.identification.data.text_tables import read_table
from estimator.rigs.rig import Rig
from estimator.support.file_io import check_readable_file

#: No file of a record is larger [bytes].
_MAX_FILE_BYTES = 2**30


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
    return read_mat_records(file, rig) if file.suffix.lower() == ".mat" else [_read_text(file, rig)]


def _read_text(path: Path, rig: Rig) -> Record:
    table = read_table(path, rig.input.column, rig.output.column)
    record = mask_over_range(
        str(path), *table.signals_in_rig_units(rig.input, rig.output), table.times(rig.step), rig.step
    )
    return replace(record, step=table.step())
