"""Runs the official protocol (`agents.studies.silverbox_protocol`), and says what came out."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from agents.cli import progress_bar
from agents.evaluation.figures import save
from agents.results import check_file, finite, show, table, versions, write_json
from agents.studies.silverbox_figures import figures_of
from agents.studies.silverbox_protocol import (
    GIVEN,
    SETTINGS,
    TESTS,
    TRAINING_SAMPLES,
    Outcome,
    Sections,
    cut,
    evaluate,
    samples_until_close,
)
from duffing_env.silverbox import load_record
from estimator.belief import Belief

SUBMITTED = ("ODE linear", "ODE look-ahead +e", "ODE spline +e, 2 passes", "NLARX three-tap")
"""Settings whose submission lines are printed."""

Compare = Callable[[Sections, Mapping[str, Outcome]], dict[str, Any]]
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
        compare: What follows the table; None is nothing.

    Returns:
        What the JSON file holds: under ``rows`` the measures of each setting in volts, seconds and nats, under
        ``targets`` what was aimed at and whether it was reached, under ``comparison`` what ``compare`` returned, and
        ``meta``.

    Raises:
        RecordNotFound: The record is not on this machine; the message says where to get it.
        RecordDamaged: The file found is not the record.
        OSError: A result cannot be written.
    """
    sections = cut(load_record(data))
    check_file("json", json)
    figures.mkdir(parents=True, exist_ok=True)
    outcomes = dict(_evaluate_all(sections))
    results = summarise(outcomes)
    for name, figure in figures_of(outcomes).items():
        save(figure, figures / f"silverbox_{name}.png")
    report(outcomes)
    if compare is not None:
        results["comparison"] = compare(sections, outcomes)
    if json is not None:
        write_json(json, results)
    return results


def _evaluate_all(sections: Sections) -> Iterator[tuple[str, Outcome]]:
    """The outcome of each setting by its name, behind a progress bar on stderr."""
    with progress_bar() as progress:
        task = progress.add_task("", total=len(SETTINGS))
        for name, setting in SETTINGS.items():
            progress.update(task, description=name)
            yield name, evaluate(setting, sections)
            progress.advance(task)


def summarise(outcomes: Mapping[str, Outcome]) -> dict[str, Any]:
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
            "parameters": _parameters(outcome.beliefs[TRAINING_SAMPLES]),
        }
        for name, outcome in outcomes.items()
    }
    meta = {
        "samples": {"training": TRAINING_SAMPLES, "given": GIVEN},
        "versions": versions(),
    }
    return {"rows": finite(rows), "meta": meta}


def _parameters(belief: Belief) -> dict[str, dict[str, Any]]:
    """Mean, standard deviation and unit of each physical parameter, or coefficient where there is none, by name."""
    return {name: dict(zip(("mean", "std", "unit"), row, strict=True)) for name, row in belief.parameters().items()}


def submission(errors: Any, digits: int = 3) -> str:
    """The official line: multisine, arrow, arrow without extrapolation [mV]."""
    return "[" + "; ".join(f"{error:.{digits}f}" for error in errors) + "]"


def report(outcomes: Mapping[str, Outcome]) -> None:
    """Prints the table, and the submission lines."""
    show(
        as_table(outcomes),
        "d = 0: without feedthrough; +e: with cubic damping; n.e.: without extrapolation;",
        "1-step and coverage: of the multisine test",
        "\nSubmission, RMSE in mV [multisine; arrow; arrow without extrapolation]:",
        *(f"  {name:24} {submission([1e3 * outcomes[name].rmse[test] for test in TESTS])}" for name in SUBMITTED),
    )


def as_table(outcomes: Mapping[str, Outcome]) -> Any:
    """A row for each setting, in 100 characters."""
    columns = ("multisine\n[mV]", "arrow\n[mV]", "n.e.\n[mV]", "1-step\n[mV]", "90 %\ncovers", "<1 mV\nafter")
    return table(
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
