"""The mixture of hypotheses about the noises (`estimator.ensemble`), compiled: their weights, and its moments."""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np

from estimator.engine.moments import moments
from estimator.lanes import LANES, jit, kernel, part

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


class Mixing(NamedTuple):
    """The moments of mixtures of beliefs, compiled.

    Attributes:
        memory_for: ``memory_for(members)``: what ``mix`` writes on.
        mix: ``mix(blocks, first, weights, memory, record, at, stride)`` writes the record of a belief with the moments
            of the mixture (`estimator.engine.moments`); all NaN where no member is finite. ``memory`` then has the
            weights of those members whose numbers are finite, which sum to 1: that of member m in lane m % LANES of
            the first row of block m // LANES.

            - ``blocks`` (blocks, rows * LANES), in adjacent lanes of which the members' records lie;
            - ``first``: lane of the first member, counted over all blocks;
            - ``weights`` (M,) of the members;
            - ``record``: flat array that receives the i-th number of the record at ``at + i * stride``.
        mixture: ``mixture(blocks, weights)`` of all members from the first lane on: those shares (M,), and the record.
    """

    memory_for: Any
    mix: Any
    mixture: Any


@cache
def mixing(names: int) -> Mixing:
    """The moments of beliefs in so many states and coefficients, of one sensor."""
    found = moments(names)
    place, check, means, spreads, tails = found.layout, found.check, found.means, found.spreads, found.tails
    n_pairs = names * (names + 1) // 2
    size, n_rows = names + n_pairs + 4, len(place)
    record_at, about_at, told_at = place["X_0"], place["ABOUT_0"], place["T_0"]
    shapes = size - 4
    inner = part(str(names))

    @inner
    def memory_for(members):
        # What no member stands in never becomes infinite.
        return np.ones((-(-members // LANES), n_rows * LANES))

    @inner
    def nothing(memory):
        # Numbers of turns that the compiler does not know: those that it does it writes out, which takes seconds.
        return memory.shape[1] // LANES - n_rows

    @inner
    def collect(blocks, first, weights, memory):
        """Copy the records of all members, and share out the weight among those that are finite.

        The others get the record of the likeliest. Gives the weight that was left, and who is the likeliest.
        """
        members, m, zero = len(weights), 0, nothing(memory)
        while m < members:
            b, j, c, k = (first + m) // LANES, (first + m) % LANES, m // LANES, m % LANES
            count = min(members - m, LANES - j, LANES - k)
            for i in range(size + zero):
                start, to = i * LANES + j, (record_at + i) * LANES + k
                for n in range(count):
                    memory[c, to + n] = blocks[b, start + n]
            m += count
        for c in range(len(memory)):
            check(memory[c])
            for k in range(max(0, members - c * LANES), LANES):
                memory[c, k] = 0.0
        total, likely, most = 0.0, 0, 0.0
        for m in range(members):
            c, k = m // LANES, m % LANES
            memory[c, k] = weights[m] if weights[m] > 0.0 and memory[c, k] > 0.0 else 0.0
            total += memory[c, k]
            if memory[c, k] > most:
                likely, most = m, memory[c, k]
        for m in range(members):
            c, k = m // LANES, m % LANES
            if memory[c, k] == 0.0:
                for row in range(record_at * LANES, (record_at + size) * LANES, LANES):
                    memory[c, row + k] = memory[likely // LANES, row + likely % LANES]
            memory[c, k] /= total
        return total, likely

    @inner
    def told(memory, k):
        """A sum over all members."""
        value = 0.0
        for c in range(len(memory)):
            value += memory[c, (told_at + k) * LANES]
        return value

    @inner
    def everywhere(memory, row, value):
        for c in range(len(memory)):
            for k in range(row * LANES, (row + 1) * LANES):
                memory[c, k] = value

    @inner
    def mix(blocks, first, weights, memory, record, at, stride):
        zero = nothing(memory)
        total, likely = collect(blocks, first, weights, memory)
        if not total > 0.0:
            for i in range(size + zero):
                record[at + i * stride] = np.nan
            return
        for i in range(names + zero):
            start = memory[likely // LANES, (record_at + i) * LANES + likely % LANES]
            record[at + i * stride] = start
            everywhere(memory, about_at + i, start)
        for c in range(len(memory)):
            means(memory[c])
        for i in range(names + zero):
            record[at + i * stride] += told(memory, i)
            everywhere(memory, about_at + i, record[at + i * stride])
        for c in range(len(memory)):
            spreads(memory[c])
        for p in range(n_pairs + zero):
            record[at + (names + p) * stride] = told(memory, p)
        for k in range(2 + zero):
            variance = told(memory, n_pairs + k)
            record[at + (shapes + 2 * k + 1) * stride] = variance
            everywhere(memory, about_at + names + k, variance)
        for c in range(len(memory)):
            tails(memory[c])
        for k in range(2 + zero):
            spread, rate = told(memory, k), at + (shapes + 2 * k + 1) * stride
            record[rate - stride], record[rate] = 1.0 / spread, record[rate] / spread

    @kernel(kind=str(names))
    def mixture(blocks, weights):
        memory, record, shares = memory_for(len(weights)), np.empty(size), np.empty(len(weights))
        mix(blocks, 0, weights, memory, record, 0, 1)
        for m in range(len(weights)):
            shares[m] = memory[m // LANES, m % LANES]
        return shares, record

    return Mixing(memory_for, mix, mixture)
