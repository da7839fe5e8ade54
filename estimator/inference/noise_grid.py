"""Several hypotheses about how two noises share what an output shows: a mixture of structured filters.

An update sees the noises through the variance of the innovation only, S = s + q + r. With e = ν²/S - 1 it changes

    E[γ] by -e / (S (2a + 1)),   and E[ξ] by the same, where both shapes are a:

the difference E[γ] - E[ξ] stays what the priors made it, and only the sum of the noises is learned. Which difference is
the right one the sequence tells, by the evidence. So members with displaced priors learn side by side, each in a lane,
and each is weighed by its free energies, F_m of a sample standing for -log p(y_t | y_1 ... y_{t-1}, m):

    w_m <- (1 - ε) w_m + ε/M                       a hypothesis may become true again, in one sample of 1/ε
    F = -log Σ_m w_m exp(-F_m),   w_m <- w_m exp(F - F_m)        (`estimator.inference.noise_mixture.reweight`)

The belief has the mixture's mean and covariance of states and coefficients, and its mean and variance of the noises'
variances: those are what acts in a prediction, and a hypothesis of no noise at all must not make a precision infinite.

Where the outputs do not tell σ_w from 0, or σ_v, the first weights decide (`initial_weights`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimator.belief import Belief
from estimator.compilation.simd import LANES
from estimator.inference.noise_mixture import compile_mixture
from estimator.support.array_types import FloatArray

#: Furthest displacement of σ_w/σ_v from that of the prior, either way.
MAX_RATIO_FACTOR = 30.0

#: A number of ratios of the noises; or how many values of each are combined.
NoiseGridSize = int | tuple[int, int]

#: Factor between two values of a noise's standard deviation.
GRID_FACTOR = 3.0

#: Displacements of the noises' total standard deviation. A member learns its total by itself, but slowly where the two
#: noises are alike: what it loses meanwhile would be held against its ratio, were there no other of this ratio.
TOTAL_STD_FACTORS = (1 / 3, 1.0, 3.0)


@dataclass(frozen=True)
class NoiseRatio:
    """Posterior of log(σ_w/σ_v), σ_w² = 1/γ and σ_v² = 1/ξ, over the hypotheses [1].

    Attributes:
        mean: of the logarithm.
        std: its standard deviation, with that within a step of the grid. Below 0.5 the ratio of the precisions is known
            to a factor of 3; near ``prior_std`` the data does not tell. A truth beyond the grid it does not show.
        prior_std: its standard deviation before the first sample.
    """

    mean: float
    std: float
    prior_std: float


def noise_grid(noises: FloatArray, grid_size: NoiseGridSize) -> FloatArray:
    """(members, 4) shapes and rates of all hypotheses about those of one sensor.

    Of two numbers: so many values of σ_w and of σ_v, `GRID_FACTOR` from each other about those of ``noises``, in all
    combinations: for noises of which each may be wrong by itself, by a factor of 9 for five values and of 27 for seven.

    Of one number, for noises whose total is known about: their σ_w/σ_v is that of ``noises`` times 1/30 to 30 in equal
    steps. Each ratio stands there three times: with √(σ_w² + σ_v²) as given, with a third of it, and with three times
    it. The sum is what every member learns by itself, so the members of a level start equally near to it.
    """
    if isinstance(grid_size, tuple):
        process, sensor = (GRID_FACTOR ** (2 * np.arange(count) - (count - 1.0)) for count in grid_size)
        return np.array([noises * [1.0, a, 1.0, b] for a in process for b in sensor])
    factors = np.geomspace(1 / MAX_RATIO_FACTOR, MAX_RATIO_FACTOR, grid_size)
    return np.array([scale_noises(noises, factor, level) for level in TOTAL_STD_FACTORS for factor in factors])


def member_priors(prior: Belief, grid_size: NoiseGridSize) -> FloatArray:
    """(members, size) the records that the members begin with; the prior's own where there is one hypothesis."""
    if grid_size == 1:
        return prior.record[None].copy()
    noises = noise_grid(prior.noises, grid_size)
    records = np.repeat(prior.record[None], len(noises), axis=0)
    records[:, -4:] = noises
    return records


