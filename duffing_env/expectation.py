"""The reward ``expected_free_energy``: what a sample teaches as it is expected, before its outcome is seen.

The belief before the sample, with the input that is chosen, predicts an output of variance S = s + 1/E[γ] + 1/E[ξ] and
of covariance c with the coefficients, linearised at the belief's mean. Of the mutual information of output and
coefficients, which is what the expected free energy counts as epistemic, there is then

    I = -½ log(1 - cᵀ C⁻¹ c / S)    [nats],

with C the coefficients' covariance: the decrease of their entropy that conditioning on the output brings, whatever the
output is. For the physical equation S has N_xx/E[γ] in the place of 1/E[γ] (`estimator.inference.continuous`).

It is computed after the update, from what that left untouched: the record before it, and its prediction.
"""

from __future__ import annotations

import numpy as np

from duffing_env.layout import LAYOUT
from duffing_env.rewards import log_det_and_density
from estimator.elementary import log
from estimator.inference import structured
from estimator.lanes import lanewise, relaid
from estimator.record import MEAN_FIELD_SCRATCH, NOISES, RECORD

# The structured prediction from the record before the sample. What it makes of the noises is not needed.
_NOISES = [*NOISES, "prior_g_rate", "prior_n_rate", "next_process_variance", "next_measurement_variance"]
_BEFORE = {**LAYOUT, **{name: LAYOUT[f"saved_{name}"] for name in RECORD}}
_BEFORE |= {name: LAYOUT[row] for name, row in zip(_NOISES, MEAN_FIELD_SCRATCH, strict=False)}

#: ``predict(W)`` makes the prediction that a mean-field update goes without; ``u`` must be the input it was given.
predict = relaid(structured.predict, _BEFORE)


@lanewise(LAYOUT, "expected_gain", uniform="walk_t1 walk_t2 walk_t3 walk_e nonlinear continuous")
def expect(
    predicted_variance, c_t1, c_t2, c_t3, c_e, N_xx,
    saved_P_t1_t1, saved_P_t1_t2, saved_P_t1_t3, saved_P_t1_e, saved_P_t2_t2, saved_P_t2_t3, saved_P_t2_e,
    saved_P_t3_t3, saved_P_t3_e, saved_P_e_e, saved_g_shape, saved_g_rate, saved_n_shape, saved_n_rate,
    walk_t1, walk_t2, walk_t3, walk_e, nonlinear, continuous,
):  # fmt: skip
    """The expected information gain of a sample; the coefficients walked by these variances before it."""
    P = (
        saved_P_t1_t1 + walk_t1, saved_P_t1_t2, saved_P_t1_t3, saved_P_t1_e, saved_P_t2_t2 + walk_t2, saved_P_t2_t3,
        saved_P_t2_e, saved_P_t3_t3 + walk_t3, saved_P_t3_e, saved_P_e_e + walk_e,
    )  # fmt: skip
    process_variance = saved_g_rate / saved_g_shape
    if continuous != 0.0:
        process_variance *= N_xx
    scale = 1.0 / np.sqrt(predicted_variance + process_variance + saved_n_rate / saved_n_shape)
    log_det, log_density, _ = log_det_and_density(
        0.0, 0.0, 0.0, 0.0, P, c_t1 * scale, c_t2 * scale, c_t3 * scale, c_e * scale, nonlinear != 0.0
    )  # fmt: skip
    explained = -2.0 * log_density - log_det  # cᵀ C⁻¹ c / S
    return -0.5 * log(1.0 - explained)
