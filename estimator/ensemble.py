"""Several hypotheses about how two noises share what an output shows: a mixture of structured filters.

An update sees the noises through the variance of the innovation only, S = s + q + r. With e = ν²/S - 1 it changes

    E[γ] by -e / (S (2a + 1)),   and E[ξ] by the same, where both shapes are a:

the difference E[γ] - E[ξ] stays what the priors made it, and only the sum of the noises is learned. Which difference is
the right one the sequence tells, by the evidence. So members with displaced priors learn side by side, each in a lane,
and each is weighed by its free energies, F_m of a sample standing for -log p(y_t | y_1 ... y_{t-1}, m):

    w_m <- (1 - ε) w_m + ε/M                       a hypothesis may become true again, in one sample of 1/ε
    F = -log Σ_m w_m exp(-F_m),   w_m <- w_m exp(F - F_m)        (`estimator.inference.mixture.weigh`)

The belief has the mixture's mean and covariance of states and coefficients, and its mean and variance of the noises'
variances: those are what acts in a prediction, and a hypothesis of no noise at all must not make a precision infinite.

Where the outputs do not tell σ_w from 0, or σ_v, the first weights decide (`first_weights`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimator.belief import Belief
from estimator.inference.mixture import mixing
from estimator.lanes import LANES
from estimator.support.array_types import FloatArray

#: Furthest displacement of σ_w/σ_v from that of the prior, either way.
FARTHEST = 30.0

#: A number of ratios of the noises; or how many values of each are combined.
Hypotheses = int | tuple[int, int]

#: Factor between two values of a noise's standard deviation.
APART = 3.0

#: Displacements of the noises' total standard deviation. A member learns its total by itself, but slowly where the two
#: noises are alike: what it loses meanwhile would be held against its ratio, were there no other of this ratio.
LEVELS = (1 / 3, 1.0, 3.0)


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


def grid(noises: FloatArray, hypotheses: Hypotheses) -> FloatArray:
    """(members, 4) shapes and rates of all hypotheses about those of one sensor.

    Of two numbers: so many values of σ_w and of σ_v, `APART` from each other about those of ``noises``, in all
    combinations: for noises of which each may be wrong by itself, by a factor of 9 for five values and of 27 for seven.

    Of one number, for noises whose total is known about: their σ_w/σ_v is that of ``noises`` times 1/30 to 30 in equal
    steps. Each ratio stands there three times: with √(σ_w² + σ_v²) as given, with a third of it, and with three times
    it. The sum is what every member learns by itself, so the members of a level start equally near to it.
    """
    if isinstance(hypotheses, tuple):
        process, sensor = (APART ** (2 * np.arange(count) - (count - 1.0)) for count in hypotheses)
        return np.array([noises * [1.0, a, 1.0, b] for a in process for b in sensor])
    factors = np.geomspace(1 / FARTHEST, FARTHEST, hypotheses)
    return np.array([displaced(noises, factor, level) for level in LEVELS for factor in factors])


def priors(prior: Belief, hypotheses: Hypotheses) -> FloatArray:
    """(members, size) the records that the members begin with; the prior's own where there is one hypothesis."""
    if hypotheses == 1:
        return prior.record[None].copy()
    noises = grid(prior.noises, hypotheses)
    records = np.repeat(prior.record[None], len(noises), axis=0)
    records[:, -4:] = noises
    return records


def first_weights(records: FloatArray, balance: float | None = None) -> FloatArray:
    """(M,) weights of members (M, size) before the first sample.

    Args:
        records: that they begin with.
        balance: log(σ_w/σ_v) of noises that move the output and hide it alike: the weights are then half a Cauchy
            density about that (`half_cauchy`). They are even where it is None: that holds that either noise may as well
            be next to 0, and where the samples cannot contradict, intervals become too narrow.
    """
    if balance is None:
        return np.full(len(records), 1 / len(records))
    weights = np.exp(-half_cauchy(np.array([log_ratio(record[-4:]) for record in records]) - balance))
    return np.asarray(weights / weights.sum())


def half_cauchy(away: FloatArray) -> FloatArray:
    """Minus the logarithm of a density of log(σ_w/σ_v), ``away`` from its middle: half a Cauchy density of the ratio.

    (Gelman 2006, doi:10.1214/06-BA117A.) Up to a constant.
    """
    return np.asarray(np.logaddexp(away, -away))


def start(records: FloatArray, names: int, weights: FloatArray) -> FloatArray:
    """(size,) the record of the mixture of members (M, size) with weights (M,), of so many states and coefficients."""
    record: FloatArray = mixing(names).mixture(side_by_side(records, LANES), weights)[1]
    return record


def side_by_side(records: FloatArray, lanes: int) -> FloatArray:
    """(blocks, size * lanes) records (n, size) in adjacent lanes of blocks; a spare lane repeats the last."""
    blocks = -(-len(records) // lanes)
    spare = records[np.minimum(np.arange(blocks * lanes), len(records) - 1)]
    return spare.reshape(blocks, lanes, -1).transpose(0, 2, 1).reshape(blocks, -1)


def displaced(noises: FloatArray, factor: float, level: float) -> FloatArray:
    """Shapes and rates (4,) with σ_w/σ_v multiplied by ``factor``, σ_w² + σ_v² by ``level``², and the shapes kept."""
    q, r = noises[1] / noises[0], noises[3] / noises[2]
    ratio, total = factor**2 * q / r, level**2 * (q + r)
    moved = noises.copy()
    moved[1] = noises[0] * total * ratio / (1 + ratio)
    moved[3] = noises[2] * total / (1 + ratio)
    return moved


def log_ratio(noises: FloatArray) -> float:
    """log(σ_w/σ_v) at the mean precisions."""
    return float(0.5 * np.log(noises[1] / noises[0] / (noises[3] / noises[2])))


def ratio_of(weights: FloatArray, ratios: FloatArray, first: FloatArray, at_first: FloatArray) -> NoiseRatio:
    """What weights (M,) of members with these log ratios (M,) say.

    Args:
        weights: of members.
        ratios: of these.
        first: (members,) the log ratios that all members began with.
        at_first: (members,) their weights then.
    """
    mean = weights @ ratios
    within = np.diff(np.unique(first.round(9)))[0] ** 2 / 12
    std = np.sqrt(weights @ (ratios - mean) ** 2 + within)
    before = np.sqrt(at_first @ (first - at_first @ first) ** 2 + within)
    return NoiseRatio(float(mean), float(std), float(before))


def matched_gamma(weights: FloatArray, shapes: FloatArray, rates: FloatArray) -> tuple[float, float]:
    """Shape and rate of a Gamma density for a mixture of them, by mean and variance of the noise's variance.

    That of a density is taken as 1/E[g], as it acts in an update, with the relative variance 1/shape
    (`estimator.engine.moments` does so in compiled code).
    """
    variances = rates / shapes
    mean = weights @ variances
    spread = weights @ ((variances / mean) ** 2 / shapes + (variances / mean - 1) ** 2)
    return float(1 / spread), float(mean / spread)
