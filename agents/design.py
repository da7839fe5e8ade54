"""The worth of a sequence of inputs, and its exact gradient, compiled: what oracle and planner climb.

The worth is ½ log det(Λ + F(u)) in nats, with F the Fisher information of (θ1, θ2, θ3, η) along the response without
noise (`estimator.fisher`) and Λ what is known before, less a penalty for displacements beyond a limit L:

    J(u) = ½ log det(Λ + F(u)) - ρ Σ_t max(0, |x_t| / L - 1)²

The gradient is the reverse derivative of this arithmetic: one pass forward that keeps every step's start, one backward.

A *start* (13,) is what a step begins with: displacement x and the one before, the filter's covariance of the two
(3 entries), and the sensitivities (4 and 4) of the two to the coefficients. All zeros is at rest.
"""

from __future__ import annotations

import math

import numpy as np

from estimator.fisher import regress, spread
from estimator.lanes import jit

START_SIZE = 13

#: A trajectory is followed no further than to this many times the limit: the difference equation blows up.
_LOST = 1.2


@jit
def roll(theta, q, r, limit, start, u, tape, F):
    """Follow the inputs (T,); F (4, 4) is overwritten by their information, and tape[t] by step t's start.

    Returns:
        The steps that were followed, the peak of |x| in them [V], and Σ max(0, |x| / L - 1)².
    """
    t1, t2, t3, e = theta[0], theta[1], theta[2], theta[3]
    F[:, :] = 0.0
    tape[0] = start
    peak, excess = 0.0, 0.0
    moved = np.empty(4)
    for t in range(len(u)):
        now, after = tape[t], tape[t + 1]
        x, last_x = now[0], now[1]
        a = t1 + 3.0 * t2 * x * x
        c0, _, variance = spread(a, t3, now[2], now[3], now[4], q)
        weight = 1.0 / (variance + r)
        regress(a, t3, now[5:9], now[9:13], x, last_x, u[t], moved)
        for j in range(4):
            for k in range(j + 1):
                F[j, k] += weight * moved[j] * moved[k]
            after[5 + j] = r * weight * moved[j]
            after[9 + j] = now[5 + j] - c0 * weight * moved[j]
        after[0] = t1 * x + t2 * x * x * x + t3 * last_x + e * u[t]
        after[1] = x
        after[2], after[3], after[4] = r * weight * variance, r * weight * c0, now[2] - c0 * c0 * weight
        size = abs(after[0])
        peak = max(peak, size)
        over = max(0.0, size / limit - 1.0)
        excess += over * over
        if not size < _LOST * limit:
            return t + 1, peak, excess
    return len(u), peak, excess


@jit
def half_log_det(A):
    """½ log det of a symmetric positive definite matrix, whose lower triangle is overwritten by its factor.

    Minus infinity where it is not positive definite.
    """
    total = 0.0
    for j in range(len(A)):
        for k in range(j):
            total_jk = A[j, k]
            for i in range(k):
                total_jk -= A[j, i] * A[k, i]
            A[j, k] = total_jk / A[k, k]
        pivot = A[j, j]
        for i in range(j):
            pivot -= A[j, i] * A[j, i]
        if not pivot > 0.0:
            return -np.inf
        A[j, j] = math.sqrt(pivot)
        total += math.log(A[j, j])
    return total


@jit
def invert(L, inverse):
    """The inverse of L Lᵀ, from the lower triangle of L."""
    size = len(L)
    column = np.empty(size)
    for j in range(size):
        for i in range(size):
            total = 1.0 if i == j else 0.0
            for k in range(i):
                total -= L[i, k] * column[k]
            column[i] = total / L[i, i]
        for i in range(size - 1, -1, -1):
            total = column[i]
            for k in range(i + 1, size):
                total -= L[k, i] * column[k]
            column[i] = total / L[i, i]
        for i in range(size):
            inverse[i, j] = column[i]


@jit
def worth(theta, precision, q, r, limit, penalty, start, u, tape, F):
    """The worth J(u) in nats, and the peak of |x| [V]. A trajectory that is lost counts what it told until then."""
    _, peak, excess = roll(theta, q, r, limit, start, u, tape, F)
    for j in range(4):
        for k in range(j + 1):
            F[j, k] += precision[j, k]
    return half_log_det(F) - penalty * excess, peak


@jit
def climb(theta, precision, q, r, limit, penalty, start, u, tape, F, gradient):
    """As `worth`, and ∂J/∂u (T,) [nats/V] into ``gradient``."""
    t2, t3, e = theta[1], theta[2], theta[3]
    steps, peak, excess = roll(theta, q, r, limit, start, u, tape, F)
    for j in range(4):
        for k in range(j + 1):
            F[j, k] += precision[j, k]
    value = half_log_det(F)
    G = np.empty((4, 4))
    invert(F, G)
    gradient[:] = 0.0
    # Names as in `roll`; a letter b at the end is the derivative of J by that quantity.
    moved, movedb, Gm = np.empty(4), np.empty(4), np.empty(4)
    sb, last_sb = np.zeros(4), np.zeros(4)
    xb, last_xb, p00b, p01b, p11b = 0.0, 0.0, 0.0, 0.0, 0.0
    for t in range(steps - 1, -1, -1):
        now = tape[t]
        x, last_x, p00, p01, p11 = now[0], now[1], now[2], now[3], now[4]
        reached = tape[t + 1, 0]
        over = max(0.0, abs(reached) / limit - 1.0)
        xb -= 2.0 * penalty * over * (1.0 if reached > 0.0 else -1.0) / limit
        a = theta[0] + 3.0 * t2 * x * x
        c0, _, variance = spread(a, t3, p00, p01, p11, q)
        w = 1.0 / (variance + r)
        regress(a, t3, now[5:9], now[9:13], x, last_x, u[t], moved)
        told, toward, back = 0.0, 0.0, 0.0
        for j in range(4):
            # J is ½ log det, so that ∂J/∂F is half the inverse, and ∂J/∂s_t the inverse times w s_t.
            Gm[j] = G[j, 0] * moved[0] + G[j, 1] * moved[1] + G[j, 2] * moved[2] + G[j, 3] * moved[3]
            told += 0.5 * Gm[j] * moved[j]
            toward += sb[j] * moved[j]
            back += last_sb[j] * moved[j]
            movedb[j] = w * (r * sb[j] - c0 * last_sb[j] + Gm[j])
        wb = r * toward - c0 * back + told + r * variance * p00b + c0 * r * p01b - c0 * c0 * p11b
        varianceb = r * w * p00b - w * w * wb
        c0b = w * (r * p01b - back - 2.0 * c0 * p11b) + a * varianceb
        c1b = t3 * varianceb
        ab = c0 * varianceb + p00 * c0b + p01 * c1b
        for j in range(4):
            ab += movedb[j] * now[5 + j]
            # s becomes the earlier one in the next step, so both of its derivatives add up.
            sb[j] = a * movedb[j] + last_sb[j]
            last_sb[j] = t3 * movedb[j]
        p00b, p01b, p11b = a * c0b + p11b, t3 * c0b + a * c1b, t3 * c1b
        gradient[t] = movedb[3] + e * xb
        xb, last_xb = (
            a * xb + last_xb + movedb[0] + 3.0 * x * x * movedb[1] + 6.0 * t2 * x * ab,
            t3 * xb + movedb[2],
        )  # fmt: skip
    return value - penalty * excess, peak
