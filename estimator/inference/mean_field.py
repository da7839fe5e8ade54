"""The paper's mean-field update: q(θ) q(η) q(γ) q(ξ) q(z_t) q(z_{t-1}), with z_t = (x_t, x_{t-1}).

Messages 6 to 11 of Kouw (2020), Fig. 1 and Eq. (7), as closed-form updates: rank one for θ, 2×2 for z_{t-1}. The
transition is N(z_t | S z_{t-1} + s g(θ, z_{t-1}) + s η u, diag(1/γ, ε)), and expectations of g = θ1 x + θ2 x³ + θ3 x₋
are taken to first order. One iteration updates η, θ, z_t, z_{t-1}, γ, ξ, in this order; the prior factors of a sample
stay fixed during its iterations.

``as_published`` reproduces the numbers of the published run, which departs from the model twice: the message to z_{t-1}
lacks the linearisation offset g(m) - Jₓᵀm, and the rate of γ gets a further E[x_{t-1}]²/2.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

from estimator.compilation.elementary_functions import LOG_2PI, expected_log_gamma, gamma_update_divergence
from estimator.compilation.scalar_jit import scalar_jit
from estimator.compilation.simd import LANES, jit, jit_closure, jit_single_lane, lanewise, number_rows
from estimator.engine.source_cache import variant_digest
from estimator.engine.storage_layout import update_layout as layout_of_update
from estimator.models.difference_equation import difference

#: Precision 1/ε of the identity between the x_{t-1} of z_t and of z_{t-1} [1/V²].
TIE_PRECISION = 1e12

_COVARIANCE_ROWS = """
    P_theta1_theta1 P_theta1_theta2 P_theta1_theta3 P_theta2_theta2 P_theta2_theta3 P_theta3_theta3 P_eta_eta
"""

#: The prior factors of a sample, fixed during its iterations.
_PRIOR_FACTOR_ROWS = """
    prior_theta1 prior_theta2 prior_theta3 prior_eta
    prior_V_11 prior_V_12 prior_V_13 prior_V_22 prior_V_23 prior_V_33 prior_eta_variance
    prior_L_00 prior_L_01 prior_L_11 prior_h_0 prior_h_1 prior_gamma_rate prior_xi_rate prior_x1 prior_x2
"""

#: The marginals of z_t = (z0, z1) and z_{t-1} = (q0, q1), and terms of the free energy.
_MARGINAL_ROWS = "z0 z1 z0_variance q0 q1"
_MOMENT_ROWS = """
    Q_00 Q_01 Q_11
    eta_information theta_information theta_shift residual_power error_power gamma_increment xi_increment
"""

#: Rows in use during an update only.
SCRATCH_ROWS = tuple(f"{_PRIOR_FACTOR_ROWS} {_MARGINAL_ROWS} gamma xi {_MOMENT_ROWS}".split())


class MeanFieldUpdate(NamedTuple):
    """The compiled update over the rows of a block.

    Attributes:
        begin: ``begin(W)``: copies the last marginals into the sample's prior factors.
        iterate: ``iterate(W, as_published)``: one iteration of the six updates.
        end: ``end(W)``: copies q(z_t) into the state.
        free_energy: ``free_energy(W, j)`` of lane j after an iteration [nats]; before ``end``, or after it.
    """

    begin: Any
    iterate: Any
    end: Any
    free_energy: Any


def compile_mean_field(layout: Mapping[str, int], lanes: int = LANES) -> MeanFieldUpdate:
    """Compile the update for a block with ``lanes`` lanes and the rows of `mean_field_layout`."""
    return MeanFieldUpdate(
        lanewise(layout, f"{_PRIOR_FACTOR_ROWS} {_MARGINAL_ROWS} gamma xi GAMMA_SHAPE XI_SHAPE_y", lanes=lanes)(begin),
        lanewise(
            layout,
            f"theta1 theta2 theta3 eta {_COVARIANCE_ROWS} {_MARGINAL_ROWS} "
            f"GAMMA_RATE XI_RATE_y gamma xi {_MOMENT_ROWS}",
            "as_published",
            lanes,
        )(iterate),
        lanewise(layout, "x1 x2 P_x1_x1 P_x1_x2 P_x2_x2", lanes=lanes)(end),
        jit_single_lane(layout, free_energy, lanes),
    )


def compile_mean_field_update(layout: Mapping[str, int]) -> Any:
    """Compile ``update(W, iterations, as_published)``, the update of every lane by its ``U_u_0`` and ``Y_y``."""
    begin, iterate, end, _ = compile_mean_field(layout)

    @jit_closure(variant_digest(sorted(layout.items())))
    def update(W, iterations, as_published):
        begin(W)
        for _ in range(iterations):
            iterate(W, as_published)
        end(W)

    return update


def mean_field_layout() -> dict[str, int]:
    """Rows of a block: the belief update of the paper's model, and `SCRATCH_ROWS`."""
    place = layout_of_update(difference(), 0)
    return place | number_rows(" ".join(SCRATCH_ROWS), first_row=len(place))


