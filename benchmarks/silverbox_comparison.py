"""Compare peer packages with our estimators in the Silverbox protocol: same record, model, prior and tests.

A peer gets all that it needs and does not learn: our prior, our estimates of the two noise variances at the end of the
training section, and float64. Our free run simulates its coefficients, started by a filter with its noises, so that
only the identification differs; fastcan simulates its own model. All rows are timed in turns.
"""

import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import numpy as np

from agents.cli import run_script
from agents.console_output import format_table, print_texts_and_tables
from agents.result_files import replace_non_finite
from benchmarks.peer_process import NotAvailable, Peers
from benchmarks.section_tables import ratio
from benchmarks.timed_rounds import Result, Row, measure, timed
from duffing_env.plants.silverbox_record import Regime
from estimator import OnlineEstimator
from estimator.belief import Belief
from estimator.models.difference_equation import PRESETS
from estimator.support.array_types import FloatArray
from research.studies.silverbox_protocol import (
    N_GIVEN_OUTPUTS,
    SETTINGS,
    TESTS,
    TRAINING_LENGTHS,
    TRAINING_SAMPLES,
    ProtocolOutcome,
    Sections,
    coverage_of,
    rmse,
    samples_until_close,
    simulation_error,
)
from research.studies.silverbox_results import run_protocol, submission_line

#: First samples of the training section, on which all online rows are timed.
TIMED = 4096

#: Repetitions of each timing.
REPETITIONS = 5

#: Unit of the times.
UNIT = "µs/sample"

#: Smallest ratio of dynamax's time per sample to ours with the same model.
BAR = 5.0

#: Our setting, by the name in a request.
MODELS = {"ode": "ODE linear", "three-tap": "NLARX three-tap", "cubic": "NLARX cubic", "paper": "paper structured"}

#: Package and model of the online peers, by the titles of their rows.
PEERS = {
    "dynamax EKF, ODE linear": ("dynamax", "ode"),
    "dynamax EKF, three-tap": ("dynamax", "three-tap"),
    "dynamax EKF, paper": ("dynamax", "paper"),
    "filterpy UKF, ODE linear": ("filterpy", "ode"),
    "padasip RLS, three-tap": ("padasip", "three-tap"),
    "padasip RLS, cubic": ("padasip", "cubic"),
}

#: Title of the row of the offline peer.
OFFLINE = "fastcan NARX, offline"

#: Places in our joint state of z, z', stiffness, damping, gain, cubic, force, y0 and d: the peers' order.
_MOTION = [0, 1, 2, 4, 5, 3, 6, 7, 8]

#: Effect on (z, z') of a force held over a sample, in proportion, without spring and damper, which ours includes.
_DIRECTION = np.array([1.0, 2.0])


@dataclass(frozen=True, eq=False)
class Contender:
    """The results of a row of the comparison.

    Attributes:
        errors: root mean square simulation error by test [V].
        coverage: of 90 % intervals of forecasts; NaN where there are none.
        learning: simulation error on the arrow [V] after each number of training samples.
        time: time per sample [µs].
        reason: why there is nothing of all this.
    """

    time: Result
    errors: dict[str, float] = field(default_factory=dict)
    coverage: float = float("nan")
    learning: dict[int, float] = field(default_factory=dict)
    reason: str = ""

    def to_dict(self) -> dict[str, Any]:
        """For the JSON file."""
        if self.reason:
            return {"not_available": self.reason}
        return {
            "rmse": self.errors,
            "coverage": self.coverage,
            "samples_until_1_mV": samples_until_close(self.learning),
            "arrow_rmse_after": {str(samples): error for samples, error in self.learning.items()},
            "time": self.time.to_dict(),
        }


def compare(sections: Sections, outcomes: Mapping[str, ProtocolOutcome], wanted: bool = True) -> dict[str, Any]:
    """Run the peers, print their rows beside ours, and return the results for the JSON file.

    Args:
        sections: The record, as the protocol cuts it.
        outcomes: Of our settings, in this run.
        wanted: Whether there are to be peers at all; without them every row says so.
    """
    from rich.console import Console

    status = Console(stderr=True).status("Peers")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "given.npz"
        np.savez(path, **given(sections, outcomes))
        with Peers(path, wanted) as peers, status:
            contenders = run(peers, sections, outcomes, status.update)
            versions = peers.versions()
    claims = {title: faster(contenders, title) for title in PEERS if title.startswith("dynamax")}
    report(contenders, claims, versions)
    compared = {
        "rows": {title: contender.to_dict() for title, contender in contenders.items()},
        "times_as_fast": {title: times for title, (times, _) in claims.items()},
        "timed_samples": TIMED,
        "versions": versions,
    }
    return cast("dict[str, Any]", replace_non_finite(compared))


