"""Records from text tables and MAT files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from estimator.identification.data.mat_files import read_mat_records
from estimator.identification.data.record import Record
from estimator.identification.data.record_cleaning import mask_over_range
from estimator.identification.data.text_tables import read_table
from estimator.rigs.rig import Rig
from estimator.support.file_io import check_readable_file

#: Largest file of a record [bytes].
_MAX_FILE_BYTES = 2**30


def read_record_file(path: str | Path, rig: Rig) -> list[Record]:
    """The whole records of a text or MAT file, with NaN for missing values.

    `estimator.identification.data.text_tables.read_table` describes the text file; where its times are not the rig's
    step apart, the record has them. A MAT file, also of version 7.3, holds the variables ``u`` and ``y``, or those that
    the rig names as columns: (T,), or (T, n) for n records.

    Args:
        path: the file.
        rig: the rig, with names of columns, units and sampling step.

    Raises:
        ValueError: naming the file, the line and the fault.
        FileNotFoundError: for a file that does not exist.
        ModuleNotFoundError: for a MAT file of version 7.3 without h5py.
    """
    file = check_readable_file(path, "record must be a text or MAT file, such as CSV", _MAX_FILE_BYTES)
    return read_mat_records(file, rig) if file.suffix.lower() == ".mat" else [_read_text(file, rig)]


def _read_text(path: Path, rig: Rig) -> Record:
    table = read_table(path, rig.only_input.column, rig.output.column)
    record = mask_over_range(
        str(path), *table.signals_in_rig_units(rig.only_input, rig.output), table.times(rig.step), rig.step
    )
    return replace(record, step=table.step(), columns=table.column_names())
