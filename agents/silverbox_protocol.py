"""The official protocol of the Silverbox benchmark, for every estimator of this project.

As `nonlinear_benchmarks` defines it: a model is identified on the first 75 % of the multisine section. From the inputs
and the first 50 outputs of three test signals (the rest of the multisine; the arrow; the arrow without the part whose
amplitude exceeds the training's) it simulates the other outputs, and the root mean square of the errors counts. Nothing
may be decided on test data: `agents.silverbox_selection` chooses settings on the last quarter of the training section.

``docs/silverbox.md`` discusses the outcome.
"""

from __future__ import annotations

import json as json_format
import platform
from collections.abc import Iterator, Mapping
from copy import deepcopy
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

from agents.silverbox_figures import draw
from duffing_env.silverbox import Regime, SilverboxRecord, load_record
from estimator import NLARX, Belief, DuffingODE, JointBelief, OnlineEstimator, Prior
from estimator.files import write_atomically
from estimator.parameters import FloatArray

MULTISINE = slice(40_650, 127_400)
TRAINING_SAMPLES = 65_062
ARROW = slice(100, 40_575)
WITHOUT_EXTRAPOLATION = 32_000

GIVEN = 50
"""First outputs of a test signal that a simulation may use, and whose errors do not count."""

TESTS = ("multisine", "arrow", "no_extrapolation")
"""In the order of the submission line."""

LENGTHS = (50, 100, 200, 300, 500, 1_000, 2_000, 5_000, 20_000, TRAINING_SAMPLES)
"""Training samples after which the learning curve has a point."""

CLOSE = 1e-3
"""Simulation error on the arrow [V] that the learning curve is timed by."""

NINETY = 1.6448536269514722
"""Half width of a central 90 % interval in standard deviations."""

TIMINGS = 3
VERSIONED = ("duffing-env", "numba", "numpy", "scipy")


@dataclass(frozen=True)
class Setting:
    """A way to identify.

    Attributes:
        model: what is identified.
        prior: None is the model's default.
        factorisation: ``structured`` or ``mean_field``.
        as_published: with the published run's two departures from the derived messages.
        passes: how often the training section is gone through; more than once is no longer online.
    """

    model: NLARX | DuffingODE
    prior: Prior | JointBelief | None = None
    factorisation: str = "structured"
    as_published: bool = False
    passes: int = 1

    def estimator(self) -> OnlineEstimator:
        """An estimator that has seen nothing yet."""
        return OnlineEstimator(self.model, self.prior, self.factorisation, as_published=self.as_published)


def _without_feedthrough(model: DuffingODE) -> Setting:
    prior = model.prior()
    place = prior.names.index("feedthrough") - len(prior.names)
    cov = prior.cov.copy()
    cov[place, :] = cov[:, place] = 0.0  # known to be 0
    return Setting(model, replace(prior, cov=cov))


SETTINGS = {
    "paper as published": Setting(NLARX(input_delay=0), Prior.published_run(), "mean_field", as_published=True),
    "paper, delay 1": Setting(NLARX(), Prior.published_run(), "mean_field"),
    "paper structured": Setting(NLARX(), Prior.silverbox_twin(state_std=0.1)),  # the section begins in motion
    "NLARX offset": Setting(NLARX(regressors="offset")),
    "NLARX three-tap": Setting(NLARX(regressors="three-tap")),
    "NLARX cubic": Setting(NLARX(regressors="cubic")),
    "ODE linear, d = 0": _without_feedthrough(DuffingODE()),
    "ODE linear": Setting(DuffingODE()),
    "ODE linear +e": Setting(DuffingODE(cubic_damping=True)),
    "ODE look-ahead": Setting(DuffingODE("look_ahead")),
    "ODE look-ahead +e": Setting(DuffingODE("look_ahead", cubic_damping=True)),
    "ODE spline, d = 0": _without_feedthrough(DuffingODE("spline")),
    "ODE spline": Setting(DuffingODE("spline")),
    "ODE spline +e": Setting(DuffingODE("spline", cubic_damping=True)),
    "ODE spline, 2 passes": Setting(DuffingODE("spline"), passes=2),
    "ODE spline +e, 2 passes": Setting(DuffingODE("spline", cubic_damping=True), passes=2),
}

