"""The reward ``fisher``: what the outputs say of the coefficients to one who knows the truth.

The covariance recursion of `estimator.inference.structured`, linearised not at the belief but at the true oscillator,
where it truly is, and with the true noises: its covariance of (θ, η) is (Λ0 + F)⁻¹ with Λ0 the prior's precision and F
the Fisher information of the outputs so far. The recursion needs no output, so no estimator can talk it into anything.
"""

from __future__ import annotations

from duffing_env.layout import IDEAL, LAYOUT
from duffing_env.rewards import log_det_and_density
from estimator.inference import structured
from estimator.lanes import LANES, at_lane, jit, lanewise, relaid
from estimator.record import MEAN_FIELD_SCRATCH, QUANTITIES, RECORD

# Everything else that the two functions write goes to rows that only a mean-field update uses, and only while it runs.
_WRITTEN = (*QUANTITIES, *(name for name in RECORD if "x2" in name and name != "x2"))
_WRITTEN += ("g_shape", "g_rate", "n_shape", "n_rate", "prior_g_rate", "prior_n_rate")
_WRITTEN += ("next_process_variance", "next_measurement_variance", "next_g_rate", "next_n_rate")
_SCRATCH = {name: LAYOUT[row] for name, row in zip(_WRITTEN, MEAN_FIELD_SCRATCH, strict=False)}
_AFTER = {
    **LAYOUT,
    **_SCRATCH,
    **{name.removeprefix("ideal_"): LAYOUT[name] for name in IDEAL},
    "y": LAYOUT["predicted"],
}
_BEFORE = {**_AFTER, **{name: LAYOUT[row] for name, row in (("x0", "x"), ("x1", "last_x"))}}
_BEFORE |= {name: LAYOUT[f"true_{name}"] for name in ("t1", "t2", "t3", "e")}

_predict = relaid(structured.predict, _BEFORE)
_correct = relaid(structured.correct, _AFTER)


def _gain(
    P_t1_t1, P_t1_t2, P_t1_t3, P_t1_e, P_t2_t2, P_t2_t3, P_t2_e, P_t3_t3, P_t3_e, P_e_e, ideal_log_det, nonlinear
):  # fmt: skip
    """The increase of ½ log det(Λ0 + F) [nats], and -log det(Λ0 + F) itself."""
    P = (P_t1_t1, P_t1_t2, P_t1_t3, P_t1_e, P_t2_t2, P_t2_t3, P_t2_e, P_t3_t3, P_t3_e, P_e_e)
    log_det, _, _ = log_det_and_density(0.0, 0.0, 0.0, 0.0, P, 0.0, 0.0, 0.0, 0.0, nonlinear != 0.0)
    return 0.5 * (ideal_log_det - log_det), log_det


# As one function over all lanes, and over one where an episode begins.
_appraise = lanewise(_AFTER, "fisher_gain ideal_log_det", uniform="nonlinear")(_gain)
_appraise_lane = at_lane(_AFTER, "fisher_gain ideal_log_det", uniform="nonlinear")(_gain)

_PRIOR_COVARIANCES = tuple((RECORD.index(name.removeprefix("ideal_")), LAYOUT[name] * LANES) for name in IDEAL)
_PROCESS_VARIANCE, _MEASUREMENT_VARIANCE = (LAYOUT[f"{name}_variance"] * LANES for name in ("process", "measurement"))


@jit
def begin(W, j, prior, nonlinear):
    """Start lane j from the prior's covariance (RECORD_SIZE,)."""
    for source, row in _PRIOR_COVARIANCES:
        W[row + j] = prior[source]
    _appraise_lane(W, j, nonlinear)


@jit
def inform(W, process_noise, measurement_noise, nonlinear):
    """What the coming sample says, in rows ``fisher_gain``; the plant has not moved yet."""
    for j in range(LANES):
        W[_PROCESS_VARIANCE + j] = process_noise * process_noise
        W[_MEASUREMENT_VARIANCE + j] = measurement_noise * measurement_noise
    _predict(W)
    _correct(W)
    _appraise(W, nonlinear)
