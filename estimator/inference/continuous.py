"""Structured factorisation of the physical equation: q(x, x', stiffness, cubic stiffness, damping, gain) q(γ) q(ξ).

The lane-wise form of `estimator.models.ode` without offsets, feedthrough and cubic damping, which a simulated plant
does not have. Time is counted in samples:

    x'' = e u - t3 x' - t1 x - t2 x³ + noise,        y = x + v,

and the input goes linearly from ``last_u`` to ``u``. Runge and Kutta's method of order 4 moves the mean, and exact
sensitivities of its arithmetic, X = ∂x/∂(x0, x1, t1, t2, t3, e) and V = ∂x'/∂(...), move the covariance.

The noise is white noise in the acceleration. 1/γ is the variance of what it alone does to x over a sample, without
spring and damper; its intensity is then 3/γ. With A the slope of (x', x'') by (x, x') along the mean, it moves (x, x')
with covariance N/γ,

    N' = A N + N Aᵀ + diag(0, 3),        N = 0 at the begin of the sample,

which is integrated along: without A it would be [[1, 3/2], [3/2, 3]], but spring and damper hold back 14 % of N_xx and
20 % of N_vv of the Silverbox's oscillator at rest, and more where the cubic term stiffens it.

From there it is a Kalman step, and γ and ξ are learned as in `estimator.inference.structured` with N_xx/E[γ] in the
place of 1/E[γ]: for the update the rate of γ is counted as the output shows it, times N_xx. The part of x' that is
independent of x given γ says nothing of γ in this sample.
"""

from __future__ import annotations

from estimator.inference.structured import learn_noise
from estimator.lanes import inlined, jit, lanewise
from estimator.record import LAYOUT

#: Runge-Kutta steps per sample. Four are far below the noise too, but where noises of 0.1 and 0.3 mV leave an interval
#: of a few parts in 10⁴ after 2,048 samples, their bias raises the mean squared error to 1.3 of what is believed.
SUBSTEPS = 8

#: Intensity of white noise whose second integral has a variance of 1 after a sample.
_INTENSITY = 3.0

_MOVING = "moved_x moved_v N_xx N_xv N_vv X_x0 X_x1 X_t1 X_t2 X_t3 X_e V_x0 V_x1 V_t1 V_t2 V_t3 V_e"


@inlined
def runge_kutta(x, v, k, b, c, g, u0, u1, u2, h):
    """One step of length h for inputs u0, u1, u2 at its begin, middle and end.

    Returns:
        x and x' after it, and at its three inner points.
    """
    a1 = g * u0 - c * v - (k + b * x * x) * x
    x2, v2 = x + 0.5 * h * v, v + 0.5 * h * a1
    a2 = g * u1 - c * v2 - (k + b * x2 * x2) * x2
    x3, v3 = x + 0.5 * h * v2, v + 0.5 * h * a2
    a3 = g * u1 - c * v3 - (k + b * x3 * x3) * x3
    x4, v4 = x + h * v3, v + h * a3
    a4 = g * u2 - c * v4 - (k + b * x4 * x4) * x4
    sixth = h / 6.0
    return (
        x + sixth * (v + 2.0 * v2 + 2.0 * v3 + v4), v + sixth * (a1 + 2.0 * a2 + 2.0 * a3 + a4),
        x2, v2, x3, v3, x4, v4,
    )  # fmt: skip


@inlined
def _carry(X, V, s1, s2, s3, s4, c, f1, f2, f3, f4, h):
    """The same step for one pair of sensitivities: X' = V, V' = s X - c V + f, with s and f at the four points."""
    A1 = s1 * X - c * V + f1
    V2 = V + 0.5 * h * A1
    A2 = s2 * (X + 0.5 * h * V) - c * V2 + f2
    V3 = V + 0.5 * h * A2
    A3 = s3 * (X + 0.5 * h * V2) - c * V3 + f3
    V4 = V + h * A3
    A4 = s4 * (X + h * V3) - c * V4 + f4
    sixth = h / 6.0
    return X + sixth * (V + 2.0 * V2 + 2.0 * V3 + V4), V + sixth * (A1 + 2.0 * A2 + 2.0 * A3 + A4)


