"""Projected gradient ascent of the D-optimality under input, output and energy limits, compiled for any model.

A step has a given length: u ← P(u + α R g / |g|), with P the projection on the limits and R the radius of the inputs
that they allow. For long steps this is the generalised power method, which under a limit of energy converges within
some ten steps: the information is about quadratic in the input, as a Rayleigh quotient is.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np

from agents.planning.d_optimality import NominalSystem, compile_d_optimality
from estimator.compilation.array_operations import copy
from estimator.compilation.simd import jit, jit_closure, kernel
from estimator.models.model import Model

#: Soft limit in parts of the output's limit, so that an ascent ends within the limit itself.
_SOFT_LIMIT_FRACTION = 0.9995

#: Penalty [nats] of outputs beyond the soft limit (`agents.planning.d_optimality`).
EXCESS_PENALTY = 3e3

#: Length of the last step in parts of the first.
_FINAL_STEP_FRACTION = 0.05


class DesignLimits(NamedTuple):
    """The limits of inputs and of their response.

    Attributes:
        output: limit of the first sensor's signal without noise, in its unit; inf for none.
        soft_limit: of the signal, beyond which it is penalised.
        amplitude: limit of the input.
        energy: limit of Σ u²; inf for none.
    """

    output: float
    soft_limit: float
    amplitude: float
    energy: float


class ProjectedGradient(NamedTuple):
    """Compiled functions of one model and interpolation of the input.

    Attributes:
        ascend_batch: ``ascend_batch(nominal, limits, first_step, iterations, inputs, values)`` improves several inputs
            (starts, T) of one system from rest, each by itself, and overwrites them by the best found within all
            limits. ``values`` (starts,) receives their criterion [nats]; -inf where none was found. The soft limit of
            ``limits`` has no effect.
        ascend: ``ascend(nominal, limits, first_step, iterations, start, u, best, workspace)`` ascends from u (T,), and
            overwrites u by the best input found within ``limits.output``. It returns that input's criterion, less the
            penalty [nats]. ``best`` (T,) is memory.
        evaluate_batch: ``evaluate_batch(coefficients, precision, noises, limit, inputs, values, peaks)`` fills in the
            criterion [nats], without a penalty, and the peak of an input (n, T) of each system (n, K). An input ends
            before its first value that is not finite.

        ``first_step`` is α of the first step; steps shrink linearly to a twentieth. ``iterations`` counts gradient
        steps.
    """

    ascend_batch: Callable[..., None]
    ascend: Callable[..., float]
    evaluate_batch: Callable[..., None]


@cache
def compile_projected_gradient(model: Model, degree: int = 0) -> ProjectedGradient:
    """Compile for a model; arguments as `agents.planning.d_optimality.compile_d_optimality`."""
    d_optimality = compile_d_optimality(model, degree)
    criterion_and_gradient, criterion, workspace_for, start_size = (
        d_optimality.criterion_and_gradient,
        d_optimality.criterion,
        d_optimality.workspace,
        d_optimality.start_size,
    )
    compile_key = f"{model.name}_{model.digest}_{degree}"

    @jit_closure(compile_key)
    def ascend(nominal, limits, first_step, iterations, start, u, best, workspace):
        copy(best, 0, u, len(u))
        best_value = -np.inf
        gradient = workspace.gradient
        radius = min(np.sqrt(limits.energy), limits.amplitude * np.sqrt(len(u)))
        for k in range(iterations + 1):
            value, peak = criterion_and_gradient(nominal, limits.soft_limit, EXCESS_PENALTY, start, u, workspace)
            if peak <= limits.output and value > best_value:
                best_value = value
                copy(best, 0, u, len(u))
            squared_norm = 0.0
            for t in range(len(u)):
                squared_norm += gradient[t] * gradient[t]
            if k == iterations or not squared_norm > 0.0:
                break
            step_length = (
                first_step * (1.0 - (1.0 - _FINAL_STEP_FRACTION) * k / iterations) * radius / np.sqrt(squared_norm)
            )
            for t in range(len(u)):
                u[t] += step_length * gradient[t]
            project_input(u, limits.amplitude, limits.energy)
        copy(u, 0, best, len(u))
        return best_value

    @kernel(variant=compile_key)
    def ascend_batch(nominal, limits, first_step, iterations, inputs, values):
        start, workspace, best = np.zeros(start_size), workspace_for(inputs.shape[1]), np.empty(inputs.shape[1])
        soft_limits = DesignLimits(limits.output, _SOFT_LIMIT_FRACTION * limits.output, limits.amplitude, limits.energy)
        for i in range(len(inputs)):
            u = inputs[i]
            project_input(u, limits.amplitude, limits.energy)
            ascend(nominal, soft_limits, first_step, iterations, start, u, best, workspace)
            values[i], peak = criterion(nominal, limits.output, 0.0, start, u, workspace)
            if not peak <= limits.output:
                values[i] = -np.inf

    @kernel(variant=compile_key)
    def evaluate_batch(coefficients, precision, noises, limit, inputs, values, peaks):
        start, workspace = np.zeros(start_size), workspace_for(inputs.shape[1])
        for i in range(len(inputs)):
            n_played = 0
            while n_played < inputs.shape[1] and np.isfinite(inputs[i, n_played]):
                n_played += 1
            nominal = NominalSystem(coefficients[i], precision, noises)
            values[i], peaks[i] = criterion(nominal, limit, 0.0, start, inputs[i, :n_played], workspace)

    return ProjectedGradient(ascend_batch, ascend, evaluate_batch)


@jit
def project_input(u, amplitude, energy):
    """Clip the inputs (T,) to their amplitude, and shrink them to their energy."""
    spent = 0.0
    for t in range(len(u)):
        u[t] = max(-amplitude, min(amplitude, u[t]))
        spent += u[t] * u[t]
    if spent > energy:
        # A little less: rounding may raise the energy above its limit again.
        scale = (1.0 - 1e-12) * np.sqrt(energy / spent)
        for t in range(len(u)):
            u[t] *= scale
