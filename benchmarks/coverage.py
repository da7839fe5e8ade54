"""Coverage: how often the posterior's 90 % intervals hold the truth, on oscillators drawn from the prior.

``python -m benchmarks.coverage`` prints the tables of docs/coverage.md.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.stats import binomtest, norm

from estimator import (
    NLARX,
    SILVERBOX_TWIN,
    Belief,
    Coefficients,
    OnlineEstimator,
    PhysicalParameters,
    Prior,
    to_coefficients,
)
from estimator.files import write_atomically
from estimator.parameters import FloatArray

LEVEL = 0.90
SPREAD = 0.3  # m, c, a and b are log-uniform on the twin's value * [1 - SPREAD, 1 + SPREAD]
MAX_INPUT = 0.15  # V; inputs are independent and uniform on ± this
MAX_DISPLACEMENT = 0.75  # V; above it the difference equation blows up, where the circuit does not

NOISES = ((2e-3, 1e-3), (2e-3, 1e-4), (5e-4, 5e-4), (1e-4, 3e-4))
LENGTHS = (256, 2048)
# Where the last three tables centre the noise priors wrongly: both at a multiple of the truth, or both at one value.
FACTORS = (3.0, 1 / 3)
EQUAL_CENTER = 5e-4  # V

QUANTITIES = ("θ1", "θ2", "θ3", "η", "m", "c", "a", "b")
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
    """

    factorisation: str
    process_noise: float
    measurement_noise: float
    samples: int
    noise_centers: tuple[float, float]

    def prior(self) -> Prior:
        """The prior of the environments, with a weak noise prior (shape 2)."""
        return Prior.silverbox_twin(
            spread=SPREAD,
            process_noise=self.noise_centers[0],
            measurement_noise=self.noise_centers[1],
            noise_shape=2.0,
        )


@dataclass(frozen=True)
class Coverage:
    """What came out.

    Attributes:
        kept: systems whose displacement stayed below `MAX_DISPLACEMENT`; the others are left out.
        hits: of the kept, those whose interval holds the truth, for each of `QUANTITIES`.
        nees: mean over systems of dᵀ P⁻¹ d / 4 with d the error of (θ, η) and P its posterior covariance; 1 where the
            posterior is calibrated.
        gamma, xi: median of E[γ] and of E[ξ], divided by the true precision.
    """

    kept: int
    hits: dict[str, int]
    nees: float
    gamma: float
    xi: float


@dataclass(frozen=True)
class Config:
    """Coverage of the 90 % intervals.

    Attributes:
        systems: oscillators simulated for each row.
        seed: of all draws.
        json: file to write the results to, too.
    """

    systems: int = 500
    seed: int = 0
    json: Path | None = None


def tables() -> dict[str, list[Case]]:
    """The cases of each table, by its title."""
    settings = [(*noises, samples) for noises in NOISES for samples in LENGTHS]
    equal = (EQUAL_CENTER, EQUAL_CENTER)
    scaled = {
        f"structured, both noise priors centred at {factor:.3g} times the truth": [
            Case("structured", w, v, samples, (factor * w, factor * v)) for w, v, samples in settings
        ]
        for factor in FACTORS
    }
    return {
        "structured": [Case("structured", w, v, samples, (w, v)) for w, v, samples in settings],
        "mean field": [Case("mean_field", w, v, samples, (w, v)) for w, v, samples in settings],
        **scaled,
        f"structured, both noise priors centred at {EQUAL_CENTER:g} V": [
            Case("structured", w, v, samples, equal) for w, v, samples in settings if (w, v) != equal
        ],
    }


def simulate(
    psi: Coefficients, process_noise: float, measurement_noise: float, samples: int, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray, np.ndarray]:
    """Simulate a batch of difference equations from rest, Eq. (2), each with its own input.

    Args:
        psi: coefficients of N systems, of shape (N,).
        process_noise: standard deviation of w̃ [V].
        measurement_noise: standard deviation of v [V].
        samples: number of samples T.
        rng: draws inputs and noises.

    Returns:
        Inputs and outputs (N, T), where ``u[:, t]`` leads to ``y[:, t]``, and whether the displacement stayed below
        `MAX_DISPLACEMENT` (N,).
    """
    shape = (np.size(psi.eta), samples)
    u = rng.uniform(-MAX_INPUT, MAX_INPUT, shape)
    w = process_noise * rng.standard_normal(shape)
    y = measurement_noise * rng.standard_normal(shape)
    stayed = np.ones(shape[0], dtype=bool)
    x = x_last = np.zeros(shape[0])
    for t in range(samples):
        x, x_last = psi.theta1 * x + psi.theta2 * x**3 + psi.theta3 * x_last + psi.eta * u[:, t] + w[:, t], x
        stayed &= np.abs(x) < MAX_DISPLACEMENT
        x = np.where(stayed, x, 0.0)  # so that those that left do not overflow
        y[:, t] += x
    return u, y, stayed


