"""Estimators in one file, without pickle."""

from __future__ import annotations

import io
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from estimator.files import write_atomically
from estimator.models.nlarx import NLARX
from estimator.models.ode import DuffingODE
from estimator.models.regressors import Term
from estimator.online import OnlineEstimator

#: Raised when the content of the files changes.
FORMAT = 1

_MODELS = {"NLARX": NLARX, "DuffingODE": DuffingODE}


def save_estimator(estimator: OnlineEstimator, path: str | Path) -> None:
    """Write an estimator to one file, a NumPy archive, from which it continues bit by bit.

    The free energies and forecasts of its last run are not kept.
    """
    description = {
        "format": FORMAT,
        "model": type(estimator.model).__name__,
        "options": asdict(estimator.model),
        "factorisation": estimator.factorisation,
        "iterations": estimator.iterations,
        "as_published": estimator.as_published,
        "drift": estimator.drift,
        "expectations": estimator.expectations,
        "noise_hypotheses": estimator.noise_hypotheses,
    }
    arrays: dict[str, Any] = {**estimator.arrays(), "description": np.array(json.dumps(description))}
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    write_atomically(Path(path), buffer.getvalue())


def load_estimator(path: str | Path) -> OnlineEstimator:
    """Read an estimator that `save_estimator` wrote.

    Raises:
        ValueError: if the file is not one, or of a format that this version does not know.
        FileNotFoundError: if there is no such file.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        description = json.loads(str(arrays.pop("description")))
    except (ValueError, KeyError, OSError) as error:
        if isinstance(error, FileNotFoundError):
            raise
        raise ValueError(f"path must be a file of save_estimator, but {path} is not one ({error})") from error
    if description.get("format") != FORMAT:
        raise ValueError(f"path must be of format {FORMAT}, but {path} is of {description.get('format')!r}")
    options = description["options"]
    if not isinstance(options.get("regressors", ""), str):
        options["regressors"] = tuple(Term(*term) for term in options["regressors"])
    estimator = OnlineEstimator(
        _MODELS[description["model"]](**options),
        factorisation=description["factorisation"],
        iterations=description["iterations"],
        as_published=description["as_published"],
        drift=description["drift"],
        expectations=description.get("expectations", "first_order"),  # files from before it was an option
        noise_hypotheses=description.get("noise_hypotheses", 1),  # older files do not name it
    )
    estimator.restore(arrays)
    return estimator
