"""Climbing the worth of an input under the limits of an experiment, compiled: projected gradient ascent."""

from __future__ import annotations

import numpy as np

from agents.design import START_SIZE, climb, worth
from estimator.lanes import jit, kernel

# Adam (Kingma and Ba 2015): decay of the two averages of the gradient.
_MEAN_DECAY, _SQUARE_DECAY = 0.9, 0.99

#: The gradient aims at this much of the displacement limit, so that what it ends with is within the limit itself.
_AIM = 0.9995

#: Penalty [nats] of displacements beyond the limit, rising from the first to the last iteration.
_SOFT, _HARD = 1e2, 1e4


@kernel
def improve(theta, precision, q, r, limit, amplitude, energy, rate, iterations, inputs, values):
    """Improve several inputs of one system, each on its own.

    Args:
        theta: (4,) its coefficients.
        precision: (4, 4) Λ0.
        q: variance of the process noise [V²].
        r: variance of the measurement noise [V²].
        limit: of the displacement without noise [V].
        amplitude: limit of the input [V].
        energy: limit of Σ u² [V²], inf where there is none.
        rate: first step of the gradient in parts of the amplitude; the steps fall linearly to 0.
        iterations: of the gradient.
        inputs: (starts, T) [V], overwritten by the best found that keeps all limits.
        values: (starts,) receives their worth [nats], -inf where nothing found keeps them.
    """
    start = np.zeros(START_SIZE)
    tape = np.empty((inputs.shape[1] + 1, START_SIZE))
    F = np.empty((4, 4))
    for i in range(len(inputs)):
        u = inputs[i]
        project(u, amplitude, energy)
        ascend(theta, precision, q, r, limit, amplitude, energy, rate, iterations, start, u, tape, F)
        values[i], peak = worth(theta, precision, q, r, limit, 0.0, start, u, tape, F)
        if not peak <= limit:
            values[i] = -np.inf


@jit
def project(u, amplitude, energy):
    """Clip the inputs (T,) to their amplitude, and shrink them to their energy."""
    total = 0.0
    for t in range(len(u)):
        u[t] = max(-amplitude, min(amplitude, u[t]))
        total += u[t] * u[t]
    if total > energy:
        # A little less, because the square of what is rounded may be above again.
        u *= (1.0 - 1e-12) * np.sqrt(energy / total)


@jit
def ascend(theta, precision, q, r, limit, amplitude, energy, rate, iterations, start, u, tape, F):
    """Projected gradient ascent from u (T,), which the best input found within the limits overwrites, if any is."""
    gradient, mean, square = np.empty(len(u)), np.zeros(len(u)), np.zeros(len(u))
    best = u.copy()
    best_value = -np.inf
    first, second = 1.0, 1.0
    for k in range(iterations):
        penalty = _SOFT * (_HARD / _SOFT) ** (k / iterations)
        value, peak = climb(theta, precision, q, r, _AIM * limit, penalty, start, u, tape, F, gradient)
        if peak <= limit and value > best_value:
            best_value = value
            best[:] = u
        first *= _MEAN_DECAY
        second *= _SQUARE_DECAY
        step = rate * amplitude * (1.0 - k / iterations)
        for t in range(len(u)):
            slope = gradient[t] * amplitude
            mean[t] += (1.0 - _MEAN_DECAY) * (slope - mean[t])
            square[t] += (1.0 - _SQUARE_DECAY) * (slope * slope - square[t])
            u[t] += step * mean[t] / (1.0 - first) / (np.sqrt(square[t] / (1.0 - second)) + 1e-9)
        project(u, amplitude, energy)
    value, peak = worth(theta, precision, q, r, limit, 0.0, start, u, tape, F)
    if not (peak <= limit and value > best_value):
        u[:] = best


@kernel
def appraise(theta, precision, q, r, limit, inputs, values, peaks):
    """Worth [nats] and peak displacement [V] of an input (n, T) for each system (n, 4), without a penalty.

    An input ends before its first value that is not finite.
    """
    tape = np.empty((inputs.shape[1] + 1, START_SIZE))
    F = np.empty((4, 4))
    start = np.zeros(START_SIZE)
    for i in range(len(inputs)):
        used = 0
        while used < inputs.shape[1] and np.isfinite(inputs[i, used]):
            used += 1
        values[i], peaks[i] = worth(theta[i], precision, q, r, limit, 0.0, start, inputs[i, :used], tape, F)
