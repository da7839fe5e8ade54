"""Time scales and sizes of a believed oscillator, measured by pumping it up along its velocity.

Time is counted in samples.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from agents.planning.model_probe import ModelView, is_on_rig, only_input_rows
from estimator.compilation.array_operations import copy, fill
from estimator.compilation.simd import kernel
from estimator.engine.noise_free_step import compile_noise_free_step
from estimator.support.array_types import FloatArray

#: Samples of the motion by which a system is measured.
_N_PROBE_SAMPLES = 128

#: Output at which the motion turns, in parts of the limit.
_TURN_FRACTION = 0.95

#: Part of a believed step response that plans count on.
_RELIABLE_STEP_FRACTION = 0.75

#: Moves of the input per period of the motion: fewer cannot follow it, more take time and shorten the horizon.
MOVES_PER_PERIOD = 9


class TimeScales(NamedTuple):
    """Time scales of an oscillation that is pumped up along its velocity and turned before the limit.

    Attributes:
        scales: (states,) sizes of the states when the first sensor is at its limit. The sensor's own state, and a state
            that keeps its last value, have the limit itself. Another, such as a velocity, has the limit times the ratio
            of its peak to the sensor's: a scale without a unit of its own, valid also where the limit is out of reach.
        hold_samples: samples for which a planned input is held, so that a plan covers some periods also where a period
            has many samples.
        accumulated_noise: variance by which process noise moves the first sensor in a quarter of a period, in parts of
            its variance of the displacement per sample, less that sample's own. No input corrects it within this time.
        mean_information: (K, K) mean of φ φᵀ over the samples, with φ the derivatives of the first sensor's output a
            sample later by the coefficients.
        rise_time: samples until the output comes near the limit; inf where it does not within `_N_PROBE_SAMPLES`.
        step_response: change of the first sensor's output after a sample from rest, per unit of the input.
    """

    scales: FloatArray
    hold_samples: int
    accumulated_noise: float
    mean_information: FloatArray
    rise_time: float
    step_response: float


@cache
def _compile_pumped_swing(view: ModelView) -> Any:
    """``swing(means, max_input, limit, peaks, mean_information)`` fills in `TimeScales.mean_information` and ``peaks``.

    These are the peaks of states and sensor, the samples in a period or 0, the samples until the limit is near or 0,
    and the change of the first sensor's output by the largest input over a sample from rest.
    """
    free_response = compile_noise_free_step(*view)
    at, sense, glance, step = (
        free_response.layout,
        free_response.output_now,
        free_response.output_after,
        free_response.step,
    )
    n, k, size = view.model.n_states, view.model.n_coefficients, len(at)
    u, shown, velocity = at[only_input_rows(view.model)[0]], at["Y_PRED"], at["VELOCITY"]
    phi = at[f"PHI_{next(iter(view.model.coefficients))}"]
    # A push along the motion itself pumps: along the rise of an accelerometer's output it would brake.
    rate, states = (view.model.rates or ("",))[0], list(view.model.states)
    velocity = at[rate] if rate in states else velocity

    @kernel(variant=view.compile_key)
    def swing(means, max_input, limit, peaks, mean_information):
        W = np.zeros(size)
        copy(W, n, means, k)
        fill(peaks, 0.0)
        for a in range(k):
            fill(mean_information[a], 0.0)
        glance(W)
        output_at_rest = W[shown]
        W[u] = max_input
        glance(W)
        peaks[n + 3] = W[shown] - output_at_rest
        n_turns, first, last, direction = 0, 0, 0, 0.0
        for t in range(_N_PROBE_SAMPLES):
            sense(W)
            now = 1.0 if W[velocity] >= 0.0 else -1.0
            W[u] = max_input * now
            if t > 0 and now != direction:
                first = t if n_turns == 0 else first
                last = t
                n_turns += 1
            direction = now
            glance(W)
            if abs(W[shown]) > _TURN_FRACTION * limit:
                W[u] = -W[u]
                peaks[n + 2] = t + 1.0 if peaks[n + 2] == 0.0 else peaks[n + 2]
            step(W)
            if not abs(W[shown]) < 2.0 * limit:
                break
            for i in range(n):
                peaks[i] = max(peaks[i], abs(W[i]))
            peaks[n] = max(peaks[n], abs(W[shown]))
            for a in range(k):
                for b in range(k):
                    mean_information[a, b] += W[phi + a] * W[phi + b] / _N_PROBE_SAMPLES
        if n_turns > 1:
            peaks[n + 1] = 2.0 * (last - first) / (n_turns - 1)

    return swing


def probe_time_scales(view: ModelView, prior_means: npt.ArrayLike, max_input: float, limit: float) -> TimeScales:
    """Measure the time scales of the system at the prior's means.

    Args:
        view: of the model.
        prior_means: (K,) of the coefficients.
        max_input: amplitude limit.
        limit: of the first sensor.
    """
    model = view.model
    peaks, mean_information = np.empty(model.n_states + 4), np.empty((model.n_coefficients, model.n_coefficients))
    _compile_pumped_swing(view)(
        np.asarray(prior_means, dtype=np.float64), float(max_input), float(limit), peaks, mean_information
    )
    sizes, (peak, period, rise_time, step_response) = peaks[:-4], peaks[-4:]
    sensor = next(iter(model.outputs.values()))
    moves = zip(model.states, model.update_expressions, strict=True)
    has_sensor_scale = np.array([x == sensor or (not model.is_continuous and move == sensor) for x, move in moves])
    has_sensor_scale |= (sizes <= 0) | (peak <= 0)
    scales = limit * np.divide(sizes, peak, out=np.ones(model.n_states), where=~has_sensor_scale)
    # Kicks of the velocity, of variance 3 a sample, after a quarter period 2π/4ω: 3 (t/2ω²), of the displacement.
    accumulated_noise = max(0.0, 3.0 * period**3 / (32.0 * np.pi**2) - 1.0) * float(limit / scales[0]) ** 2
    hold_samples = max(1, round(period / MOVES_PER_PERIOD))
    return TimeScales(
        scales,
        hold_samples,
        float(accumulated_noise),
        mean_information,
        float(rise_time) or np.inf,
        float(step_response) / max_input,
    )


def kept_accumulated_noise(experiment: Any, time_scales: TimeScales) -> float:
    """`TimeScales.accumulated_noise`, where plans keep it from the limit; else 0.

    They do on a rig, and with several sensors: the others show a disturbance before the first one does.
    """
    return time_scales.accumulated_noise if is_on_rig(experiment) or experiment.model.n_outputs > 1 else 0.0


def recoverable_step(experiment: Any, view: ModelView, time_scales: TimeScales) -> float:
    """The part of `TimeScales.step_response` that plans count on (`PlanObjective.recoverable_step`); 0 for none.

    None where an input acts in full only a sample later, is held or slew-limited, or has little energy, where another
    sensor shows a disturbance before the first one does, and on a rig, where leaving the limit may cost more than
    information.
    """
    setup = experiment.kernel_params
    acts_slowly = (
        view.degree
        or view.lag
        or time_scales.hold_samples > 1
        or np.isfinite(setup.max_slew).any()
        or np.isfinite(setup.budget)
    )
    return (
        0.0
        if acts_slowly or is_on_rig(experiment) or experiment.model.n_outputs > 1
        else _RELIABLE_STEP_FRACTION * time_scales.step_response
    )
