"""Duplicate samples: whether two records share samples, which would count twice."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from estimator.support.array_types import FloatArray

_Hashes = npt.NDArray[np.uint64]

#: Length of the compared rows [samples]: equal rows are no coincidence unless the noise is far below the last digit.
_ROW_LENGTH = 50

#: Fraction of the overlap of two records that a copy has in common, at least. Records of a repeated experiment may
#: share a stretch through a coarse converter.
_MIN_SHARED_FRACTION = 0.5

#: Odd numbers that mix the bits of a sample.
_HASH_MULTIPLIERS = tuple(np.uint64(n) for n in (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB))


class SharedSamples(NamedTuple):
    """Samples that two records share.

    Attributes:
        earlier: number of the earlier record.
        begin_earlier: first shared sample in the earlier record.
        later: number of the later record.
        begin_later: first shared sample in the later record.
    """

    earlier: int
    begin_earlier: int
    later: int
    begin_later: int


def find_shared_samples(records: Sequence[tuple[FloatArray, FloatArray]]) -> SharedSamples | None:
    """The first samples that two records share, or None.

    Two records share samples if, at some shift, half of the outputs that both have, and at least 50, agree bit by bit
    with their inputs, in rows of 50. Outputs that are NaN are skipped. A row that occurs twice within a record does not
    count: a periodic motion without noise, or a rest between two levels of a converter, repeats itself. The search
    takes O(T log T).

    Args:
        records: (T,) inputs and (T,) outputs of each record; the inputs are finite.
    """
    observed = [np.flatnonzero(np.isfinite(y)) for _, y in records]
    hashes, owners, places = [], [], []
    for number, ((u, y), at) in enumerate(zip(records, observed, strict=True)):
        found = _hash_rows(_hash_samples(u[at], y[at]))
        values, first, count = np.unique(found, return_index=True, return_counts=True)
        is_unique = count == 1
        hashes.append(values[is_unique])
        places.append(at[first[is_unique]])
        owners.append(np.full(int(is_unique.sum()), number))
    value, owner, place = (np.concatenate(given) for given in (hashes, owners, places))
    order = np.argsort(value, kind="stable")
    value, owner, place = value[order], owner[order], place[order]
    repeated = np.flatnonzero(value[1:] == value[:-1])
    if len(repeated) == 0:
        return None
    # A row that two records have in common gives a shift between them.
    alignments = np.stack([owner[repeated], owner[repeated + 1], place[repeated + 1] - place[repeated]], axis=1)
    distinct_alignments, which, count = np.unique(alignments, axis=0, return_inverse=True, return_counts=True)
    for alignment in np.lexsort((distinct_alignments[:, 0], distinct_alignments[:, 1])):
        earlier, later, shift = (int(n) for n in distinct_alignments[alignment])
        both = len(np.intersect1d(observed[earlier] + shift, observed[later], assume_unique=True))
        if count[alignment] + _ROW_LENGTH - 1 >= _MIN_SHARED_FRACTION * both:
            begin = int(place[repeated[which.ravel() == alignment]].min())
            return SharedSamples(earlier, begin, later, begin + shift)
    return None


def _hash_samples(u: FloatArray, y: FloatArray) -> _Hashes:
    """(T,) hash of each pair of an input and an output; -0.0 counts as 0.0."""
    first, second, third = _HASH_MULTIPLIERS
    mixed = (u + 0.0).view(np.uint64) * first + (y + 0.0).view(np.uint64) * second
    mixed = (mixed ^ (mixed >> np.uint64(31))) * third
    return np.asarray(mixed ^ (mixed >> np.uint64(29)), dtype=np.uint64)


def _hash_rows(samples: _Hashes) -> _Hashes:
    """(T - 49,) hash of each row of 50: the sum of samples times powers of an odd number, modulo 2**64."""
    if len(samples) < _ROW_LENGTH:
        return np.zeros(0, dtype=np.uint64)
    base = int(_HASH_MULTIPLIERS[0])
    powers, inverses = (
        np.cumprod(np.full(len(samples), factor, dtype=np.uint64)) for factor in (base, pow(base, -1, 2**64))
    )
    sums = np.concatenate([np.zeros(1, dtype=np.uint64), np.cumsum(samples * powers)])
    return np.asarray(
        (sums[_ROW_LENGTH:] - sums[:-_ROW_LENGTH]) * inverses[: len(samples) - _ROW_LENGTH + 1], dtype=np.uint64
    )
