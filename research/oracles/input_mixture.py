"""Best mixture of inputs by their moments; it gives the multipliers of a bound (`research.oracles.certificate`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimator.support.array_types import FloatArray

#: Moments C (4, 4), N (f, 4) and M (f, f) of an input. Its information is at most C - WᵀN - NᵀW + WᵀMW.
InformationMoments = tuple[FloatArray, FloatArray, FloatArray]

#: Steps that improve a mixture.
_N_STEPS = 200


@dataclass(frozen=True)
class BoundMultipliers:
    """The multipliers of a bound.

    Attributes:
        G: (4, 4), in units in which Λ0 is the identity.
        W: (features, 4), likewise.
    """

    G: FloatArray
    W: FloatArray


def improve_mixture(
    moments: list[InformationMoments], weights: FloatArray
) -> tuple[FloatArray, float, BoundMultipliers]:
    """Improve a mixture of inputs by exponentiated gradient.

    Args:
        moments: moments of every input, in units in which Λ0 is the identity.
        weights: (inputs,) initial weights, which add up to 1.

    Returns:
        The weights of the mixture, its gain of information [nats], and the multipliers of its bound.
    """
    C, N, M = (np.array(part) for part in zip(*moments, strict=True))

    def information_and_gains(p: FloatArray) -> tuple[float, FloatArray, BoundMultipliers]:
        mean_M, mean_N = np.tensordot(p, M, 1), np.tensordot(p, N, 1)
        W = np.linalg.solve(mean_M + 1e-10 * np.diag(np.diag(mean_M)), mean_N)
        total = np.eye(4) + np.tensordot(p, C, 1) - mean_N.T @ W
        G = np.linalg.inv(total)
        each = C - W.T @ N - np.swapaxes(W.T @ N, 1, 2) + W.T @ M @ W
        information = 0.5 * float(np.linalg.slogdet(total)[1])
        return (
            information,
            np.einsum("ij,nji->n", G, each),
            BoundMultipliers(G.astype(np.float64), W.astype(np.float64)),
        )

    value, gains, found = information_and_gains(weights)
    rate = 1.0
    for _ in range(_N_STEPS):
        # Relative to the step that changes weights by a factor e.
        tried = weights * np.exp(rate * (gains - gains.max()) / (1e-12 + float(np.ptp(gains))))
        tried /= tried.sum()
        new = information_and_gains(tried)
        if new[0] > value - 1e-12:
            weights, (value, gains, found) = tried, new
            rate *= 1.5
        else:
            rate *= 0.4
        if rate < 1e-5:
            break
    return weights, value, found
