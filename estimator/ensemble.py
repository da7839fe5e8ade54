"""Several hypotheses about how two noises share what an output shows: a mixture of structured filters.

An update sees the noises through the variance of the innovation only, S = s + q + r. With e = ν²/S - 1 it changes

    E[γ] by -e / (S (2a + 1)),   and E[ξ] by the same, where both shapes are a:

the difference E[γ] - E[ξ] stays what the priors made it, and only the sum of the noises is learned. Which difference is
the right one the sequence tells, by the evidence. So members with displaced priors learn side by side, and each is
weighed by its free energies, F_m of a sample standing for -log p(y_t | y_1 ... y_{t-1}, m):

    w_m <- (1 - ε) w_m + ε/M                       a hypothesis may become true again, in one sample of 1/ε
    F = -log Σ_m w_m exp(-F_m),   w_m <- w_m exp(F - F_m)

The belief has the mixture's mean and covariance of states and coefficients, and its mean and variance of the noises'
variances: those are what acts in a prediction, and a hypothesis of no noise at all must not make a precision infinite.
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from estimator.belief import Belief
from estimator.filters import Filter, NLARXFilter, Self
from estimator.gaussian import JointBelief
from estimator.inference import structured, walk
from estimator.inference.joint import G_RATE, G_SHAPE, N_RATE, N_SHAPE
from estimator.lanes import LANES, kernel
from estimator.parameters import FloatArray
from estimator.record import LAYOUT, N_ROWS, RECORD_SIZE

_U, _Y, _PREDICTED = LAYOUT["u"], LAYOUT["y"], LAYOUT["predicted"]
_VARIANCES = (LAYOUT["predicted_variance"], LAYOUT["process_variance"], LAYOUT["measurement_variance"])

#: Furthest displacement of σ_w/σ_v from that of the prior, either way.
FARTHEST = 30.0

#: Displacements of the noises' total standard deviation. A member learns its total by itself, but slowly where the two
#: noises are alike: what it loses meanwhile would be held against its ratio, were there no other of this ratio.
LEVELS = (1 / 3, 1.0, 3.0)

#: Probability per sample that the hypothesis is drawn anew (ε above): no weight stays below ε/M for good.
SWITCHING = 1e-6


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


class Member(Filter, Protocol):
    """A filter whose belief can be replaced."""

    @property
    def moments(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Mean (n,), covariance (n, n), and shapes and rates of γ and ξ (4,), in the filter's own coordinates."""
        ...

    def with_moments(self: Self, mean: FloatArray, cov: FloatArray, noises: FloatArray) -> Self:
        """A copy with another belief."""
        ...


