"""Coverage of credible intervals: how often the posterior's 90 % intervals hold the truth, over systems of the prior.

``python -m benchmarks.interval_coverage`` prints the tables of docs/evidence/coverage.md, continuous.md and
expectations.md.
"""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from scipy.stats import binomtest, norm

from agents.console_output import format_table, print_texts_and_tables
from agents.result_files import write_json
from benchmarks.random_systems import SPREAD, draw, make_model, make_prior, make_rig, names_of
from duffing_env.tracks.differential_equation_tracks import ContinuousVectorEnv
from estimator import OnlineEstimator, coefficients_of, duffing
from estimator.belief import Belief
from estimator.support.array_types import FloatArray
from estimator.support.update_options import EXPECTATIONS

#: Probability of the intervals.
LEVEL = 0.90

#: Half width of the intervals, in standard deviations.
QUANTILE = float(norm.ppf(0.5 + LEVEL / 2))

#: Shape of the Gamma priors of the noise precisions: a weak prior.
NOISE_SHAPE = 2.0

#: Noise ratios in an ensemble.
HYPOTHESES = 9

#: Standard deviations of process and measurement noise [V].
NOISES = ((2e-3, 1e-3), (2e-3, 1e-4), (5e-4, 5e-4), (1e-4, 3e-4))

#: Lengths of records [samples].
LENGTHS = (256, 2048)

#: Centres of wrong noise priors, as multiples of the true process and measurement noise.
FACTORS = ((3.0, 3.0), (1 / 3, 1 / 3), (2.0, 1 / 4))

#: Centre of wrong priors of both noises [V].
EQUAL_CENTER = 5e-4

#: Process and measurement noise of the population ``wide`` [V].
WIDE_NOISES = (5e-6, 3e-4)

#: Centres of its prior of the measurement noise [V].
WIDE_CENTERS = (3e-4, 1e-3)

#: Its relative spreads.
WIDE_SPREADS = (0.3, 0.1)

#: Environment whose plants are the population ``track``.
TRACK = "duffing_env/Amplitude-v1"

#: Its estimators.
TRACK_ESTIMATORS = ("ode", "nlarx")

#: Limit of its output that no plant reaches [V].
NO_LIMIT = 1e3


@dataclass(frozen=True)
class Case:
    """Settings of one row of a table.

    Attributes:
        process_noise: standard deviation of w̃ on the displacement [V].
        measurement_noise: standard deviation of v [V].
        samples: length of each record.
        noise_centers: standard deviations [V] at which the priors of γ and of ξ are centred.
        population: one of `benchmarks.random_systems.POPULATIONS`; or ``track``, the plants of `TRACK` without limit.
        spread: relative half width of the population's parameters.
        factorisation: factorisation of the estimator, ``structured`` or ``mean_field``.
        hypotheses: noise ratios that the estimator weighs.
        expectations: ``first_order`` or ``sigma_points``.
        estimator: of ``track``, which identifies within the environment: ``ode`` or ``nlarx``.
    """

    process_noise: float
    measurement_noise: float
    samples: int
    noise_centers: tuple[float, float]
    population: str = "paper"
    spread: float = SPREAD
    factorisation: str = "structured"
    hypotheses: int = 1
    expectations: str = "first_order"
    estimator: str = "ode"


@dataclass(frozen=True)
class Coverage:
    """Results of one row.

    Attributes:
        kept: number of systems whose displacement stayed in range; the others do not count.
        hits: number of kept systems whose interval holds the truth, by coefficient; for ``paper`` and ``track`` also
            by physical parameter m, c, a, b.
        nees: mean over systems of dᵀ P⁻¹ d / K with d the error of the K coefficients (of ``track``: of m, c, a, b) and
            P its posterior covariance; 1 where the posterior is calibrated.
        nees_quantiles: its median, its 99 % quantile and its largest value.
        gamma, xi: 5 % quantile, median and 95 % quantile of E[γ] and of E[ξ], divided by the true precision.
        ratio_std: median standard deviation of log(σ_w/σ_v); None without an ensemble.
        error: median of |estimate / truth - 1|, by physical parameter; empty where the truth has none.
    """

    kept: int
    hits: dict[str, int]
    nees: float
    nees_quantiles: tuple[float, float, float]
    gamma: tuple[float, float, float]
    xi: tuple[float, float, float]
    ratio_std: float | None
    error: dict[str, float]


@dataclass(frozen=True)
class Config:
    """Tables of the coverage of 90 % intervals."""

    systems: int = 500
    """Number of systems of each row."""
    only: tuple[str, ...] = ("",)
    """Beginnings of the titles of the tables to make; all tables by default."""
    seed: int = 0
    """Seed of all draws."""
    json: Path | None = None
    """File for the results."""


