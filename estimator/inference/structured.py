"""Structured factorisation: q(x_t, x_{t-1}, x_{t-2}, θ, η) q(γ) q(ξ).

States and coefficients stay jointly Gaussian, so that the uncertainty of the one is known to the other. With the
transition x_{t+1} = g(θ, x_t, x_{t-1}) + η u + w linearised at the belief's mean (first order), minimising the free
energy over q(x, θ, η) for fixed E[γ], E[ξ] is a Kalman step with process variance 1/E[γ] and measurement variance
1/E[ξ]; minimising it over q(γ) and q(ξ) needs E[w²] and E[v²] under that step's posterior. Both depend on the noise
variances only through scalars, so the iterations cost a few operations, and the covariance is updated once:

    h = ∂x_{t+1}/∂(x_t, x_{t-1}, θ, η),   c = P h,   s = hᵀ P h,   S = s + 1/E[γ] + 1/E[ξ],   ν = y - prediction
    E[w²] = (ν/(E[γ] S))² + (1/E[γ]) (1 - 1/(E[γ] S))
    E[v²] = (ν/(E[ξ] S))² + (1/E[ξ]) (1 - 1/(E[ξ] S))

which are the moments of w = x_{t+1} - g - η u and v = y - x_{t+1} under the joint posterior of three lags.
"""

from __future__ import annotations

from estimator.inference.noise import half_noise_powers, sample_free_energy
from estimator.lanes import at_lane, lanewise
from estimator.record import LAYOUT


@lanewise(
    LAYOUT,
    "predicted predicted_variance c_x0 c_x1 c_t1 c_t2 c_t3 c_e "
    "g_shape n_shape prior_g_rate prior_n_rate next_process_variance next_measurement_variance",
)
def predict(
    x0, x1, t1, t2, t3, e, u,
    P_x0_x0, P_x0_x1, P_x0_t1, P_x0_t2, P_x0_t3, P_x0_e,
    P_x1_x1, P_x1_t1, P_x1_t2, P_x1_t3, P_x1_e,
    P_t1_t1, P_t1_t2, P_t1_t3, P_t1_e,
    P_t2_t2, P_t2_t3, P_t2_e,
    P_t3_t3, P_t3_e,
    P_e_e,
    g_shape, g_rate, n_shape, n_rate,
):  # fmt: skip
    """Moments of x_{t+1} without its noise: mean, variance s = hᵀPh, covariance c = Ph with (x_t, x_{t-1}, θ, η)."""
    cube = x0 * x0 * x0
    a0 = t1 + 3 * t2 * x0 * x0
    a1 = t3
    c_x0 = a0 * P_x0_x0 + a1 * P_x0_x1 + x0 * P_x0_t1 + cube * P_x0_t2 + x1 * P_x0_t3 + u * P_x0_e
    c_x1 = a0 * P_x0_x1 + a1 * P_x1_x1 + x0 * P_x1_t1 + cube * P_x1_t2 + x1 * P_x1_t3 + u * P_x1_e
    c_t1 = a0 * P_x0_t1 + a1 * P_x1_t1 + x0 * P_t1_t1 + cube * P_t1_t2 + x1 * P_t1_t3 + u * P_t1_e
    c_t2 = a0 * P_x0_t2 + a1 * P_x1_t2 + x0 * P_t1_t2 + cube * P_t2_t2 + x1 * P_t2_t3 + u * P_t2_e
    c_t3 = a0 * P_x0_t3 + a1 * P_x1_t3 + x0 * P_t1_t3 + cube * P_t2_t3 + x1 * P_t3_t3 + u * P_t3_e
    c_e = a0 * P_x0_e + a1 * P_x1_e + x0 * P_t1_e + cube * P_t2_e + x1 * P_t3_e + u * P_e_e
    predicted = t1 * x0 + t2 * cube + t3 * x1 + e * u
    predicted_variance = a0 * c_x0 + a1 * c_x1 + x0 * c_t1 + cube * c_t2 + x1 * c_t3 + u * c_e
    return (
        predicted, predicted_variance, c_x0, c_x1, c_t1, c_t2, c_t3, c_e,
        g_shape + 0.5, n_shape + 0.5, g_rate, n_rate, g_rate / g_shape, n_rate / n_shape,
    )  # fmt: skip


