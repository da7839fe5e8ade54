"""The observation: a posterior, seen from its prior, as numbers within bounds."""

from __future__ import annotations

import numpy as np

from duffing_env.layout import LAYOUT, OBSERVATION
from estimator.elementary import log
from estimator.lanes import inlined, lanewise


@lanewise(
    LAYOUT,
    " ".join(f"obs_{name}" for name in OBSERVATION),
    uniform=(
        "center_t1 center_t2 center_t3 center_e scale_t1 scale_t2 scale_t3 scale_e log_gamma_0 log_xi_0 "
        "max_input max_output horizon budget"
    ),
)
def observe(
    x0, x1, t1, t2, t3, e,
    P_t1_t1, P_t1_t2, P_t1_t3, P_t1_e, P_t2_t2, P_t2_t3, P_t2_e, P_t3_t3, P_t3_e, P_e_e,
    g_shape, g_rate, n_shape, n_rate, u, y, elapsed, spent,
    center_t1, center_t2, center_t3, center_e, scale_t1, scale_t2, scale_t3, scale_e, log_gamma_0, log_xi_0,
    max_input, max_output, horizon, budget,
):  # fmt: skip
    """The observation, in the order of `OBSERVATION`. A scale is 1/std of the prior; 0 for a known θ2."""
    i1 = 1.0 / np.sqrt(P_t1_t1)
    i3 = 1.0 / np.sqrt(P_t3_t3)
    ie = 1.0 / np.sqrt(P_e_e)
    i2 = 1.0 / np.sqrt(P_t2_t2) if scale_t2 > 0.0 else 0.0
    log_std_2 = -log(i2 / scale_t2) if scale_t2 > 0.0 else 0.0
    return (
        _clip((t1 - center_t1) * scale_t1, -10.0, 10.0), _clip((t2 - center_t2) * scale_t2, -10.0, 10.0),
        _clip((t3 - center_t3) * scale_t3, -10.0, 10.0), _clip((e - center_e) * scale_e, -10.0, 10.0),
        _clip(-log(i1 / scale_t1), -20.0, 5.0), _clip(log_std_2, -20.0, 5.0),
        _clip(-log(i3 / scale_t3), -20.0, 5.0), _clip(-log(ie / scale_e), -20.0, 5.0),
        _clip(P_t1_t2 * i1 * i2, -1.0, 1.0), _clip(P_t1_t3 * i1 * i3, -1.0, 1.0), _clip(P_t1_e * i1 * ie, -1.0, 1.0),
        _clip(P_t2_t3 * i2 * i3, -1.0, 1.0), _clip(P_t2_e * i2 * ie, -1.0, 1.0), _clip(P_t3_e * i3 * ie, -1.0, 1.0),
        _clip(log(g_shape / g_rate) - log_gamma_0, -20.0, 20.0),
        _clip(log(n_shape / n_rate) - log_xi_0, -20.0, 20.0),
        _clip(x0 / max_output, -2.0, 2.0), _clip(x1 / max_output, -2.0, 2.0),
        _clip(u / max_input, -1.0, 1.0), _clip(y / max_output, -2.0, 2.0),
        _clip(1.0 - elapsed / horizon, 0.0, 1.0), _clip(1.0 - spent / budget, 0.0, 1.0),
    )  # fmt: skip


@inlined
def _clip(value, low, high):
    """A finite value within its bounds; NaN becomes the lower bound."""
    value = value if value > low else low
    return value if value < high else high
