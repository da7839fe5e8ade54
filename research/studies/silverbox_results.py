"""Runs the official protocol (`research.studies.silverbox_protocol`), and reports the results.

`compare_on_validation` compares settings of the estimators without test data.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from agents.console_output import format_table, print_texts_and_tables
from agents.evaluation.figures import save_png
from agents.output_paths import check_output_file
from agents.result_files import package_versions, replace_non_finite, write_json
from duffing_env.plants.silverbox_record import Regime, load_record
from estimator import recorded_prior
from estimator.support.progress import iterate_with_progress
from research.studies.silverbox_figures import protocol_figures
from research.studies.silverbox_protocol import (
    N_GIVEN_OUTPUTS,
    SETTINGS,
    TESTS,
    TRAINING_SAMPLES,
    IdentificationSetting,
    ProtocolOutcome,
    Sections,
    coverage,
    evaluate,
    identify,
    rmse,
    samples_until_close,
    simulation_error,
    split_record,
)

SUBMITTED_SETTINGS = ("ODE linear", "ODE look-ahead +e", "ODE spline +e, 2 passes", "NLARX three-tap")
"""Settings whose submission lines are printed."""

VALIDATION_SAMPLES = TRAINING_SAMPLES // 4
"""At the end of the training section; the samples before identify."""

PROCESS_NOISES = (1e-6, 2e-5, 1e-4)
SUBSTEPS = (2, 4)
"""What is tried instead of the defaults, one at a time."""

Compare = Callable[[Sections, Mapping[str, ProtocolOutcome]], dict[str, Any]]
"""Compares the outcomes with something else in the same run, prints that, and returns it, fit for JSON."""


def run_protocol(
    data: Path | None = None,
    json: Path | None = None,
    figures: Path = Path("runs/silverbox"),
    compare: Compare | None = None,
) -> dict[str, Any]:
    """Evaluates all `SETTINGS`: progress on stderr, table and submission lines on stdout, figures and JSON in files.

    Args:
        data: File or folder of the record; searched for where it is None (`load_record`).
        json: File for the results; None writes none.
        figures: Folder for ``silverbox_arrow.png``, ``silverbox_learning.png`` and ``silverbox_parameters.png``.
        compare: Called after the table; None for nothing.

    Returns:
        What the JSON file holds: under ``rows`` the measures of each setting in volts, seconds and nats, under
        ``comparison`` what ``compare`` returned, and ``meta``.

    Raises:
        RecordNotFound, RecordDamaged: As `load_record`.
        OSError: A result cannot be written.
    """
    sections = split_record(load_record(data))
    check_output_file("json", json)
    figures.mkdir(parents=True, exist_ok=True)
    outcomes = {
        name: evaluate(SETTINGS[name], sections) for name in iterate_with_progress((name, name) for name in SETTINGS)
    }
    results = summarise(outcomes)
    for name, figure in protocol_figures(outcomes).items():
        save_png(figure, figures / f"silverbox_{name}.png")
    if json is not None:
        write_json(json, results)
    report(outcomes)
    if compare is not None:
        results["comparison"] = compare(sections, outcomes)
        if json is not None:
            write_json(json, results)
    return results


def summarise(outcomes: Mapping[str, ProtocolOutcome]) -> dict[str, Any]:
    """The results as `run_protocol` returns them: plain dictionaries, for JSON."""
    rows = {
        name: {
            "model": SETTINGS[name].model.name,
            "coefficients": list(SETTINGS[name].model.coefficients),
            "interpolation": SETTINGS[name].rig.interpolation,
            "delay": SETTINGS[name].rig.delay,
            "passes": SETTINGS[name].passes,
            "rmse": outcome.rmse,
            "prediction_rmse": outcome.prediction_rmse,
            "coverage": outcome.coverage,
            "seconds_per_sample": outcome.seconds,
            "samples_until_1_mV": samples_until_close(outcome.learning),
            "free_energy": outcome.free_energy,
            "arrow_rmse_after": {str(samples): error for samples, error in outcome.learning.items()},
            "parameters": {
                parameter: dict(zip(("mean", "std", "unit"), told, strict=True))
                for parameter, told in outcome.beliefs[TRAINING_SAMPLES].parameters().items()
            },
        }
        for name, outcome in outcomes.items()
    }
    meta = {"samples": {"training": TRAINING_SAMPLES, "given": N_GIVEN_OUTPUTS}, "versions": package_versions()}
    return {"rows": replace_non_finite(rows), "meta": meta}


def submission_line(errors: Any) -> str:
    """The official line: multisine, arrow, arrow without extrapolation [mV]."""
    return "[" + "; ".join(f"{error:.3f}" for error in errors) + "]"


def report(outcomes: Mapping[str, ProtocolOutcome]) -> None:
    """Prints the table, and the submission lines."""
    print_texts_and_tables(
        as_table(outcomes),
        "d = 0: without feedthrough; +e: with cubic damping; n.e.: without extrapolation;",
        "1-step and coverage: of the multisine test",
        "\nSubmission, RMSE in mV [multisine; arrow; arrow without extrapolation]:",
        *(
            f"  {name:24} {submission_line([1e3 * outcomes[name].rmse[test] for test in TESTS])}"
            for name in SUBMITTED_SETTINGS
        ),
    )


def as_table(outcomes: Mapping[str, ProtocolOutcome]) -> Any:
    """A row for each setting."""
    columns = ("multisine\n[mV]", "arrow\n[mV]", "n.e.\n[mV]", "1-step\n[mV]", "90 %\ncovers", "<1 mV\nafter")
    return format_table(
        ("", *columns, "µs per\nsample", "free energy\n[nats]"),
        (
            (
                name,
                *(f"{1e3 * outcome.rmse[test]:.3f}" for test in TESTS),
                f"{1e3 * outcome.prediction_rmse:.3f}",
                "-" if np.isnan(outcome.coverage) else f"{outcome.coverage:.3f}",
                str(samples_until_close(outcome.learning) or "never"),
                f"{1e6 * outcome.seconds:.2f}",
                f"{outcome.free_energy:.0f}",
            )
            for name, outcome in outcomes.items()
        ),
    )


def compare_on_validation(data: Path | None = None) -> dict[str, dict[str, tuple[float, float]]]:
    """Prints the results of settings other than the defaults on the last quarter of the training section.

    Args:
        data: File or folder of the record; searched for where it is None (`load_record`).

    Returns:
        By model, and by setting: simulation error [V], and coverage of the 90 % intervals of forecasts.

    Raises:
        RecordNotFound, RecordDamaged: As `load_record`.
    """
    training = split_record(load_record(data)).training
    split = TRAINING_SAMPLES - VALIDATION_SAMPLES
    first = Regime("first", training.u[:split], training.y[:split])
    last = Regime("last", training.u[split:], training.y[split:])
    scores: dict[str, dict[str, tuple[float, float]]] = {}
    settings = {
        name: setting
        for name, setting in SETTINGS.items()
        if "feedthrough" in setting.model.coefficients and setting.passes == 1
    }
    for name, setting in iterate_with_progress((name, (name, setting)) for name, setting in settings.items()):
        scores[name] = {}
        for label, candidate in _candidates(setting):
            estimator, _, _ = identify(candidate, first, split)
            scores[name][label] = rmse(simulation_error(estimator, last)), coverage(estimator, first, last)
    rows = (
        (name, *(f"{1e3 * error:.4f}\n{covers:.3f}" for error, covers in row.values())) for name, row in scores.items()
    )
    print_texts_and_tables(format_table(("simulation [mV]\n90 % covers", *next(iter(scores.values()))), rows))
    return scores


def _candidates(setting: IdentificationSetting) -> Iterator[tuple[str, IdentificationSetting]]:
    """The setting with its default prior, and with one thing changed at a time."""
    yield "default", setting
    for noise in PROCESS_NOISES:
        yield f"{1e6 * noise:g} µV", replace(setting, prior=recorded_prior(setting.model, process_noise=noise))
    for substeps in SUBSTEPS:
        yield f"{substeps} steps", replace(setting, model=replace(setting.model, substeps=substeps))
