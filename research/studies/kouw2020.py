"""The experiment of Kouw (2020), section 4, repeated on the Silverbox record and set against the published numbers.

Every model is trained on the multisine part of the record, 90,972 samples, and validated on the arrow part, 40,100
samples, with its parameters fixed: by one-step predictions from the measured outputs, and by a simulation, a free run
from the first two of them. `reproduce` does it all; ``docs/evidence/reproduction.md`` discusses the outcome.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np

from agents.console_output import format_table, print_texts_and_tables
from agents.evaluation.figures import new_figure, save_png
from agents.output_paths import check_output_file
from agents.policies import make_policy
from agents.result_files import package_versions, write_json
from duffing_env.plants.silverbox_record import Regime, SilverboxRecord, load_record
from estimator import OnlineEstimator, Rig, difference, published_run_prior
from estimator.belief import Belief
from estimator.inference.pem_narx import PEMNARX
from estimator.support.array_types import FloatArray
from estimator.support.progress import iterate_with_progress

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PUBLISHED = {
    "PEM-NARX": {"prediction_mse": 5.830793034083989e-05, "simulation_mse": 1.001367833873263e-03},
    "FEM-LARX": {"prediction_mse": 5.9446129987526364e-05, "simulation_mse": 1.0204335589997665e-03},
    "FEM-NLARX": {"prediction_mse": 5.8304968780121563e-05, "simulation_mse": 9.256401174690808e-04},
}
"""Mean squared errors [V²] of the published run, from its own files; the paper's text has 1.002e-3 for FEM-LARX."""

MEASURES = ("prediction", "simulation")
_PLOT_STRIDE = 80
"""The figures show one sample of this many, as the paper's do."""


@dataclass(frozen=True)
class ExperimentSetting:
    """One way to run the experiment. All start from `published_run_prior`, with the default number of iterations.

    Attributes:
        summary: what it is, for the reader of the table.
        factorisation: of the online estimator, ``mean_field`` or ``structured``.
        input_delay: samples between an input and the output it acts on, 0 or 1.
        as_published: with the published run's two departures from the derived messages.
        through_environment: every sample is one step of the Gymnasium environment.
        models: names of the models, in the paper's order.
    """

    summary: str
    factorisation: str
    input_delay: int
    as_published: bool = False
    through_environment: bool = False
    models: tuple[str, ...] = ("FEM-LARX", "FEM-NLARX")


_ALL_MODELS = ("PEM-NARX", "FEM-LARX", "FEM-NLARX")

SETTINGS = {
    "as_published": ExperimentSetting(
        "mean field, input delay 0, with the two departures", "mean_field", 0, as_published=True, models=_ALL_MODELS
    ),
    "through_environment": ExperimentSetting(
        "the same, each sample a step of SilverboxReplay-v0",
        "mean_field",
        0,
        as_published=True,
        through_environment=True,
    ),
    "corrected_messages": ExperimentSetting("mean field, input delay 0, messages as derived", "mean_field", 0),
    "as_derived": ExperimentSetting(
        "mean field, input delay 1, messages as derived", "mean_field", 1, models=_ALL_MODELS
    ),
    "structured": ExperimentSetting("states and coefficients jointly Gaussian, input delay 1", "structured", 1),
}


@dataclass(frozen=True, eq=False)
class ValidationRun:
    """A trained model on the validation part.

    Attributes:
        prediction: (T,) one-step predictions [V]; the first two entries repeat the measured outputs.
        simulation: (T,) free run [V]; likewise.
        prediction_mse: see `prediction_mse` [V²].
        simulation_mse: see `simulation_mse` [V²].
        seconds: time that the training took, once compiled [s].
    """

    prediction: FloatArray
    simulation: FloatArray
    prediction_mse: float
    simulation_mse: float
    seconds: float


def reproduce(
    data: Path | None = None, json: Path | None = None, figures: Path = Path("runs/reproduction")
) -> dict[str, Any]:
    """Repeats the experiment in all `SETTINGS`: progress on stderr, a table on stdout, figures and results in files.

    Args:
        data: File or folder of the record; searched for where it is None (`load_record`).
        json: File for the results; None writes none.
        figures: Folder for ``prediction_error.png`` and ``simulation_error.png``, which show ``as_published``.

    Returns:
        What the JSON file holds: for ``published`` and every name in `SETTINGS`, for each of its models, the two
        mean squared errors [V²]; and under ``meta`` the settings, seconds of training, sample counts and versions.

    Raises:
        RecordNotFound, RecordDamaged: As `load_record`.
        OSError: A result cannot be written; found out before the work begins, where it can be.
    """
    record = load_record(data)
    check_output_file("json", json)
    figures.mkdir(parents=True, exist_ok=True)

    runs = run_all(record, data)
    results = summarise(runs, record)
    if json is not None:
        write_json(json, results)
    for measure in MEASURES:
        save_png(draw_errors(runs["as_published"], record.arrow, measure), figures / f"{measure}_error.png")

    report(results)
    return results


