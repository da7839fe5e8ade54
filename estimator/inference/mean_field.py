"""Mean-field factorisation, the paper's: q(θ) q(η) q(γ) q(ξ) q(z_t) q(z_{t-1}), with z_t = (x_t, x_{t-1}).

Messages 6 to 11 of Kouw (2020), Fig. 1 and Eq. (7), as closed-form updates: rank one for θ, 2×2 for z_{t-1}, where
the factor of the transition is N(z_t | S z_{t-1} + s g(θ, z_{t-1}) + s η u, diag(1/γ, ε)) and expectations of
g = θ1 x + θ2 x³ + θ3 x₋ are taken to first order. One iteration updates η, θ, z_t, z_{t-1}, γ, ξ, in this order; the
prior factors of the step stay fixed during its iterations.

The published run has two departures from the model, kept under ``as_published`` so that its numbers reproduce: the
message to z_{t-1} lacks the linearisation offset g(m) - Jₓᵀm, and the rate of γ gets a further E[x_{t-1}]²/2.
"""

from __future__ import annotations

import math

from estimator.elementary import LOG_2PI, expected_log_gamma, gamma_step_divergence
from estimator.lanes import at_lane, inlined, jit, lanewise
from estimator.record import LAYOUT

#: Precision of the identity x_{t-1} = x_{t-1} between z_t and z_{t-1}: 1/ε of the paper.
TIE = 1e12


@lanewise(
    LAYOUT,
    "prior_t1 prior_t2 prior_t3 prior_e "
    "prior_V_11 prior_V_12 prior_V_13 prior_V_22 prior_V_23 prior_V_33 prior_e_variance "
    "prior_L_00 prior_L_01 prior_L_11 prior_h_0 prior_h_1 prior_g_rate prior_n_rate "
    "prior_x0 prior_x1 z0 z1 z0_variance q0 q1 gamma xi g_shape n_shape",
)
def begin(
    x0, x1, t1, t2, t3, e, P_x0_x0, P_x0_x1, P_x1_x1,
    P_t1_t1, P_t1_t2, P_t1_t3, P_t2_t2, P_t2_t3, P_t3_t3, P_e_e, g_shape, g_rate, n_shape, n_rate,
):  # fmt: skip
    """Make the last marginals this step's prior factors; the state's in information form (L, h)."""
    determinant = P_x0_x0 * P_x1_x1 - P_x0_x1 * P_x0_x1
    l00 = P_x1_x1 / determinant
    l01 = -P_x0_x1 / determinant
    l11 = P_x0_x0 / determinant
    return (
        t1, t2, t3, e,
        P_t1_t1, P_t1_t2, P_t1_t3, P_t2_t2, P_t2_t3, P_t3_t3, P_e_e,
        l00, l01, l11, l00 * x0 + l01 * x1, l01 * x0 + l11 * x1, g_rate, n_rate,
        x0, x1, x0, x1, P_x0_x0, x0, x1, g_shape / g_rate, n_shape / n_rate, g_shape + 0.5, n_shape + 0.5,
    )  # fmt: skip


