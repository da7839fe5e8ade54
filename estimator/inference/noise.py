"""What one sample says about the noise precisions γ and ξ, for every estimator with a jointly Gaussian state.

All of it depends on scalars: the innovation ν = y - prediction, the prediction's variance s without this sample's
noises, and the two noise variances q = 1/E[γ] (as it acts on the output) and r = 1/E[ξ]; S = s + q + r.
"""

from __future__ import annotations

import math

from estimator.elementary import LOG_2PI, expected_log_gamma, gamma_step_divergence
from estimator.lanes import inlined, jit


@inlined
def half_noise_powers(innovation, variance, q, r):
    """Half of E[w²] and of E[v²] under the Kalman step with noise variances q and r."""
    weight = 1.0 / (variance + q + r)
    step = innovation * weight
    w = q * step
    v = r * step
    return 0.5 * (w * w + q * (1.0 - q * weight)), 0.5 * (v * v + r * (1.0 - r * weight))


@jit
def sample_free_energy(innovation, variance, q, r, g_shape, prior_g_rate, n_shape, prior_n_rate):
    """Free energy of a sample in nats, to first order.

    F = KL[q(x, c) || prior, transition, likelihood] + KL[q(γ) || prior] + KL[q(ξ) || prior]: the Gaussian part is
    ½ log 2πS + ν²/2S at the noise variances of the Kalman step, corrected for those that q(γ) and q(ξ) moved to. The
    shapes count the sample already, the rates do not.
    """
    half_w, half_v = half_noise_powers(innovation, variance, q, r)
    g_rate, n_rate = prior_g_rate + half_w, prior_n_rate + half_v
    total = variance + q + r
    gaussian = 0.5 * (LOG_2PI + math.log(total) + innovation * innovation / total)
    process = half_w * (g_shape / g_rate - 1 / q) - 0.5 * (math.log(q) + expected_log_gamma(g_shape, g_rate))
    sensor = half_v * (n_shape / n_rate - 1 / r) - 0.5 * (math.log(r) + expected_log_gamma(n_shape, n_rate))
    divergences = gamma_step_divergence(g_shape - 0.5, prior_g_rate, half_w)
    divergences += gamma_step_divergence(n_shape - 0.5, prior_n_rate, half_v)
    return gaussian + process + sensor + divergences