def run_all(record: SilverboxRecord, data: Path | None) -> dict[str, dict[str, ValidationRun]]:
    """Trains and validates each model of each setting, behind a progress bar on stderr."""
    compile_kernels(record, data)
    runs: dict[str, dict[str, ValidationRun]] = {name: {} for name in SETTINGS}
    tasks = [(f"{name}, {model}", (name, model)) for name, setting in SETTINGS.items() for model in setting.models]
    for name, model in iterate_with_progress(tasks):
        runs[name][model] = train_and_validate(SETTINGS[name], model, record, data)
    return runs


def compile_kernels(record: SilverboxRecord, data: Path | None) -> None:
    """Compiles the kernels of `train_and_validate`, so that its seconds do not include compilation.

    Numba compiles anew for the record's arrays, which are read-only, and for the delayed copies of them.
    """
    for setting in SETTINGS.values():
        if setting.through_environment:
            env = make_environment(setting, True, data)
            env.reset(seed=0)
            env.step(np.zeros(1, dtype=np.float32))
        else:
            train_online(setting, True, Regime("multisine", record.multisine.u[:2], record.multisine.y[:2]))


def train_and_validate(
    setting: ExperimentSetting, model: str, record: SilverboxRecord, data: Path | None
) -> ValidationRun:
    """Trains one model on the multisine part and validates it on the arrow part."""
    training, validation = record.multisine, record.arrow
    u, y = validation.u, validation.y
    start = perf_counter()
    if model == "PEM-NARX":
        narx = PEMNARX(input_delay=setting.input_delay).fit(training.u, training.y)
        seconds = perf_counter() - start
        prediction, simulation = narx.predict(u, y), narx.simulate(u, y[:2])
    else:
        nonlinear = model == "FEM-NLARX"
        if setting.through_environment:
            coefficients = train_through_environment(setting, nonlinear, data)
        else:
            coefficients = train_online(setting, nonlinear, training)
        seconds = perf_counter() - start
        trained = estimator_at(coefficients, setting.input_delay)
        prediction, simulation = trained.predict(u, y), trained.simulate(u, y[:2])
    return ValidationRun(prediction, simulation, prediction_mse(prediction, y), simulation_mse(simulation, y), seconds)


def train_online(setting: ExperimentSetting, nonlinear: bool, training: Regime) -> FloatArray:
    """Posterior means (4,) of θ1, θ2, θ3, η after the whole training part."""
    estimator = OnlineEstimator(
        difference(),
        published_run_prior(nonlinear),
        Rig.silverbox("zero_order", setting.input_delay),
        factorisation=setting.factorisation,
        as_published=setting.as_published,
    )
    estimator.run(training.u, training.y)
    return estimator.belief.coefficients_mean


def estimator_at(coefficients: FloatArray, input_delay: int) -> OnlineEstimator:
    """An estimator whose belief is the coefficients (4,), for predictions and free runs."""
    prior = published_run_prior()
    record = prior.record.copy()
    record[2:6] = coefficients
    believed = Belief(difference(), record, prior.scales)
    return OnlineEstimator(difference(), believed, Rig.silverbox("zero_order", input_delay))


def train_through_environment(setting: ExperimentSetting, nonlinear: bool, data: Path | None) -> FloatArray:
    """The same means, from an episode in which the reference policy plays the recorded input.

    Raises:
        RuntimeError: The episode ended before the record did.
    """
    env = make_environment(setting, nonlinear, data)
    policy = make_policy("silverbox-multisine", env=env)
    observation, info = env.reset(seed=0)
    state, terminated, truncated = None, False, False
    while not (terminated or truncated):
        action, state = policy.predict(observation, state)
        observation, _, terminated, truncated, info = env.step(action)
    if terminated:
        raise RuntimeError(f"the episode must reach the end of the record, but was terminated before: {info}")
    means: FloatArray = env.unwrapped.belief.coefficients_mean  # type: ignore[attr-defined]
    return means if nonlinear else np.insert(means, 1, 0.0)  # a model without the cubic term has θ2 = 0


def make_environment(setting: ExperimentSetting, nonlinear: bool, data: Path | None) -> gym.Env:
    """The environment that replays the training part."""
    return gym.make(
        "duffing_env/SilverboxReplay-v0",
        regime="multisine",
        prior="published_run",
        input_delay=setting.input_delay,
        factorisation=setting.factorisation,
        as_published=setting.as_published,
        nonlinear=nonlinear,
        data=None if data is None else str(data),
    )