TARGETS = {
    "ODE linear": (0.36, 0.45, 0.36),
    "ODE look-ahead": (0.33, 0.40, 0.33),
    "ODE spline +e, 2 passes": (0.25, 0.39, 0.26),
    "NLARX three-tap": (0.45, 0.65, 0.46),
}
"""Simulation errors that were aimed at [mV], in the order of `TESTS`."""
MAX_SAMPLES_UNTIL_CLOSE = 500
COVERAGE_RANGE = (0.87, 0.93)
MAX_SECONDS = {"ODE": 5e-6, "paper structured": 2e-6}
"""Of training for each sample, by the beginnings of the settings' names."""
RANKED = ("paper structured", "NLARX offset", "NLARX three-tap", "ODE linear")
"""Accumulated free energy is to rank these as their simulation errors do."""


@dataclass(frozen=True)
class Sections:
    """The record as the protocol cuts it."""

    training: Regime
    multisine: Regime
    arrow: Regime
    no_extrapolation: Regime


@dataclass(frozen=True, eq=False)
class Outcome:
    """What one setting came to.

    Attributes:
        rmse: root mean square simulation error by test [V].
        prediction_rmse: that of one-step predictions of the multisine test, at the posterior means [V].
        coverage: fraction of the multisine test within the 90 % intervals of their forecasts, while the estimator goes
            on learning; NaN in mean field, which makes none.
        seconds: of training for each sample and pass, compiled.
        free_energy: accumulated over the first pass [nats].
        learning: simulation error on the arrow [V] after each number of training samples.
        beliefs: posterior after each number of training samples.
        arrow_error: (T,) simulated minus measured arrow [V].
    """

    rmse: dict[str, float]
    prediction_rmse: float
    coverage: float
    seconds: float
    free_energy: float
    learning: dict[int, float]
    beliefs: dict[int, Belief | JointBelief]
    arrow_error: FloatArray

    @property
    def samples_until_close(self) -> int | None:
        """The first of `LENGTHS` from which on the arrow error is below `CLOSE`; None if the last is above."""
        far = [samples for samples, error in self.learning.items() if not error < CLOSE]
        close = [samples for samples in self.learning if not far or samples > far[-1]]
        return close[0] if close else None


def run_protocol(
    data: Path | None = None, json: Path | None = None, figures: Path = Path("runs/silverbox")
) -> dict[str, Any]:
    """Evaluates all `SETTINGS`: progress on stderr, table and submission lines on stdout, figures and JSON in files.

    Args:
        data: File or folder of the record; searched for where it is None (`load_record`).
        json: File for the results; None writes none.
        figures: Folder for ``silverbox_arrow.png``, ``silverbox_learning.png`` and ``silverbox_parameters.png``.

    Returns:
        What the JSON file holds: under ``rows`` the measures of each setting in volts, seconds and nats, under
        ``targets`` what was aimed at and whether it was reached, and ``meta``.

    Raises:
        RecordNotFound: The record is not on this machine; the message says where to get it.
        RecordDamaged: The file found is not the record.
        OSError: A result cannot be written.
    """
    sections = cut(load_record(data))
    if json is not None and json.is_dir():
        raise IsADirectoryError(f"json must be a file, but is the folder {json}; name a file in it")
    figures.mkdir(parents=True, exist_ok=True)
    outcomes = dict(_evaluate_all(sections))
    results = summarise(outcomes)
    if json is not None:
        write_atomically(json, json_format.dumps(results, indent=2, allow_nan=False) + "\n")
    for name, png in draw(outcomes, WITHOUT_EXTRAPOLATION).items():
        write_atomically(figures / f"silverbox_{name}.png", png)
    report(outcomes, results)
    return results


def _evaluate_all(sections: Sections) -> Iterator[tuple[str, Outcome]]:
    """The outcome of each setting by its name, behind a progress bar on stderr."""
    with progress_bar() as progress:
        task = progress.add_task("", total=len(SETTINGS))
        for name, setting in SETTINGS.items():
            progress.update(task, description=name)
            yield name, evaluate(setting, sections)
            progress.advance(task)


def progress_bar() -> Progress:
    """A bar on stderr that names what is being done."""
    columns = (SpinnerColumn(), BarColumn(), TimeElapsedColumn(), TextColumn("{task.description}"))
    return Progress(*columns, console=Console(stderr=True))


# --- The protocol --------------------------------------------------------------------------------------------------


