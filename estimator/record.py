"""The layout of a belief: which quantity lies in which row of a block.

A belief is one flat float64 record of `RECORD_SIZE` numbers: the means of (x_t, x_{t-1}, x_{t-2}, θ1, θ2, θ3, η), the
upper triangle of their covariance, and the Gamma shapes and rates of γ (process precision) and ξ (measurement
precision). Both factorisations use the same record; mean field leaves the cross-covariances and the third lag zero.
The belief of the physical equation (`estimator.continuous`) uses it too: x0 and x1 are x and x', t1, t2, t3 and e are
stiffness, cubic stiffness, damping and gain, all counted in samples, and x2 is zero.

Names of rows, as they appear as parameters of the scalar functions:

===================  ==================================================================
``x0 x1 x2``         means of x_t, x_{t-1}, x_{t-2}  [V]
``t1 t2 t3 e``       means of θ1, θ2 [1/V²], θ3, η
``P_i_j``            covariance of quantities i and j
``g_shape g_rate``   γ ~ Gamma(shape, rate), rate in V²
``n_shape n_rate``   ξ ~ Gamma(shape, rate), rate in V²
``u y``              the sample: input that acted on x_{t-1}, and output of x_t  [V]
``last_u``           the input before ``u`` [V], for those who interpolate between the two
===================  ==================================================================
"""

from __future__ import annotations

from itertools import combinations_with_replacement

from estimator.lanes import rows

STATES = ("x0", "x1", "x2")
COEFFICIENTS = ("t1", "t2", "t3", "e")
QUANTITIES = STATES + COEFFICIENTS
COVARIANCES = tuple(f"P_{i}_{j}" for i, j in combinations_with_replacement(QUANTITIES, 2))
NOISES = ("g_shape", "g_rate", "n_shape", "n_rate")

#: The belief itself: 7 means, 28 covariances, 4 noise parameters.
RECORD = QUANTITIES + COVARIANCES + NOISES
RECORD_SIZE = len(RECORD)

#: The noises' rates before the sample, which the free energy of either update needs.
_PRIOR_RATES = "prior_g_rate prior_n_rate"

#: What one structured update keeps between its loops.
_STRUCTURED = """
    predicted predicted_variance c_x0 c_x1 c_t1 c_t2 c_t3 c_e
    process_variance measurement_variance next_process_variance next_measurement_variance next_g_rate next_n_rate
"""

#: What the iterations of one mean-field update share: the prior factors, and the marginals of z_t and z_{t-1}.
_MEAN_FIELD = """
    prior_t1 prior_t2 prior_t3 prior_e
    prior_V_11 prior_V_12 prior_V_13 prior_V_22 prior_V_23 prior_V_33 prior_e_variance
    prior_L_00 prior_L_01 prior_L_11 prior_h_0 prior_h_1
    prior_x0 prior_x1 z0 z1 z0_variance q0 q1 Q_00 Q_01 Q_11 gamma xi
    e_information theta_information theta_shift residual_power error_power g_increment n_increment
"""

#: Rows that lie idle but during a mean-field update.
MEAN_FIELD_SCRATCH = tuple(_MEAN_FIELD.split())
#: What one update of the physical equation keeps, besides what is in `_STRUCTURED`: the point that moves, with its
#: sensitivities to the state and the parameters before the sample, the covariance that process noise brings it, and the
#: covariances of the velocity that is reached.
_CONTINUOUS = """
    moved_x moved_v N_xx N_xv N_vv X_x0 X_x1 X_t1 X_t2 X_t3 X_e V_x0 V_x1 V_t1 V_t2 V_t3 V_e d_x1 d_t1 d_t2 d_t3 d_e
"""

#: Rows of an estimator's block. An environment's block has these first, then its own.
LAYOUT = rows(" ".join(RECORD), "u y last_u", _PRIOR_RATES, _STRUCTURED, _MEAN_FIELD, _CONTINUOUS)
N_ROWS = len(LAYOUT)

#: From this row on, a block holds what only lasts for an update.
SCRATCH_BEGIN = LAYOUT["prior_g_rate"]
