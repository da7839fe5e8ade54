"""What an experiment can tell at best: Fisher information and Cramér-Rao bounds, of Eq. (2) and of Eq. (1).

The displacement is latent, so an output tells about the coefficients only what the past outputs did not. With the
Kalman filter of the model linearised along the trajectory, ν_t the innovation, S_t its variance, s_t = -∂ν_t/∂(θ, η),

    F = Σ_t s_t s_tᵀ / S_t.

The filter's mean moves as m⁻ = θ1 x + θ2 x³ + θ3 x' + η u (x' the displacement one sample earlier), so with
a = θ1 + 3 θ2 x² and the regressors φ = (x, x³, x', u) the sensitivities of its mean are exactly

    s_t = a s + θ3 s' + φ,      after the update    s ← (1 - K_0) s_t,   s' ← s - K_1 s_t,

with K the Kalman gain. What is left out is the sensitivity of K and S themselves: it enters F relative to the above by
the squared ratio of noise to displacement (1e-5 on the tracks), and what S tells needs noises that are known exactly.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from estimator.checks import series
from estimator.lanes import jit, kernel
from estimator.models.ode import N_MOTION, N_STATES, NOISE_DIRECTION, DuffingODE, flow
from estimator.parameters import SAMPLING_STEP, Coefficients, FloatArray, physical_jacobian, to_physical


def fisher_information(
    coefficients: Coefficients,
    u: npt.ArrayLike,
    process_noise: float = 5e-4,
    measurement_noise: float = 5e-4,
    *,
    y: npt.ArrayLike | None = None,
    state_std: float = 0.0,
) -> FloatArray:
    """Fisher information of (θ1, θ2, θ3, η) in the outputs that inputs bring about.

    Args:
        coefficients: one difference equation or a batch of shape (n,); their precisions are not used.
        u: (T,) or (n, T) inputs [V]; the t-th acts on the displacement of the sample before. A series ends before its
            first NaN, so that episodes of different lengths fit into one array.
        process_noise: standard deviation of w̃ [V], positive.
        measurement_noise: standard deviation of v [V], positive.
        y: (T,) or (n, T) the outputs [V] that followed the inputs: the information is then taken along the filter's
            trajectory on them. Without them it is taken along the response without noise, as a design needs it.
        state_std: standard deviation of x_0 and x_{-1} about their mean 0 [V]; by default the oscillator starts at
            rest.

    Returns:
        (4, 4), or (n, 4, 4) where an argument is a batch. Not finite where the difference equation blows up.

    Raises:
        ValueError: for shapes that do not fit, or a noise that is not positive.
    """
    for name, value in (("process_noise", process_noise), ("measurement_noise", measurement_noise)):
        if not 0 < value < np.inf:
            raise ValueError(f"{name} must be positive and finite, but is {value}; pass a standard deviation in V")
    if not 0 <= state_std < np.inf:
        raise ValueError(f"state_std must be 0 or more and finite, but is {state_std}; 0 is at rest")
    theta = as_rows(coefficients)
    inputs = np.asarray(u, dtype=np.float64)
    outputs = inputs if y is None else np.asarray(y, dtype=np.float64)
    if inputs.ndim not in (1, 2) or outputs.shape != inputs.shape:
        raise ValueError(f"u and y must have one shape, (T,) or (n, T), but have {inputs.shape} and {outputs.shape}")
    try:
        shape = np.broadcast_shapes(theta.shape[:-1], inputs.shape[:-1])
    except ValueError:
        raise ValueError(
            f"coefficients and u must be batches of one size, but are of {theta.shape[:-1]} and {inputs.shape[:-1]}"
        ) from None
    rows, samples = int(np.prod(shape)), inputs.shape[-1]
    information = np.zeros((rows, 4, 4))
    accumulate(
        np.broadcast_to(theta, (*shape, 4)).reshape(rows, 4).copy(),
        np.broadcast_to(inputs, (*shape, samples)).reshape(rows, samples).copy(),
        np.broadcast_to(outputs, (*shape, samples)).reshape(rows, samples).copy(),
        y is not None,
        float(process_noise) ** 2,
        float(measurement_noise) ** 2,
        float(state_std) ** 2,
        information,
    )
    return information.reshape(*shape, 4, 4)


def ode_information(
    parameters: npt.ArrayLike,
    u: npt.ArrayLike,
    process_noise: float = 5e-6,
    measurement_noise: float = 1e-3,
    *,
    model: DuffingODE | None = None,
) -> FloatArray:
    """Fisher information of the parameters of Eq. (1) in the outputs that an input brings about.

    The other parameters of `DuffingODE` are 0 and known. The motion starts at rest at the first sample.

    Args:
        parameters: (4,) stiffness [s⁻²], damping [s⁻¹], gain [s⁻²] and cubic stiffness [V⁻² s⁻²].
        u: (T,) inputs at the samples [V].
        process_noise: what the process noise of a sample does to x: standard deviation [V], 0 or more.
        measurement_noise: standard deviation of v [V], positive.
        model: says how the input runs between samples; by default linearly.

    Returns:
        (4, 4), in the units of ``parameters``, along the response without noise.

    Raises:
        ValueError: for shapes that do not fit, or a noise that is out of range.
    """
    if not 0 <= process_noise < np.inf:
        raise ValueError(f"process_noise must be 0 or more and finite, but is {process_noise}; pass it in V")
    if not 0 < measurement_noise < np.inf:
        raise ValueError(f"measurement_noise must be positive and finite, but is {measurement_noise}; pass it in V")
    values, inputs = np.array(parameters, dtype=np.float64), series("u", u)
    if values.shape != (4,):
        raise ValueError(f"parameters must have shape (4,), but have {values.shape}; pass k, c, g and b")
    model = model or DuffingODE()
    scales = SAMPLING_STEP ** np.array([2.0, 1.0, 2.0, 2.0])  # to units per sample
    information = np.zeros((4, 4))
    _accumulate_ode(
        np.concatenate([values * scales, np.zeros(3)]), model.pieces(inputs), model.substeps,
        float(process_noise) ** 2, float(measurement_noise) ** 2, information,
    )  # fmt: skip
    return information * np.outer(scales, scales)


def cramer_rao(information: FloatArray, prior_precision: FloatArray | None = None) -> FloatArray:
    """Lower bound of the error covariance of any estimate of (θ1, θ2, θ3, η).

    Without a prior the bound holds for estimates without bias, at the system whose information is given. With one it
    is the Bayesian bound (van Trees 1968): E[(error)(error)ᵀ] over systems and noise is at least (Λ0 + E[F])⁻¹, for
    biased estimates too, and for inputs that were chosen by feedback, because these are functions of past outputs.
    For that, pass the mean of F over systems that are drawn from the prior. Λ0 = E[∇log p ∇log pᵀ] is the inverse
    covariance where the prior is Gaussian.

    Args:
        information: (..., 4, 4) F, or its mean.
        prior_precision: (4, 4) Λ0; none where it is None.

    Returns:
        (..., 4, 4) the bound.

    Raises:
        ValueError: if Λ0 + F is not finite or not positive definite.
    """
    total = np.asarray(information, dtype=np.float64)
    if prior_precision is not None:
        total = total + prior_precision
    if not np.isfinite(total).all():
        raise ValueError("information must be finite, but has entries that are not; leave out systems that blew up")
    # In units in which the diagonal is 1, because θ2 is informed a hundred times less than the others.
    scale = np.sqrt(np.diagonal(total, axis1=-2, axis2=-1))
    with np.errstate(divide="ignore", invalid="ignore"):
        unit = total / (scale[..., :, None] * scale[..., None, :])
    if not np.isfinite(unit).all() or np.linalg.eigvalsh(unit).min() <= 0:
        raise ValueError("information must be positive definite, but is not; pass more samples or a prior_precision")
    return np.linalg.inv(unit) / (scale[..., :, None] * scale[..., None, :])


def relative_covariance(
    coefficients: Coefficients, covariance: FloatArray, step: float = SAMPLING_STEP
) -> FloatArray:  # fmt: skip
    """Covariance of the relative errors of m, c, a and b, to first order, from one of (θ1, θ2, θ3, η).

    Args:
        coefficients: one difference equation or a batch (...).
        covariance: (..., 4, 4).
        step: sampling step δ [s].

    Returns:
        (..., 4, 4): the roots of its diagonal are coefficients of variation.
    """
    phi = to_physical(coefficients, step)
    values = np.stack([phi.m, phi.c, phi.a, phi.b], axis=-1)
    slopes = physical_jacobian(coefficients, step) / values[..., :, None]
    relative: FloatArray = slopes @ covariance @ np.swapaxes(slopes, -1, -2)
    return relative


def as_rows(coefficients: Coefficients) -> FloatArray:
    """(..., 4) the values of (θ1, θ2, θ3, η)."""
    c = coefficients
    return np.stack([c.theta1, c.theta2, c.theta3, c.eta], axis=-1)


@kernel
def _accumulate_ode(p, pieces, substeps, q, r, information):
    """Fill in the information (4, 4) of the first four of the motion's parameters p (7,), in units per sample."""
    J, work = np.empty((N_STATES, N_MOTION)), np.empty((3, N_STATES, N_MOTION))
    S, P = np.zeros((N_STATES, 4)), np.zeros((N_STATES, N_STATES))
    direction = NOISE_DIRECTION.copy()
    z, v = 0.0, 0.0
    for t in range(len(pieces)):
        z, v = flow(z, v, p, pieces[t], substeps, J, work)
        A = J[:, :N_STATES].copy()
        S = A @ S + J[:, N_STATES : N_STATES + 4]
        P = A @ P @ A.T
        for i in range(N_STATES):
            for j in range(N_STATES):
                P[i, j] += q * direction[i] * direction[j]
        weight = 1.0 / (P[0, 0] + r)
        told, gain = S[0].copy(), weight * P[:, 0].copy()
        for j in range(4):
            for k in range(4):
                information[j, k] += weight * told[j] * told[k]
        for i in range(N_STATES):
            for j in range(4):
                S[i, j] -= gain[i] * told[j]
        P = P - np.outer(gain, P[0])


