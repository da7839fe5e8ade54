"""Sigma points: how a joint Gaussian moves, without derivatives and to a higher order.

The cubature rule of degree 3 (Arasaratnam and Haykin 2009, doi:10.1109/TAC.2009.2019800; an unscented transform whose
centre has no weight). With L Lᵀ = P over the n dimensions m that the motion f of the state depends on, and l_i the
columns of √n L,

    X_i± = f(m ± l_i),   E[f] = Σ X / 2n,   Cov[f] = Σ (X - E[f]) (X - E[f])ᵀ / 2n,   Cov[f, θ] = Σ (X - E[f]) lᵀ / 2n.

The mean is exact for cubic f, the rest for linear f. The parameters θ do not move: their block of the covariance stays
as it is, bit by bit. A dimension on which the motion does not depend needs no points: its rows of L say how it goes
along with the others.
"""

from __future__ import annotations

import numpy as np

from estimator.lanes import jit
from estimator.parameters import FloatArray

#: What rounding leaves of the variance of a dimension that depends on those before it, as a part of that variance.
ROUNDING = 1e-14


def memory(size: int, movers: int) -> tuple[FloatArray, FloatArray]:
    """What `spread` fills, for a belief of some size whose first ``movers`` dimensions decide the motion."""
    return np.empty((size, movers)), np.empty((movers, 2 * movers))


@jit
def spread(mean, cov, columns, points):
    """Lay sigma points around a mean.

    A dimension of variance 0, or one that depends on those before it, gets no points of its own.

    Args:
        mean: (n,) of the joint state.
        cov: (n, n).
        columns: (n, m) receives √pairs L in its first columns, for the first m dimensions.
        points: (m, 2 m) receives a point in each of its first 2 pairs columns: first those with +, then with -.

    Returns:
        The number of pairs, at least 1.
    """
    n, m = columns.shape
    pairs = 0
    for j in range(m):
        pivot = cov[j, j]
        for c in range(pairs):
            pivot -= columns[j, c] * columns[j, c]
        if pivot <= ROUNDING * cov[j, j]:
            continue
        root = np.sqrt(pivot)
        for i in range(j):
            columns[i, pairs] = 0.0
        columns[j, pairs] = root
        for i in range(j + 1, n):
            total = cov[i, j]
            for c in range(pairs):
                total -= columns[i, c] * columns[j, c]
            columns[i, pairs] = total / root
        pairs += 1
    if pairs == 0:  # everything is known: a pair at the mean moves with it
        columns[:, 0] = 0.0
        pairs = 1
    width = np.sqrt(float(pairs))
    for i in range(n):
        for c in range(pairs):
            columns[i, c] *= width
            if i < m:
                points[i, c] = mean[i] + columns[i, c]
                points[i, pairs + c] = mean[i] - columns[i, c]
    return pairs


@jit
def predict(mean, cov, moved, columns, pairs, walk):
    """Move the state to the mean of the moved points, and its rows of the covariance with it; without process noise.

    Args:
        mean: (n,) of the joint state; its first k entries are overwritten.
        cov: (n, n), overwritten.
        moved: (k, 2 m) the state after the step in each of the first 2 pairs points.
        columns: (n, m) of `spread`, as ``pairs``.
        pairs: number of pairs.
        walk: (n - k,) variances of the coefficients' random walk; 0 where they do not change.
    """
    k, n = len(moved), len(mean)
    weight = 0.5 / pairs
    for i in range(k):
        total = 0.0
        for p in range(2 * pairs):
            total += moved[i, p]
        mean[i] = weight * total
    for i in range(k):
        for j in range(i, k):
            total = 0.0
            for p in range(2 * pairs):
                total += (moved[i, p] - mean[i]) * (moved[j, p] - mean[j])
            cov[i, j] = cov[j, i] = weight * total
        for j in range(k, n):
            total = 0.0
            for c in range(pairs):
                total += (moved[i, c] - moved[i, pairs + c]) * columns[j, c]
            cov[i, j] = cov[j, i] = weight * total
    for i in range(k, n):
        cov[i, i] += walk[i - k]
