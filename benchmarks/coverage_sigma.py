"""Coverage of the physical equation: expectations to first order against sigma points, on the same oscillators.

``python -m benchmarks.coverage_sigma`` prints the tables of docs/estimators.md.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from benchmarks.coverage import LENGTHS, QUANTILE
from duffing_env.silverbox import synthesise_multisine
from estimator import SAMPLING_STEP, OnlineEstimator, Rig, duffing, recorded_prior
from estimator.belief import Belief
from estimator.parameters import FloatArray
from estimator.physical import coefficients_of
from estimator.settings import EXPECTATIONS

LEAST = 0.1  # of their means: stiffness, damping, gain and cubic stiffness are drawn again where one is below
PROCESS_NOISE = 5e-6  # V
MEASUREMENT_NOISE = 3e-4  # V
CENTERS = (3e-4, 1e-3)  # V, of the measurement noise's prior: the truth, and what `recorded_prior` has
AMPLIFICATION = 3  # of the Silverbox's excitation
SUBSTEPS = 12

#: The model, and its rig.
MODEL = duffing(offsets=True, feedthrough=True, noise="held")
RIG = Rig.silverbox("linear")

#: What is drawn as the prior has it, in this order: per sample, but for the offsets [V].
NAMES = ("stiffness", "damping", "gain", "cubic", "input_offset", "output_offset", "feedthrough")
SHOWN = ("a/m", "c/m", "1/m", "b/m", "force", "y0", "d")


@dataclass(frozen=True)
class Config:
    """Coverage of the 90 % intervals of `duffing`, by expectations.

    Attributes:
        systems: oscillators simulated for each length.
        spread: relative standard deviation of stiffness, damping, gain and cubic stiffness, in truth and in the prior.
        seed: of all draws.
    """

    systems: int = 500
    spread: float = 0.3
    seed: int = 0


def draw(spread: float, systems: int, rng: np.random.Generator) -> FloatArray:
    """Parameters (systems, 7) in the order of `NAMES`; those whose first four are not all well above 0 again."""
    prior = recorded_prior(MODEL, spread)
    found = prior.coefficients()
    mean = np.array([found[name][0] for name in NAMES[:4]] + [0.0] * 3)
    std = np.array([found[name][1] for name in NAMES[:4]] + [0.02, 0.02, 0.1])
    truth = mean + std * rng.standard_normal((systems, len(mean)))
    while (low := (truth[:, :4] < LEAST * mean[:4]).any(axis=1)).any():
        truth[low] = mean + std * rng.standard_normal((low.sum(), len(mean)))
    return truth


def as_coefficients(truth: FloatArray) -> FloatArray:
    """(N, 7) of the model."""
    k, c, g, b, u0, y0, d = truth.T
    values = {"m": SAMPLING_STEP**2 / g, "c": SAMPLING_STEP * c / g, "a": k / g, "b": b / g}
    return coefficients_of(MODEL, {**values, "u0": u0, "y0": y0, "d": d})


def simulate(truth: FloatArray, samples: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Simulate oscillators from rest a sample before the first, each with its own multisine, linear between samples.

    By Runge-Kutta steps of a twelfth of a sample, which share nothing with the estimator.

    Args:
        truth: parameters (N, 7), in the order of `NAMES`.
        samples: number of samples T.
        rng: draws inputs and noises.

    Returns:
        Inputs and outputs (N, T) [V].
    """
    k, c, g, b, u0, y0, d = truth.T
    systems = len(truth)
    u = np.array([AMPLIFICATION * synthesise_multisine(rng, 1)[500 : 500 + samples] for _ in range(systems)])
    y = u * d[:, None] + MEASUREMENT_NOISE * rng.standard_normal(u.shape)
    w = PROCESS_NOISE * rng.standard_normal(u.shape)  # a force over a sample, which alone moves x by w
    h = 1 / SUBSTEPS
    x, v = np.zeros((2, systems))

    def acceleration(x: FloatArray, v: FloatArray, force: FloatArray) -> FloatArray:
        return g * (force - u0) - c * v - k * x - b * x**3

    for t in range(samples):
        start, stop = u[:, t - 1] if t else 0 * u[:, 0], u[:, t]
        push = 2 * w[:, t] / g
        for i in range(SUBSTEPS):
            f1, f2, f3 = (start + (stop - start) * (i + part) / SUBSTEPS + push for part in (0.0, 0.5, 1.0))
            a1 = acceleration(x, v, f1)
            v2 = v + h / 2 * a1
            a2 = acceleration(x + h / 2 * v, v2, f2)
            v3 = v + h / 2 * a2
            a3 = acceleration(x + h / 2 * v2, v3, f2)
            v4 = v + h * a3
            a4 = acceleration(x + h * v3, v4, f3)
            x = x + h / 6 * (v + 2 * v2 + 2 * v3 + v4)
            v = v + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
        y[:, t] += x + y0
    return u, y