def given(sections: Sections, outcomes: Mapping[str, ProtocolOutcome]) -> dict[str, Any]:
    """Input of `benchmarks.silverbox_peer_filters`: samples, models, priors, noises, and the tests' first outputs."""
    training, test = sections.training, sections.multisine
    arrays: dict[str, Any] = {
        "u": np.concatenate([training.u, test.u]),
        "y": np.concatenate([training.y, test.y]),
        "timed": TIMED,
        "lengths": np.array(TRAINING_LENGTHS),
        "tests": np.array(TESTS),
    }
    for name in TESTS:
        section: Regime = getattr(sections, name)
        arrays |= {f"{name}_u": section.u, f"{name}_given": section.y[:N_GIVEN_OUTPUTS]}
    for name, ours in MODELS.items():
        prior = prior_of(name)
        learned = outcomes[ours].beliefs[TRAINING_SAMPLES]
        arrays[f"{name}_process_variance"] = 1 / learned.gamma_mean
        arrays[f"{name}_measurement_variance"] = 1 / learned.xi_mean
        mean, cov, direction = prior.mean, prior.cov, np.array([1.0, 0.0])
        if name == "ode":
            mean, cov, direction = mean[_MOTION], cov[np.ix_(_MOTION, _MOTION)], _DIRECTION
            arrays[f"{name}_substeps"] = prior.model.substeps
        else:
            arrays[f"{name}_terms"] = terms_of(name)
        arrays |= {f"{name}_mean": mean, f"{name}_cov": cov, f"{name}_direction": direction}
    return arrays


def prior_of(name: str) -> Belief:
    """Our prior for a model of `MODELS`."""
    return SETTINGS[MODELS[name]].estimator().belief


def terms_of(name: str) -> FloatArray:
    """(K, 3) powers of the lags and delay of the input, or -1, of a model's terms."""
    delay = SETTINGS[MODELS[name]].rig.delay
    return np.array([(t.lag1, t.lag2, -1 if t.tap is None else t.tap + delay) for t in PRESETS[name]])


def run(
    peers: Peers, sections: Sections, outcomes: Mapping[str, ProtocolOutcome], on_row: Callable[[str], None]
) -> dict[str, Contender]:
    """All rows: ours, then the peers that share the model; fastcan last."""
    training = sections.training
    u, y = training.u[:TIMED], training.y[:TIMED]
    rows = []
    for name, ours in MODELS.items():
        rows.append(Row(ours, UNIT, timed(_passes(ours, u, y))))
        theirs = [(title, peer) for title, (peer, model) in PEERS.items() if model == name]
        rows += [peers.row(f"silverbox {peer} {name} time", title, UNIT) for title, peer in theirs]
    times = measure(rows, REPETITIONS, on_row)
    contenders: dict[str, Contender] = {}
    for title, time in times.items():
        if title in outcomes:
            outcome = outcomes[title]
            contenders[title] = Contender(time, outcome.rmse, outcome.coverage, outcome.learning)
            continue
        if time.reason:
            contenders[title] = Contender(time, reason=time.reason.removeprefix("NotAvailable: "))
            continue
        peer, model = PEERS[title]
        on_row(f"protocol: {title}")
        try:
            answer = peers.ask(f"silverbox {peer} {model} protocol", 1)
        except NotAvailable as error:
            contenders[title] = Contender(time, reason=str(error))
        else:
            contenders[title] = judge(model, answer, time, sections, outcomes)
    on_row(f"protocol: {OFFLINE}")
    contenders[OFFLINE] = _offline(peers, sections)
    return contenders


def _passes(ours: str, u: FloatArray, y: FloatArray) -> Callable[[int], float]:
    """Process the samples from the prior on, and return their number."""

    def action(count: int) -> float:
        for _ in range(count):
            SETTINGS[ours].estimator().run(u, y)
        return count * len(u)

    return action


def judge(
    name: str, answer: Mapping[str, Any], time: Result, sections: Sections, outcomes: Mapping[str, ProtocolOutcome]
) -> Contender:
    """Measure the errors of an online peer's answer."""
    noises = outcomes[MODELS[name]].beliefs[TRAINING_SAMPLES]
    learning = {}
    for samples, mean in zip(TRAINING_LENGTHS, answer["means"], strict=True):
        estimator = estimator_at(name, np.array(mean), 1 / noises.gamma_mean, 1 / noises.xi_mean)
        learning[samples] = float("nan") if estimator is None else rmse(simulation_error(estimator, sections.arrow))
    errors = dict.fromkeys(TESTS, float("nan"))
    if estimator is not None:
        errors = {test: rmse(simulation_error(estimator, getattr(sections, test))) for test in TESTS}
    covers = float("nan")
    if answer["forecasts"] is not None:
        covers = coverage_of(np.array(answer["forecasts"]), sections.multisine.y)
    return Contender(time, errors, covers, learning)


