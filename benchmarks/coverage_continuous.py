"""Coverage on Continuous-v0: of its own equation's estimator, and of the paper's difference equation on the same plant.

``python -m benchmarks.coverage_continuous`` prints the tables of docs/continuous.md.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import gymnasium as gym
import numpy as np

from benchmarks.coverage import LENGTHS, NOISES, QUANTILE, wilson
from duffing_env.vector_env import ContinuousVectorEnv
from estimator.files import write_atomically
from estimator.models.duffing import duffing
from estimator.parameters import FloatArray
from estimator.physical import coefficients_of

TRACK = "duffing_env/Continuous-v0"
NO_LIMIT = 1e3  # V
ESTIMATORS = ("ode", "nlarx")
COEFFICIENTS = tuple(duffing().coefficients)
PHYSICAL = tuple(duffing().physical)


@dataclass(frozen=True)
class Coverage:
    """What came out for one estimator, noise pair and length.

    Attributes:
        estimator: ``ode`` or ``nlarx``, structured.
        process_noise: standard deviation of what a sample's process noise does to x [V].
        measurement_noise: standard deviation of v [V].
        samples: length of each record.
        systems: their number.
        hits: of them, those whose 90 % interval holds the truth: of the equation's four parameters, and m, c, a, b. Of
            ``nlarx`` the latter only, as its coefficients have no truth.
        nees: mean over systems of dᵀ P⁻¹ d / 4, d the error of (m, c, a, b) and P its covariance, to first order.
        error: median over systems of |estimate / truth - 1|, by parameter m, c, a, b.
        gamma, xi: median of E[γ] and of E[ξ], divided by the true precision.
    """

    estimator: str
    process_noise: float
    measurement_noise: float
    samples: int
    systems: int
    hits: dict[str, int]
    nees: float
    error: dict[str, float]
    gamma: float
    xi: float


@dataclass(frozen=True)
class Config:
    """Coverage of the 90 % intervals on Continuous-v0.

    Attributes:
        systems: oscillators simulated for each row.
        seed: of oscillators, noise and inputs, which are those of both estimators.
        json: file to write the results to, too.
    """

    systems: int = 500
    seed: int = 0
    json: Path | None = None


def evaluate(
    estimator: str, process_noise: float, measurement_noise: float, samples: int, systems: int, seed: int
) -> Coverage:
    """Identify systems from uniform inputs, and compare their posteriors with the truth."""
    envs = gym.make_vec(
        TRACK, num_envs=systems, vectorization_mode="vector_entry_point", copy=False, estimator=estimator,
        process_noise=process_noise, measurement_noise=measurement_noise, horizon=samples, max_output=NO_LIMIT,
    )  # fmt: skip
    assert isinstance(envs, ContinuousVectorEnv)
    envs.reset(seed=seed)
    rng = np.random.default_rng([seed, samples])
    for _ in range(samples):
        envs.step(rng.uniform(-1, 1, (systems, 1)).astype(np.float32))
    truth = envs.truth
    physical = np.stack([getattr(truth, name) for name in PHYSICAL], axis=-1)
    beliefs = [envs.belief(row) for row in range(systems)]
    estimates, covariances = (np.array(moments) for moments in zip(*(b.physical() for b in beliefs), strict=True))
    hits = _hits(PHYSICAL, estimates, covariances, physical)
    if estimator == "ode":
        means = np.array([belief.coefficients_mean for belief in beliefs])
        covs = np.array([belief.coefficients_cov for belief in beliefs])
        known = dict(zip(PHYSICAL, physical.T, strict=True))
        hits = _hits(COEFFICIENTS, means, covs, coefficients_of(duffing(), known, beliefs[0].step)) | hits
    # Relative to the truth, because the scales of m, c, a and b are ten orders apart.
    error = estimates / physical - 1
    relative = covariances / (physical[:, :, None] * physical[:, None, :])
    return Coverage(
        estimator, process_noise, measurement_noise, samples, systems, hits,
        nees=float(np.einsum("ni,ni->", error, np.linalg.solve(relative, error[..., None])[..., 0]) / (4 * systems)),
        error=dict(zip(PHYSICAL, np.median(np.abs(error), axis=0).tolist(), strict=True)),
        gamma=float(np.median([belief.gamma_mean for belief in beliefs]) * process_noise**2),
        xi=float(np.median([belief.xi_mean for belief in beliefs]) * measurement_noise**2),
    )  # fmt: skip


def _hits(names: tuple[str, ...], means: FloatArray, covs: FloatArray, truth: FloatArray) -> dict[str, int]:
    inside = np.abs(means - truth) <= QUANTILE * np.sqrt(np.diagonal(covs, axis1=-2, axis2=-1))
    return dict(zip(names, inside.sum(axis=0).tolist(), strict=True))


def run(config: Config) -> dict[str, list[Coverage]]:
    """All rows, by estimator."""
    settings = [(*noises, samples) for noises in NOISES for samples in LENGTHS]
    return {
        estimator: [evaluate(estimator, *setting, config.systems, config.seed) for setting in settings]
        for estimator in ESTIMATORS
    }


def show(results: dict[str, list[Coverage]]) -> None:
    """Print the tables, in the format of docs/continuous.md."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    console = Console(width=160)
    for estimator, rows in results.items():
        console.print(f"\n{estimator}")
        errors = (f"{name}, %" for name in PHYSICAL)
        table = Table("σ_w [V]", "σ_v [V]", "T", *rows[0].hits, "NEES/4", "E[γ]/γ", "E[ξ]/ξ", *errors, box=box.MARKDOWN)
        for row in rows:
            table.add_row(*_cells(row))
        console.print(table)


def _cells(row: Coverage) -> Iterator[str]:
    yield from (f"{row.process_noise:g}", f"{row.measurement_noise:g}", str(row.samples))
    yield from (f"{hits / row.systems:.2f}" for hits in row.hits.values())
    yield from (f"{value:.3g}" for value in (row.nees, row.gamma, row.xi))
    yield from (f"{100 * value:.2g}" for value in row.error.values())


def write(results: dict[str, list[Coverage]], path: Path) -> None:
    """Write the results as JSON, with Wilson's 95 % interval of every coverage."""
    rows = {
        estimator: [
            dataclasses.asdict(row) | {"wilson": {name: wilson(hits, row.systems) for name, hits in row.hits.items()}}
            for row in rows
        ]
        for estimator, rows in results.items()
    }
    write_atomically(path, json.dumps(rows, ensure_ascii=False, indent=1) + "\n")


def main(config: Config) -> None:
    """Evaluate, print, and write where a file is named."""
    results = run(config)
    show(results)
    if config.json is not None:
        write(results, config.json)


if __name__ == "__main__":
    import tyro

    main(tyro.cli(Config))
