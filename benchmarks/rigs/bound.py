"""The Cramér-Rao bound of m, c, a and b from one record, the noises known and the state at its begin unknown.

The sensitivities of the outputs, taken along the path that the oscillator went, are whitened by the Kalman filter of
the linearised motion. What the noises' dependence on the parameters would add is left out: it does not grow as noises
shrink.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from benchmarks.rigs.simulator import FloatArray


@njit(cache=True)
def information(moved, by_state, by_force, direct, process, sensor, spread):  # type: ignore[no-untyped-def]
    """Fisher information of P unknowns, of which the four parameters come first.

    Args:
        moved: (T, 7, 2) of `simulator.paths`.
        by_state: (T + 1, 2) derivatives of the outputs by the state.
        by_force: (T + 1,) by the process noise that acted before.
        direct: (T + 1, P) by the unknowns, at a given state.
        process: variance of the force held over a sample.
        sensor: variance of the sensor's noise.
        spread: (2,) standard deviations of the state at the begin.
    """
    unknowns = direct.shape[1]
    found = np.zeros((unknowns, unknowns))
    paths = np.zeros((2, unknowns))
    P = np.diag(spread**2)
    for k in range(len(by_state)):
        h = by_state[k]
        added = np.zeros(2)
        variance = sensor
        if k > 0:
            through = moved[k - 1, :2].T.copy()
            paths = through @ paths
            paths[:, :4] += moved[k - 1, 3:].T
            P = through @ P @ through.T + process * np.outer(moved[k - 1, 2], moved[k - 1, 2])
            added = process * by_force[k] * moved[k - 1, 2]
            variance += 2 * (h @ added) + process * by_force[k] ** 2
        cross = P @ h + added
        variance += h @ P @ h
        news = h @ paths + direct[k]
        found += np.outer(news, news) / variance
        paths -= np.outer(cross, news) / variance
        P = P - np.outer(cross, cross) / variance
        P = 0.5 * (P + P.T)
    return found


def deviations(found: FloatArray) -> FloatArray:
    """(4,) least standard deviations of m, c, a and b, relative to each; the other unknowns are marginalised."""
    scale = np.sqrt(np.diag(found))
    if not (scale > 0).all():
        return np.full(4, np.inf)
    variances = np.diag(np.linalg.pinv(found / np.outer(scale, scale), hermitian=True, rcond=1e-13))
    return np.asarray(np.sqrt(variances)[:4] / scale[:4])
