"""Settings of the estimators for the Silverbox protocol, compared without test data."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from agents.cli import progress_bar
from agents.results import show, table
from agents.studies.silverbox_protocol import (
    SETTINGS,
    TRAINING_SAMPLES,
    Setting,
    coverage,
    cut,
    identify,
    rmse,
    simulation_error,
)
from duffing_env.silverbox import Regime, load_record
from estimator import recorded_prior

VALIDATION_SAMPLES = TRAINING_SAMPLES // 4
"""At the end of the training section; the samples before identify."""

PROCESS_NOISES = (1e-6, 2e-5, 1e-4)
SUBSTEPS = (2, 4)
"""What is tried instead of the defaults, one at a time."""


def select(data: Path | None = None) -> dict[str, dict[str, tuple[float, float]]]:
    """Prints what other settings than the defaults give on the last quarter of the training section.

    Args:
        data: File or folder of the record; searched for where it is None (`load_record`).

    Returns:
        By model, and by setting: simulation error [V], and coverage of the 90 % intervals of forecasts.

    Raises:
        RecordNotFound: The record is not on this machine; the message says where to get it.
        RecordDamaged: The file found is not the record.
    """
    training = cut(load_record(data)).training
    split = TRAINING_SAMPLES - VALIDATION_SAMPLES
    first = Regime("first", training.u[:split], training.y[:split])
    last = Regime("last", training.u[split:], training.y[split:])
    scores: dict[str, dict[str, tuple[float, float]]] = {}
    settings = {
        name: setting
        for name, setting in SETTINGS.items()
        if "feedthrough" in setting.model.coefficients and setting.passes == 1
    }
    with progress_bar() as progress:
        task = progress.add_task("", total=len(settings))
        for name, setting in settings.items():
            progress.update(task, description=name)
            scores[name] = {}
            for label, candidate in _candidates(setting):
                estimator, _, _ = identify(candidate, first, split)
                scores[name][label] = rmse(simulation_error(estimator, last)), coverage(estimator, first, last)
            progress.advance(task)
    rows = (
        (name, *(f"{1e3 * error:.4f}\n{covers:.3f}" for error, covers in row.values())) for name, row in scores.items()
    )
    show(table(("simulation [mV]\n90 % covers", *next(iter(scores.values()))), rows))
    return scores


def _candidates(setting: Setting) -> Iterator[tuple[str, Setting]]:
    """The setting with its default prior, and with one thing changed at a time."""
    yield "default", setting
    for noise in PROCESS_NOISES:
        yield f"{1e6 * noise:g} µV", replace(setting, prior=recorded_prior(setting.model, process_noise=noise))
    for substeps in SUBSTEPS:
        yield f"{substeps} steps", replace(setting, model=replace(setting.model, substeps=substeps))