@kernel
def accumulate(theta, u, y, observed, q, r, state_variance, information):
    """Fill in the information (n, 4, 4) of n series; arguments as `fisher_information`, with variances."""
    s, last_s, moved = np.empty(4), np.empty(4), np.empty(4)
    for i in range(len(u)):
        t1, t2, t3, e = theta[i]
        F = information[i]
        x, last_x, p00, p01, p11 = 0.0, 0.0, state_variance, 0.0, state_variance
        s[:] = 0.0
        last_s[:] = 0.0
        for t in range(u.shape[1]):
            if u[i, t] != u[i, t]:
                break
            a = t1 + 3.0 * t2 * x * x
            predicted = t1 * x + t2 * x * x * x + t3 * last_x + e * u[i, t]
            c0, _, variance = spread(a, t3, p00, p01, p11, q)
            weight = 1.0 / (variance + r)
            regress(a, t3, s, last_s, x, last_x, u[i, t], moved)
            for j in range(4):
                for k in range(4):
                    F[j, k] += weight * moved[j] * moved[k]
                last_s[j] = s[j] - c0 * weight * moved[j]
                s[j] = r * weight * moved[j]
            innovation = y[i, t] - predicted if observed else 0.0
            last_x = x + c0 * weight * innovation
            x = predicted + variance * weight * innovation
            p00, p01, p11 = r * weight * variance, r * weight * c0, p00 - c0 * c0 * weight


@jit
def spread(a, t3, p00, p01, p11, q):
    """Covariances of the next displacement with the last two, and its variance, before the output is seen."""
    c0 = a * p00 + t3 * p01
    c1 = a * p01 + t3 * p11
    return c0, c1, a * c0 + t3 * c1 + q


@jit
def regress(a, t3, s, last_s, x, last_x, u, moved):
    """The sensitivities (4,) of the next displacement into ``moved``, from those of the last two."""
    moved[0] = a * s[0] + t3 * last_s[0] + x
    moved[1] = a * s[1] + t3 * last_s[1] + x * x * x
    moved[2] = a * s[2] + t3 * last_s[2] + last_x
    moved[3] = a * s[3] + t3 * last_s[3] + u