class EnsembleFilter:
    """Memory of a mixture over noise ratios.

    Args:
        center: a structured filter before its first sample.
        ratios: number of ratios, at least 2. Their σ_w/σ_v is that of the centre times 1/30 to 30 in equal steps, and
            each is there with the centre's σ_w² + σ_v², and with a third and three times its root: the sum is what
            every member learns by itself, so the members of a level start equally near to it. The shapes are the
            centre's, and all weights are the same.
    """

    def __init__(self, center: Member, ratios: int) -> None:
        mean, cov, noises = center.moments
        factors = np.geomspace(1 / FARTHEST, FARTHEST, ratios)
        grid = [displaced(noises, factor, level) for level in LEVELS for factor in factors]
        self._members = [center.with_moments(mean, cov, of_member) for of_member in grid]
        self._weights = np.full(len(grid), 1 / len(grid))

    def copy(self) -> EnsembleFilter:
        """An independent copy."""
        other = copy(self)
        other._members = [member.copy() for member in self._members]
        other._weights = self._weights.copy()
        return other

    def run(self, u: FloatArray, y: FloatArray, free_energies: FloatArray, forecasts: FloatArray) -> int:
        """Take samples with every member, and weigh them."""
        energies = np.empty((len(self._members), *free_energies.shape))
        predictions = np.empty((len(self._members), *forecasts.shape))
        used = self._run_members(u, y, energies[:, : len(u)], predictions[:, : len(u)])
        mix(self._weights, energies[:, :used], predictions[:, :used], free_energies, forecasts)
        return used

    def _run_members(self, u: FloatArray, y: FloatArray, energies: FloatArray, predictions: FloatArray) -> int:
        """Let every member take the samples: those of the paper's model a lane each, the others one by one."""
        first, used = self._members[0], 0
        if not isinstance(first, NLARXFilter):
            for member, of_energies, of_predictions in zip(self._members, energies, predictions, strict=True):
                used = member.run(u, y, of_energies, of_predictions)
            return used
        last_input = float(first.arrays()["last_input"])
        acting = np.concatenate(([last_input], u[:-1])) if first.model.input_delay else u
        for start in range(0, len(self._members), LANES):
            chunk = slice(start, start + LANES)
            records = np.array([member.arrays()["record"] for member in self._members[chunk]])
            block = np.zeros((N_ROWS, LANES))
            block[:RECORD_SIZE] = records[np.minimum(np.arange(LANES), len(records) - 1)].T  # a spare lane repeats
            _run_lanes(block.reshape(-1), acting, y, first.arrays()["walk"], energies[chunk], predictions[chunk])
            for member, record in zip(self._members[chunk], block[:RECORD_SIZE].T.copy(), strict=False):
                member.restore({**member.arrays(), "record": record, "last_input": np.array(u[-1])})
        return len(u)

    def rewind(self) -> None:
        """Forget the state and the inputs; the weights are of the noises, and stay."""
        for member in self._members:
            member.rewind()

    def arrays(self) -> dict[str, FloatArray]:
        """Everything that the future depends on."""
        each = {f"{name}_{m}": a for m, member in enumerate(self._members) for name, a in member.arrays().items()}
        return {"weights": self._weights, **each}

    def restore(self, arrays: Mapping[str, FloatArray]) -> None:
        """Become another filter."""
        self._weights = arrays["weights"]
        for m, member in enumerate(self._members):
            member.restore({name: arrays[f"{name}_{m}"] for name in member.arrays()})

    @property
    def is_finite(self) -> bool:
        """Whether a member is left; one that overflowed has no weight."""
        return bool(self._finite_weights().sum() > 0)

    @property
    def belief(self) -> Belief | JointBelief:
        """The belief of the mixture."""
        return self._mixture().belief

    @property
    def noise_ratio(self) -> NoiseRatio:
        """What the weights say, at the precisions that each member has learned."""
        weights = self._finite_weights()
        weights /= weights.sum()
        known = weights > 0
        ratios = np.array([log_ratio(member.moments[2]) for member in self._members])[known]
        mean = weights[known] @ ratios
        size = len(self._members) // len(LEVELS)
        step = 2 * np.log(FARTHEST) / (size - 1)
        std = np.sqrt(weights[known] @ (ratios - mean) ** 2 + step**2 / 12)
        return NoiseRatio(float(mean), float(std), float(size * step / np.sqrt(12)))

    def predict(self, u: FloatArray, y: FloatArray) -> FloatArray:
        """One-step predictions at the mixture's means."""
        return self._mixture().predict(u, y)

    def simulate(self, u: FloatArray, y_init: FloatArray) -> FloatArray:
        """Free run at the mixture's means."""
        return self._mixture().simulate(u, y_init)

    def _finite_weights(self) -> FloatArray:
        """(M,) weights, 0 where a member overflowed."""
        return np.where([member.is_finite for member in self._members], self._weights, 0.0)

    def _mixture(self) -> Member:
        """A filter with the moments of the mixture."""
        weights = self._finite_weights()
        weights /= weights.sum()
        heaviest = self._members[int(np.argmax(weights))]
        parts = [(w, member.moments) for w, member in zip(weights, self._members, strict=True) if w > 0]
        about = heaviest.moments[0]  # so that what all members know stays as it is, to the last bit
        mean = about + sum((w * (m - about) for w, (m, _, _) in parts), np.zeros_like(about))
        cov = np.zeros((len(mean), len(mean)))
        for w, (m, P, _) in parts:
            cov += w * (P + np.outer(m - mean, m - mean))
        noises = np.array([of_member for _, (_, _, of_member) in parts])
        share = np.array([w for w, _ in parts])
        gamma = matched_gamma(share, noises[:, G_SHAPE], noises[:, G_RATE])
        xi = matched_gamma(share, noises[:, N_SHAPE], noises[:, N_RATE])
        return heaviest.with_moments(mean, cov, np.array([*gamma, *xi]))


