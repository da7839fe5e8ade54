"""Saving and loading estimators, without pickle; a file is checked before its content is used."""

from __future__ import annotations

import io
import json
import zipfile
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from estimator.belief import Belief, record_size
from estimator.models.model import Model
from estimator.online import OnlineEstimator
from estimator.rigs.rig import Rig
from estimator.rigs.units import Scales
from estimator.support.argument_checks import short_repr
from estimator.support.file_io import check_readable_file, to_path, write_atomically

#: Version of the file format.
FILE_FORMAT = 3

#: Upper limit of a file's size, packed and unpacked [bytes].
_MAX_BYTES = 64 * 2**20


def save_estimator(estimator: OnlineEstimator, path: str | Path) -> None:
    """Write an estimator to one file, a NumPy archive, from which it continues bit by bit.

    The free energies and forecasts of the last run are not saved.

    Raises:
        ValueError: for anything but an estimator, or a path that is no file name.
    """
    if not isinstance(estimator, OnlineEstimator):
        raise ValueError(f"estimator must be an OnlineEstimator, but is {short_repr(estimator)}")
    place = to_path("path", path)
    if place.is_dir():
        raise ValueError(f"path must be the name of a file, but {place} is a folder; name a file in it")
    description = {
        "format": FILE_FORMAT,
        "model": estimator.model.to_dict(),
        "rig": estimator.rig.to_dict(),
        "scales": estimator.scales.to_dict(),
        "settings": asdict(estimator.settings),
    }
    text = np.frombuffer(json.dumps(description).encode(), dtype=np.uint8)
    buffer = io.BytesIO()
    np.savez(buffer, **estimator.arrays(), description=text)  # type: ignore[arg-type]
    write_atomically(place, buffer.getvalue())


def load_estimator(path: str | Path) -> OnlineEstimator:
    """Read an estimator from a file of `save_estimator`.

    Raises:
        ValueError: for a file that is damaged, of another kind, or of another format.
        FileNotFoundError: if there is no such file.
    """
    place = check_readable_file(path, "path must be a file of save_estimator, identify --save or a run", _MAX_BYTES)
    try:
        return _estimator_from(_read_arrays(place))
    except Exception as error:  # the readers raise many kinds for a foreign file
        raise ValueError(
            f"path must be a whole file of save_estimator, identify --save or a run, but {place} is not "
            f"({type(error).__name__}: {error}); write it again"
        ) from error


def _read_arrays(path: Path) -> dict[str, Any]:
    """The arrays of an archive."""
    with zipfile.ZipFile(path) as archive:
        size = sum(member.file_size for member in archive.infolist())
    if size > _MAX_BYTES:
        raise ValueError(f"it unpacks to {size} bytes")
    with np.load(path, allow_pickle=False) as arrays:
        return {name: arrays[name] for name in arrays.files}


def _estimator_from(arrays: dict[str, Any]) -> OnlineEstimator:
    """The estimator of the arrays in a file."""
    text = arrays.pop("description")
    if text.dtype != np.uint8 or text.ndim != 1:
        raise ValueError("its description is of another version" if text.ndim == 0 else "its description is no text")
    description = json.loads(text.tobytes())
    if not isinstance(description, dict) or description.get("format") != FILE_FORMAT:
        found = description.get("format") if isinstance(description, dict) else None
        raise ValueError(f"it is of format {found!r}, and this version reads {FILE_FORMAT}")
    model, settings = Model(**description["model"]), description["settings"]
    rig, scales = Rig.from_dict(description["rig"]), Scales(**description["scales"])
    first = arrays.get("first")
    if first is None or first.dtype != np.float64 or first.shape != (record_size(model),):
        raise ValueError("its prior does not fit its model")
    prior = Belief(model, first, scales, factorisation=settings["factorisation"])
    estimator = OnlineEstimator(model, prior, rig, **settings)
    estimator.restore(arrays)
    return estimator
