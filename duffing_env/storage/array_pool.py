"""A pool of output arrays: every step returns an array without a copy, and reuses one that nothing else references."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import numpy.typing as npt


class ArrayPool:
    """Arrays of one shape, reused when the pool holds the only reference.

    The caller keeps the array that a step returned, and the next step writes into another one, so nothing is copied.

    Args:
        shape: of the arrays.
        dtype: of the arrays.
    """

    #: Arrays that the pool remembers. A caller that keeps more than these gets new ones.
    MAX_ARRAYS = 4

    def __init__(self, shape: tuple[int, ...], dtype: npt.DTypeLike) -> None:
        self._shape, self._dtype = shape, np.dtype(dtype)
        self._arrays: list[npt.NDArray[Any]] = [np.zeros(shape, dtype)]
        self._unshared_count = self._reference_count(0)

    def acquire(self) -> npt.NDArray[Any]:
        """An array without any other reference, direct or through a view. Its numbers have no meaning."""
        for i in range(len(self._arrays)):
            if self._reference_count(i) == self._unshared_count:
                return self._arrays[i]
        self._arrays = [*self._arrays[1 - self.MAX_ARRAYS :], np.zeros(self._shape, self._dtype)]
        return self._arrays[-1]

    def _reference_count(self, i: int) -> int:
        return sys.getrefcount(self._arrays[i])
