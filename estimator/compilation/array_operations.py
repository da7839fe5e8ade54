"""Array operations in compiled code, entry by entry.

NumPy's operations on whole arrays take long to compile: an assignment alone brings in the error message for other
shapes, and with it the formatting of numbers.
"""

from __future__ import annotations

import numpy as np

from estimator.compilation.scalar_jit import scalar_jit
from estimator.compilation.simd import jit

#: Length of a cache line [doubles].
_CACHE_LINE = 8


@jit
def aligned_matrix(n_rows, n_columns):
    """An empty matrix (n_rows, n_columns) that begins at a cache line; so do its rows if n_columns divides by 8.

    AVX-512 registers are as long as a cache line, and take longer to fill from two lines.
    """
    numbers = np.empty(n_rows * n_columns + _CACHE_LINE)
    start = (-(numbers.ctypes.data // 8)) % _CACHE_LINE
    return numbers[start : start + n_rows * n_columns].reshape(n_rows, n_columns)


@jit
def copy(target, target_start, source, count):
    """Copy the first ``count`` numbers of ``source`` into ``target`` from ``target_start`` on; both are flat."""
    for i in range(count):
        target[target_start + i] = source[i]


@scalar_jit
def copy_range(target, target_start, source, source_start, count):
    """Copy ``count`` > 0 numbers of ``source`` from ``source_start`` on into ``target`` from ``target_start`` on.

    Both are flat. The indices are not negative, and so the loop vectorises.
    """
    for i in range(count):
        target[target_start + i] = source[source_start + i]


@jit
def copy_scaled(target, factor, source):
    """Write ``factor`` times a matrix into another, or into itself."""
    for i in range(source.shape[0]):
        for j in range(source.shape[1]):
            target[i, j] = factor * source[i, j]


@jit
def fill(target, value):
    """Fill a flat array with one number."""
    for i in range(len(target)):
        target[i] = value


@jit
def index_of_max(values, count):
    """Index of the maximum of the first ``count`` values."""
    best = 0
    for i in range(1, count):
        if values[i] > values[best]:
            best = i
    return best