@inlined
def _spread(xx, xv, vv, s, c):
    """N' = A N + N Aᵀ + diag(0, 3) with A = [[0, 1], [s, -c]]."""
    return 2.0 * xv, vv + s * xx - c * xv, 2.0 * (s * xv - c * vv) + _INTENSITY


@inlined
def _widen(xx, xv, vv, s1, s2, s3, s4, c, h):
    """The same step for the covariance of the noise."""
    half = 0.5 * h
    xx1, xv1, vv1 = _spread(xx, xv, vv, s1, c)
    xx2, xv2, vv2 = _spread(xx + half * xx1, xv + half * xv1, vv + half * vv1, s2, c)
    xx3, xv3, vv3 = _spread(xx + half * xx2, xv + half * xv2, vv + half * vv2, s3, c)
    xx4, xv4, vv4 = _spread(xx + h * xx3, xv + h * xv3, vv + h * vv3, s4, c)
    sixth = h / 6.0
    return (
        xx + sixth * (xx1 + 2.0 * xx2 + 2.0 * xx3 + xx4),
        xv + sixth * (xv1 + 2.0 * xv2 + 2.0 * xv3 + xv4),
        vv + sixth * (vv1 + 2.0 * vv2 + 2.0 * vv3 + vv4),
    )


@lanewise(LAYOUT, _MOVING)
def begin(x0, x1):
    """The point that moves, at the mean, and its sensitivities."""
    return x0, x1, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0


@lanewise(LAYOUT, _MOVING, uniform="start length")
def move(
    moved_x, moved_v, N_xx, N_xv, N_vv, X_x0, X_x1, X_t1, X_t2, X_t3, X_e, V_x0, V_x1, V_t1, V_t2, V_t3, V_e,
    t1, t2, t3, e, last_u, u, start, length,
):  # fmt: skip
    """One step of the point, its noise and sensitivities, ``length`` of a sample long from ``start`` in it."""
    rise = u - last_u
    u0 = last_u + start * rise
    u1 = last_u + (start + 0.5 * length) * rise
    u2 = last_u + (start + length) * rise
    x, v, p2, v2, p3, v3, p4, v4 = runge_kutta(moved_x, moved_v, t1, t2, t3, e, u0, u1, u2, length)
    p1, v1 = moved_x, moved_v
    q1, q2, q3, q4 = p1 * p1, p2 * p2, p3 * p3, p4 * p4
    s1, s2, s3, s4 = -t1 - 3.0 * t2 * q1, -t1 - 3.0 * t2 * q2, -t1 - 3.0 * t2 * q3, -t1 - 3.0 * t2 * q4
    N_xx, N_xv, N_vv = _widen(N_xx, N_xv, N_vv, s1, s2, s3, s4, t3, length)
    X_x0, V_x0 = _carry(X_x0, V_x0, s1, s2, s3, s4, t3, 0.0, 0.0, 0.0, 0.0, length)
    X_x1, V_x1 = _carry(X_x1, V_x1, s1, s2, s3, s4, t3, 0.0, 0.0, 0.0, 0.0, length)
    X_t1, V_t1 = _carry(X_t1, V_t1, s1, s2, s3, s4, t3, -p1, -p2, -p3, -p4, length)
    X_t2, V_t2 = _carry(X_t2, V_t2, s1, s2, s3, s4, t3, -p1 * q1, -p2 * q2, -p3 * q3, -p4 * q4, length)
    X_t3, V_t3 = _carry(X_t3, V_t3, s1, s2, s3, s4, t3, -v1, -v2, -v3, -v4, length)
    X_e, V_e = _carry(X_e, V_e, s1, s2, s3, s4, t3, u0, u1, u1, u2, length)
    return x, v, N_xx, N_xv, N_vv, X_x0, X_x1, X_t1, X_t2, X_t3, X_e, V_x0, V_x1, V_t1, V_t2, V_t3, V_e


