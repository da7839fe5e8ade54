"""Mixtures of hypotheses about the noises (`estimator.inference.noise_grid`), compiled: their weights, and their moments.

Everything here is of n systems at once, so that the compiler may work on several at a time. Of one system, each sum
over the members goes from the first to the last, so that a system comes out the same however many there are.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np

from estimator.compilation.array_operations import fill
from estimator.compilation.elementary_functions import exp, log
from estimator.compilation.simd import LANES, jit, jit_closure, kernel
from estimator.engine.mixture_moments import N_NOISES, compile_mixture_moments

#: Probability per sample that the hypothesis is drawn anew: no weight stays below it for good.
SWITCHING_PROBABILITY = 1e-6


@jit
def apply_switching(weights, member_energies):
    """Let the hypothesis be drawn anew, and leave out the members that are no longer finite.

    Args:
        weights: (M, n) of the members; overwritten. NaN where none is left.
        member_energies: (M, n) their free energies of the next sample.
    """
    members, n = weights.shape
    total = np.zeros(n)
    for m in range(members):
        for j in range(n):
            weight = (1.0 - SWITCHING_PROBABILITY) * weights[m, j] + SWITCHING_PROBABILITY / members
            weights[m, j] = weight if np.isfinite(member_energies[m, j]) else 0.0
            total[j] += weights[m, j]
    for m in range(members):
        for j in range(n):
            weights[m, j] /= total[j]


@jit
def reweight(weights, member_energies, mixture_energies):
    """Weigh the members by their free energies of a sample.

    Args:
        weights: (M, n) before it, as `apply_switching` leaves them; overwritten with those after it.
        member_energies: (M, n) free energies of the members [nats]; of no effect where there is no weight.
        mixture_energies: (n,) receives those of the mixtures; not finite where no member is left.
    """
    members, n = weights.shape
    evidence = np.zeros(n)
    fill(mixture_energies, np.inf)
    for m in range(members):
        for j in range(n):
            mixture_energies[j] = (
                member_energies[m, j]
                if weights[m, j] > 0.0 and member_energies[m, j] < mixture_energies[j]
                else mixture_energies[j]
            )
    for m in range(members):
        for j in range(n):
            likelihood = exp(mixture_energies[j] - member_energies[m, j])
            weights[m, j] = weights[m, j] * likelihood if weights[m, j] > 0.0 else 0.0
            evidence[j] += weights[m, j]
    for m in range(members):
        for j in range(n):
            weights[m, j] /= evidence[j]
    for j in range(n):
        mixture_energies[j] -= log(evidence[j])


@jit
def mark_diverged(member_energies, predictions):
    """Make all free energies (iterations,) of a member NaN where one is not finite, or a prediction (sensors, 2)."""
    total = 0.0
    for k in range(len(predictions)):
        total += predictions[k, 0] + predictions[k, 1]
    for i in range(len(member_energies)):
        total += member_energies[i]
    for i in range(len(member_energies)):
        member_energies[i] = member_energies[i] if np.isfinite(total) else np.nan


@jit
def forecast_mixture(weights, predictions, forecasts):
    """Mean and variance of the mixture of one system's predictions.

    Args:
        weights: (M, n), of which the first column counts, as `apply_switching` leaves it.
        predictions: (M, sensors, 2) means and variances of the members.
        forecasts: (sensors, 2) receives those of the mixture; NaN where no member is left.
    """
    initial = 0.0 * weights[0, 0]  # NaN where no member is left
    for k in range(len(forecasts)):
        mean, variance = initial, initial
        for m in range(len(weights)):
            if weights[m, 0] > 0.0:
                mean += weights[m, 0] * predictions[m, k, 0]
        for m in range(len(weights)):
            if weights[m, 0] > 0.0:
                variance += weights[m, 0] * (predictions[m, k, 1] + (predictions[m, k, 0] - mean) ** 2)
        forecasts[k, 0], forecasts[k, 1] = mean, variance


class MixtureMoments(NamedTuple):
    """The moments of mixtures of beliefs, compiled.

    Attributes:
        mix: ``mix(blocks, first, weights, shares, records, stride)`` writes the records of beliefs with the moments of
            n mixtures (`estimator.engine.mixture_moments`); all NaN where no member is finite.

            - ``blocks`` (blocks, rows * LANES): member m of system j stands in lane m n + j, counted from block
              ``first`` on, with the numbers of its record in the first rows; n divides `LANES`;
            - ``weights`` (M, n) of the members;
            - ``shares`` (M n,) receives those of the members whose numbers are finite, which sum to 1 for a system;
            - ``records``: flat array that receives number i of system j at ``i * stride + j``.
        mixture: ``mixture(blocks, weights)``, of one system with weights (M,): the shares (M,), and the record.
    """

    mix: Any
    mixture: Any


@cache
def compile_mixture(n_quantities: int) -> MixtureMoments:
    """The moments of beliefs in so many states and coefficients, of one sensor."""
    compiled_moments, jit_variant = compile_mixture_moments(n_quantities), jit_closure(str(n_quantities))
    check, means, spreads, tails = (
        compiled_moments.check,
        compiled_moments.means,
        compiled_moments.spreads,
        compiled_moments.tails,
    )
    size = n_quantities + n_quantities * (n_quantities + 1) // 2 + 2 * N_NOISES

    @jit_variant
    def share_out(blocks, first, weights, shares, likeliest):
        """Share out the weight among the members that are finite, and note who is the likeliest (n,)."""
        members, n = weights.shape
        total, most = np.zeros(n), np.zeros(n)
        for m in range(members):
            at = m * n
            check(blocks[first + at // LANES], at % LANES, shares, at, n)
            for j in range(n):
                share = weights[m, j] if shares[at + j] == 0.0 and weights[m, j] > 0.0 else 0.0
                shares[at + j] = share
                total[j] += share
                likeliest[j] = m if share > most[j] else likeliest[j]
                most[j] = max(most[j], share)
        for m in range(members):
            for j in range(n):
                shares[m * n + j] /= total[j]

    @jit_variant
    def mix(blocks, first, weights, shares, records, stride):
        members, n = weights.shape
        X, begun, likeliest = np.zeros(size * LANES), np.empty(n_quantities * LANES), np.zeros(n, np.int64)
        share_out(blocks, first, weights, shares, likeliest)
        for j in range(n):
            at = likeliest[j] * n + j
            for i in range(n_quantities):
                begun[i * LANES + j] = X[i * LANES + j] = blocks[first + at // LANES, i * LANES + at % LANES]
        for at in range(0, members * n, n):
            means(blocks[first + at // LANES], at % LANES, shares, at, begun, X, n)
        for at in range(0, members * n, n):
            spreads(blocks[first + at // LANES], at % LANES, shares, at, X, n)
        for at in range(0, members * n, n):
            tails(blocks[first + at // LANES], at % LANES, shares, at, X, n)
        for k in range(size - 2 * N_NOISES, size, 2):
            for j in range(n):
                spread = X[k * LANES + j]
                X[k * LANES + j] = 1.0 / spread
                X[(k + 1) * LANES + j] /= spread
        for i in range(size):
            for j in range(n):
                records[i * stride + j] = X[i * LANES + j] if shares[j] >= 0.0 else np.nan

    @kernel(variant=str(n_quantities))
    def mixture(blocks, weights):
        shares, record = np.empty(len(weights)), np.empty(size)
        mix(blocks, 0, weights.reshape((-1, 1)), shares, record, 1)
        return shares, record

    return MixtureMoments(mix, mixture)
