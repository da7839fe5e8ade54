"""A grid of hypotheses about the process and measurement noise variances: a mixture of structured filters.

An update depends on the noises through the innovation's variance S = s + q + r alone. With e = ν²/S - 1 it changes

    E[γ] by -e / (S (2a + 1)),   and E[ξ] by the same, if both shapes are a:

the difference E[γ] - E[ξ] stays as in the priors, and only the sum of the noises is learned. The evidence of the whole
sequence identifies the difference. So members with different priors are updated side by side, one per lane, and
weighed by their free energies, F_m of a sample for -log p(y_t | y_1 ... y_{t-1}, m):

    w_m <- (1 - ε) w_m + ε/M                       the true hypothesis may change, once in 1/ε samples
    F = -log Σ_m w_m exp(-F_m),   w_m <- w_m exp(F - F_m)        (`estimator.inference.noise_mixture.reweight`)

Several sensors share one unknown factor on their noises: their ratios stay as in the prior, and so do the ratios of
several sources of process noise (`estimator.models.noise_ratios`).

The belief has the mixture's mean and covariance of states and coefficients, and the mixture's mean and variance of the
noise variances, which act in a prediction: so a hypothesis without noise does not make a precision infinite.

If the outputs cannot distinguish σ_w or σ_v from 0, the first weights decide (`initial_weights`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimator.belief import Belief
from estimator.compilation.simd import LANES
from estimator.inference.noise_mixture import compile_mixture
from estimator.support.array_types import FloatArray

#: Largest factor between σ_w/σ_v of a hypothesis and of the prior, up or down [1].
MAX_RATIO_FACTOR = 30.0

#: Number of noise ratios; or the number of values of σ_w and of σ_v, which are combined.
NoiseGridSize = int | tuple[int, int]

#: Factor between adjacent values of a noise's standard deviation [1].
GRID_FACTOR = 3.0

#: Factors on the noises' total standard deviation [1]. A member learns its total, but slowly if both noises are alike;
#: without other totals, the evidence lost meanwhile would count against its ratio.
TOTAL_STD_FACTORS = (1 / 3, 1.0, 3.0)


@dataclass(frozen=True)
class NoiseRatio:
    """Posterior of log(σ_w/σ_v), σ_w² = 1/γ and σ_v² = 1/ξ, over the hypotheses [1].

    Attributes:
        mean: mean of the logarithm.
        std: standard deviation of the logarithm, with a part for the step of the grid. Below 0.5 the ratio of the
            precisions is known to a factor of 3; near ``prior_std`` the data has no information. A true ratio beyond
            the grid goes unnoticed.
        prior_std: standard deviation before the first sample.
    """

    mean: float
    std: float
    prior_std: float


def noise_grid(noises: FloatArray, grid_size: NoiseGridSize) -> FloatArray:
    """(members, 2 + 2 s) shapes and rates of γ and of each sensor's ξ of all hypotheses, for s sensors.

    Two numbers are for noises that may each be wrong: the numbers of values of σ_w and of σ_v, a factor of
    `GRID_FACTOR` apart about ``noises``, in all combinations. Five values reach a factor of 9, seven a factor of 27.

    One number is for noises of roughly known total: the number of ratios σ_w/σ_v, from 1/30 to 30 times the ratio of
    ``noises`` in equal logarithmic steps. Each ratio has three members, with √(σ_w² + σ_v²) as given, a third of it and
    three times it. Here σ_v is the first sensor's; the others' noises are scaled by its factor.
    """
    if isinstance(grid_size, tuple):
        process, sensor = (GRID_FACTOR ** (2 * np.arange(count) - (count - 1.0)) for count in grid_size)
        n_sensors = len(noises) // 2 - 1
        return np.array([noises * [1.0, a, *[1.0, b] * n_sensors] for a in process for b in sensor])
    factors = np.geomspace(1 / MAX_RATIO_FACTOR, MAX_RATIO_FACTOR, grid_size)
    return np.array([scale_noise_gammas(noises, factor, level) for level in TOTAL_STD_FACTORS for factor in factors])


def member_priors(prior: Belief, grid_size: NoiseGridSize) -> FloatArray:
    """(members, size) records of the members before the first sample; the prior itself for one hypothesis."""
    if grid_size == 1:
        return prior.record[None].copy()
    noises = noise_grid(prior.noises, grid_size)
    records = np.repeat(prior.record[None], len(noises), axis=0)
    records[:, -noises.shape[1] :] = noises
    return records


def initial_weights(noises: FloatArray, log_ratio_center: float | None = None) -> FloatArray:
    """(M,) weights of members before the first sample.

    Args:
        noises: (M, 2 + 2 s) shapes and rates of their precisions.
        log_ratio_center: log(σ_w/σ_v) of noises with equal effect on the output: the weights are then a half-Cauchy
            density about it (`neg_log_half_cauchy`). None is even weights: either noise may then be near 0, and
            intervals become too narrow if the samples cannot contradict that.
    """
    if log_ratio_center is None:
        return np.full(len(noises), 1 / len(noises))
    weights = np.exp(-neg_log_half_cauchy(np.array([log_noise_ratio(one) for one in noises]) - log_ratio_center))
    return np.asarray(weights / weights.sum())


def neg_log_half_cauchy(log_deviation: FloatArray) -> FloatArray:
    """Minus the log density of log(σ_w/σ_v) at ``log_deviation`` from its median, for a half-Cauchy ratio.

    (Gelman 2006, doi:10.1214/06-BA117A.) Up to a constant.
    """
    return np.asarray(np.logaddexp(log_deviation, -log_deviation))


def mixture_record(records: FloatArray, n_quantities: int, weights: FloatArray) -> FloatArray:
    """(size,) record of the mixture of members (M, size) with weights (M,), for ``n_quantities`` means."""
    n_noises = (records.shape[1] - n_quantities * (n_quantities + 3) // 2) // 2
    record: FloatArray = compile_mixture(n_quantities, n_noises).mixture(pack_into_lanes(records, LANES), weights)[1]
    return record


def pack_into_lanes(records: FloatArray, lanes: int) -> FloatArray:
    """(blocks, size * lanes) records (n, size) in adjacent lanes of blocks; a spare lane repeats the last."""
    blocks = -(-len(records) // lanes)
    padded = records[np.minimum(np.arange(blocks * lanes), len(records) - 1)]
    return padded.reshape(blocks, lanes, -1).transpose(0, 2, 1).reshape(blocks, -1)


def scale_noise_gammas(noises: FloatArray, ratio_factor: float, total_std_factor: float) -> FloatArray:
    """(2 + 2 s,) shapes and rates with σ_w/σ_v scaled by ``ratio_factor`` and σ_w² + σ_v² by ``total_std_factor``².

    σ_v is the first sensor's; the variances of the others are scaled by its factor.
    """
    q, r = noises[1] / noises[0], noises[3] / noises[2]
    ratio, total = ratio_factor**2 * q / r, total_std_factor**2 * (q + r)
    scaled = noises.copy()
    scaled[1] = noises[0] * total * ratio / (1 + ratio)
    scaled[3::2] = noises[2::2] * total / (1 + ratio) * (noises[3::2] / noises[2::2] / r)
    return scaled


def log_noise_ratio(noises: FloatArray) -> float:
    """log(σ_w/σ_v) at the mean precisions, with the first sensor's noise."""
    return float(0.5 * np.log(noises[1] / noises[0] / (noises[3] / noises[2])))


