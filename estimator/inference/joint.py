"""Structured factorisation for any model: q(state, coefficients) jointly Gaussian, times q(γ) q(ξ).

The same equations as `estimator.inference.structured`, with matrices of the model's size: a model says where it moves
the state, with which Jacobian, and how the output reads off the joint state. Coefficients do not move, so only the
state's rows of the covariance change in a prediction; unless they are let walk, to follow a system that changes.
`estimator.inference.sigma_points` has another `predict`, without the Jacobian.
"""

from __future__ import annotations

import numpy as np

from estimator.inference.noise import half_noise_powers, sample_free_energy
from estimator.lanes import jit

#: Places in the four numbers of the noises' beliefs.
G_SHAPE, G_RATE, N_SHAPE, N_RATE = range(4)


@jit
def predict(mean, cov, moved, jacobian, walk, rows):
    """Move the state, and its rows of the covariance with it; without process noise.

    Args:
        mean: (n,) of the joint state; its first ``len(moved)`` entries become ``moved``.
        cov: (n, n), overwritten.
        moved: (k,) the state after the step.
        jacobian: (k, n) its derivative by the joint state before the step.
        walk: (n - k,) variances of the coefficients' random walk; 0 where they do not change.
        rows: (k, n) memory.
    """
    k, n = jacobian.shape
    for i in range(k):
        for j in range(n):
            total = 0.0
            for m in range(n):
                total += jacobian[i, m] * cov[m, j]
            rows[i, j] = total
    for i in range(k):
        for j in range(i, k):
            total = 0.0
            for m in range(n):
                total += rows[i, m] * jacobian[j, m]
            cov[i, j] = total
            cov[j, i] = total
        for j in range(k, n):
            cov[i, j] = rows[i, j]
            cov[j, i] = rows[i, j]
        mean[i] = moved[i]
    for i in range(k, n):
        cov[i, i] += walk[i - k]


@jit
def correct(mean, cov, readout, direction, innovation, noises, iterations, trace, gain):
    """Condition on an output, and learn the noise precisions from it.

    Args:
        mean: (n,) predicted; overwritten with the posterior.
        cov: (n, n) predicted, without process noise; overwritten with the posterior.
        readout: (n,) derivative of the output by the joint state.
        direction: (k,) how the process noise moves the state; scaled so that it moves the output by w.
        innovation: the output minus its prediction [V]; NaN where the output is missing, and nothing is learned.
        noises: (4,) shapes and rates of q(γ) and q(ξ); overwritten.
        iterations: at least 1.
        trace: (iterations,) receives the free energy after each iteration [nats]; 0 for a missing output.
        gain: (n,) memory.

    Returns:
        The innovation's variance S [V²].
    """
    n = len(mean)
    variance = 0.0
    for i in range(n):
        total = 0.0
        for j in range(n):
            total += cov[i, j] * readout[j]
        gain[i] = total
    for i in range(n):
        variance += readout[i] * gain[i]

    seen = not np.isnan(innovation)
    q, r = noises[G_RATE] / noises[G_SHAPE], noises[N_RATE] / noises[N_SHAPE]
    g_shape, n_shape = noises[G_SHAPE] + 0.5, noises[N_SHAPE] + 0.5
    g_rate, n_rate = noises[G_RATE], noises[N_RATE]
    next_q, next_r = q, r
    trace[:] = 0.0
    for i in range(iterations if seen else 0):
        q, r = next_q, next_r
        half_w, half_v = half_noise_powers(innovation, variance, q, r)
        g_rate, n_rate = noises[G_RATE] + half_w, noises[N_RATE] + half_v
        next_q, next_r = g_rate / g_shape, n_rate / n_shape
        trace[i] = sample_free_energy(innovation, variance, q, r, g_shape, noises[G_RATE], n_shape, noises[N_RATE])
    if seen:
        noises[G_SHAPE], noises[G_RATE], noises[N_SHAPE], noises[N_RATE] = g_shape, g_rate, n_shape, n_rate

    k = len(direction)
    for i in range(k):
        gain[i] += q * direction[i]
        for j in range(k):
            cov[i, j] += q * direction[i] * direction[j]
    total = variance + q + r
    for i in range(n if seen else 0):
        weight = gain[i] / total
        mean[i] += weight * innovation
        for j in range(i, n):
            cov[i, j] -= weight * gain[j]
            cov[j, i] = cov[i, j]
    return total