def begin(
    x1, x2, theta1, theta2, theta3, eta, P_x1_x1, P_x1_x2, P_x2_x2,
    P_theta1_theta1, P_theta1_theta2, P_theta1_theta3, P_theta2_theta2, P_theta2_theta3, P_theta3_theta3, P_eta_eta,
    GAMMA_SHAPE, GAMMA_RATE, XI_SHAPE_y, XI_RATE_y,
):  # fmt: skip
    """Copy the last marginals into the sample's prior factors; the state's factor in information form (L, h)."""
    determinant = P_x1_x1 * P_x2_x2 - P_x1_x2 * P_x1_x2
    l00 = P_x2_x2 / determinant
    l01 = -P_x1_x2 / determinant
    l11 = P_x1_x1 / determinant
    return (
        theta1, theta2, theta3, eta,
        P_theta1_theta1, P_theta1_theta2, P_theta1_theta3, P_theta2_theta2, P_theta2_theta3, P_theta3_theta3, P_eta_eta,
        l00, l01, l11, l00 * x1 + l01 * x2, l01 * x1 + l11 * x2, GAMMA_RATE, XI_RATE_y,
        x1, x2, x1, x2, P_x1_x1, x1, x2,
        GAMMA_SHAPE / GAMMA_RATE, XI_SHAPE_y / XI_RATE_y, GAMMA_SHAPE + 0.5, XI_SHAPE_y + 0.5,
    )  # fmt: skip


def iterate(
    theta1, theta2, theta3, z0, q0, q1, U_u_0, Y_y, gamma, xi, GAMMA_SHAPE, XI_SHAPE_y,
    prior_theta1, prior_theta2, prior_theta3, prior_eta,
    prior_V_11, prior_V_12, prior_V_13, prior_V_22, prior_V_23, prior_V_33, prior_eta_variance,
    prior_L_00, prior_L_01, prior_L_11, prior_h_0, prior_h_1, prior_gamma_rate, prior_xi_rate,
    as_published,
):  # fmt: skip
    """One iteration of the six updates. The shapes of both precisions include this sample already."""
    u, y = U_u_0, Y_y
    # η: the residual E[x_t] - g under the last θ.
    regression = theta1 * q0 + theta2 * (q0 * q0 * q0) + theta3 * q1
    eta_information = gamma * u * u * prior_eta_variance
    eta_variance = prior_eta_variance / (1.0 + eta_information)
    eta = prior_eta + eta_variance * gamma * u * (z0 - regression - prior_eta * u)

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
    step = weight * (z0 - eta * u - (j1 * prior_theta1 + j2 * prior_theta2 + j3 * prior_theta3))
    theta1 = prior_theta1 + s1 * step
    theta2 = prior_theta2 + s2 * step
    theta3 = prior_theta3 + s3 * step
    V_11 = prior_V_11 - weight * s1 * s1
    V_12 = prior_V_12 - weight * s1 * s2
    V_13 = prior_V_13 - weight * s1 * s3
    V_22 = prior_V_22 - weight * s2 * s2
    V_23 = prior_V_23 - weight * s2 * s3
    V_33 = prior_V_33 - weight * s3 * s3

    # z_t: transition times likelihood; its second component repeats x_{t-1}.
    regression = theta1 * j1 + theta2 * j2 + theta3 * j3
    z0_variance = 1.0 / (gamma + xi)
    z0 = (gamma * (regression + eta * u) + xi * y) * z0_variance
    z1 = q0

    # z_{t-1}: prior times the message backward through the transition, linearised at the last mean.
    a0 = theta1 + 3.0 * theta2 * q0 * q0
    a1 = theta3
    offset = 0.0 if as_published else regression - a0 * q0 - a1 * q1
    pull = gamma * (z0 - eta * u - offset)
    l00 = prior_L_00 + gamma * a0 * a0 + TIE_PRECISION
    l01 = prior_L_01 + gamma * a0 * a1
    l11 = prior_L_11 + gamma * a1 * a1
    h0 = prior_h_0 + a0 * pull + TIE_PRECISION * z1
    h1 = prior_h_1 + a1 * pull
    determinant = l00 * l11 - l01 * l01
    Q_00 = l11 / determinant
    Q_01 = -l01 / determinant
    Q_11 = l00 / determinant
    q0 = Q_00 * h0 + Q_01 * h1
    q1 = Q_01 * h0 + Q_11 * h1

    # γ and ξ: half the expected squared noises.
    residual_power = _residual_power(
        theta1, theta2, theta3, eta, u, z0, z0_variance, q0, q1, Q_00, Q_01, Q_11,
        V_11, V_12, V_13, V_22, V_23, V_33, eta_variance,
    )  # fmt: skip
    error = y - z0
    error_power = error * error + z0_variance
    gamma_increment = 0.5 * (residual_power + (q0 * q0 if as_published else 0.0))
    xi_increment = 0.5 * error_power
    gamma_rate = prior_gamma_rate + gamma_increment
    xi_rate = prior_xi_rate + xi_increment
    return (
        theta1, theta2, theta3, eta, V_11, V_12, V_13, V_22, V_23, V_33, eta_variance,
        z0, z1, z0_variance, q0, q1,
        gamma_rate, xi_rate, GAMMA_SHAPE / gamma_rate, XI_SHAPE_y / xi_rate,
        Q_00, Q_01, Q_11, eta_information, theta_information, step * step * leverage,
        residual_power, error_power, gamma_increment, xi_increment,
    )  # fmt: skip