def evaluate(case: Case, systems: int, rng: np.random.Generator) -> Coverage:
    """Draw systems, identify each, and compare its posterior with the truth."""
    low, high = np.log(1 - SPREAD), np.log(1 + SPREAD)
    center = np.array([SILVERBOX_TWIN.m, SILVERBOX_TWIN.c, SILVERBOX_TWIN.a, SILVERBOX_TWIN.b])
    physical = center * np.exp(rng.uniform(low, high, (systems, 4)))
    psi = to_coefficients(PhysicalParameters(*physical.T))
    truth = np.column_stack([psi.theta1, psi.theta2, psi.theta3, psi.eta, physical])
    u, y, stayed = simulate(psi, case.process_noise, case.measurement_noise, case.samples, rng)

    prior = case.prior()
    kept = np.flatnonzero(stayed)
    hits = np.zeros((len(kept), len(QUANTITIES)), dtype=bool)
    nees, gamma, xi = np.empty((3, len(kept)))
    for i, system in enumerate(kept):
        estimator = OnlineEstimator(NLARX(input_delay=0), prior, case.factorisation)
        estimator.run(u[system], y[system])
        belief = estimator.belief
        assert isinstance(belief, Belief)
        physical_mean, physical_cov = belief.physical()
        error = truth[system] - np.concatenate([belief.coefficients_mean, physical_mean])
        std = np.sqrt(np.concatenate([np.diag(belief.coefficients_cov), np.diag(physical_cov)]))
        hits[i] = np.abs(error) <= QUANTILE * std
        nees[i] = error[:4] @ np.linalg.solve(belief.coefficients_cov, error[:4]) / 4
        gamma[i] = belief.gamma_mean * case.process_noise**2
        xi[i] = belief.xi_mean * case.measurement_noise**2
    return Coverage(
        kept=len(kept),
        hits=dict(zip(QUANTITIES, hits.sum(axis=0).tolist(), strict=True)),
        nees=float(nees.mean()),
        gamma=float(np.median(gamma)),
        xi=float(np.median(xi)),
    )


def wilson(hits: int, trials: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a proportion, of which ``hits`` of ``trials`` were seen."""
    interval = binomtest(hits, trials).proportion_ci(0.95, method="wilson")
    return float(interval.low), float(interval.high)


def run(config: Config) -> dict[str, list[tuple[Case, Coverage]]]:
    """Evaluate all tables. Cases of one noise pair and length share their systems and data, whatever the estimator."""
    from rich.progress import track

    all_tables = tables()
    results: dict[str, list[tuple[Case, Coverage]]] = {title: [] for title in all_tables}
    cases = [(title, case) for title, rows in all_tables.items() for case in rows]
    for title, case in track(cases, description="Identifying"):
        setting = (NOISES.index((case.process_noise, case.measurement_noise)), case.samples)
        rng = np.random.default_rng([config.seed, *setting])
        results[title].append((case, evaluate(case, config.systems, rng)))
    return results


def show(results: dict[str, list[tuple[Case, Coverage]]]) -> None:
    """Print the tables, in the format of docs/coverage.md."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    console = Console(width=140)
    for title, rows in results.items():
        console.print(f"\n{title}")
        table = Table(*_HEADER, box=box.MARKDOWN)
        for case, coverage in rows:
            table.add_row(*_cells(case, coverage))
        console.print(table)


_HEADER = ("σ_w [V]", "σ_v [V]", "T", "kept", *QUANTITIES, "NEES/4", "E[γ]/γ", "E[ξ]/ξ")


def _cells(case: Case, coverage: Coverage) -> Iterator[str]:
    yield from (f"{case.process_noise:g}", f"{case.measurement_noise:g}", str(case.samples), str(coverage.kept))
    for hits in coverage.hits.values():
        yield f"{hits / coverage.kept:.2f}"
    yield from (f"{value:.3g}" for value in (coverage.nees, coverage.gamma, coverage.xi))


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
    show(results)
    if config.json is not None:
        write(results, config.json)


if __name__ == "__main__":
    import tyro

    main(tyro.cli(Config))