@lanewise(
    LAYOUT,
    "t1 t2 t3 e P_t1_t1 P_t1_t2 P_t1_t3 P_t2_t2 P_t2_t3 P_t3_t3 P_e_e "
    "z0 z1 z0_variance q0 q1 Q_00 Q_01 Q_11 g_rate n_rate gamma xi "
    "e_information theta_information theta_shift residual_power error_power g_increment n_increment",
    uniform="as_published",
)
def iterate(
    t1, t2, t3, z0, q0, q1, u, y, gamma, xi, g_shape, n_shape,
    prior_t1, prior_t2, prior_t3, prior_e,
    prior_V_11, prior_V_12, prior_V_13, prior_V_22, prior_V_23, prior_V_33, prior_e_variance,
    prior_L_00, prior_L_01, prior_L_11, prior_h_0, prior_h_1, prior_g_rate, prior_n_rate,
    as_published,
):  # fmt: skip
    """One iteration of the six updates. Both noises' shapes already count this sample."""
    # η: the residual E[x_t] - g under the last θ.
    regression = t1 * q0 + t2 * (q0 * q0 * q0) + t3 * q1
    e_information = gamma * u * u * prior_e_variance
    e_variance = prior_e_variance / (1.0 + e_information)
    e = prior_e + e_variance * gamma * u * (z0 - regression - prior_e * u)

    # θ: rank one in J = ∂g/∂θ.
    j1 = q0
    j2 = q0 * q0 * q0
    j3 = q1
    s1 = prior_V_11 * j1 + prior_V_12 * j2 + prior_V_13 * j3
    s2 = prior_V_12 * j1 + prior_V_22 * j2 + prior_V_23 * j3
    s3 = prior_V_13 * j1 + prior_V_23 * j2 + prior_V_33 * j3
    leverage = j1 * s1 + j2 * s2 + j3 * s3
    theta_information = gamma * leverage
    weight = gamma / (1.0 + theta_information)
    step = weight * (z0 - e * u - (j1 * prior_t1 + j2 * prior_t2 + j3 * prior_t3))
    t1 = prior_t1 + s1 * step
    t2 = prior_t2 + s2 * step
    t3 = prior_t3 + s3 * step
    V_11 = prior_V_11 - weight * s1 * s1
    V_12 = prior_V_12 - weight * s1 * s2
    V_13 = prior_V_13 - weight * s1 * s3
    V_22 = prior_V_22 - weight * s2 * s2
    V_23 = prior_V_23 - weight * s2 * s3
    V_33 = prior_V_33 - weight * s3 * s3

    # z_t: transition times likelihood; its second component repeats x_{t-1}.
    regression = t1 * j1 + t2 * j2 + t3 * j3
    z0_variance = 1.0 / (gamma + xi)
    z0 = (gamma * (regression + e * u) + xi * y) * z0_variance
    z1 = q0

    # z_{t-1}: prior times the message backward through the transition, linearised at the last mean.
    a0 = t1 + 3.0 * t2 * q0 * q0
    a1 = t3
    offset = 0.0 if as_published else regression - a0 * q0 - a1 * q1
    pull = gamma * (z0 - e * u - offset)
    l00 = prior_L_00 + gamma * a0 * a0 + TIE
    l01 = prior_L_01 + gamma * a0 * a1
    l11 = prior_L_11 + gamma * a1 * a1
    h0 = prior_h_0 + a0 * pull + TIE * z1
    h1 = prior_h_1 + a1 * pull
    determinant = l00 * l11 - l01 * l01
    Q_00 = l11 / determinant
    Q_01 = -l01 / determinant
    Q_11 = l00 / determinant
    q0 = Q_00 * h0 + Q_01 * h1
    q1 = Q_01 * h0 + Q_11 * h1

    # γ and ξ: half the expected squared noises.
    residual_power = _residual_power(
        t1, t2, t3, e, u, z0, z0_variance, q0, q1, Q_00, Q_01, Q_11, V_11, V_12, V_13, V_22, V_23, V_33, e_variance
    )  # fmt: skip
    error = y - z0
    error_power = error * error + z0_variance
    g_increment = 0.5 * (residual_power + (q0 * q0 if as_published else 0.0))
    n_increment = 0.5 * error_power
    g_rate = prior_g_rate + g_increment
    n_rate = prior_n_rate + n_increment
    return (
        t1, t2, t3, e, V_11, V_12, V_13, V_22, V_23, V_33, e_variance,
        z0, z1, z0_variance, q0, q1, Q_00, Q_01, Q_11, g_rate, n_rate, g_shape / g_rate, n_shape / n_rate,
        e_information, theta_information, step * step * leverage,
        residual_power, error_power, g_increment, n_increment,
    )  # fmt: skip


