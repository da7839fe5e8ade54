"""The flow of Eq. (1) with its sensitivities, for `estimator.fisher`.

    z'' = g u + f - c z' - k z - b (z - y0)³ - e z'³,        y = z + d u + v,

with time counted in samples, and the input linear between samples.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimator.lanes import inlined, jit
from estimator.parameters import FloatArray

#: Parameters k, c, g, b, f, e, y0 and d, after the state (z, z').
N_STATES, N_PARAMETERS = 2, 8
N_JOINT = N_STATES + N_PARAMETERS

#: What the motion depends on: the state, and all parameters but the feedthrough.
N_MOTION = N_JOINT - 1

#: Direction of the process noise in (z, z'): an acceleration held over a sample, scaled to move z by 1.
NOISE_DIRECTION = np.array([1.0, 2.0])


@dataclass(frozen=True)
class DuffingODE:
    """Runge-Kutta steps per sample of the flow."""

    substeps: int = 8

    def pieces(self, u: FloatArray) -> FloatArray:
        """The input between samples as polynomials of τ in [0, 1]: (T - 1, 2) coefficients of 1 and τ."""
        return np.column_stack([u[:-1], u[1:] - u[:-1]])


@inlined
def _acceleration(z, v, u, k, c, g, b, f, e, y0):
    x = z - y0
    return g * u + f - c * v - k * z - b * x * x * x - e * v * v * v


@jit
def _derivative(z, v, p, u, J, D):
    """(z', z'') at a point, and into ``D`` the derivative of the sensitivities ``J`` (2, N_MOTION)."""
    k, c, g, b, f, e, y0 = p[0], p[1], p[2], p[3], p[4], p[5], p[6]
    x = z - y0
    slope_z = -k - 3.0 * b * x * x
    slope_v = -c - 3.0 * e * v * v
    for j in range(N_MOTION):
        D[0, j] = J[1, j]
        D[1, j] = slope_z * J[0, j] + slope_v * J[1, j]
    D[1, 2] -= z
    D[1, 3] -= v
    D[1, 4] += u
    D[1, 5] -= x * x * x
    D[1, 6] += 1.0
    D[1, 7] -= v * v * v
    D[1, 8] += 3.0 * b * x * x
    return v, _acceleration(z, v, u, k, c, g, b, f, e, y0)


@jit
def flow(z, v, p, piece, substeps, J, work):
    """Move (z, z') over one sample.

    Args:
        z: displacement plus output offset [V].
        v: its change per sample [V].
        p: (7,) parameters of the motion k, c, g, b, f, e, y0, per sample.
        piece: (degree + 1,) the input's polynomial.
        substeps: Runge-Kutta steps.
        J: (2, N_MOTION) receives the sensitivities of the result to z, v and p.
        work: (3, 2, N_MOTION) memory.
    """
    D, trial, total = work[0], work[1], work[2]
    J[:] = 0.0
    J[0, 0] = J[1, 1] = 1.0
    h = 1.0 / substeps
    for s in range(substeps):
        u0 = _polynomial(piece, s * h)
        u1 = _polynomial(piece, (s + 0.5) * h)
        u2 = _polynomial(piece, (s + 1.0) * h)
        z1, v1 = _derivative(z, v, p, u0, J, D)
        for i in range(2):
            for j in range(N_MOTION):
                total[i, j] = D[i, j]
                trial[i, j] = J[i, j] + 0.5 * h * D[i, j]
        z2, v2 = _derivative(z + 0.5 * h * z1, v + 0.5 * h * v1, p, u1, trial, D)
        for i in range(2):
            for j in range(N_MOTION):
                total[i, j] += 2.0 * D[i, j]
                trial[i, j] = J[i, j] + 0.5 * h * D[i, j]
        z3, v3 = _derivative(z + 0.5 * h * z2, v + 0.5 * h * v2, p, u1, trial, D)
        for i in range(2):
            for j in range(N_MOTION):
                total[i, j] += 2.0 * D[i, j]
                trial[i, j] = J[i, j] + h * D[i, j]
        z4, v4 = _derivative(z + h * z3, v + h * v3, p, u2, trial, D)
        for i in range(2):
            for j in range(N_MOTION):
                J[i, j] += h / 6.0 * (total[i, j] + D[i, j])
        z += h / 6.0 * (z1 + 2.0 * z2 + 2.0 * z3 + z4)
        v += h / 6.0 * (v1 + 2.0 * v2 + 2.0 * v3 + v4)
    return z, v


@jit
def _polynomial(piece, tau):
    value = piece[-1]
    for n in range(len(piece) - 2, -1, -1):
        value = piece[n] + tau * value
    return value