@scalar_jit
def _residual_power(
    theta1, theta2, theta3, eta, u, z0, z0_variance, q0, q1, Q_00, Q_01, Q_11,
    V_11, V_12, V_13, V_22, V_23, V_33, eta_variance,
):  # fmt: skip
    """E[(x_t - g - η u)²] to first order."""
    j2 = q0 * q0 * q0
    a0 = theta1 + 3.0 * theta2 * q0 * q0
    residual = z0 - (theta1 * q0 + theta2 * j2 + theta3 * q1) - eta * u
    from_state = a0 * a0 * Q_00 + 2.0 * a0 * theta3 * Q_01 + theta3 * theta3 * Q_11
    from_theta = V_11 * q0 * q0 + V_22 * j2 * j2 + V_33 * q1 * q1
    cross = V_12 * q0 * j2 + V_13 * q0 * q1 + V_23 * j2 * q1
    return residual * residual + z0_variance + from_state + from_theta + 2.0 * cross + u * u * eta_variance


def end(z0, z1, z0_variance):
    """Copy q(z_t) into the state; coefficients and precisions are in their rows already."""
    return z0, z1, z0_variance, 0.0, 1.0 / TIE_PRECISION


def free_energy(
    eta, GAMMA_SHAPE, GAMMA_RATE, XI_SHAPE_y, XI_RATE_y, prior_x1, prior_x2, prior_eta, prior_eta_variance,
    prior_L_00, prior_L_01, prior_L_11, prior_gamma_rate, prior_xi_rate,
    z1, z0_variance, q0, q1, Q_00, Q_01, Q_11, gamma, xi,
    eta_information, theta_information, theta_shift, residual_power, error_power, gamma_increment, xi_increment,
):  # fmt: skip
    """Free energy of the sample after an iteration [nats], with expectations of g to first order.

    F = Σ KL[q || prior factor] over θ, η, z_{t-1}, γ, ξ, minus the entropy of q(z_t), minus the expected log
    transition and log likelihood. The updates of θ and η have rank one, so their divergences are scalars.
    """
    eta_shift = (eta - prior_eta) * (eta - prior_eta) / prior_eta_variance
    coefficients = _rank_one_divergence(theta_information, theta_shift)
    coefficients += _rank_one_divergence(eta_information, eta_shift)

    d0 = q0 - prior_x1
    d1 = q1 - prior_x2
    overlap = prior_L_00 * Q_00 + 2.0 * prior_L_01 * Q_01 + prior_L_11 * Q_11
    shift = prior_L_00 * d0 * d0 + 2.0 * prior_L_01 * d0 * d1 + prior_L_11 * d1 * d1
    volumes = (prior_L_00 * prior_L_11 - prior_L_01 * prior_L_01) * (Q_00 * Q_11 - Q_01 * Q_01)
    last_state = 0.5 * (overlap - 2.0 + shift - math.log(volumes))

    noises = gamma_update_divergence(GAMMA_SHAPE - 0.5, prior_gamma_rate, gamma_increment)
    noises += gamma_update_divergence(XI_SHAPE_y - 0.5, prior_xi_rate, xi_increment)

    tie_power = (z1 - q0) * (z1 - q0) + 1.0 / TIE_PRECISION + Q_00
    transition = LOG_2PI + 0.5 * (gamma * residual_power + TIE_PRECISION * tie_power)
    transition -= 0.5 * (expected_log_gamma(GAMMA_SHAPE, GAMMA_RATE) + math.log(TIE_PRECISION))
    likelihood = 0.5 * (LOG_2PI - expected_log_gamma(XI_SHAPE_y, XI_RATE_y) + xi * error_power)
    state_entropy = LOG_2PI + 1.0 + 0.5 * (math.log(z0_variance) - math.log(TIE_PRECISION))
    return coefficients + last_state + noises + transition + likelihood - state_entropy


@jit
def _rank_one_divergence(information, shift):
    """KL[N(m + d, (P + g j jᵀ)⁻¹) || N(m, P⁻¹)] with information g jᵀP⁻¹j and shift dᵀP d."""
    return 0.5 * (math.log1p(information) - information / (1.0 + information) + shift)