@inlined
def _residual_power(
    t1, t2, t3, e, u, z0, z0_variance, q0, q1, Q_00, Q_01, Q_11, V_11, V_12, V_13, V_22, V_23, V_33, e_variance
):  # fmt: skip
    """E[(x_t - g - η u)²] to first order."""
    j2 = q0 * q0 * q0
    a0 = t1 + 3.0 * t2 * q0 * q0
    residual = z0 - (t1 * q0 + t2 * j2 + t3 * q1) - e * u
    from_state = a0 * a0 * Q_00 + 2.0 * a0 * t3 * Q_01 + t3 * t3 * Q_11
    from_theta = V_11 * q0 * q0 + V_22 * j2 * j2 + V_33 * q1 * q1
    cross = V_12 * q0 * j2 + V_13 * q0 * q1 + V_23 * j2 * q1
    return residual * residual + z0_variance + from_state + from_theta + 2.0 * cross + u * u * e_variance


@lanewise(LAYOUT, "x0 x1 P_x0_x0 P_x0_x1 P_x1_x1")
def end(z0, z1, z0_variance):
    """Keep q(z_t) as the state belief; the coefficients and noises are in their rows already."""
    return z0, z1, z0_variance, 0.0, 1.0 / TIE


@at_lane(LAYOUT)
def free_energy(
    e, g_shape, g_rate, n_shape, n_rate, prior_x0, prior_x1, prior_e, prior_e_variance,
    prior_L_00, prior_L_01, prior_L_11, prior_g_rate, prior_n_rate,
    z1, z0_variance, q0, q1, Q_00, Q_01, Q_11, gamma, xi,
    e_information, theta_information, theta_shift, residual_power, error_power, g_increment, n_increment,
):  # fmt: skip
    """Free energy of this sample in nats after an iteration (before `end`), expectations of g to first order.

    F = Σ KL[q || prior factor] over θ, η, z_{t-1}, γ, ξ, minus the entropy of q(z_t), minus the expected log
    transition and log likelihood. θ and η moved by an update of rank one, so their divergences are scalars.
    """
    e_shift = (e - prior_e) * (e - prior_e) / prior_e_variance
    coefficients = _rank_one_divergence(theta_information, theta_shift) + _rank_one_divergence(e_information, e_shift)

    d0 = q0 - prior_x0
    d1 = q1 - prior_x1
    overlap = prior_L_00 * Q_00 + 2.0 * prior_L_01 * Q_01 + prior_L_11 * Q_11
    shift = prior_L_00 * d0 * d0 + 2.0 * prior_L_01 * d0 * d1 + prior_L_11 * d1 * d1
    volumes = (prior_L_00 * prior_L_11 - prior_L_01 * prior_L_01) * (Q_00 * Q_11 - Q_01 * Q_01)
    last_state = 0.5 * (overlap - 2.0 + shift - math.log(volumes))

    noises = gamma_step_divergence(g_shape - 0.5, prior_g_rate, g_increment)
    noises += gamma_step_divergence(n_shape - 0.5, prior_n_rate, n_increment)

    tie_power = (z1 - q0) * (z1 - q0) + 1.0 / TIE + Q_00
    transition = LOG_2PI + 0.5 * (gamma * residual_power + TIE * tie_power)
    transition -= 0.5 * (expected_log_gamma(g_shape, g_rate) + math.log(TIE))
    likelihood = 0.5 * (LOG_2PI - expected_log_gamma(n_shape, n_rate) + xi * error_power)
    state_entropy = LOG_2PI + 1.0 + 0.5 * (math.log(z0_variance) - math.log(TIE))
    return coefficients + last_state + noises + transition + likelihood - state_entropy


@jit
def _rank_one_divergence(information, shift):
    """KL[N(m + d, (P + g j jᵀ)⁻¹) || N(m, P⁻¹)] with information g jᵀP⁻¹j and shift dᵀP d."""
    return 0.5 * (math.log1p(information) - information / (1.0 + information) + shift)
