"""The reward ``expected_free_energy``: what a sample teaches as it is expected, before its outcome is seen.

The belief before the sample, with the input that is chosen, predicts an output of variance S = s + 1/E[γ] + 1/E[ξ] and
of covariance c with the coefficients, linearised at the belief's mean. Of the mutual information of output and
coefficients, which is what the expected free energy counts as epistemic, there is then

    I = -½ log(1 - cᵀ C⁻¹ c / S)    [nats],

with C the coefficients' covariance: the decrease of their entropy that conditioning on the output brings, whatever the
output is. For the physical equation S has N_xx/E[γ] in the place of 1/E[γ] (`estimator.inference.continuous`).

The prediction is the structured one for every belief; of a mean-field one the covariances between its factors are zero.
"""

from __future__ import annotations

import numpy as np

from duffing_env.layout import LAYOUT
from duffing_env.rewards import log_det_and_density
from estimator.elementary import log
from estimator.inference import continuous as ode
from estimator.inference import structured
from estimator.lanes import jit, lanewise, relaid
from estimator.record import MEAN_FIELD_SCRATCH, NOISES

# The belief stays as it is: what a prediction makes of its noises goes to rows that only a mean-field update uses.
_MADE = (*NOISES, "prior_g_rate", "prior_n_rate", "next_process_variance", "next_measurement_variance")
_LAYOUT = {**LAYOUT, **{name: LAYOUT[row] for name, row in zip(_MADE, MEAN_FIELD_SCRATCH, strict=False)}}

_predict_difference = relaid(structured.predict, _LAYOUT)
_predict_continuous = relaid(ode.predict, _LAYOUT)


@lanewise(LAYOUT, "surprise", uniform="nonlinear continuous")
def _expect(
    predicted_variance, c_t1, c_t2, c_t3, c_e, N_xx,
    P_t1_t1, P_t1_t2, P_t1_t3, P_t1_e, P_t2_t2, P_t2_t3, P_t2_e, P_t3_t3, P_t3_e, P_e_e,
    g_shape, g_rate, n_shape, n_rate, nonlinear, continuous,
):  # fmt: skip
    P = (P_t1_t1, P_t1_t2, P_t1_t3, P_t1_e, P_t2_t2, P_t2_t3, P_t2_e, P_t3_t3, P_t3_e, P_e_e)
    process_variance = g_rate / g_shape * (N_xx if continuous != 0.0 else 1.0)
    scale = 1.0 / np.sqrt(predicted_variance + process_variance + n_rate / n_shape)
    log_det, log_density, _ = log_det_and_density(
        0.0, 0.0, 0.0, 0.0, P, c_t1 * scale, c_t2 * scale, c_t3 * scale, c_e * scale, nonlinear != 0.0
    )  # fmt: skip
    explained = -2.0 * log_density - log_det  # cᵀ C⁻¹ c / S
    return 0.5 * log(1.0 - explained)


@jit
def foresee(W, nonlinear, continuous):
    """The expected free energy of the coming sample, in rows ``surprise``; its input stands in row ``u``."""
    if continuous != 0.0:
        ode.begin(W)
        for s in range(ode.SUBSTEPS):
            ode.move(W, s / ode.SUBSTEPS, 1.0 / ode.SUBSTEPS)
        _predict_continuous(W)
    else:
        _predict_difference(W)
    _expect(W, nonlinear, continuous)
