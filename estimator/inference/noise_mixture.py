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
from estimator.engine.mixture_moments import compile_mixture_moments

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
        mix: ``mix(blocks, first, weights, n, records, stride)`` writes the records of beliefs with the moments of n
            mixtures (`estimator.engine.mixture_moments`); all NaN where no member has a weight.

            - ``blocks`` (blocks, rows * LANES): member m of system j stands in lane m n + j, counted from block
              ``first`` on, with the numbers of its record in the first rows; n divides `LANES`;
            - ``weights`` (M n,) of the members, which sum to 1 for a system;
            - ``records``: flat array that receives number i of system j at ``i * stride + j``.
        mixture: ``mixture(blocks, weights)``, of one system with weights (M,): the weights of the members whose numbers
            are finite, which sum to 1, and the record.
    """

    mix: Any
    mixture: Any


@cache
def compile_mixture(n_quantities: int, n_noises: int = 2) -> MixtureMoments:
    """Compile the moments of mixtures of beliefs in ``n_quantities`` states and coefficients.

    Args:
        n_quantities: number of states and coefficients.
        n_noises: number of noises: one more than sensors.
    """
    variant = f"{n_quantities}_{n_noises}"
    moments, jit_variant = compile_mixture_moments(n_quantities, n_noises), jit_closure(variant)
    add, finish = moments.add, moments.finish
    first_shape = n_quantities + n_quantities * (n_quantities + 1) // 2
    size = first_shape + 2 * n_noises

    @jit_variant
    def refer_to_likeliest(blocks, first, weights, n, A):
        """Put the mean of each system's likeliest member into A, and the inverse of its noises' variances."""
        for j in range(n):
            likeliest = j
            for at in range(j, len(weights), n):
                likeliest = at if weights[at] > weights[likeliest] else likeliest
            B, lane = blocks[first + likeliest // LANES], likeliest % LANES
            for i in range(n_quantities):
                A[i * LANES + j] = B[i * LANES + lane]
            for i in range(first_shape, size, 2):
                A[(i + 1) * LANES + j] = B[i * LANES + lane] / B[(i + 1) * LANES + lane]

    @jit_variant
    def mix(blocks, first, weights, n, records, stride):
        A, X = np.zeros(size * LANES), np.zeros(size * LANES)
        refer_to_likeliest(blocks, first, weights, n, A)
        for at in range(0, len(weights), n):
            add(blocks[first + at // LANES], at % LANES, weights, at, A, X, n)
        finish(A, X, n)
        for i in range(size):
            for j in range(n):
                records[i * stride + j] = X[i * LANES + j] if weights[j] >= 0.0 else np.nan

    @kernel(variant=variant)
    def mixture(blocks, weights):
        kept, record = np.empty(len(weights)), np.empty(size)
        total = 0.0
        for m in range(len(weights)):
            kept[m] = weights[m]
            for i in range(size):
                kept[m] = kept[m] if np.isfinite(blocks[m // LANES, i * LANES + m % LANES]) else 0.0
            total += kept[m]
        for m in range(len(weights)):
            kept[m] /= total
        mix(blocks, 0, kept, 1, record, 1)
        return kept, record

    return MixtureMoments(mix, mixture)
