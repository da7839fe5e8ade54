"""Whether two records share samples, which would count twice."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from estimator.parameters import FloatArray

_Words = npt.NDArray[np.uint64]

#: So many outputs in a row, with their inputs, are the same by chance only where the noise is far below the last digit.
_STRETCH = 50

#: Where two records lie over each other, a copy has at least this part of their samples. Of an experiment that was
#: repeated, a coarse converter gives a stretch twice now and then.
_PART = 0.5

#: Odd numbers that mix the bits of a sample.
_MIXERS = tuple(np.uint64(n) for n in (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB))


class Shared(NamedTuple):
    """Samples that a later part has in common with an earlier one, by number, and where they begin in both."""

    earlier: int
    begin_earlier: int
    later: int
    begin_later: int


def shared(parts: Sequence[tuple[FloatArray, FloatArray]]) -> Shared | None:
    """The first samples that two parts share, or None.

    Two parts share samples where, laid over each other at some place, half of the outputs that both have, and 50 at
    least, are the same in rows of 50, with their inputs, bit by bit. Outputs that are NaN are passed over. A row that
    comes again within a part is no sign: a periodic motion without noise, or a rest between two of a converter's
    levels, repeats itself. It takes O(T log T).

    Args:
        parts: (T,) inputs and (T,) outputs of each; inputs are finite.
    """
    seen = [np.flatnonzero(np.isfinite(y)) for _, y in parts]
    hashes, owners, places = [], [], []
    for number, ((u, y), at) in enumerate(zip(parts, seen, strict=True)):
        found = _of_rows(_of_samples(u[at], y[at]))
        values, first, count = np.unique(found, return_index=True, return_counts=True)
        once = count == 1
        hashes.append(values[once])
        places.append(at[first[once]])
        owners.append(np.full(int(once.sum()), number))
    value, owner, place = (np.concatenate(given) for given in (hashes, owners, places))
    order = np.argsort(value, kind="stable")
    value, owner, place = value[order], owner[order], place[order]
    twice = np.flatnonzero(value[1:] == value[:-1])
    if len(twice) == 0:
        return None
    # A row that two parts have says where one would lie over the other.
    laid = np.stack([owner[twice], owner[twice + 1], place[twice + 1] - place[twice]], axis=1)
    kinds, which, count = np.unique(laid, axis=0, return_inverse=True, return_counts=True)
    for kind in np.lexsort((kinds[:, 0], kinds[:, 1])):
        earlier, later, shift = (int(n) for n in kinds[kind])
        both = len(np.intersect1d(seen[earlier] + shift, seen[later], assume_unique=True))
        if count[kind] + _STRETCH - 1 >= _PART * both:
            begin = int(place[twice[which.ravel() == kind]].min())
            return Shared(earlier, begin, later, begin + shift)
    return None


def _of_samples(u: FloatArray, y: FloatArray) -> _Words:
    """(T,) a number for each pair of an input and an output; -0.0 is 0.0."""
    first, second, third = _MIXERS
    mixed = (u + 0.0).view(np.uint64) * first + (y + 0.0).view(np.uint64) * second
    mixed = (mixed ^ (mixed >> np.uint64(31))) * third
    return np.asarray(mixed ^ (mixed >> np.uint64(29)), dtype=np.uint64)


def _of_rows(samples: _Words) -> _Words:
    """(T - 49,) a number for each row of 50: the sum of samples times powers of an odd number, modulo 2**64."""
    if len(samples) < _STRETCH:
        return np.zeros(0, dtype=np.uint64)
    base = int(_MIXERS[0])
    powers, inverses = (
        np.cumprod(np.full(len(samples), factor, dtype=np.uint64)) for factor in (base, pow(base, -1, 2**64))
    )
    sums = np.concatenate([np.zeros(1, dtype=np.uint64), np.cumsum(samples * powers)])
    return np.asarray((sums[_STRETCH:] - sums[:-_STRETCH]) * inverses[: len(samples) - _STRETCH + 1], dtype=np.uint64)
