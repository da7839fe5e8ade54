"""Properties of a believed model that policies and planners read: layout of observations, resonance, linearisation.

Time is counted in samples: a frequency is in cycles per sample, a velocity in change of the first sensor per sample.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from duffing_env.storage.kernel_spec import last_input_entries, observation_bounds
from estimator.belief import Belief
from estimator.compilation.array_operations import copy
from estimator.compilation.simd import kernel
from estimator.engine.noise_free_step import compile_noise_free_step
from estimator.engine.storage_layout import input_history_row
from estimator.models.model import Model
from estimator.models.single_input import check_single_input
from estimator.support.array_types import FloatArray


class ModelView(NamedTuple):
    """The model of an experiment, with the timing of its input.

    Attributes:
        model: of the belief.
        degree: of the input over a sample of a differential equation.
        lag: 1 for a difference equation that takes every input a sample later.
    """

    model: Model
    degree: int = 0
    lag: int = 0

    @classmethod
    def of(cls, experiment: Any) -> ModelView:
        """The view of an experiment of duffing_env.

        On a plant whose input goes linearly from one action to the next, a difference equation takes the input at the
        start of a sample, as the environment feeds it (`duffing_env.kernel_stages.generated_environment_functions`).
        """
        model = experiment.model
        if model.is_continuous:
            return cls(model, experiment.degree)
        return cls(model, 0, int(experiment.truth_model.is_continuous and experiment.degree == 1))

    @property
    def compile_key(self) -> str:
        """Distinguishes the functions compiled for this view (`estimator.compilation.simd.jit_closure`)."""
        return f"{self.model.name}_{self.model.digest}_{self.degree}_{self.lag}"


class ObservationLayout(NamedTuple):
    """Places of the entries of an observation.

    Attributes:
        mean: of the coefficients' means.
        log_std: of the logarithms of their standard deviations.
        correlation: of their correlations.
        noise: of the logarithms of the precisions: process noise, then each sensor's.
        state: of the states.
        last_input: of the last input, or the first of several.
        last_output: of the last outputs.
        time_left: of the time left.
        budget_left: of the energy left.
        size: entries.
    """

    mean: int
    log_std: int
    correlation: int
    noise: int
    state: int
    last_input: int
    last_output: int
    time_left: int
    budget_left: int
    size: int


@cache
def observation_layout(model: Model) -> ObservationLayout:
    """Places of the entries of a model's observation."""
    at = {name: i for i, name in enumerate(observation_bounds(model))}
    k, state, sensor = model.n_coefficients, next(iter(model.states)), next(iter(model.outputs))
    return ObservationLayout(
        0, k, 2 * k, at["log_gamma"], at[f"state_{state}"], at[last_input_entries(model)[0]], at[f"last_{sensor}"],
        at["time_left"], at["budget_left"], len(at),
    )  # fmt: skip


def only_input_rows(model: Model) -> tuple[str, str, str]:
    """Rows of the newest value of a model's only input, and of the two before it (`input_history_row`).

    Raises:
        ValueError: for a model with several inputs.
    """
    name = check_single_input("planning", model, "choose a signal such as prbs")
    return input_history_row(name, 0), input_history_row(name, 1), input_history_row(name, 2)


class LocalDynamics(NamedTuple):
    """Outputs and linearisations of n systems at given states.

    Attributes:
        outputs_shown: (n,) outputs of the first sensor.
        velocities: (n,) their velocities.
        input_gains: (n,) the gain (`estimator.engine.noise_free_step`); of several inputs, which change alike.
        jacobians: (n, states, states) of the linear part.
        regressors: (n, K) derivatives of the motion over a sample by the coefficients.
    """

    outputs_shown: FloatArray
    velocities: FloatArray
    input_gains: FloatArray
    jacobians: FloatArray
    regressors: FloatArray