def prediction_mse(predicted: FloatArray, y: FloatArray) -> float:
    """Mean squared one-step prediction error [V²], indexed as in the published run.

    With samples numbered from 1, that run predicts y_4, ..., y_T, and takes the mean over y_3, ..., y_T with the value
    0 in place of a prediction of y_3.

    Args:
        predicted: (T,) predictions [V]; the first three are not used.
        y: (T,) measured outputs [V], T >= 3.
    """
    errors = predicted[2:] - y[2:]
    errors[0] = 0.0 - y[2]
    return float(np.mean(errors**2))


def simulation_mse(simulated: FloatArray, y: FloatArray) -> float:
    """Mean squared simulation error [V²] over y_3, ..., y_T: all but the two initial outputs.

    Args:
        simulated: (T,) free run [V].
        y: (T,) measured outputs [V], T >= 3.
    """
    return float(np.mean((simulated[2:] - y[2:]) ** 2))


def summarise(runs: dict[str, dict[str, ValidationRun]], record: SilverboxRecord) -> dict[str, Any]:
    """The results as `reproduce` returns them: plain dictionaries, fit for JSON."""
    measured = [f"{measure}_mse" for measure in MEASURES]
    errors = {
        name: {model: {measure: getattr(run, measure) for measure in measured} for model, run in models.items()}
        for name, models in runs.items()
    }
    meta = {
        "prior": "published_run",
        "settings": {name: asdict(setting) for name, setting in SETTINGS.items()},
        "seconds": {name: {model: run.seconds for model, run in models.items()} for name, models in runs.items()},
        "samples": {"training": len(record.multisine.u), "validation": len(record.arrow.u)},
        "versions": package_versions("matplotlib"),
    }
    return {"published": PUBLISHED, **errors, "meta": meta}


def report(results: dict[str, Any]) -> None:
    """Prints the errors, their ratios to the published errors of the same models, and their roots."""
    titles, rows = ["\nrun", "\nmodel"], []
    for measure in MEASURES:
        titles += [f"{measure}\nMSE [V²]", "\nratio", "RMSE\n[mV]"]
    for name in ("published", *SETTINGS):
        for model, errors in results[name].items():
            cells = [name, model]
            for measure in MEASURES:
                mse = errors[f"{measure}_mse"]
                ratio = mse / PUBLISHED[model][f"{measure}_mse"]
                cells += [f"{mse:.4e}", f"{ratio:.4f}", f"{1e3 * np.sqrt(mse):.3f}"]
            rows.append(cells)
    print_texts_and_tables(
        format_table(titles, rows, n_labels=2),
        "\nratio: to the published error of the same model",
        *(f"{name + ':':20} {setting.summary}" for name, setting in SETTINGS.items()),
        *(
            f"{name} is within {max_relative_deviation(results[name]):.1e} of the published FEM errors, relative"
            for name in ("as_published", "through_environment")
        ),
    )


def max_relative_deviation(errors: dict[str, dict[str, float]]) -> float:
    """Largest relative deviation of the four FEM errors from the published ones."""
    return max(
        abs(mse / PUBLISHED[model][measure] - 1)
        for model in ("FEM-LARX", "FEM-NLARX")
        for measure, mse in errors[model].items()
    )


def draw_errors(runs: Mapping[str, Any], validation: Regime, measure: str) -> Figure:
    """One of the paper's two figures of errors: a column for each model, the lower row in log scale.

    Args:
        runs: The models by name.
        validation: The validation part of the record.
        measure: ``prediction`` or ``simulation``.
    """
    figure = new_figure(11, 5.2)
    axes = figure.subplots(2, len(runs), sharex=True, sharey="row", squeeze=False)
    samples = np.arange(0, len(validation.y), _PLOT_STRIDE)
    for (upper, lower), (model, run) in zip(axes.T, runs.items(), strict=True):
        output = getattr(run, measure)[samples]
        squared_error = (output - validation.y[samples]) ** 2
        upper.plot(samples, output, color="purple", linewidth=0.8, label=f"{measure} [V]")
        upper.plot(samples, squared_error, color="black", linewidth=1.0, label="squared error [V²]")
        upper.set_title(f"{model}: MSE {getattr(run, f'{measure}_mse'):.3e} V²", fontsize=11)
        lower.semilogy(samples, squared_error, color="black", linewidth=0.6, nonpositive="mask")
        lower.set_xlabel("sample")
    axes[0, 0].set_ylabel("output [V], squared error [V²]")
    axes[1, 0].set_ylabel("squared error [V²]")
    axes[0, 0].legend(loc="lower left", fontsize=9)
    return figure
