"""Weights, forecasts and moments of mixtures of noise hypotheses (`estimator.inference.noise_grid`), compiled.

The functions take n systems at once, for SIMD. Every sum over the members of a system runs from the first to the last,
so the result does not depend on n.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np

from estimator.compilation.array_operations import fill
from estimator.compilation.elementary_functions import exp, log
from estimator.compilation.simd import LANES, jit, jit_closure, kernel
from estimator.engine.mixture_moments import N_NOISES, compile_mixture_moments

#: Probability per sample that the true hypothesis is drawn anew [1]; it bounds the weights from below.
SWITCHING_PROBABILITY = 1e-6


@jit
def apply_switching(weights, member_energies):
    """Mix the weights with even ones, and drop the members that are not finite.

    Args:
        weights: (M, n) of the members; overwritten. NaN if no member is left.
        member_energies: (M, n) free energies of the sample [nats].
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
    """Update the weights by the free energies of a sample.

    Args:
        weights: (M, n) after `apply_switching`; overwritten with the weights after the sample.
        member_energies: (M, n) free energies of the members [nats]; ignored without weight.
        mixture_energies: (n,) receives the free energies of the mixtures; not finite if no member is left.
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
    """Set a member's free energies (iterations,) to NaN if one, or a prediction (sensors, 2), is not finite."""
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
        weights: (M, n) after `apply_switching`; the first column counts.
        predictions: (M, sensors, 2) means and variances of the members.
        forecasts: (sensors, 2) receives mean and variance of the mixture; NaN if no member is left.
    """
    initial = 0.0 * weights[0, 0]  # NaN if no member is left
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
            n mixtures (`estimator.engine.mixture_moments`); all NaN if no member is finite.

            - ``blocks`` (blocks, rows * LANES): member m of system j is in lane m n + j, counted from block ``first``
              on, with its record in the first rows; n divides `LANES`;
            - ``weights`` (M, n) of the members;
            - ``shares`` (M n,) receives the weights of the finite members, normalised for each system;
            - ``records``: flat array that receives number i of system j at ``i * stride + j``.
        mixture: ``mixture(blocks, weights)`` for one system with weights (M,): the shares (M,), and the record.
    """

    mix: Any
    mixture: Any


@cache
def compile_mixture(n_quantities: int) -> MixtureMoments:
    """Compile the moments of mixtures of beliefs in ``n_quantities`` states and coefficients, of one sensor."""
    check, means, spreads, tails = compile_mixture_moments(n_quantities)
    jit_variant = jit_closure(str(n_quantities))
    size = n_quantities + n_quantities * (n_quantities + 1) // 2 + 2 * N_NOISES

    @jit_variant
    def share_out(blocks, first, weights, shares, likeliest):
        """Normalise the weights of the finite members, and find the likeliest member (n,)."""
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
