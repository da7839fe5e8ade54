"""Coverage: how often the posterior's 90 % intervals hold the truth, on systems drawn from the prior.

``python -m benchmarks.coverage`` prints the tables of docs/coverage.md.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest, norm

from benchmarks.systems import draw, make_model, make_prior, make_rig
from estimator import OnlineEstimator
from estimator.belief import Belief
from estimator.files import write_atomically

LEVEL = 0.90
NOISE_SHAPE = 2.0  # of both Gamma priors: weak
HYPOTHESES = 9  # noise ratios of an ensemble

NOISES = ((2e-3, 1e-3), (2e-3, 1e-4), (5e-4, 5e-4), (1e-4, 3e-4))
LENGTHS = (256, 2048)
# Where tables centre the noise priors wrongly: at these multiples of the true process and measurement noise, or both at
# one value.
FACTORS = ((3.0, 3.0), (1 / 3, 1 / 3), (2.0, 1 / 4))
EQUAL_CENTER = 5e-4  # V

QUANTILE = float(norm.ppf(0.5 + LEVEL / 2))


@dataclass(frozen=True)
class Case:
    """What one row of a table tests.

    Attributes:
        factorisation: of the estimator, ``structured`` or ``mean_field``.
        process_noise: standard deviation of w̃ on the displacement [V].
        measurement_noise: standard deviation of v [V].
        samples: length of each record.
        noise_centers: standard deviations [V] at which the priors of γ and of ξ are centred.
        model: one of `benchmarks.systems.MODELS`.
        hypotheses: noise ratios that the estimator weighs.
    """

    factorisation: str
    process_noise: float
    measurement_noise: float
    samples: int
    noise_centers: tuple[float, float]
    model: str = "paper"
    hypotheses: int = 1

    def prior(self) -> Belief:
        """The prior that describes the population, with a weak noise prior."""
        return make_prior(self.model, *self.noise_centers, NOISE_SHAPE)


@dataclass(frozen=True)
class Coverage:
    """What came out.

    Attributes:
        kept: systems whose displacement stayed in range; the others are left out.
        hits: of the kept, those whose interval holds the truth, for each coefficient (and m, c, a, b for ``paper``).
        nees: mean over systems of dᵀ P⁻¹ d / K with d the error of the K coefficients and P its posterior covariance; 1
            where the posterior is calibrated.
        gamma, xi: median of E[γ] and of E[ξ], divided by the true precision.
        gamma_range, xi_range: 5 % and 95 % quantiles of the same.
        ratio_std: median standard deviation of log(σ_w/σ_v), for an ensemble.
    """

    kept: int
    hits: dict[str, int]
    nees: float
    gamma: float
    xi: float
    gamma_range: tuple[float, float]
    xi_range: tuple[float, float]
    ratio_std: float | None


@dataclass(frozen=True)
class Config:
    """Coverage of the 90 % intervals.

    Attributes:
        systems: oscillators simulated for each row.
        only: beginnings of the titles of the tables to make; all without.
        seed: of all draws.
        json: file to write the results to, too.
    """

    systems: int = 500
    only: tuple[str, ...] = ("",)
    seed: int = 0
    json: Path | None = None


def tables() -> dict[str, list[Case]]:
    """The cases of each table, by its title."""
    settings = [(*noises, samples) for noises in NOISES for samples in LENGTHS]
    equal = (EQUAL_CENTER, EQUAL_CENTER)
    right = [Case("structured", w, v, samples, (w, v)) for w, v, samples in settings]
    wrong = {
        f"noise priors centred at {a:.3g} σ_w and {b:.3g} σ_v": [
            Case("structured", w, v, samples, (a * w, b * v)) for w, v, samples in settings
        ]
        for a, b in FACTORS
    }
    wrong[f"noise priors centred at {EQUAL_CENTER:g} V"] = [
        Case("structured", w, v, samples, equal) for w, v, samples in settings if (w, v) != equal
    ]
    alone_and_ensemble = {}
    for title, cases in wrong.items():
        alone_and_ensemble[f"structured, {title}"] = cases
        alone_and_ensemble[f"ensemble, {title}"] = _with(cases, hypotheses=HYPOTHESES)
    return {
        "structured": right,
        "mean field": _with(right, factorisation="mean_field"),
        **{name: _with(right, model=name) for name in ("offset", "three-tap", "cubic", "ode")},
        "ensemble": _with(right, hypotheses=HYPOTHESES),
        **alone_and_ensemble,
    }


def _with(cases: list[Case], **changes: Any) -> list[Case]:
    return [dataclasses.replace(case, **changes) for case in cases]


def evaluate(case: Case, systems: int, rng: np.random.Generator) -> Coverage:
    """Draw systems, identify each, and compare its posterior with the truth."""
    drawn = draw(case.model, systems, case.process_noise, case.measurement_noise, case.samples, rng)
    model, prior, rig = make_model(case.model), case.prior(), make_rig(case.model)
    kept = np.flatnonzero(drawn.stayed)
    hits, nees, gamma, xi, ratio = [], [], [], [], []
    for i in kept:
        estimator = OnlineEstimator(
            model, prior, rig, factorisation=case.factorisation, noise_hypotheses=case.hypotheses
        )
        estimator.run(drawn.u[i], drawn.y[i])
        belief = estimator.belief
        mean, cov = belief.coefficients_mean, belief.coefficients_cov
        std, error = np.sqrt(np.diag(cov)), drawn.truth[i, : len(mean)] - mean
        nees.append((error / std) @ np.linalg.solve(cov / np.outer(std, std), error / std) / len(std))
        if case.model == "paper":
            physical_mean, physical_cov = belief.physical()
            error = np.concatenate([error, drawn.truth[i, len(mean) :] - physical_mean])
            std = np.concatenate([std, np.sqrt(np.diag(physical_cov))])
        hits.append(np.abs(error) <= QUANTILE * std)
        gamma.append(belief.gamma_mean * case.process_noise**2)
        xi.append(belief.xi_mean * case.measurement_noise**2)
        if case.hypotheses > 1:
            ratio.append(estimator.noise_ratio.std)
    return Coverage(
        kept=len(kept),
        hits=dict(zip(drawn.names, np.sum(hits, axis=0).tolist(), strict=True)),
        nees=float(np.mean(nees)),
        gamma=float(np.median(gamma)),
        xi=float(np.median(xi)),
        gamma_range=_range(gamma),
        xi_range=_range(xi),
        ratio_std=float(np.median(ratio)) if ratio else None,
    )


def _range(values: list[float]) -> tuple[float, float]:
    low, high = np.quantile(values, [0.05, 0.95])
    return float(low), float(high)


def wilson(hits: int, trials: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a proportion, of which ``hits`` of ``trials`` were seen."""
    interval = binomtest(hits, trials).proportion_ci(0.95, method="wilson")
    return float(interval.low), float(interval.high)


