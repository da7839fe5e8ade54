"""Polishing an input at known parameters to a summit of its worth under the exact limits, for any model.

Sequential linear programmes: the worth ½ log det(Λ + F(u)) is linearised by its gradient, the motion by the slopes of
every sample, and HiGHS finds the best change of at most ``radius`` within the limits of input, signal and energy:

    max gᵀδ    with    ξ_{t+1} = A_t ξ_t + B_t δ_t,    |x_t + C_t ξ_t + D_t δ_t| ≤ limit,    |u_t + δ_t| ≤ amplitude,
                       |δ_t| ≤ radius,    2 uᵀδ ≤ energy - uᵀu.

What is left of the change's curvature would add up over the samples, and keep the steps small. So the input that is
tried follows the planned states by feedback (the gains of a linear quadratic regulator), which keeps the errors of one
sample from the next: tens of programmes of some milliseconds then reach a summit, where without it hundreds do not.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np

from agents.planner.ascent import Limits
from agents.planner.design import Known, designer
from agents.planner.programme import Programme
from estimator.arrays import copy, fill
from estimator.lanes import kernel
from estimator.models.model import Model
from estimator.parameters import FloatArray

#: The first radius in parts of the amplitude, and the one at which a search ends.
_RADIUS, _LEAST = 0.1, 1e-5

#: A search ends where a step gains less [nats].
_ENOUGH = 1e-5

#: Linear programmes over which the pace of a search is measured. It becomes slower, so what is given up is far off.
_PACED = 8

#: Worth [nats] of a signal beyond its limit, per part of it and sample, and of energy, where steps are compared.
_PENALTY, _OVERSPENT = 5.0, 20.0

#: The price of the feedback's input, in parts of its amplitude, against states in parts of their sizes.
_PRICE = 1e-2


class Line(NamedTuple):
    """A path and its slopes.

    Attributes:
        gradient: (T,) of the worth by the inputs.
        shown: (T,) what the first sensor shows.
        states: (T, n) before every sample.
        slopes: (T, n + 1, n + 3) of the states after a sample, and of what is shown then, by the states before it, its
            input, the last and the one before.
    """

    gradient: FloatArray
    shown: FloatArray
    states: FloatArray
    slopes: FloatArray

    @classmethod
    def empty(cls, samples: int, n: int) -> Line:
        """One to be filled in."""
        return cls(np.empty(samples), np.empty(samples), np.empty((samples, n)), np.empty((samples, n + 1, n + 3)))


@cache
def _compiled(model: Model, degree: int) -> tuple[Any, Any]:
    """``line`` and ``follow``.

    - ``line(known, limit, u, found)`` fills in a `Line` from rest; gives the worth [nats] and the peak of the signal.
    - ``follow(known, amplitude, unit, aims, states, slopes, weights, u)``: the inputs u (T,), multiples of ``unit``,
      that keep to states (T, n), which the inputs aims (T,) are to bring about; weights (n,) of the states' errors.
    """
    found = designer(model, degree)
    code, memory_for, climb, earlier = found.code, found.memory, found.climb, found.earlier
    begin, coefficients_of, lay, step, back, seed = (
        code.begin, code.coefficients, code.lay, code.step, code.back, code.seed
    )  # fmt: skip
    n, start_size = model.n_states, found.start_size
    kind = f"{model.name}_{model.digest}_{degree}"

    @kernel(kind=kind)
    def line(known, limit, u, found):
        start, memory = np.zeros(start_size), memory_for(len(u))
        value, peak = climb(known, limit, 0.0, start, u, memory)
        copy(found.gradient, 0, memory.gradient, len(u))
        copy(found.shown, 0, memory.shown, len(u))
        C = coefficients_of(known.coefficients)
        for row in range(len(memory.G)):
            fill(memory.G[row], 0.0)
        _, H = seed(memory.G)
        after = np.zeros(start_size)
        for i in range(n + 1):
            fill(after, 0.0)
            if i < n:
                after[i] = 1.0
            adjoint, _ = begin(after)
            for t in range(len(u)):
                U = lay(u[t], earlier(start, u, t - 1), earlier(start, u, t - 2))
                G, now, last, older = back(
                    adjoint, H, C, U, known.noises, 1.0 if i == n else 0.0, memory.tape, t
                )  # fmt: skip
                for j in range(n):
                    found.slopes[t, i, j] = G[j]
                    found.states[t, j] = memory.tape[t, j]
                found.slopes[t, i, n], found.slopes[t, i, n + 1], found.slopes[t, i, n + 2] = now, last, older
        return value, peak

    @kernel(kind=kind)
    def follow(known, amplitude, unit, aims, states, slopes, weights, u):
        gains, S, SA, SB = np.zeros((len(u), n)), np.zeros((n, n)), np.zeros((n, n)), np.zeros(n)
        for t in range(len(u) - 1, -1, -1):
            A, B = slopes[t, :n, :n], slopes[t, :n, n]
            for i in range(n):
                S[i, i] += weights[i]
            price = _PRICE / amplitude**2
            for i in range(n):
                SB[i] = 0.0
                for j in range(n):
                    SB[i] += S[i, j] * B[j]
                price += B[i] * SB[i]
            for j in range(n):
                for i in range(n):
                    gains[t, j] -= SB[i] * A[i, j] / price
            for i in range(n):
                for j in range(n):
                    SA[i, j] = SB[i] * gains[t, j]
                    for m in range(n):
                        SA[i, j] += S[i, m] * A[m, j]
            for i in range(n):
                for j in range(n):
                    S[i, j] = 0.0
                    for m in range(n):
                        S[i, j] += A[m, i] * SA[m, j]
        start, tape = np.zeros(start_size), memory_for(1).tape
        C = coefficients_of(known.coefficients)
        P, F = begin(start)
        for t in range(len(u)):
            now = aims[t]
            for i in range(n):
                now += gains[t, i] * (P[i] - states[t, i])
            u[t] = unit * np.floor(max(-amplitude, min(amplitude, now)) / unit + 0.5)
            U = lay(u[t], earlier(start, u, t - 1), earlier(start, u, t - 2))
            P, F, _, _ = step(P, F, C, U, known.noises, tape, 0)

    return line, follow


def polish(
    model: Model,
    degree: int,
    known: Known,
    limits: Limits,
    sizes: FloatArray,
    u: FloatArray,
    unit: float,
    rounds: int = 80,
    goal: float = -np.inf,
) -> tuple[FloatArray, float]:
    """Improve an input from rest until no small change does.

    Args:
        model: the equation.
        degree: of the input's polynomial over a sample.
        known: what the worth is taken at.
        limits: to be kept; ``aim`` is the limit of the signal that is aimed at. The energy may be exceeded a little.
        sizes: (n,) of the states (`agents.planner.motion.Swing`).
        u: (T,) inputs, which may be beyond the limits of signal and energy.
        unit: that inputs are multiples of, and the amplitude too. Rounding them afterwards would lead far away: of a
            hard oscillator errors grow by several powers of ten over an episode.
        rounds: linear programmes at most.
        goal: worth [nats] that is looked for. Where it is out of reach at the pace of the last programmes, an input is
            given up as it is.

    Returns:
        The input and its worth [nats]; -inf where it does not keep the limits.
    """
    line, follow = _compiled(model, degree)
    here, there = Line.empty(len(u), model.n_states), Line.empty(len(u), model.n_states)
    states, sensor = list(model.states), next(iter(model.outputs.values()))
    shown = states.index(sensor) if sensor in states else model.n_states
    best, tried = _within(np.clip(u, -limits.amplitude, limits.amplitude), limits), np.empty(len(u))

    def judge(inputs: FloatArray, found: Line) -> tuple[float, float, float]:
        value, peak = line(known, limits.aim, inputs, found)
        if not np.isfinite(found.slopes).all():  # so far beyond the limit that the equation has blown up
            return -np.inf, np.inf, -np.inf
        excess = float(np.maximum(0.0, np.abs(found.shown) / limits.aim - 1.0).sum())
        overspent = max(0.0, float(inputs @ inputs) / limits.energy - 1.0)
        return value, peak, value - _PENALTY * excess - _OVERSPENT * overspent

    value, peak, merit = judge(best, here)
    if not np.isfinite(merit):
        return best, -np.inf
    programme = Programme(len(u), model.n_states, shown, limits)
    radius, merits = _RADIUS, [merit]
    for k in range(rounds):
        change = programme.best(best, here.gradient, here.shown, here.slopes, radius * limits.amplitude)
        if change is None:  # no small change leads within the limits
            radius *= 2.0
            if radius > 2.0:
                break
            continue
        delta, moved = change
        aims = np.clip(best + delta, -limits.amplitude, limits.amplitude)
        aims = _within(aims, limits)
        follow(known, limits.amplitude, unit, aims, here.states + moved, here.slopes, 1.0 / sizes**2, tried)
        promised = float(here.gradient @ delta) + value - merit
        new_value, new_peak, new_merit = judge(tried, there)
        gained = new_merit - merit
        if gained > 0.0:
            value, peak, merit = new_value, new_peak, new_merit
            best, tried, here, there = tried, best, there, here
            radius *= 2.0 if gained > 0.5 * promised else 0.5 if gained < 0.2 * promised else 1.0
            if gained < _ENOUGH and peak <= limits.output:
                break
        else:
            radius *= 0.35
        merits.append(merit)
        pace = (merit - merits[max(0, len(merits) - 1 - _PACED)]) / _PACED
        if radius < _LEAST or (len(merits) > _PACED and merit + pace * (rounds - 1 - k) < goal):
            break
    return best, value if peak <= limits.output else -np.inf


def _within(u: FloatArray, limits: Limits) -> FloatArray:
    """Inputs shrunk to their energy."""
    energy = float(u @ u)
    return u if energy <= limits.energy else u * np.sqrt(limits.energy / energy) * (1.0 - 1e-12)