def errors(
    prior: Belief, expectations: str, truth: FloatArray, u: FloatArray, y: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Identify each oscillator.

    Returns:
        Errors of the seven coefficients in posterior standard deviations (N, 7), in the order of `SHOWN`, and
        dᵀ P⁻¹ d / 7 (N,) with d these errors and P their posterior covariance.
    """
    order = [list(MODEL.coefficients).index(name) for name in (*NAMES[:4], "force", *NAMES[5:])]
    normalised, nees, true = np.empty((len(truth), 7)), np.empty(len(truth)), as_coefficients(truth)
    for i in range(len(truth)):
        estimator = OnlineEstimator(prior.model, prior, RIG, expectations=expectations)
        estimator.run(u[i], y[i])
        belief = estimator.belief
        cov = belief.coefficients_cov[np.ix_(order, order)]
        std = np.sqrt(np.diag(cov))
        normalised[i] = (belief.coefficients_mean - true[i])[order] / std
        nees[i] = normalised[i] @ np.linalg.solve(cov / np.outer(std, std), normalised[i]) / len(order)
    return normalised, nees


def rows(config: Config) -> Iterator[tuple[float, tuple[str, ...]]]:
    """The centre of the noise prior and the cells of each row. The rows of one length share their oscillators."""
    for center in CENTERS:
        prior = recorded_prior(MODEL, config.spread, PROCESS_NOISE, center)
        for samples in LENGTHS:
            rng = np.random.default_rng([config.seed, samples])
            truth = draw(config.spread, config.systems, rng)
            u, y = simulate(truth, samples, rng)
            for expectations in EXPECTATIONS:
                normalised, nees = errors(prior, expectations, truth, u, y)
                hits = (np.abs(normalised) <= QUANTILE).mean(axis=0)
                sizes = np.mean(nees), np.median(nees), np.quantile(nees, 0.99), np.max(nees)
                cells = (f"{hit:.2f}" for hit in hits), (f"{size:.3g}" for size in sizes)
                yield center, (expectations, str(samples), *cells[0], *cells[1])


def main(config: Config) -> None:
    """Evaluate, and print the tables in the format of the manual."""
    from rich import box
    from rich.console import Console
    from rich.progress import track
    from rich.table import Table

    header = ("expectations", "T", *SHOWN, "NEES/7", "median", "99 %", "largest")
    tables = {center: Table(*header, box=box.MARKDOWN) for center in CENTERS}
    total = len(CENTERS) * len(LENGTHS) * len(EXPECTATIONS)
    for center, cells in track(rows(config), description="Identifying", total=total):
        tables[center].add_row(*cells)
    console = Console(width=140)
    for center, table in tables.items():
        console.print(f"\nnoise prior centred at {1e3 * center:g} mV")
        console.print(table)


if __name__ == "__main__":
    import tyro

    main(tyro.cli(Config))
