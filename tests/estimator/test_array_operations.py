"""Array operations in compiled code."""

import numba
import numpy as np
from tables import table

from estimator.compilation.array_operations import aligned_matrix, copy, copy_scaled, fill, index_of_max


def test_numbers_are_copied_to_their_places():
    into = np.zeros(5)
    copy(into, 2, np.array([1.0, 2.0, 3.0]), 2)
    np.testing.assert_array_equal(into, [0, 0, 1, 2, 0])
    fill(into, 7.0)
    np.testing.assert_array_equal(into, 7.0)
    matrix = np.arange(4.0).reshape(2, 2)
    copy_scaled(matrix, 2.0, matrix)
    np.testing.assert_array_equal(matrix, [[0, 2], [4, 6]])


def test_index_of_max_is_the_first_of_equal_values():
    values = np.array([1.0, 3.0, 3.0, 9.0])
    assert index_of_max(values, 3) == 1
    assert index_of_max(values, 4) == 3


@numba.njit
def address(rows, size):
    matrix = aligned_matrix(rows, size)
    matrix[:] = 1.0
    return matrix, matrix.ctypes.data


@table("shape", [(1, 8), (3, 1216), (5, 3)])
def test_an_aligned_matrix_begins_with_a_cache_line(shape):
    kept = [address(*shape) for _ in range(9)]  # kept, so that each lies elsewhere
    for matrix, place in kept:
        assert matrix.shape == shape
        assert matrix.flags.c_contiguous
        assert place % 64 == 0