def estimator_at(
    name: str, mean: FloatArray, process_variance: float, measurement_variance: float
) -> OnlineEstimator | None:
    """Our estimator with a peer's means (n,) of the joint state and its noises; None if a mean is not finite.

    Of the state only the coefficients count: a simulation begins at rest, with the prior's uncertainty.
    """
    if not np.isfinite(mean).all():
        return None
    prior, places = prior_of(name), _MOTION if name == "ode" else list(range(len(mean)))
    whole = prior.mean
    whole[places[2:]] = mean[2:]
    noises = (1.0, process_variance), (1.0, measurement_variance)
    return OnlineEstimator(prior.model, Belief.of(prior.model, whole, prior.cov, *noises), SETTINGS[MODELS[name]].rig)


def _offline(peers: Peers, sections: Sections) -> Contender:
    """Fit and time fastcan once with each length."""
    try:
        answer = peers.ask("silverbox fastcan - protocol", 1)
    except NotAvailable as error:
        return Contender(Result(OFFLINE, UNIT), reason=str(error))
    time = Result(OFFLINE, UNIT, (1e6 * answer["seconds"] / answer["work"],))
    with np.errstate(over="ignore", invalid="ignore"):
        learning = {int(n): rmse(np.array(x) - sections.arrow.y) for n, x in answer["learning"].items()}
        errors = {test: rmse(np.array(x) - getattr(sections, test).y) for test, x in answer["simulations"].items()}
    return Contender(time, errors, learning=learning)


def faster(contenders: Mapping[str, Contender], title: str) -> tuple[float, bool]:
    """The ratio of a peer's time to ours with the peer's model, and whether our errors are no larger.

    Errors are compared as the submission line gives them, to the microvolt. NaN and False without the peer.
    """
    theirs, ours = contenders[title], contenders[MODELS[PEERS[title][1]]]
    if theirs.reason:
        return float("nan"), False
    no_worse = all(round(1e6 * ours.errors[test]) <= round(1e6 * theirs.errors[test]) for test in TESTS)
    return ratio(theirs.time, ours.time), no_worse


def report(
    contenders: Mapping[str, Contender], claims: Mapping[str, tuple[float, bool]], versions: Mapping[str, str]
) -> None:
    """Print the table, and the ratio of times of dynamax's filter and ours with the same model."""
    print_texts_and_tables("\nPeers, and ours with the same model:", as_table(contenders))
    for title, contender in contenders.items():
        if contender.reason:
            print_texts_and_tables(f"{title}: not available: {contender.reason}")
    used = [name for name in ("dynamax", "jax", "filterpy", "padasip", "fastcan", "numpy") if name in versions]
    print_texts_and_tables(
        f"µs per sample: median [least, most] of {REPETITIONS} turns over the first {TIMED:,} samples,",
        "compiled before; fastcan: of its fit to all samples, once",
        ", ".join(f"{name} {versions[name]}" for name in used) or "no peers",
        "\nSpeed at equal or better error:",
    )
    for title, (times, no_worse) in claims.items():
        ours = MODELS[PEERS[title][1]]
        if np.isnan(times):
            print_texts_and_tables(f"  not available: {title}")
            continue
        verdict = "PASS" if times >= BAR and no_worse else "MISS"
        print_texts_and_tables(f"  {verdict}  {ours} is {times:.1f} times as fast as {title}, at least {BAR:g},")
        print_texts_and_tables(f"        with {_line(contenders[ours])} mV against {_line(contenders[title])} mV")


def _line(contender: Contender) -> str:
    return submission_line(1e3 * contender.errors[test] for test in TESTS)


def as_table(contenders: Mapping[str, Contender]) -> Any:
    """A row for each contender, in 100 characters."""
    titles = ("multisine\n[mV]", "arrow\n[mV]", "n.e.\n[mV]", "90 %\ncovers", "<1 mV\nafter", "µs per\nsample")
    return format_table(("", *titles, "[least, most]"), (_row(*entry) for entry in contenders.items()))


def _row(title: str, contender: Contender) -> tuple[str, ...]:
    if contender.reason:
        return (title, *["-"] * 7)
    low, high = min(contender.time.values), max(contender.time.values)
    return (
        title,
        *(f"{1e3 * contender.errors[test]:.3f}" for test in TESTS),
        "-" if np.isnan(contender.coverage) else f"{contender.coverage:.3f}",
        str(samples_until_close(contender.learning) or "never"),
        f"{contender.time.median:.2f}",
        f"[{low:.2f}, {high:.2f}]" if len(contender.time.values) > 1 else "-",
    )


@dataclass(frozen=True)
class Config:
    """Run the official Silverbox protocol for every estimator of this project, and for other packages beside them."""

    json: Path | None = None
    """JSON file for the results."""
    figures: Path = Path("runs/silverbox")
    """Folder for the figures of errors, learning and parameters, as PNG."""
    data: Path | None = None
    """The record or its folder; by default it is searched for on this machine."""


def main(config: Config) -> None:
    """Run the protocol and compare."""
    run_protocol(config.data, config.json, config.figures, compare)


if __name__ == "__main__":
    run_script(main, Config)