def cut(record: SilverboxRecord) -> Sections:
    """The training section, and the three tests."""

    def section(name: str, start: int, stop: int) -> Regime:
        return Regime(name, record.u[start:stop], record.y[start:stop])

    end_of_training = MULTISINE.start + TRAINING_SAMPLES
    return Sections(
        section("training", MULTISINE.start, end_of_training),
        section("multisine", end_of_training, MULTISINE.stop),
        section("arrow", ARROW.start, ARROW.stop),
        section("no_extrapolation", ARROW.start, ARROW.start + WITHOUT_EXTRAPOLATION),
    )


def evaluate(setting: Setting, sections: Sections) -> Outcome:
    """Identifies on the training section and on its beginnings, and tests what came out."""
    training = sections.training
    learning, beliefs = {}, {}
    for samples in LENGTHS:
        estimator, free_energy, seconds = identify(setting, training, samples)
        learning[samples] = rmse(simulation_error(estimator, sections.arrow))
        beliefs[samples] = estimator.belief
    for _ in range(TIMINGS - 1):
        seconds = min(seconds, identify(setting, training, len(training.y))[2])
    test = sections.multisine
    return Outcome(
        rmse={name: rmse(simulation_error(estimator, getattr(sections, name))) for name in TESTS},
        prediction_rmse=rmse(estimator.predict(test.u, test.y) - test.y),
        coverage=coverage(estimator, training, test),
        seconds=seconds,
        free_energy=free_energy,
        learning=learning,
        beliefs=beliefs,
        arrow_error=simulation_error(estimator, sections.arrow),
    )


def identify(setting: Setting, training: Regime, samples: int) -> tuple[OnlineEstimator, float, float]:
    """An estimator after the first samples of the training, its free energy [nats], and seconds for each of them."""
    u, y = training.u[:samples], training.y[:samples]
    estimator = setting.estimator()
    start = perf_counter()
    free_energy = float(estimator.run(u, y)[:, -1].sum())
    for _ in range(setting.passes - 1):
        estimator.rewind()
        estimator.run(u, y)
    return estimator, free_energy, (perf_counter() - start) / (setting.passes * samples)


def simulation_error(estimator: OnlineEstimator, test: Regime) -> FloatArray:
    """(T,) simulated minus measured outputs [V]; the simulation knows the inputs and the `GIVEN` first outputs."""
    return estimator.simulate(test.u, test.y[:GIVEN]) - test.y


def rmse(error: FloatArray) -> float:
    """Root mean square [V] of an error (T,), but for the first `GIVEN`."""
    return float(np.sqrt(np.mean(error[GIVEN:] ** 2)))


def coverage(estimator: OnlineEstimator, training: Regime, test: Regime) -> float:
    """Fraction of the outputs within their 90 % intervals, while a copy of the estimator goes on from the training.

    A model that looks ahead has not used the last training sample yet, and does not come to use the last test sample.
    """
    copy = deepcopy(estimator)
    copy.run(test.u, test.y)
    waited = getattr(copy.model, "look_ahead", 0)
    y = np.concatenate([training.y[len(training.y) - waited :], test.y])[: len(copy.forecasts)]
    mean, variance = copy.forecasts.T
    if np.isnan(variance).any():
        return float("nan")
    return float(np.mean(np.abs(y - mean) <= NINETY * np.sqrt(variance)))


# --- Results -------------------------------------------------------------------------------------------------------


def summarise(outcomes: Mapping[str, Outcome]) -> dict[str, Any]:
    """The results as `run_protocol` returns them: plain dictionaries, fit for JSON."""
    rows = {
        name: {
            "model": type(SETTINGS[name].model).__name__,
            "options": asdict(SETTINGS[name].model),
            "passes": SETTINGS[name].passes,
            "rmse": {test: _finite(error) for test, error in outcome.rmse.items()},
            "prediction_rmse": _finite(outcome.prediction_rmse),
            "coverage": _finite(outcome.coverage),
            "seconds_per_sample": outcome.seconds,
            "samples_until_1_mV": outcome.samples_until_close,
            "free_energy": outcome.free_energy,
            "arrow_rmse_after": {str(samples): _finite(error) for samples, error in outcome.learning.items()},
            "parameters": _parameters(outcome.beliefs[TRAINING_SAMPLES]),
        }
        for name, outcome in outcomes.items()
    }
    meta = {
        "samples": {"training": TRAINING_SAMPLES, "given": GIVEN},
        "versions": {"python": platform.python_version()} | {name: version(name) for name in VERSIONED},
    }
    return {"rows": rows, "targets": [{"target": text, "reached": ok} for text, ok in targets(outcomes)], "meta": meta}