def tables() -> dict[str, list[Case]]:
    """The cases of each table, by its title."""
    settings = [(*noises, samples) for noises in NOISES for samples in LENGTHS]
    equal = (EQUAL_CENTER, EQUAL_CENTER)
    right = [Case(w, v, samples, (w, v)) for w, v, samples in settings]
    wrong = {
        f"noise priors centred at {a:.3g} σ_w and {b:.3g} σ_v": [
            Case(w, v, samples, (a * w, b * v)) for w, v, samples in settings
        ]
        for a, b in FACTORS
    }
    wrong[f"noise priors centred at {EQUAL_CENTER:g} V"] = [
        Case(w, v, samples, equal) for w, v, samples in settings if (w, v) != equal
    ]
    chosen = {
        "structured": right,
        "mean field": _with(right, factorisation="mean_field"),
        **{name: _with(right, population=name) for name in ("offset", "three-tap", "cubic", "ode")},
        "ensemble": _with(right, hypotheses=HYPOTHESES),
    }
    for title, cases in wrong.items():
        chosen[f"structured, {title}"] = cases
        chosen[f"ensemble, {title}"] = _with(cases, hypotheses=HYPOTHESES)
    for name in TRACK_ESTIMATORS:
        chosen[f"track, {name}"] = _with(right, population="track", estimator=name)
    for spread in WIDE_SPREADS:
        for center in WIDE_CENTERS:
            chosen[f"wide, prior of {100 * spread:g} %, noise prior centred at {1e3 * center:g} mV"] = [
                Case(*WIDE_NOISES, samples, (WIDE_NOISES[0], center), "wide", spread, expectations=expectations)
                for samples in LENGTHS
                for expectations in EXPECTATIONS
            ]
    return chosen


def _with(cases: list[Case], **changes: Any) -> list[Case]:
    return [dataclasses.replace(case, **changes) for case in cases]


def evaluate(case: Case, systems: int, seed: int) -> Coverage:
    """Draw systems, identify each, and compare its posterior with the truth.

    Cases of one population, noise pair and length share their systems and data.
    """
    identify = _identify_in_track if case.population == "track" else _identify
    beliefs, truth, physical, ratios = identify(case, systems, seed)
    hits, nees, error = {}, np.empty(0), {}
    if truth:
        means, covs = (np.array([getattr(b, f"coefficients_{part}") for b in beliefs]) for part in ("mean", "cov"))
        hits, nees = _judge(means, covs, truth)
    if physical:
        means, covs = (np.array(moments) for moments in zip(*(b.physical() for b in beliefs), strict=True))
        found, nees_of_these = _judge(means, covs, physical)
        hits |= found
        nees = nees_of_these if case.population == "track" else nees
        true = np.column_stack(list(physical.values()))
        error = dict(zip(physical, np.median(np.abs(means / true - 1), axis=0).tolist(), strict=True))
    return Coverage(
        kept=len(beliefs),
        hits=hits,
        nees=float(np.mean(nees)),
        nees_quantiles=_quantiles(nees, 0.5, 0.99, 1.0),
        gamma=_quantiles([b.gamma_mean * case.process_noise**2 for b in beliefs], 0.05, 0.5, 0.95),
        xi=_quantiles([b.xi_mean * case.measurement_noise**2 for b in beliefs], 0.05, 0.5, 0.95),
        ratio_std=float(np.median(ratios)) if ratios else None,
        error=error,
    )


#: Beliefs, true coefficients and true m, c, a, b by name, and standard deviations of log(σ_w/σ_v) of an ensemble.
Identified = tuple[list[Belief], dict[str, FloatArray], dict[str, FloatArray], list[float]]


def _identify(case: Case, systems: int, seed: int) -> Identified:
    """Draw systems of a population, and identify each from its record."""
    noises = case.process_noise, case.measurement_noise
    rng = np.random.default_rng([seed, NOISES.index(noises) if noises in NOISES else len(NOISES), case.samples])
    drawn = draw(case.population, systems, *noises, case.samples, rng, case.spread)
    prior = make_prior(case.population, *case.noise_centers, NOISE_SHAPE, case.spread)
    model, rig = make_model(case.population), make_rig(case.population)
    beliefs, ratios, kept = [], [], np.flatnonzero(drawn.stayed)
    for i in kept:
        estimator = OnlineEstimator(
            model, prior, rig, factorisation=case.factorisation, noise_hypotheses=case.hypotheses,
            expectations=case.expectations,
        )  # fmt: skip
        estimator.run(drawn.u[i], drawn.y[i])
        beliefs.append(estimator.belief)
        if case.hypotheses > 1:
            ratios.append(estimator.noise_ratio.std)
    truth = dict(zip(names_of(case.population), drawn.truth[kept].T, strict=True))
    physical = {} if drawn.physical is None else dict(zip("mcab", drawn.physical[kept].T, strict=True))
    return beliefs, truth, physical, ratios