@lanewise(
    LAYOUT,
    "process_variance measurement_variance next_g_rate next_n_rate next_process_variance next_measurement_variance",
)
def learn_noise(
    predicted, predicted_variance, y, g_shape, g_rate, n_shape, n_rate, next_process_variance, next_measurement_variance
):  # fmt: skip
    """One iteration: the Kalman step's moments of w and v, then q(γ) and q(ξ). Their shapes count the sample."""
    q = next_process_variance
    r = next_measurement_variance
    half_w, half_v = half_noise_powers(y - predicted, predicted_variance, q, r)
    next_g_rate = g_rate + half_w
    next_n_rate = n_rate + half_v
    return q, r, next_g_rate, next_n_rate, next_g_rate / g_shape, next_n_rate / n_shape


@lanewise(
    LAYOUT,
    "x0 x1 x2 t1 t2 t3 e "
    "P_x0_x0 P_x0_x1 P_x0_x2 P_x0_t1 P_x0_t2 P_x0_t3 P_x0_e "
    "P_x1_x1 P_x1_x2 P_x1_t1 P_x1_t2 P_x1_t3 P_x1_e "
    "P_x2_x2 P_x2_t1 P_x2_t2 P_x2_t3 P_x2_e "
    "P_t1_t1 P_t1_t2 P_t1_t3 P_t1_e P_t2_t2 P_t2_t3 P_t2_e P_t3_t3 P_t3_e P_e_e "
    "g_rate n_rate",
)
def correct(
    x0, x1, t1, t2, t3, e, y,
    predicted, predicted_variance, c_x0, c_x1, c_t1, c_t2, c_t3, c_e,
    process_variance, measurement_variance,
    P_x0_x0, P_x0_x1, P_x0_t1, P_x0_t2, P_x0_t3, P_x0_e,
    P_x1_x1, P_x1_t1, P_x1_t2, P_x1_t3, P_x1_e,
    P_t1_t1, P_t1_t2, P_t1_t3, P_t1_e,
    P_t2_t2, P_t2_t3, P_t2_e,
    P_t3_t3, P_t3_e,
    P_e_e,
    next_g_rate, next_n_rate,
):  # fmt: skip
    """Shift the lags by one sample and condition on y: the new x0 is x_{t+1}, the old x0 becomes x1, and so on."""
    prior_variance = predicted_variance + process_variance
    weight = 1.0 / (prior_variance + measurement_variance)
    step = (y - predicted) * weight
    keep = measurement_variance * weight
    k_x0 = c_x0 * weight
    k_x1 = c_x1 * weight
    k_t1 = c_t1 * weight
    k_t2 = c_t2 * weight
    k_t3 = c_t3 * weight
    k_e = c_e * weight
    return (
        predicted + prior_variance * step, x0 + c_x0 * step, x1 + c_x1 * step,
        t1 + c_t1 * step, t2 + c_t2 * step, t3 + c_t3 * step, e + c_e * step,
        keep * prior_variance, keep * c_x0, keep * c_x1, keep * c_t1, keep * c_t2, keep * c_t3, keep * c_e,
        P_x0_x0 - k_x0 * c_x0, P_x0_x1 - k_x0 * c_x1,
        P_x0_t1 - k_x0 * c_t1, P_x0_t2 - k_x0 * c_t2, P_x0_t3 - k_x0 * c_t3, P_x0_e - k_x0 * c_e,
        P_x1_x1 - k_x1 * c_x1,
        P_x1_t1 - k_x1 * c_t1, P_x1_t2 - k_x1 * c_t2, P_x1_t3 - k_x1 * c_t3, P_x1_e - k_x1 * c_e,
        P_t1_t1 - k_t1 * c_t1, P_t1_t2 - k_t1 * c_t2, P_t1_t3 - k_t1 * c_t3, P_t1_e - k_t1 * c_e,
        P_t2_t2 - k_t2 * c_t2, P_t2_t3 - k_t2 * c_t3, P_t2_e - k_t2 * c_e,
        P_t3_t3 - k_t3 * c_t3, P_t3_e - k_t3 * c_e,
        P_e_e - k_e * c_e,
        next_g_rate, next_n_rate,
    )  # fmt: skip


@at_lane(LAYOUT)
def free_energy(
    predicted, predicted_variance, y, g_shape, n_shape, prior_g_rate, prior_n_rate,
    process_variance, measurement_variance,
):  # fmt: skip
    """Free energy of this sample in nats after an iteration, to first order."""
    return sample_free_energy(
        y - predicted, predicted_variance, process_variance, measurement_variance,
        g_shape, prior_g_rate, n_shape, prior_n_rate,
    )  # fmt: skip
