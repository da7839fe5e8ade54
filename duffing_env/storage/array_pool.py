"""Arrays that are given out with every step, without a copy each time."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import numpy.typing as npt


class ArrayPool:
    """Arrays of one shape, given out one after another, and given out again when nobody else holds them any more.

    What a step returns stays the caller's. A step writes into an array that nobody holds, so nothing is copied.

    Args:
        shape: of the arrays.
        dtype: of the arrays.
    """

    #: Arrays that are remembered. Whoever keeps all that is given out gets new ones.
    MAX_ARRAYS = 4

    def __init__(self, shape: tuple[int, ...], dtype: npt.DTypeLike) -> None:
        self._shape, self._dtype = shape, np.dtype(dtype)
        self._arrays: list[npt.NDArray[Any]] = [np.zeros(shape, dtype)]
        self._unshared_count = self._reference_count(0)

    def acquire(self) -> npt.NDArray[Any]:
        """An array that nobody else holds, itself or through a view. What it contains has no meaning."""
        for i in range(len(self._arrays)):
            if self._reference_count(i) == self._unshared_count:
                return self._arrays[i]
        self._arrays = [*self._arrays[1 - self.MAX_ARRAYS :], np.zeros(self._shape, self._dtype)]
        return self._arrays[-1]

    def _reference_count(self, i: int) -> int:
        return sys.getrefcount(self._arrays[i])
