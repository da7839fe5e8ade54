"""Posterior over coefficients and the ratio of process noise to sensor noise, on a refined grid."""

from __future__ import annotations

import numpy as np

from estimator.identification.fitting.search_result import SearchResult
from estimator.identification.likelihood.fit_hypothesis import FitHypothesis, with_noise_ratios
from estimator.identification.likelihood.laplace_fit import LaplaceFitter
from estimator.inference.noise_grid import neg_log_half_cauchy
from estimator.support.array_types import FloatArray

#: Ratios in a grid.
_RATIO_GRID_POINTS = 8

#: Standard deviations of the log ratio that the last grid reaches, either way.
_GRID_REACH_STDS = 3.0

#: Free energy by which the ends of a grid are worse than its best, at least [nats].
_MIN_EDGE_NATS = 2.0

#: Smallest ratio, in units of the squared angular frequency.
_MIN_NOISE_RATIO = 1e-5

#: Largest ratio, in the same units.
_MAX_NOISE_RATIO = 1e4


def fit_noise_ratio(
    fitter: LaplaceFitter,
    hypothesis: FitHypothesis,
    initial_coefficients: FloatArray,
    sensor_std: float,
    ratio_reach: float,
) -> SearchResult:
    """The posterior over coefficients and noises, for one hypothesis about all else.

    A grid of noise ratios about the best is narrowed until it is finer than the posterior. Where the records do not
    distinguish σ_w or σ_v from 0, the prior decides: a half-Cauchy density of the ratio (Gelman 2006), scaled to the
    ratio at which both noises have the same effect on the output. A density that is flat in the logarithm would hold
    one of the noises for 0.

    Args:
        fitter: fitter of the records.
        hypothesis: the hypothesis, with the ratio to start from.
        initial_coefficients: (K,) coefficients to start from.
        sensor_std: σ_v to start from.
        ratio_reach: factor of the ratio, either way, that the first grid spans.

    Raises:
        ValueError: where every fit diverges.
    """
    unit = fitter.problem.mean_frequency ** (2 - fitter.problem.scales.order)
    bounds = np.log([_MIN_NOISE_RATIO * unit, _MAX_NOISE_RATIO * unit])
    width, middle = np.log(ratio_reach), np.log(hypothesis.noise_ratio)
    for _ in range(12):
        logs = np.clip(middle + np.linspace(-width, width, _RATIO_GRID_POINTS), *bounds)
        fits = fitter.fit(with_noise_ratios(hypothesis, np.exp(logs)), initial_coefficients, sensor_std)
        if not np.isfinite(fits.free_energy).any():
            raise ValueError(
                "records must keep the fit finite, but it diverged; check units and the sampling step, and add noise "
                "to a simulated record, at least 1e-8 of its size"
            )
        log_ratios_from_unit = logs - np.log(unit)
        energies = fits.free_energy + neg_log_half_cauchy(log_ratios_from_unit)
        best = int(np.argmin(energies))
        initial_coefficients, sensor_std = fits.mean[best], float(fits.sensor_std[best])
        excess_energies = energies - energies[best]
        weights = np.exp(-excess_energies) / np.exp(-excess_energies).sum()
        middle, std = _parabola_moments(logs, excess_energies, best)
        if (excess_energies[[0, -1]] < _MIN_EDGE_NATS)[logs[[0, -1]] != bounds].any():
            width *= 1.5
            continue
        spread = np.sqrt(weights @ (logs - weights @ logs) ** 2)
        if spread > 0.8 * (logs[-1] - logs[0]) / (_RATIO_GRID_POINTS - 1) or width < 0.02:
            break
        width = np.clip(_GRID_REACH_STDS * std, width / 40, width / 2)
    has_weight = weights > 1e-6
    return SearchResult(fits.select(has_weight), weights[has_weight] / weights[has_weight].sum(), fitter)


def _parabola_moments(places: FloatArray, energies: FloatArray, best: int) -> tuple[float, float]:
    """Mean and standard deviation of the Gaussian whose free energy is the parabola through the best three points."""
    if not 0 < best < len(places) - 1:
        return float(places[best]), np.inf
    left, right = places[best] - places[best - 1], places[best + 1] - places[best]
    if not left > 0 < right:
        return float(places[best]), np.inf
    before, after = (energies[best] - energies[best - 1]) / left, (energies[best + 1] - energies[best]) / right
    curvature = 2 * (after - before) / (left + right)
    if not 0 < curvature < np.inf:
        return float(places[best]), np.inf
    slope = (before * right + after * left) / (left + right)
    return float(places[best] - slope / curvature), float(1 / np.sqrt(curvature))
