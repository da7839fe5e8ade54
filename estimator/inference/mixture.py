"""The mixture of hypotheses about the noises (`estimator.ensemble`), compiled: their weights, and its moments."""

from __future__ import annotations

import numpy as np

from estimator.lanes import LANES, jit, kernel

#: Probability per sample that the hypothesis is drawn anew: no weight stays below it for good.
SWITCHING = 1e-6


@jit
def weigh(weights, each, predictions, energies, forecasts):
    """Weigh the members by their free energies of one sample.

    Args:
        weights: (M,) before it; overwritten with those after it.
        each: (M, iterations) free energies of the members [nats].
        predictions: (M, sensors, 2) mean and variance of each output before it was seen.
        energies: (iterations,) receives those of the mixture, from the weights before.
        forecasts: (sensors, 2) receives mean and variance of the mixture before the output was seen.

    A member whose numbers are not finite has no weight. Where none is left, all results are NaN.
    """
    members, iterations = each.shape
    before = np.zeros(members)
    total = 0.0
    for m in range(members):
        told = each[m, iterations - 1]
        for k in range(len(forecasts)):
            told += predictions[m, k, 0] + predictions[m, k, 1]
        if np.isfinite(told):
            before[m] = (1.0 - SWITCHING) * weights[m] + SWITCHING / members
        total += before[m]
    for m in range(members):
        before[m] /= total
    for k in range(len(forecasts)):
        mean, variance = 0.0, 0.0
        for m in range(members):
            if before[m] > 0.0:
                mean += before[m] * predictions[m, k, 0]
        for m in range(members):
            if before[m] > 0.0:
                variance += before[m] * (predictions[m, k, 1] + (predictions[m, k, 0] - mean) ** 2)
        forecasts[k, 0] = mean if total > 0.0 else np.nan
        forecasts[k, 1] = variance if total > 0.0 else np.nan
    for i in range(iterations):
        least = np.inf
        for m in range(members):
            if before[m] > 0.0:
                least = min(least, each[m, i])
        evidence = 0.0
        for m in range(members):
            weights[m] = 0.0
            if before[m] > 0.0:
                weights[m] = before[m] * np.exp(least - each[m, i])
                evidence += weights[m]
        for m in range(members):
            weights[m] /= evidence
        energies[i] = least - np.log(evidence)


@jit
def mix(blocks, first, weights, names, shares, record, at, stride):
    """Write the record of a belief with the mixture's moments.

    Args:
        blocks: (blocks, rows * LANES) in adjacent lanes of which the members' records lie.
        first: lane of the first member, counted over all blocks.
        weights: (M,) of the members.
        names: number of states and coefficients.
        shares: (M,) receives the weights of those members whose numbers are finite; they sum to 1.
        record: flat array that receives the i-th number of the record at ``at + i * stride``.
        at: see there.
        stride: see there.

    The noises' Gamma densities have the mean and variance of the noises' variances: that of a member is 1/E[g], as it
    acts in an update, with the relative variance 1/shape. Where no member is finite, all results are NaN.
    """
    members, size = len(weights), names + names * (names + 1) // 2 + 4
    total, likely = 0.0, 0
    for m in range(members):
        b, j = (first + m) // LANES, (first + m) % LANES
        broken = 0.0
        for i in range(size):
            broken += blocks[b, i * LANES + j] - blocks[b, i * LANES + j]  # NaN of what is not finite
        shares[m] = weights[m] if weights[m] > 0.0 and broken == 0.0 else 0.0
        total += shares[m]
        if shares[m] > shares[likely]:
            likely = m
    # Means are about those of the likeliest, so that what all members know stays as it is, to the last bit.
    c, k = (first + likely) // LANES, (first + likely) % LANES
    for i in range(size):
        start = blocks[c, i * LANES + k] if i < names else 0.0
        record[at + i * stride] = start if total > 0.0 else np.nan
    for m in range(members):
        shares[m] /= total
        b, j = (first + m) // LANES, (first + m) % LANES
        for i in range(names if shares[m] > 0.0 else 0):
            record[at + i * stride] += shares[m] * (blocks[b, i * LANES + j] - blocks[c, i * LANES + k])
    for m in range(members):
        b, j = (first + m) // LANES, (first + m) % LANES
        place = names
        for i in range(names if shares[m] > 0.0 else 0):
            one = blocks[b, i * LANES + j] - record[at + i * stride]
            for n in range(i, names):
                other = blocks[b, n * LANES + j] - record[at + n * stride]
                record[at + place * stride] += shares[m] * (blocks[b, place * LANES + j] + one * other)
                place += 1
    for shape in range(size - 4, size, 2):
        mean, spread = 0.0, 0.0
        for again in range(2):
            for m in range(members):
                if shares[m] > 0.0:
                    b, j = (first + m) // LANES, (first + m) % LANES
                    worth = blocks[b, shape * LANES + j]
                    variance = blocks[b, (shape + 1) * LANES + j] / worth
                    if again:
                        spread += shares[m] * ((variance / mean) ** 2 / worth + (variance / mean - 1.0) ** 2)
                    else:
                        mean += shares[m] * variance
        if total > 0.0:
            record[at + shape * stride], record[at + (shape + 1) * stride] = 1.0 / spread, mean / spread


@kernel
def mixture(blocks, weights, names):
    """`mix` of all members from the first lane on: their shares (M,), and the record."""
    shares, record = np.empty(len(weights)), np.empty(names + names * (names + 1) // 2 + 4)
    mix(blocks, 0, weights, names, shares, record, 0, 1)
    return shares, record
