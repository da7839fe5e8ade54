"""Arrays in compiled code, number by number.

What NumPy does with whole arrays takes long to compile: an assignment alone brings with it the message that it would
raise for other shapes, with all that writes numbers as text.
"""

from __future__ import annotations

import numpy as np

from estimator.lanes import jit
from estimator.straight import straight

#: Numbers in a cache line.
_CACHE_LINE = 8


@jit
def aligned(rows, size):
    """An empty matrix (rows, size) that begins with a cache line; each of its rows does where so many fill some.

    Registers of AVX-512 are as long as a cache line, and take longer to fill from two of them.
    """
    numbers = np.empty(rows * size + _CACHE_LINE)
    start = (-(numbers.ctypes.data // 8)) % _CACHE_LINE
    return numbers[start : start + rows * size].reshape(rows, size)


@jit
def copy(into, at, given, count):
    """The first ``count`` numbers of ``given`` go into ``into``, from ``at`` on; both are flat."""
    for i in range(count):
        into[at + i] = given[i]


@straight
def copy_lanes(into, at, given, start, count):
    """``count`` numbers of ``given`` from ``start`` on go into ``into`` from ``at`` on, at least one; both are flat.

    Straight, so that it takes several numbers at a time: NumPy's places may be counted from the end, these may not.
    """
    for i in range(count):
        into[at + i] = given[start + i]


@jit
def copy_scaled(into, factor, given):
    """``factor`` times a matrix goes into another, or into itself."""
    for i in range(given.shape[0]):
        for j in range(given.shape[1]):
            into[i, j] = factor * given[i, j]


@jit
def fill(into, value):
    """One number everywhere in a flat array."""
    for i in range(len(into)):
        into[i] = value


@jit
def highest(values, count):
    """Where the highest of the first values is."""
    place = 0
    for i in range(1, count):
        if values[i] > values[place]:
            place = i
    return place
