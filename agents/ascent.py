"""Climbing the worth of an input under the limits of an experiment, compiled.

The method is a projected gradient with steps of given length: u ← P(u + α R g / |g|), with P the projection on the
limits and R the radius of what they allow. For long steps it is the generalised power method, which under a limit of
energy is at a summit within some ten steps: information is about quadratic in the input, as a Rayleigh quotient is.
"""

from __future__ import annotations

import numpy as np

from agents.design import START_SIZE, climb, worth
from estimator.lanes import jit, kernel

#: The gradient aims at this much of the displacement limit, so that what it ends with is within the limit itself.
_AIM = 0.9995

#: Penalty [nats] of displacements beyond that, see `agents.design`.
PENALTY = 3e3

#: The last step in parts of the first.
_LAST = 0.05


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
        rate: first step α; the steps fall linearly to a twentieth.
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
        ascend(theta, precision, q, r, _AIM * limit, limit, amplitude, energy, rate, iterations, start, u, tape, F)
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
def ascend(theta, precision, q, r, aim, limit, amplitude, energy, rate, iterations, start, u, tape, F):
    """Climb from u (T,) with displacements beyond ``aim`` penalised; the best input met overwrites it.

    Best is the most worth, less the penalty, of those within ``limit``, inf for all. Gives that worth [nats].
    """
    gradient = np.empty(len(u))
    best = u.copy()
    best_value = -np.inf
    radius = min(np.sqrt(energy), amplitude * np.sqrt(len(u)))
    for k in range(iterations + 1):
        value, peak = climb(theta, precision, q, r, aim, PENALTY, start, u, tape, F, gradient)
        if peak <= limit and value > best_value:
            best_value = value
            best[:] = u
        length = np.sqrt(np.sum(gradient * gradient))
        if k == iterations or not length > 0.0:
            break
        u += (rate * (1.0 - (1.0 - _LAST) * k / iterations) * radius / length) * gradient
        project(u, amplitude, energy)
    u[:] = best
    return best_value


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
