"""The pool reuses only arrays without another reference."""

import copy

import numpy as np

from duffing_env.storage.array_pool import ArrayPool


def test_an_array_with_references_is_not_reused() -> None:
    arrays = ArrayPool((3, 2), np.float32)
    held = [arrays.acquire() for _ in range(2 * ArrayPool.MAX_ARRAYS)]
    assert len({id(array) for array in held}) == len(held)


def test_a_view_holds_its_array() -> None:
    arrays = ArrayPool((3, 2), np.float64)
    view = arrays.acquire()[1:, 0]
    view[:] = 7.0
    for _ in range(2 * ArrayPool.MAX_ARRAYS):
        arrays.acquire()[:] = 0.0
    np.testing.assert_array_equal(view, 7.0)


def test_an_array_without_references_is_reused() -> None:
    arrays = ArrayPool((3, 2), np.float64)
    places, held = set(), None
    for _ in range(20):
        held = arrays.acquire()
        places.add(held.ctypes.data)
    assert held is not None
    assert len(places) == 2


def test_a_copy_gives_out_arrays_of_its_own() -> None:
    arrays = ArrayPool((3, 2), np.float64)
    other = copy.deepcopy(arrays)
    ours, theirs = arrays.acquire(), other.acquire()
    assert not np.shares_memory(ours, theirs)
    assert not np.shares_memory(theirs, other.acquire())
