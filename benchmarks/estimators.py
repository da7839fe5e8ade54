"""Section 1: speed of the estimator on the Silverbox record, beside common filters of other packages."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.peer_process import Peers
from benchmarks.section_tables import Claim, Section, ratio
from benchmarks.timed_rounds import Row, measure, timed
from duffing_env.plants.silverbox_record import load_record, record_available, synthesise_multisine
from estimator import SILVERBOX_TWIN, OnlineEstimator, coefficients_of, difference, duffing, silverbox_prior
from estimator.belief import Belief
from estimator.models.model import Model
from estimator.support.array_types import FloatArray

#: Samples of the record.
SAMPLES = 4096

#: Unit of the rows.
UNIT = "µs/sample"

#: Names of our rows.
STRUCTURED, MEAN_FIELD = "ours, structured, 3 iterations", "ours, mean field, 10 iterations"

#: Model and longest time of a sample [µs] of the rows that call ``update``.
ONE_BY_ONE = {"ours, update(u, y), Eq. (2)": (difference(), 10), "ours, update(u, y), Eq. (1)": (duffing(), 15)}

#: Names of the rows of other packages.
PEERS = {"filterpy": "filterpy, UKF", "dynamax": "dynamax, EKF, compiled scan", "padasip": "padasip, RLS"}


def samples() -> tuple[FloatArray, FloatArray, str]:
    """Input and output [V] and their origin: the record's multisine, or the twin under a synthesised one."""
    if record_available():
        regime = load_record().multisine
        return regime.u[:SAMPLES], regime.y[:SAMPLES], f"first {SAMPLES:,} samples of the record's multisine"
    rng = np.random.default_rng(0)
    u = synthesise_multisine(rng, realisations=1)[:SAMPLES]
    theta1, theta2, theta3, eta = coefficients_of(difference(), SILVERBOX_TWIN)
    x = np.zeros(SAMPLES)
    for t in range(2, SAMPLES):
        x[t] = theta1 * x[t - 1] + theta2 * x[t - 1] ** 3 + theta3 * x[t - 2] + eta * u[t - 1]
        x[t] += 5e-4 * rng.standard_normal()
    y = x + 5e-4 * rng.standard_normal(SAMPLES)
    return u, y, f"{SAMPLES:,} samples of the twin under a synthesised multisine (the record is not on this machine)"


def write_samples(path: Path) -> None:
    """Write the input of `benchmarks.silverbox_peer_filters`: the same samples, our prior and its expected noises."""
    u, y, _ = samples()
    prior = silverbox_prior()
    gamma_shape, gamma_rate, xi_shape, xi_rate = prior.noises
    np.savez(
        path,
        u=u,
        y=y,
        timed=len(y),
        lengths=[len(y)],
        paper_mean=prior.mean,
        paper_cov=prior.cov,
        paper_direction=[1.0, 0.0],
        paper_process_variance=gamma_rate / gamma_shape,
        paper_measurement_variance=xi_rate / xi_shape,
        paper_terms=[(1, 0, -1), (3, 0, -1), (0, 1, -1), (0, 0, 1)],
    )


def run(peers: Peers, repetitions: int, on_row: Callable[[str], None]) -> Section:
    """Time the estimators, and compute the errors of their coefficients: speed alone says little."""
    u, y, origin = samples()
    coefficients: dict[str, Any] = {}
    rows = [
        Row(title, UNIT, timed(_passes(title, factorisation, u, y, coefficients)))
        for title, factorisation in ((STRUCTURED, "structured"), (MEAN_FIELD, "mean_field"))
    ]
    rows += [Row(title, UNIT, timed(_updates(model, u, y))) for title, (model, _) in ONE_BY_ONE.items()]
    rows += [peers.row(f"silverbox {name} paper time", title, UNIT) for name, title in PEERS.items()]
    results = measure(rows, repetitions, on_row)
    coefficients.update({title: np.array(answer["mean"][2:]) for title, answer in peers.answers.items()})
    errors = {title: _errors(values, u, y) for title, values in coefficients.items()}
    claims = [
        Claim(f"time per sample: {other} over {ours}", ratio(results[other], results[ours]))
        for other in PEERS.values()
        for ours in (STRUCTURED, MEAN_FIELD)
    ]
    for title, (_, bar) in ONE_BY_ONE.items():
        claims.append(Claim(title, results[title].median, bar, at_most=True, unit=UNIT))
    notes = [
        f"On the {origin}; one system, sample by sample: a loop of its own in compiled code or, where it says "
        f"update, one call from Python for each. All have the same four coefficients; the two Kalman filters "
        f"have our prior and its expected noise variances.",
        "RMSE of the coefficients they end with, on these samples [mV]:  one step ahead, free run",
        *(f"  {title:<34} {one:9.3f} {free:9.2f}" for title, (one, free) in errors.items()),
    ]
    data = {"samples": origin, "rmse_mV": {title: {"one_step": e[0], "free_run": e[1]} for title, e in errors.items()}}
    return Section("Estimators, one system", list(results.values()), claims, ["\n".join(notes)], data)


def _passes(
    title: str, factorisation: str, u: FloatArray, y: FloatArray, coefficients: dict[str, Any]
) -> Callable[[int], float]:
    prior = silverbox_prior()

    def action(count: int) -> float:
        for _ in range(count):
            estimator = OnlineEstimator(prior=prior, factorisation=factorisation)
            estimator.run(u, y)
        coefficients[title] = estimator.belief.coefficients_mean
        return count * len(u)

    return action


def _updates(model: Model, u: FloatArray, y: FloatArray) -> Callable[[int], float]:
    """Time one estimator, called from Python for every sample."""
    estimator, pairs = OnlineEstimator(model), list(zip(u.tolist(), y.tolist(), strict=True))

    def action(count: int) -> float:
        for _ in range(count):
            for sample in pairs:
                estimator.update(*sample)
        return count * len(pairs)

    return action


def _errors(coefficients: FloatArray, u: FloatArray, y: FloatArray) -> tuple[float, float]:
    """RMSE one step ahead and in a free run [mV]."""
    prior = silverbox_prior()
    record = prior.record.copy()
    record[2:6] = coefficients
    estimator = OnlineEstimator(difference(), Belief(difference(), record))
    predicted, simulated = estimator.predict(u, y), estimator.simulate(u, y[:2])
    with np.errstate(over="ignore", invalid="ignore"):
        one, free = (1e3 * float(np.sqrt(np.mean((series - y)[2:] ** 2))) for series in (predicted, simulated))
    return one, free