def run(config: Config) -> dict[str, list[tuple[Case, Coverage]]]:
    """Evaluate all tables, and print each. Cases of one model, noise pair and length share their systems and data."""
    from rich.progress import track

    results: dict[str, list[tuple[Case, Coverage]]] = {}
    chosen = {title: cases for title, cases in tables().items() if title.startswith(config.only)}
    for title, cases in chosen.items():
        rows = []
        for case in track(cases, description=f"Identifying: {title}"):
            setting = (NOISES.index((case.process_noise, case.measurement_noise)), case.samples)
            rows.append((case, evaluate(case, config.systems, np.random.default_rng([config.seed, *setting]))))
        results[title] = rows
        show(title, rows)
    return results


def show(title: str, rows: list[tuple[Case, Coverage]]) -> None:
    """Print a table, in the format of docs/coverage.md; and for an ensemble one of the noises."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    console = Console(width=160)
    console.print(f"\n{title}")
    table = Table(*_HEADER, *rows[0][1].hits, "NEES/K", "E[γ]/γ", "E[ξ]/ξ", box=box.MARKDOWN)
    for case, coverage in rows:
        table.add_row(*_cells(case, coverage))
    console.print(table)
    if rows[0][0].hypotheses > 1:
        noises = Table(*_NOISE_HEADER, box=box.MARKDOWN)
        for case, coverage in rows:
            noises.add_row(*_noise_cells(case, coverage))
        console.print(noises)


_HEADER = ("σ_w [V]", "σ_v [V]", "T", "kept")
_NOISE_HEADER = (*_HEADER[:3], "E[γ]/γ", "5 %", "95 %", "E[ξ]/ξ", "5 %", "95 %", "std of log(σ_w/σ_v)")


def _cells(case: Case, coverage: Coverage) -> Iterator[str]:
    yield from (f"{case.process_noise:g}", f"{case.measurement_noise:g}", str(case.samples), str(coverage.kept))
    for hits in coverage.hits.values():
        yield f"{hits / coverage.kept:.2f}"
    yield from (f"{value:.3g}" for value in (coverage.nees, coverage.gamma, coverage.xi))


def _noise_cells(case: Case, coverage: Coverage) -> Iterator[str]:
    yield from (f"{case.process_noise:g}", f"{case.measurement_noise:g}", str(case.samples))
    for median, around in ((coverage.gamma, coverage.gamma_range), (coverage.xi, coverage.xi_range)):
        yield from (f"{value:.2g}" for value in (median, *around))
    yield f"{coverage.ratio_std:.2f}"


def write(results: dict[str, list[tuple[Case, Coverage]]], path: Path) -> None:
    """Write the results as JSON, with Wilson's 95 % interval of every coverage."""
    tables = {
        title: [
            dataclasses.asdict(case)
            | dataclasses.asdict(coverage)
            | {"wilson": {name: wilson(hits, coverage.kept) for name, hits in coverage.hits.items()}}
            for case, coverage in rows
        ]
        for title, rows in results.items()
    }
    write_atomically(path, json.dumps(tables, ensure_ascii=False, indent=1) + "\n")


def main(config: Config) -> None:
    """Evaluate, print, and write where a file is named."""
    results = run(config)
    if config.json is not None:
        write(results, config.json)


if __name__ == "__main__":
    import tyro

    main(tyro.cli(Config))
