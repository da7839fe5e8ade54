"""Sequential linear programming: refinement of an input to a local maximum of its D-optimality under exact limits.

The criterion ½ log det(Λ + F(u)) is linearised by its gradient, the motion by the slopes of
every sample, and HiGHS finds the best change of at most ``radius`` within the limits of input, signal and energy:

    max gᵀδ    with    ξ_{t+1} = A_t ξ_t + B_t δ_t,    |x_t + C_t ξ_t + D_t δ_t| ≤ limit,    |u_t + δ_t| ≤ amplitude,
                       |δ_t| ≤ radius,    2 uᵀδ ≤ energy - uᵀu.

The neglected curvature would add up over the samples and keep the steps small. Therefore the input follows the planned
states by feedback (the gains of a linear quadratic regulator), which stops the propagation of errors: tens of
programmes of some milliseconds then reach a maximum, and hundreds do not without the feedback.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np

from agents.planning.d_optimality import NominalSystem, compile_d_optimality
from agents.planning.projected_gradient import DesignLimits
from estimator.compilation.array_operations import copy, fill
from estimator.compilation.simd import kernel
from estimator.models.model import Model
from estimator.support.array_types import FloatArray
from research.oracles.linear_programme import LinearProgramme

#: First radius, and the radius at which a search ends, as fractions of the amplitude.
_FIRST_RADIUS, _MIN_RADIUS = 0.1, 1e-5

#: Gain of a step [nats] below which a search ends.
_MIN_GAIN = 1e-5

#: Linear programmes over which the pace of a search is measured. The pace only falls, so a search that is abandoned
#: would not have reached its target.
_N_PROGRAMMES_MEASURED = 8

#: Penalty [nats] of a violated signal limit, per relative excess and sample, and of a violated energy limit, where
#: steps are compared.
_EXCESS_PENALTY, _ENERGY_PENALTY = 5.0, 20.0

#: Weight of the feedback's input, relative to its amplitude, against states relative to their scales.
_FEEDBACK_INPUT_WEIGHT = 1e-2


class Linearisation(NamedTuple):
    """A trajectory and its derivatives.

    Attributes:
        gradient: (T,) derivatives of the criterion by the inputs.
        output_signal: (T,) output of the first sensor.
        states: (T, n) states before every sample.
        jacobians: (T, n + 1, n + 3) of the states after a sample, and of the output then, by the states before it, its
            input, the last one and the one before.
    """

    gradient: FloatArray
    output_signal: FloatArray
    states: FloatArray
    jacobians: FloatArray

    @classmethod
    def empty(cls, samples: int, n: int) -> Linearisation:
        """A linearisation with room for T samples, to be filled in."""
        return cls(np.empty(samples), np.empty(samples), np.empty((samples, n)), np.empty((samples, n + 1, n + 3)))


@cache
def _compile_linearisation(model: Model, degree: int) -> tuple[Any, Any]:
    """``linearise`` and ``track_states``.

    - ``linearise(nominal, limit, u, found)`` fills in a `Linearisation` from rest, and returns the criterion [nats] and
      the peak of the signal.
    - ``track_states(nominal, amplitude, unit, nominal_inputs, states, jacobians, weights, u)`` fills in the inputs u
      (T,), multiples of ``unit``, that track the states (T, n) planned for ``nominal_inputs`` (T,), with weights (n,)
      of the state errors.
    """
    found = compile_d_optimality(model, degree)
    code, workspace_for, criterion_and_gradient, earlier = (
        found.path_functions,
        found.workspace,
        found.criterion_and_gradient,
        found.input_at,
    )
    begin, coefficients_of, lay, step, back, seed = (
        code.begin, code.coefficients, code.input_coefficients, code.step, code.backward, code.seed_adjoint
    )  # fmt: skip
    n, start_size = model.n_states, found.start_size
    compile_key = f"{model.name}_{model.digest}_{degree}"

    @kernel(variant=compile_key)
    def linearise(nominal, limit, u, found):
        start, workspace = np.zeros(start_size), workspace_for(len(u))
        value, peak = criterion_and_gradient(nominal, limit, 0.0, start, u, workspace)
        copy(found.gradient, 0, workspace.gradient, len(u))
        copy(found.output_signal, 0, workspace.output_signal, len(u))
        C = coefficients_of(nominal.coefficients)
        for row in range(len(workspace.G)):
            fill(workspace.G[row], 0.0)
        _, H = seed(workspace.G)
        after = np.zeros(start_size)
        for i in range(n + 1):
            fill(after, 0.0)
            if i < n:
                after[i] = 1.0
            adjoint, _ = begin(after)
            for t in range(len(u)):
                U = lay(u[t], earlier(start, u, t - 1), earlier(start, u, t - 2))
                G, now, last, older = back(
                    adjoint, H, C, U, nominal.noises, 1.0 if i == n else 0.0, workspace.tape, t
                )  # fmt: skip
                for j in range(n):
                    found.jacobians[t, i, j] = G[j]
                    found.states[t, j] = workspace.tape[t, j]
                found.jacobians[t, i, n], found.jacobians[t, i, n + 1], found.jacobians[t, i, n + 2] = now, last, older
        return value, peak

    @kernel(variant=compile_key)
    def track_states(nominal, amplitude, unit, nominal_inputs, states, slopes, weights, u):
        gains, S, SA, SB = np.zeros((len(u), n)), np.zeros((n, n)), np.zeros((n, n)), np.zeros(n)
        for t in range(len(u) - 1, -1, -1):
            A, B = slopes[t, :n, :n], slopes[t, :n, n]
            for i in range(n):
                S[i, i] += weights[i]
            input_weight = _FEEDBACK_INPUT_WEIGHT / amplitude**2
            for i in range(n):
                SB[i] = 0.0
                for j in range(n):
                    SB[i] += S[i, j] * B[j]
                input_weight += B[i] * SB[i]
            for j in range(n):
                for i in range(n):
                    gains[t, j] -= SB[i] * A[i, j] / input_weight
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
        start, tape = np.zeros(start_size), workspace_for(1).tape
        C = coefficients_of(nominal.coefficients)
        P, F = begin(start)
        for t in range(len(u)):
            now = nominal_inputs[t]
            for i in range(n):
                now += gains[t, i] * (P[i] - states[t, i])
            u[t] = unit * np.floor(max(-amplitude, min(amplitude, now)) / unit + 0.5)
            U = lay(u[t], earlier(start, u, t - 1), earlier(start, u, t - 2))
            P, F, _, _ = step(P, F, C, U, nominal.noises, tape, 0)

    return linearise, track_states


def refine_input(
    model: Model,
    degree: int,
    nominal: NominalSystem,
    limits: DesignLimits,
    state_scales: FloatArray,
    u: FloatArray,
    quantum: float,
    max_programmes: int = 80,
    target_value: float = -np.inf,
) -> tuple[FloatArray, float]:
    """Improve an input from rest until no small change improves it further.

    Args:
        model: the equation.
        degree: degree of the input's polynomial over a sample.
        nominal: the system and its prior precision.
        limits: limits of the input; ``soft_limit`` is the limit of the signal in programmes. The energy may be exceeded
            a little.
        state_scales: (n,) scales of the states (`agents.planning.time_scales.TimeScales`).
        u: (T,) inputs, which may be beyond the limits of signal and energy.
        quantum: step of the inputs, which are multiples of it, as is the amplitude. Rounding them afterwards would
            change the trajectory: in a chaotic motion errors grow by several powers of ten over an episode.
        max_programmes: largest number of linear programmes.
        target_value: criterion [nats] to reach. The search ends early where the pace of the last programmes would not
            reach it.

    Returns:
        The input and its criterion [nats], which is -inf where the input breaks a limit.
    """
    linearise, track_states = _compile_linearisation(model, degree)
    current, candidate = Linearisation.empty(len(u), model.n_states), Linearisation.empty(len(u), model.n_states)
    states, sensor = list(model.states), next(iter(model.outputs.values()))
    shown = states.index(sensor) if sensor in states else model.n_states
    best, tried = _shrink_to_energy(np.clip(u, -limits.amplitude, limits.amplitude), limits), np.empty(len(u))

    def merit_of(inputs: FloatArray, found: Linearisation) -> tuple[float, float, float]:
        value, peak = linearise(nominal, limits.soft_limit, inputs, found)
        if not np.isfinite(found.jacobians).all():  # the equation has diverged, far beyond the limit
            return -np.inf, np.inf, -np.inf
        excess = float(np.maximum(0.0, np.abs(found.output_signal) / limits.soft_limit - 1.0).sum())
        overspent = max(0.0, float(inputs @ inputs) / limits.energy - 1.0)
        return value, peak, value - _EXCESS_PENALTY * excess - _ENERGY_PENALTY * overspent

    value, peak, merit = merit_of(best, current)
    if not np.isfinite(merit):
        return best, -np.inf
    programme = LinearProgramme(len(u), model.n_states, shown, limits)
    radius, merits = _FIRST_RADIUS, [merit]
    for k in range(max_programmes):
        change = programme.best_change(
            best, current.gradient, current.output_signal, current.jacobians, radius * limits.amplitude
        )
        if change is None:  # no small change satisfies the limits
            radius *= 2.0
            if radius > 2.0:
                break
            continue
        delta, moved = change
        nominal_inputs = np.clip(best + delta, -limits.amplitude, limits.amplitude)
        nominal_inputs = _shrink_to_energy(nominal_inputs, limits)
        track_states(
            nominal,
            limits.amplitude,
            quantum,
            nominal_inputs,
            current.states + moved,
            current.jacobians,
            1.0 / state_scales**2,
            tried,
        )
        predicted_gain = float(current.gradient @ delta) + value - merit
        new_value, new_peak, new_merit = merit_of(tried, candidate)
        gain = new_merit - merit
        if gain > 0.0:
            value, peak, merit = new_value, new_peak, new_merit
            best, tried, current, candidate = tried, best, candidate, current
            radius *= 2.0 if gain > 0.5 * predicted_gain else 0.5 if gain < 0.2 * predicted_gain else 1.0
            if gain < _MIN_GAIN and peak <= limits.output:
                break
        else:
            radius *= 0.35
        merits.append(merit)
        gain_per_programme = (merit - merits[max(0, len(merits) - 1 - _N_PROGRAMMES_MEASURED)]) / _N_PROGRAMMES_MEASURED
        if radius < _MIN_RADIUS or (
            len(merits) > _N_PROGRAMMES_MEASURED
            and merit + gain_per_programme * (max_programmes - 1 - k) < target_value
        ):
            break
    return best, value if peak <= limits.output else -np.inf


def _shrink_to_energy(u: FloatArray, limits: DesignLimits) -> FloatArray:
    """Inputs scaled down to the energy limit."""
    energy = float(u @ u)
    return u if energy <= limits.energy else u * np.sqrt(limits.energy / energy) * (1.0 - 1e-12)