def noise_ratio_posterior(
    weights: FloatArray, log_ratios: FloatArray, prior_log_ratios: FloatArray, prior_weights: FloatArray
) -> NoiseRatio:
    """Posterior of the noise ratio from weighed members.

    Args:
        weights: (M,) weights of members.
        log_ratios: (M,) their log(σ_w/σ_v).
        prior_log_ratios: (members,) log ratios of all members before the first sample.
        prior_weights: (members,) their weights then.
    """
    mean = weights @ log_ratios
    grid_variance = np.diff(np.unique(prior_log_ratios.round(9)))[0] ** 2 / 12
    std = np.sqrt(weights @ (log_ratios - mean) ** 2 + grid_variance)
    prior_std = np.sqrt(prior_weights @ (prior_log_ratios - prior_weights @ prior_log_ratios) ** 2 + grid_variance)
    return NoiseRatio(float(mean), float(std), float(prior_std))


def moment_matched_gamma(weights: FloatArray, shapes: FloatArray, rates: FloatArray) -> tuple[float, float]:
    """Shape and rate of a Gamma density that matches a mixture in mean and variance of the noise variance.

    A density has the noise variance 1/E[g], as in an update, with relative variance 1/shape; the compiled version is
    `estimator.engine.mixture_moments`.
    """
    variances = rates / shapes
    mean = weights @ variances
    spread = weights @ ((variances / mean) ** 2 / shapes + (variances / mean - 1) ** 2)
    return float(1 / spread), float(mean / spread)
