"""Solutions and inverses of batches of symmetric matrices, some of which may be singular."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from estimator.support.array_types import FloatArray


def _with_unit_diagonal(matrices: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Matrices scaled to unit diagonals, and the roots of their diagonals."""
    root = np.sqrt(np.einsum("hii->hi", matrices))
    return matrices / (root[:, :, None] * root[:, None, :]), root


def solve_batch(matrices: FloatArray, vectors: FloatArray) -> FloatArray:
    """(H, K) solutions of linear equations; zeros where a matrix is singular."""
    unit, root = _with_unit_diagonal(matrices)
    return _solve_each_if_singular(np.linalg.solve, 0.0, unit, (vectors / root)[:, :, None])[:, :, 0] / root


def solve_with_fixed_directions(matrices: FloatArray, vectors: FloatArray, directions: FloatArray) -> FloatArray:
    """(H, K) solutions restricted to the planes orthogonal to the directions (H, K)."""
    unit, root = _with_unit_diagonal(matrices)
    plane = np.linalg.qr((directions / root)[:, :, None], mode="complete")[0][:, :, 1:]
    transposed = np.swapaxes(plane, 1, 2)
    return (
        plane @ solve_batch(transposed @ unit @ plane, (transposed @ (vectors / root)[:, :, None])[:, :, 0])[:, :, None]
    )[:, :, 0] / root


def invert_batch(matrices: FloatArray) -> FloatArray:
    """(H, K, K) inverses; NaN where a matrix is singular."""
    unit, root = _with_unit_diagonal(matrices)
    return _solve_each_if_singular(np.linalg.inv, np.nan, unit) / (root[:, :, None] * root[:, None, :])


def _solve_each_if_singular(solve: Callable[..., FloatArray], fallback: float, *stacks: FloatArray) -> FloatArray:
    """Results of ``solve`` for all matrices at once, or one by one with ``fallback`` for each singular matrix."""
    try:
        return np.asarray(solve(*stacks))
    except np.linalg.LinAlgError:
        if len(stacks[0]) == 1:
            return np.full_like(stacks[-1], fallback)
        rows = [[stack[i : i + 1] for stack in stacks] for i in range(len(stacks[0]))]
        return np.concatenate([_solve_each_if_singular(solve, fallback, *row) for row in rows])
