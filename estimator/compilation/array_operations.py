"""Arrays in compiled code, number by number.

What NumPy does with whole arrays takes long to compile: an assignment alone brings with it the message that it would
raise for other shapes, with all that writes numbers as text.
"""

from __future__ import annotations

import numpy as np

from estimator.compilation.scalar_jit import scalar_jit
from estimator.compilation.simd import jit

#: Numbers in a cache line.
_CACHE_LINE = 8


@jit
def aligned_matrix(n_rows, n_columns):
    """An empty matrix (rows, size) that begins with a cache line; each of its rows does where so many fill some.

    Registers of AVX-512 are as long as a cache line, and take longer to fill from two of them.
    """
    numbers = np.empty(n_rows * n_columns + _CACHE_LINE)
    start = (-(numbers.ctypes.data // 8)) % _CACHE_LINE
    return numbers[start : start + n_rows * n_columns].reshape(n_rows, n_columns)


@jit
def copy(target, target_start, source, count):
    """The first ``count`` numbers of ``source`` go into ``target``, from ``target_start`` on; both are flat."""
    for i in range(count):
        target[target_start + i] = source[i]


@scalar_jit
def copy_range(target, target_start, source, source_start, count):
    """``count`` numbers of ``source`` from ``source_start`` on go into ``target`` from ``target_start`` on, at least one; both are flat.

    Straight, so that it takes several numbers at a time: NumPy's places may be counted from the end, these may not.
    """
    for i in range(count):
        target[target_start + i] = source[source_start + i]


@jit
def copy_scaled(target, factor, source):
    """``factor`` times a matrix goes into another, or into itself."""
    for i in range(source.shape[0]):
        for j in range(source.shape[1]):
            target[i, j] = factor * source[i, j]


@jit
def fill(target, value):
    """One number everywhere in a flat array."""
    for i in range(len(target)):
        target[i] = value


@jit
def index_of_max(values, count):
    """Where the highest of the first values is."""
    best = 0
    for i in range(1, count):
        if values[i] > values[best]:
            best = i
    return best