def displaced(noises: FloatArray, factor: float, level: float) -> FloatArray:
    """Shapes and rates (4,) with σ_w/σ_v multiplied by ``factor``, σ_w² + σ_v² by ``level``², and the shapes kept."""
    q, r = noises[G_RATE] / noises[G_SHAPE], noises[N_RATE] / noises[N_SHAPE]
    ratio, total = factor**2 * q / r, level**2 * (q + r)
    moved = noises.copy()
    moved[G_RATE] = noises[G_SHAPE] * total * ratio / (1 + ratio)
    moved[N_RATE] = noises[N_SHAPE] * total / (1 + ratio)
    return moved


def log_ratio(noises: FloatArray) -> float:
    """log(σ_w/σ_v) at the mean precisions."""
    q, r = noises[G_RATE] / noises[G_SHAPE], noises[N_RATE] / noises[N_SHAPE]
    return float(0.5 * np.log(q / r))


def matched_gamma(weights: FloatArray, shapes: FloatArray, rates: FloatArray) -> tuple[float, float]:
    """Shape and rate of a Gamma density for a mixture of them, by mean and variance of the noise's variance.

    That of a density is taken as 1/E[g], as it acts in an update, with the relative variance 1/shape.
    """
    variances = rates / shapes
    mean = weights @ variances
    spread = weights @ ((variances / mean) ** 2 / shapes + (variances / mean - 1) ** 2)
    return float(1 / spread), float(mean / spread)


@kernel
def mix(weights, energies, predictions, free_energies, forecasts):
    """Weigh the members by their free energies, sample by sample.

    Args:
        weights: (M,) before the first sample; overwritten with those after the last.
        energies: (M, T, iterations) free energies of the members [nats].
        predictions: (M, T, 2) mean [V] and variance [V²] of each output before it was seen.
        free_energies: (T or more, iterations) receives those of the mixture, each from the weights before the sample.
        forecasts: (T or more, 2) receives mean and variance of the mixture before the output was seen.

    A member whose numbers are not finite has no weight. Where none is left, all results are NaN.
    """
    members, samples, iterations = energies.shape
    before = np.empty(members)
    for t in range(samples):
        total = 0.0
        for m in range(members):
            before[m] = 0.0
            if np.isfinite(energies[m, t, -1] + predictions[m, t, 0] + predictions[m, t, 1]):
                before[m] = (1.0 - SWITCHING) * weights[m] + SWITCHING / members
            total += before[m]
        before /= total
        mean, variance = 0.0, 0.0
        for m in range(members):
            if before[m] > 0.0:
                mean += before[m] * predictions[m, t, 0]
        for m in range(members):
            if before[m] > 0.0:
                variance += before[m] * (predictions[m, t, 1] + (predictions[m, t, 0] - mean) ** 2)
        alive = total > 0.0
        forecasts[t, 0] = mean if alive else np.nan
        forecasts[t, 1] = variance if alive else np.nan
        for i in range(iterations):
            least = np.inf
            for m in range(members):
                if before[m] > 0.0:
                    least = min(least, energies[m, t, i])
            evidence = 0.0
            for m in range(members):
                weights[m] = 0.0
                if before[m] > 0.0:
                    weights[m] = before[m] * np.exp(least - energies[m, t, i])
                    evidence += weights[m]
            weights /= evidence
            free_energies[t, i] = least - np.log(evidence)


@kernel
def _run_lanes(W, u, y, variances, free_energies, forecasts):
    """Update every lane with every sample, structured; for the first M lanes (M, T, iterations) and (M, T, 2)."""
    members, samples, iterations = free_energies.shape
    changes = variances.max() > 0.0
    for t in range(samples):
        if changes:
            walk(W, variances[0], variances[1], variances[2], variances[3])
        for j in range(LANES):
            W[_U * LANES + j] = u[t]
            W[_Y * LANES + j] = y[t]
        structured.predict(W)
        for i in range(iterations):
            structured.learn_noise(W)
            for j in range(members):
                free_energies[j, t, i] = structured.free_energy(W, j)
        structured.correct(W)
        for j in range(members):
            forecasts[j, t, 0] = W[_PREDICTED * LANES + j]
            forecasts[j, t, 1] = 0.0
            for row in _VARIANCES:
                forecasts[j, t, 1] += W[row * LANES + j]