@lanewise(
    LAYOUT,
    "predicted predicted_variance c_x1 c_t1 c_t2 c_t3 c_e d_x1 d_t1 d_t2 d_t3 d_e "
    "g_shape g_rate n_shape prior_g_rate prior_n_rate next_process_variance next_measurement_variance",
)
def predict(
    moved_x, N_xx, X_x0, X_x1, X_t1, X_t2, X_t3, X_e, V_x0, V_x1, V_t1, V_t2, V_t3, V_e,
    P_x0_x0, P_x0_x1, P_x0_t1, P_x0_t2, P_x0_t3, P_x0_e,
    P_x1_x1, P_x1_t1, P_x1_t2, P_x1_t3, P_x1_e,
    P_t1_t1, P_t1_t2, P_t1_t3, P_t1_e,
    P_t2_t2, P_t2_t3, P_t2_e,
    P_t3_t3, P_t3_e,
    P_e_e,
    g_shape, g_rate, n_shape, n_rate,
):  # fmt: skip
    """Moments of x and x' after the sample, without its noise: of x with all others in ``c``, of x' in ``d``."""
    g_rate = N_xx * g_rate
    c_x0 = X_x0 * P_x0_x0 + X_x1 * P_x0_x1 + X_t1 * P_x0_t1 + X_t2 * P_x0_t2 + X_t3 * P_x0_t3 + X_e * P_x0_e
    c_x1 = X_x0 * P_x0_x1 + X_x1 * P_x1_x1 + X_t1 * P_x1_t1 + X_t2 * P_x1_t2 + X_t3 * P_x1_t3 + X_e * P_x1_e
    c_t1 = X_x0 * P_x0_t1 + X_x1 * P_x1_t1 + X_t1 * P_t1_t1 + X_t2 * P_t1_t2 + X_t3 * P_t1_t3 + X_e * P_t1_e
    c_t2 = X_x0 * P_x0_t2 + X_x1 * P_x1_t2 + X_t1 * P_t1_t2 + X_t2 * P_t2_t2 + X_t3 * P_t2_t3 + X_e * P_t2_e
    c_t3 = X_x0 * P_x0_t3 + X_x1 * P_x1_t3 + X_t1 * P_t1_t3 + X_t2 * P_t2_t3 + X_t3 * P_t3_t3 + X_e * P_t3_e
    c_e = X_x0 * P_x0_e + X_x1 * P_x1_e + X_t1 * P_t1_e + X_t2 * P_t2_e + X_t3 * P_t3_e + X_e * P_e_e
    d_x0 = V_x0 * P_x0_x0 + V_x1 * P_x0_x1 + V_t1 * P_x0_t1 + V_t2 * P_x0_t2 + V_t3 * P_x0_t3 + V_e * P_x0_e
    d_x1 = V_x0 * P_x0_x1 + V_x1 * P_x1_x1 + V_t1 * P_x1_t1 + V_t2 * P_x1_t2 + V_t3 * P_x1_t3 + V_e * P_x1_e
    d_t1 = V_x0 * P_x0_t1 + V_x1 * P_x1_t1 + V_t1 * P_t1_t1 + V_t2 * P_t1_t2 + V_t3 * P_t1_t3 + V_e * P_t1_e
    d_t2 = V_x0 * P_x0_t2 + V_x1 * P_x1_t2 + V_t1 * P_t1_t2 + V_t2 * P_t2_t2 + V_t3 * P_t2_t3 + V_e * P_t2_e
    d_t3 = V_x0 * P_x0_t3 + V_x1 * P_x1_t3 + V_t1 * P_t1_t3 + V_t2 * P_t2_t3 + V_t3 * P_t3_t3 + V_e * P_t3_e
    d_e = V_x0 * P_x0_e + V_x1 * P_x1_e + V_t1 * P_t1_e + V_t2 * P_t2_e + V_t3 * P_t3_e + V_e * P_e_e
    return (
        moved_x,
        X_x0 * c_x0 + X_x1 * c_x1 + X_t1 * c_t1 + X_t2 * c_t2 + X_t3 * c_t3 + X_e * c_e,
        V_x0 * c_x0 + V_x1 * c_x1 + V_t1 * c_t1 + V_t2 * c_t2 + V_t3 * c_t3 + V_e * c_e,
        c_t1, c_t2, c_t3, c_e,
        V_x0 * d_x0 + V_x1 * d_x1 + V_t1 * d_t1 + V_t2 * d_t2 + V_t3 * d_t3 + V_e * d_e,
        d_t1, d_t2, d_t3, d_e,
        g_shape + 0.5, g_rate, n_shape + 0.5, g_rate, n_rate, g_rate / g_shape, n_rate / n_shape,
    )  # fmt: skip