def _identify_in_track(case: Case, systems: int, seed: int) -> Identified:
    """Let the environment identify its plants under uniform inputs; coefficients of ``nlarx`` have no truth."""
    envs = gym.make_vec(
        TRACK, num_envs=systems, vectorization_mode="vector_entry_point", copy=False, estimator=case.estimator,
        process_noise=case.process_noise, measurement_noise=case.measurement_noise, horizon=case.samples,
        max_output=NO_LIMIT, noise_range=1.0, noise_hypotheses=1,
    )  # fmt: skip
    assert isinstance(envs, ContinuousVectorEnv)
    envs.reset(seed=seed)
    rng = np.random.default_rng([seed, case.samples])
    for _ in range(case.samples):
        envs.step(rng.uniform(-1, 1, (systems, 1)).astype(np.float32))
    beliefs = [envs.belief(row) for row in range(systems)]
    physical = {name: np.asarray(getattr(envs.truth, name)) for name in duffing().physical}
    truth = {}
    if case.estimator == "ode":
        columns = coefficients_of(duffing(), physical, beliefs[0].scales).T
        truth = dict(zip(duffing().coefficients, columns, strict=True))
    return beliefs, truth, physical, []


def _judge(means: FloatArray, covs: FloatArray, truth: dict[str, FloatArray]) -> tuple[dict[str, int], FloatArray]:
    """Intervals that hold the truth by name, and (N,) dᵀ P⁻¹ d / K, from means (N, K) and covs (N, K, K)."""
    std = np.sqrt(np.diagonal(covs, axis1=1, axis2=2))
    errors = (np.column_stack(list(truth.values())) - means) / std
    units = covs / (std[:, :, None] * std[:, None, :])  # well conditioned: the scales of P are up to ten orders apart
    nees = np.einsum("ni,ni->n", errors, np.linalg.solve(units, errors[..., None])[..., 0]) / len(truth)
    return dict(zip(truth, (np.abs(errors) <= QUANTILE).sum(axis=0).tolist(), strict=True)), nees


def _quantiles(values: Any, low: float, middle: float, high: float) -> tuple[float, float, float]:
    a, b, c = np.quantile(values, [low, middle, high]).tolist()
    return a, b, c


def wilson(hits: int, trials: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a proportion with ``hits`` in ``trials``."""
    interval = binomtest(hits, trials).proportion_ci(0.95, method="wilson")
    return float(interval.low), float(interval.high)


def cells(case: Case, found: Coverage) -> dict[str, str]:
    """Cells of a row by the titles of their columns."""
    row = {"σ_w [V]": f"{case.process_noise:g}", "σ_v [V]": f"{case.measurement_noise:g}", "T": str(case.samples)}
    if case.population == "wide":
        row = {"expectations": case.expectations, "T": str(case.samples)}
    row["kept"] = str(found.kept)
    row |= {name: f"{hits / found.kept:.2f}" for name, hits in found.hits.items()}
    row["NEES/K"] = f"{found.nees:.3g}"
    if case.population == "wide":
        row |= {name: f"{v:.3g}" for name, v in zip(("median", "99 %", "largest"), found.nees_quantiles, strict=True)}
    row |= {"E[γ]/γ": f"{found.gamma[1]:.3g}", "E[ξ]/ξ": f"{found.xi[1]:.3g}"}
    if case.population == "track":
        row |= {f"{name}, %": f"{100 * error:.2g}" for name, error in found.error.items()}
    return row


def noise_cells(case: Case, found: Coverage) -> tuple[str, ...]:
    """Cells of a row in an ensemble's table of noises."""
    (low, gamma, high), (least, xi, most) = found.gamma, found.xi
    noises = (f"{value:.2g}" for value in (gamma, low, high, xi, least, most))
    return (f"{case.process_noise:g}", f"{case.measurement_noise:g}", str(case.samples), *noises,
            f"{found.ratio_std:.2f}")  # fmt: skip


#: Titles of an ensemble's table of noises.
_NOISES = ("σ_w [V]", "σ_v [V]", "T", "E[γ]/γ", "5 %", "95 %", "E[ξ]/ξ", "5 %", "95 %", "std of log(σ_w/σ_v)")


def main(config: Config) -> None:
    """Evaluate and print the tables; write them into the file, if one is given, with Wilson's 95 % intervals."""
    from rich.progress import track

    results = {}
    for title, cases in tables().items():
        if not title.startswith(config.only):
            continue
        found = [evaluate(case, config.systems, config.seed) for case in track(cases, description=title)]
        rows = [cells(case, one) for case, one in zip(cases, found, strict=True)]
        print_texts_and_tables(
            f"\n{title}", format_table(list(rows[0]), [list(row.values()) for row in rows], markdown=True)
        )
        if cases[0].hypotheses > 1:
            noises = [noise_cells(case, one) for case, one in zip(cases, found, strict=True)]
            print_texts_and_tables(format_table(_NOISES, noises, markdown=True))
        results[title] = [
            dataclasses.asdict(case) | dataclasses.asdict(one)
            | {"wilson": {name: wilson(hits, one.kept) for name, hits in one.hits.items()}}
            for case, one in zip(cases, found, strict=True)
        ]  # fmt: skip
    if config.json is not None:
        write_json(config.json, results)


if __name__ == "__main__":
    from agents.cli import run_script

    run_script(main, Config, __doc__ or "")