def _finite(value: float) -> float | None:
    """A number for JSON, which has no other."""
    return value if np.isfinite(value) else None


def _parameters(belief: Belief | JointBelief) -> dict[str, dict[str, Any]]:
    """Mean and standard deviation of each coefficient, by name."""
    if isinstance(belief, JointBelief):
        return {name: dict(zip(("mean", "std", "unit"), row, strict=True)) for name, row in belief.parameters().items()}
    stds = np.sqrt(np.diag(belief.coefficients_cov))
    rows = zip(("theta1", "theta2", "theta3", "eta"), belief.coefficients_mean.tolist(), stds.tolist(), strict=True)
    return {name: {"mean": mean, "std": std} for name, mean, std in rows}


def targets(outcomes: Mapping[str, Outcome]) -> Iterator[tuple[str, bool]]:
    """What was aimed at, with what was measured, and whether it was reached."""
    for name, bounds in TARGETS.items():
        errors = [1e3 * outcomes[name].rmse[test] for test in TESTS]
        reached = all(error <= bound for error, bound in zip(errors, bounds, strict=True))
        yield f"{name}: {submission(errors)} mV, at most {submission(bounds, 2)}", reached
    samples = outcomes["ODE linear"].samples_until_close
    text = f"ODE linear: arrow below {1e3 * CLOSE:g} mV after {samples} samples, at most {MAX_SAMPLES_UNTIL_CLOSE}"
    yield text, samples is not None and samples <= MAX_SAMPLES_UNTIL_CLOSE
    coverages = [outcome.coverage for name, outcome in outcomes.items() if name.startswith("ODE")]
    low, high = COVERAGE_RANGE
    text = f"ODE: 90 % intervals cover {min(coverages):.3f} to {max(coverages):.3f}, within {low} to {high}"
    yield text, all(low <= fraction <= high for fraction in coverages)
    for start, bound in MAX_SECONDS.items():
        slowest = max(outcome.seconds for name, outcome in outcomes.items() if name.startswith(start))
        yield f"{start}: {1e6 * slowest:.1f} µs per sample, at most {1e6 * bound:g}", slowest <= bound
    by_error = sorted(RANKED, key=lambda name: outcomes[name].rmse["multisine"])
    by_free_energy = sorted(RANKED, key=lambda name: outcomes[name].free_energy)
    yield "free energy ranks paper, offset, three-tap and ODE as their simulation errors do", by_error == by_free_energy


def submission(errors: Any, digits: int = 3) -> str:
    """The official line: multisine, arrow, arrow without extrapolation [mV]."""
    return "[" + "; ".join(f"{error:.{digits}f}" for error in errors) + "]"


def report(outcomes: Mapping[str, Outcome], results: Mapping[str, Any]) -> None:
    """Prints the table, the submission lines, and what became of the targets."""
    console = Console(highlight=False, markup=False)
    console.width = max(console.width, 100)
    console.print(table(outcomes))
    console.print("d = 0: without feedthrough; +e: with cubic damping; n.e.: without extrapolation;")
    console.print("1-step and coverage: of the multisine test")
    console.print("\nSubmission, RMSE in mV [multisine; arrow; arrow without extrapolation]:")
    for name in TARGETS:
        errors = [1e3 * outcomes[name].rmse[test] for test in TESTS]
        console.print(f"  {name:24} {submission(errors)}")
    console.print("\nTargets:")
    for row in results["targets"]:
        console.print(f"  {'PASS' if row['reached'] else 'MISS'}  {row['target']}")


def table(outcomes: Mapping[str, Outcome]) -> Table:
    """A row for each setting, in 100 characters."""
    shown = Table(box=SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0))
    shown.add_column("")
    columns = ("multisine\n[mV]", "arrow\n[mV]", "n.e.\n[mV]", "1-step\n[mV]", "90 %\ncovers", "<1 mV\nafter")
    for title in (*columns, "µs per\nsample", "free energy\n[nats]"):
        shown.add_column(title, justify="right")
    for name, outcome in outcomes.items():
        shown.add_row(
            name,
            *(f"{1e3 * outcome.rmse[test]:.3f}" for test in TESTS),
            f"{1e3 * outcome.prediction_rmse:.3f}",
            "-" if np.isnan(outcome.coverage) else f"{outcome.coverage:.3f}",
            str(outcome.samples_until_close or "never"),
            f"{1e6 * outcome.seconds:.2f}",
            f"{outcome.free_energy:.0f}",
        )
    return shown
