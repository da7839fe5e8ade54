"""The likelihood of records under Eq. (1) with white process noise, its slope and its Fisher information.

The Kalman filter of the physical equation at given coefficients ψ = (stiffness, cubic stiffness, damping, gain), all
counted in samples: `estimator.inference.continuous` moves its mean (x, x') over a sample and tells A, its slope by the
mean before, B, its slope by ψ, and the covariance N of unit noise. With S the sensitivities (2, 4) of the mean to ψ,

    P⁻ = A P Aᵀ + q N,        S⁻ = A S + B,        and after the update    S = S⁻ - K S⁻_x,

so that the innovation ν_t of variance S_t tells F = Σ_t s sᵀ / S_t with s = S⁻_x, as in `estimator.fisher`.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from estimator.inference.continuous import SUBSTEPS, begin, move
from estimator.lanes import LANES, jit, kernel
from estimator.parameters import FloatArray
from estimator.record import LAYOUT, N_ROWS

_X, _V, _U, _LAST_U = (LAYOUT[name] * LANES for name in ("x0", "x1", "u", "last_u"))
_T1, _T2, _T3, _E = (LAYOUT[name] * LANES for name in ("t1", "t2", "t3", "e"))
_MOVED_X, _MOVED_V = LAYOUT["moved_x"] * LANES, LAYOUT["moved_v"] * LANES
_N_XX, _N_XV, _N_VV = (LAYOUT[name] * LANES for name in ("N_xx", "N_xv", "N_vv"))
# Slopes of x and of x' stand in adjacent rows: by x and x' before the sample, then by the four coefficients.
_X_X0, _X_T1, _V_X0, _V_T1 = (LAYOUT[name] * LANES for name in ("X_x0", "X_t1", "V_x0", "V_t1"))


def continuous_information(
    coefficients: npt.ArrayLike, u: npt.ArrayLike, y: npt.ArrayLike, process_noise: float, measurement_noise: float
) -> FloatArray:
    """Fisher information of (stiffness, cubic, damping, gain) along the outputs that were seen.

    Args:
        coefficients: (n, 4) of each record's oscillator, per sample, as `ContinuousBelief.coefficients_of` tells them.
        u: (n, T) inputs at the samples [V]; a record begins at rest without input, and ends before its first NaN.
        y: (n, T) the outputs [V].
        process_noise: what the white process noise of a sample alone does to x: standard deviation [V].
        measurement_noise: standard deviation of v [V].

    Returns:
        (n, 4, 4).
    """
    points, inputs, outputs = (np.array(a, dtype=np.float64) for a in (coefficients, u, y))
    loss, slope, information = np.zeros(len(points)), np.zeros((len(points), 4)), np.zeros((len(points), 4, 4))
    accumulate(points, inputs, outputs, process_noise**2, measurement_noise**2, 0.0, loss, slope, information)
    return information


@kernel
def accumulate(psi, u, y, q, r, state_variance, loss, slope, information):
    """Add to -log likelihood (n,), its gradient (n, 4) and F (n, 4, 4) at (n, 4) points, of records (n, T)."""
    W = np.empty(N_ROWS * LANES)
    P, S = np.empty((LANES, 3)), np.empty((LANES, 2, 4))
    for first in range(0, len(u), LANES):
        lanes = min(LANES, len(u) - first)
        W[:] = 0.0
        S[:] = 0.0
        P[:, 0], P[:, 1], P[:, 2] = state_variance, 0.0, state_variance
        for j in range(LANES):
            i = first + min(j, lanes - 1)  # a spare lane repeats the last one
            W[_T1 + j], W[_T2 + j], W[_T3 + j], W[_E + j] = psi[i, 0], psi[i, 1], psi[i, 2], psi[i, 3]
        for t in range(u.shape[1]):
            running = 0
            for j in range(LANES):
                i = first + min(j, lanes - 1)
                sounds = u[i, t] == u[i, t]
                running += sounds
                W[_LAST_U + j] = W[_U + j]
                W[_U + j] = u[i, t] if sounds else 0.0
            if running == 0:
                break
            begin(W)
            for s in range(SUBSTEPS):
                move(W, s / SUBSTEPS, 1.0 / SUBSTEPS)
            for j in range(lanes):
                i = first + j
                if u[i, t] == u[i, t]:
                    _see(W, j, P[j], S[j], y[i, t], q, r, loss[i : i + 1], slope[i], information[i])


@jit
def _see(W, j, P, S, y, q, r, loss, slope, information):
    """The output y of lane j, after its point has moved."""
    xx, xv = W[_X_X0 + j], W[_X_X0 + LANES + j]
    vx, vv = W[_V_X0 + j], W[_V_X0 + LANES + j]
    c0, c1 = xx * P[0] + xv * P[1], xx * P[1] + xv * P[2]
    d0, d1 = vx * P[0] + vv * P[1], vx * P[1] + vv * P[2]
    p00 = xx * c0 + xv * c1 + q * W[_N_XX + j]
    p01 = vx * c0 + vv * c1 + q * W[_N_XV + j]
    p11 = vx * d0 + vv * d1 + q * W[_N_VV + j]
    weight = 1.0 / (p00 + r)
    gain_x, gain_v = p00 * weight, p01 * weight
    innovation = y - W[_MOVED_X + j]
    for k in range(4):
        of_x, of_v = S[0, k], S[1, k]
        S[0, k] = xx * of_x + xv * of_v + W[_X_T1 + k * LANES + j]
        S[1, k] = vx * of_x + vv * of_v + W[_V_T1 + k * LANES + j]
    loss[0] += 0.5 * (innovation * innovation * weight - np.log(weight))
    for k in range(4):
        slope[k] -= weight * S[0, k] * innovation
        for i in range(4):
            information[k, i] += weight * S[0, k] * S[0, i]
    for k in range(4):
        S[1, k] -= gain_v * S[0, k]
        S[0, k] -= gain_x * S[0, k]
    W[_X + j] = W[_MOVED_X + j] + gain_x * innovation
    W[_V + j] = W[_MOVED_V + j] + gain_v * innovation
    P[0], P[1], P[2] = r * gain_x, r * gain_v, p11 - gain_v * p01