def initial_weights(records: FloatArray, log_ratio_center: float | None = None) -> FloatArray:
    """(M,) weights of members (M, size) before the first sample.

    Args:
        records: that they begin with.
        log_ratio_center: log(σ_w/σ_v) of noises that move the output and hide it alike: the weights are then half a Cauchy
            density about that (`neg_log_half_cauchy`). They are even where it is None: that holds that either noise may as well
            be next to 0, and where the samples cannot contradict, intervals become too narrow.
    """
    if log_ratio_center is None:
        return np.full(len(records), 1 / len(records))
    weights = np.exp(
        -neg_log_half_cauchy(np.array([log_noise_ratio(record[-4:]) for record in records]) - log_ratio_center)
    )
    return np.asarray(weights / weights.sum())


def neg_log_half_cauchy(log_deviation: FloatArray) -> FloatArray:
    """Minus the logarithm of a density of log(σ_w/σ_v), ``log_deviation`` from its middle: half a Cauchy density of the ratio.

    (Gelman 2006, doi:10.1214/06-BA117A.) Up to a constant.
    """
    return np.asarray(np.logaddexp(log_deviation, -log_deviation))


def mixture_record(records: FloatArray, n_quantities: int, weights: FloatArray) -> FloatArray:
    """(size,) the record of the mixture of members (M, size) with weights (M,), of so many states and coefficients."""
    record: FloatArray = compile_mixture(n_quantities).mixture(pack_into_lanes(records, LANES), weights)[1]
    return record


def pack_into_lanes(records: FloatArray, lanes: int) -> FloatArray:
    """(blocks, size * lanes) records (n, size) in adjacent lanes of blocks; a spare lane repeats the last."""
    blocks = -(-len(records) // lanes)
    padded = records[np.minimum(np.arange(blocks * lanes), len(records) - 1)]
    return padded.reshape(blocks, lanes, -1).transpose(0, 2, 1).reshape(blocks, -1)


def scale_noises(noises: FloatArray, ratio_factor: float, total_std_factor: float) -> FloatArray:
    """Shapes and rates (4,) with σ_w/σ_v multiplied by ``ratio_factor``, σ_w² + σ_v² by ``total_std_factor``², and the shapes kept."""
    q, r = noises[1] / noises[0], noises[3] / noises[2]
    ratio, total = ratio_factor**2 * q / r, total_std_factor**2 * (q + r)
    scaled = noises.copy()
    scaled[1] = noises[0] * total * ratio / (1 + ratio)
    scaled[3] = noises[2] * total / (1 + ratio)
    return scaled


def log_noise_ratio(noises: FloatArray) -> float:
    """log(σ_w/σ_v) at the mean precisions."""
    return float(0.5 * np.log(noises[1] / noises[0] / (noises[3] / noises[2])))


def noise_ratio_posterior(
    weights: FloatArray, log_ratios: FloatArray, prior_log_ratios: FloatArray, prior_weights: FloatArray
) -> NoiseRatio:
    """What weights (M,) of members with these log ratios (M,) say.

    Args:
        weights: of members.
        log_ratios: of these.
        prior_log_ratios: (members,) the log ratios that all members began with.
        prior_weights: (members,) their weights then.
    """
    mean = weights @ log_ratios
    grid_variance = np.diff(np.unique(prior_log_ratios.round(9)))[0] ** 2 / 12
    std = np.sqrt(weights @ (log_ratios - mean) ** 2 + grid_variance)
    prior_std = np.sqrt(prior_weights @ (prior_log_ratios - prior_weights @ prior_log_ratios) ** 2 + grid_variance)
    return NoiseRatio(float(mean), float(std), float(prior_std))


def moment_matched_gamma(weights: FloatArray, shapes: FloatArray, rates: FloatArray) -> tuple[float, float]:
    """Shape and rate of a Gamma density for a mixture of them, by mean and variance of the noise's variance.

    That of a density is taken as 1/E[g], as it acts in an update, with the relative variance 1/shape
    (`estimator.engine.mixture_moments` does so in compiled code).
    """
    variances = rates / shapes
    mean = weights @ variances
    spread = weights @ ((variances / mean) ** 2 / shapes + (variances / mean - 1) ** 2)
    return float(1 / spread), float(mean / spread)
