"""Climbing the worth of an input under the limits of an experiment, compiled for any model.

The method is a projected gradient with steps of given length: u ← P(u + α R g / |g|), with P the projection on the
limits and R the radius of what they allow. For long steps it is the generalised power method, which under a limit of
energy is at a summit within some ten steps: information is about quadratic in the input, as a Rayleigh quotient is.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np

from agents.planner.design import Known, designer
from estimator.arrays import copy
from estimator.lanes import jit, kernel, part
from estimator.models.model import Model

#: The gradient aims at this much of the displacement limit, so that what it ends with is within the limit itself.
_AIM = 0.9995

#: Penalty [nats] of displacements beyond that, see `agents.planner.design`.
PENALTY = 3e3

#: The last step in parts of the first.
_LAST = 0.05


class Limits(NamedTuple):
    """What inputs must keep, and what climbing aims at.

    Attributes:
        output: limit of the first sensor's signal without noise, in its unit; inf where there is none.
        aim: signals beyond this one are penalised.
        amplitude: limit of the input.
        energy: limit of Σ u², inf where there is none.
    """

    output: float
    aim: float
    amplitude: float
    energy: float


class Climber(NamedTuple):
    """Compiled functions of one model and interpolation of the input.

    Attributes:
        improve: ``improve(known, limits, rate, iterations, inputs, values)``: improve several inputs (starts, T) of one
            system from rest, each on its own; overwritten by the best found that keeps all limits. ``values`` (starts,)
            receives their worth [nats], -inf where nothing found keeps them. ``limits.aim`` is not used.
        ascend: ``ascend(known, limits, rate, iterations, start, u, best, memory)``: climb from u (T,); the best input
            met overwrites it, that is the most worth, less the penalty, of those within ``limits.output``. Gives that
            worth [nats]. ``best`` (T,) is written on.
        appraise: ``appraise(coefficients, precision, noises, limit, inputs, values, peaks)``: worth [nats] and peak of
            an input (n, T) for each system (n, K), without a penalty. An input ends before its first value that is not
            finite.

        ``rate`` is the first step α; the steps fall linearly to a twentieth. ``iterations`` are those of the gradient.
    """

    improve: Any
    ascend: Any
    appraise: Any


@cache
def climber(model: Model, degree: int = 0) -> Climber:
    """What climbs the worth of inputs to a model; arguments as `agents.planner.design.designer`."""
    found = designer(model, degree)
    climb, worth, memory_for, start_size = found.climb, found.worth, found.memory, found.start_size
    kind = f"{model.name}_{model.digest}_{degree}"

    @part(kind)
    def ascend(known, limits, rate, iterations, start, u, best, memory):
        copy(best, 0, u, len(u))
        best_value = -np.inf
        gradient = memory.gradient
        radius = min(np.sqrt(limits.energy), limits.amplitude * np.sqrt(len(u)))
        for k in range(iterations + 1):
            value, peak = climb(known, limits.aim, PENALTY, start, u, memory)
            if peak <= limits.output and value > best_value:
                best_value = value
                copy(best, 0, u, len(u))
            power = 0.0
            for t in range(len(u)):
                power += gradient[t] * gradient[t]
            if k == iterations or not power > 0.0:
                break
            stride = rate * (1.0 - (1.0 - _LAST) * k / iterations) * radius / np.sqrt(power)
            for t in range(len(u)):
                u[t] += stride * gradient[t]
            project(u, limits.amplitude, limits.energy)
        copy(u, 0, best, len(u))
        return best_value

    @kernel(kind=kind)
    def improve(known, limits, rate, iterations, inputs, values):
        start, memory, best = np.zeros(start_size), memory_for(inputs.shape[1]), np.empty(inputs.shape[1])
        inner = Limits(limits.output, _AIM * limits.output, limits.amplitude, limits.energy)
        for i in range(len(inputs)):
            u = inputs[i]
            project(u, limits.amplitude, limits.energy)
            ascend(known, inner, rate, iterations, start, u, best, memory)
            values[i], peak = worth(known, limits.output, 0.0, start, u, memory)
            if not peak <= limits.output:
                values[i] = -np.inf

    @kernel(kind=kind)
    def appraise(coefficients, precision, noises, limit, inputs, values, peaks):
        start, memory = np.zeros(start_size), memory_for(inputs.shape[1])
        for i in range(len(inputs)):
            used = 0
            while used < inputs.shape[1] and np.isfinite(inputs[i, used]):
                used += 1
            known = Known(coefficients[i], precision, noises)
            values[i], peaks[i] = worth(known, limit, 0.0, start, inputs[i, :used], memory)

    return Climber(improve, ascend, appraise)


@jit
def project(u, amplitude, energy):
    """Clip the inputs (T,) to their amplitude, and shrink them to their energy."""
    total = 0.0
    for t in range(len(u)):
        u[t] = max(-amplitude, min(amplitude, u[t]))
        total += u[t] * u[t]
    if total > energy:
        # A little less, because the square of what is rounded may be above again.
        share = (1.0 - 1e-12) * np.sqrt(energy / total)
        for t in range(len(u)):
            u[t] *= share