@lanewise(
    LAYOUT,
    "x0 x1 t1 t2 t3 e "
    "P_x0_x0 P_x0_x1 P_x0_t1 P_x0_t2 P_x0_t3 P_x0_e P_x1_x1 P_x1_t1 P_x1_t2 P_x1_t3 P_x1_e "
    "P_t1_t1 P_t1_t2 P_t1_t3 P_t1_e P_t2_t2 P_t2_t3 P_t2_e P_t3_t3 P_t3_e P_e_e g_rate n_rate",
)
def correct(
    t1, t2, t3, e, y, moved_v, N_xx, N_xv, N_vv,
    predicted, predicted_variance, c_x1, c_t1, c_t2, c_t3, c_e, d_x1, d_t1, d_t2, d_t3, d_e,
    process_variance, measurement_variance,
    P_t1_t1, P_t1_t2, P_t1_t3, P_t1_e, P_t2_t2, P_t2_t3, P_t2_e, P_t3_t3, P_t3_e, P_e_e,
    next_g_rate, next_n_rate,
):  # fmt: skip
    """Add the process noise, and condition on y."""
    scale = 1.0 / N_xx
    noise = process_variance * scale
    c_x0 = predicted_variance + process_variance
    c_x1 = c_x1 + N_xv * noise
    weight = 1.0 / (c_x0 + measurement_variance)
    step = (y - predicted) * weight
    keep = measurement_variance * weight
    k_x1 = c_x1 * weight
    k_t1 = c_t1 * weight
    k_t2 = c_t2 * weight
    k_t3 = c_t3 * weight
    k_e = c_e * weight
    return (
        predicted + c_x0 * step, moved_v + c_x1 * step,
        t1 + c_t1 * step, t2 + c_t2 * step, t3 + c_t3 * step, e + c_e * step,
        keep * c_x0, keep * c_x1, keep * c_t1, keep * c_t2, keep * c_t3, keep * c_e,
        d_x1 + N_vv * noise - k_x1 * c_x1,
        d_t1 - k_x1 * c_t1, d_t2 - k_x1 * c_t2, d_t3 - k_x1 * c_t3, d_e - k_x1 * c_e,
        P_t1_t1 - k_t1 * c_t1, P_t1_t2 - k_t1 * c_t2, P_t1_t3 - k_t1 * c_t3, P_t1_e - k_t1 * c_e,
        P_t2_t2 - k_t2 * c_t2, P_t2_t3 - k_t2 * c_t3, P_t2_e - k_t2 * c_e,
        P_t3_t3 - k_t3 * c_t3, P_t3_e - k_t3 * c_e,
        P_e_e - k_e * c_e,
        next_g_rate * scale, next_n_rate,
    )  # fmt: skip


@jit
def update(W, iterations, substeps):
    """Update every lane's belief with its rows ``last_u``, ``u`` and ``y``.

    `estimator.inference.structured.free_energy` tells the free energy that it leaves.

    Args:
        W: block, (rows * LANES,).
        iterations: variational iterations, at least 1.
        substeps: Runge-Kutta steps per sample; `SUBSTEPS`.
    """
    begin(W)
    for s in range(substeps):
        move(W, s / substeps, 1.0 / substeps)
    predict(W)
    for _ in range(iterations):
        learn_noise(W)
    correct(W)