@cache
def _compile_local_dynamics(model: Model) -> Any:
    """``probe_dynamics(means, states, inputs, free_response)`` fills in a `LocalDynamics`."""
    free_response = compile_noise_free_step(model)
    at, sense, linearise, regress = (
        free_response.layout,
        free_response.output_now,
        free_response.linearise,
        free_response.regressors,
    )
    n, k, size = model.n_states, model.n_coefficients, len(at)
    input_rows = np.array([at[input_history_row(name, 0)] for name in model.inputs])
    now, velocity, gain = at["NOW"], at["VELOCITY"], at["GAIN"]
    state, coefficient = next(iter(model.states)), next(iter(model.coefficients))
    linear, first = at[f"A_{state}_{state}"], at[f"REGRESSOR_{coefficient}"]

    @kernel(variant=f"{model.name}_{model.digest}")
    def local_dynamics_kernel(means, states, inputs, found):
        W = np.zeros(size)
        for i in range(len(means)):
            copy(W, 0, states[i], n)
            copy(W, n, means[i], k)
            for row in input_rows:
                W[row] = inputs
            sense(W)
            linearise(W)
            regress(W)
            found.outputs_shown[i], found.velocities[i], found.input_gains[i] = W[now], W[velocity], W[gain]
            for a in range(n):
                for b in range(n):
                    found.jacobians[i, a, b] = W[linear + a * n + b]
            copy(found.regressors[i], 0, W[first:], k)

    return local_dynamics_kernel


def probe_dynamics(model: Model, means: npt.ArrayLike, states: npt.ArrayLike, u: float = 0.0) -> LocalDynamics:
    """Outputs and linearisations of systems at states and under an input.

    Args:
        model: of all systems.
        means: (n, K) their coefficients.
        states: (n, states) their states.
        u: the input, or each of several.
    """
    coefficient_rows = np.ascontiguousarray(np.atleast_2d(means), dtype=np.float64)
    state_rows = np.ascontiguousarray(np.atleast_2d(states), dtype=np.float64)
    count, n, k = len(coefficient_rows), model.n_states, model.n_coefficients
    shown, velocities, gains = np.empty((3, count))
    found = LocalDynamics(shown, velocities, gains, np.empty((count, n, n)), np.empty((count, k)))
    _compile_local_dynamics(model)(coefficient_rows, state_rows, float(u), found)
    return found


def resonance_frequencies(model: Model, jacobians: FloatArray) -> FloatArray:
    """(n,) resonances of linear parts in cycles per sample: the highest, or 0 where a part does not oscillate."""
    poles = np.linalg.eigvals(jacobians)
    angles = np.abs(poles.imag if model.is_continuous else np.where(poles.imag != 0, np.angle(poles), 0.0))
    highest: FloatArray = angles.max(axis=-1) / (2.0 * np.pi)
    return highest


def believed_resonance(belief: Belief) -> float:
    """Resonance of a believed system for small motions, in cycles per sample; with two wells, in one of them."""
    means = belief.coefficients_mean
    found = probe_dynamics(belief.model, means, np.zeros(belief.model.n_states))
    cycles = float(resonance_frequencies(belief.model, found.jacobians)[0])
    if cycles <= 0.0:
        stiffness = dict(zip(belief.names, means, strict=True)).get("stiffness", 0.0)
        cycles = np.sqrt(2.0 * abs(stiffness)) / (2.0 * np.pi)
    return max(cycles, 1e-9)


def sampled_peak_fraction(belief: Belief, amplitude: float) -> float:
    """The least part of a peak that samples catch, for a believed oscillator of this amplitude."""
    means = dict(zip(belief.names, belief.coefficients_mean, strict=True))
    square = means.get("stiffness", 0.0) + 0.75 * means.get("cubic", 0.0) * amplitude**2
    # Half a sample from the peak, and no worse than with six samples per period.
    return float(np.cos(min(np.sqrt(max(square, 0.0)) / 2, np.pi / 6)))


def is_on_rig(experiment: Any) -> bool:
    """Whether an experiment of duffing_env is one on a rig, where leaving the limit may cost more than information."""
    return getattr(experiment, "rig", None) is not None


def planning_limit(experiment: Any, state_scales: FloatArray) -> float:
    """The limit that plans keep; on a rig it is lower by the part of a peak that falls between samples.

    Args:
        experiment: of duffing_env.
        state_scales: (states,) sizes of the states when the first sensor is at its limit.
    """
    limit = float(experiment.kernel_params.max_output)
    return (
        limit * sampled_peak_fraction(experiment.prior_belief, float(state_scales[0]))
        if is_on_rig(experiment)
        else limit
    )
