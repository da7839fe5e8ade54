"""Simulation of m x'' + c x' + a x + b x³ + q x⁵ = u + w by the Dormand-Prince method of order 8, with sensitivities.

Coefficients and step control are from SciPy's ``DOP853``. The force is a polynomial between two samples; every sample
starts a new integration, so that no step crosses a jump of the force.
"""

from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit
from scipy.integrate import DOP853

FloatArray = npt.NDArray[np.float64]

#: Kinds of a sensor, by the order of the time derivative.
SENSOR_KINDS = ("displacement", "velocity", "acceleration")

#: Directions of `state_sensitivities`: the state at the begin of the sample, the held process noise, and the logarithms
#: of the parameters.
SENSITIVITY_DIRECTIONS = ("x", "v", "w", "m", "c", "a", "b")

#: Relative tolerance of a step.
RTOL = 1e-9

#: Absolute tolerance of a step, in sizes of x and x'.
ATOL = 1e-12

_A, _B, _E3, _E5 = (np.ascontiguousarray(getattr(DOP853, name)) for name in ("A", "B", "E3", "E5"))
_C = np.ascontiguousarray(DOP853.C)
_STAGES = len(_B)


@njit(cache=True)
def _state_derivative(tau, s, p, force, slope, out):
    """Time derivative of (x, x') and of its derivatives in the directions that ``s`` has room for."""
    m, c, a, b, q = p
    x, v = s[0], s[1]
    acceleration = (force + slope * tau - c * v - a * x - b * x**3 - q * x**5) / m
    out[0], out[1] = v, acceleration
    if len(s) > 2:
        stiffness = (a + 3 * b * x**2 + 5 * q * x**4) / m
        for j in range(7):
            out[2 + 2 * j] = s[3 + 2 * j]
            out[3 + 2 * j] = -c / m * s[3 + 2 * j] - stiffness * s[2 + 2 * j]
        out[7] += 1 / m
        out[9] -= acceleration
        out[11] -= c * v / m
        out[13] -= a * x / m
        out[15] -= b * x**3 / m


@njit(cache=True)
def _advance_sample(s, p, force, slope, step, scale, h, K, new):
    """Integrate ``s`` over a sample, and return the first step size of the next one."""
    tau = 0.0
    n = len(s)
    _state_derivative(0.0, s, p, force, slope, K[0])
    while tau < step:
        last = h >= step - tau
        now = step - tau if last else h
        for i in range(1, _STAGES):
            for k in range(n):
                total = 0.0
                for j in range(i):
                    total += _A[i, j] * K[j, k]
                new[k] = s[k] + now * total
            _state_derivative(tau + _C[i] * now, new, p, force, slope, K[i])
        for k in range(n):
            total = 0.0
            for j in range(_STAGES):
                total += _B[j] * K[j, k]
            new[k] = s[k] + now * total
        _state_derivative(tau + now, new, p, force, slope, K[_STAGES])
        fifth, third = 0.0, 0.0
        for k in range(2):
            size = ATOL * scale[k] + RTOL * max(abs(s[k]), abs(new[k]))
            five, three = 0.0, 0.0
            for j in range(_STAGES + 1):
                five += _E5[j] * K[j, k]
                three += _E3[j] * K[j, k]
            fifth += (five / size) ** 2
            third += (three / size) ** 2
        error = 0.0 if fifth == 0.0 else now * fifth / np.sqrt((fifth + 0.01 * third) * 2)
        if not np.isfinite(error) or now < 1e-9 * step:
            s[:] = np.nan
            return step
        if error < 1.0:
            tau = step if last else tau + now
            s[:] = new
            K[0] = K[_STAGES]
        factor = 10.0 if error == 0.0 else min(10.0, max(0.2, 0.9 * error**-0.125))
        if error >= 1.0:
            h = now * min(1.0, factor)
        elif not last or factor < 1.0:
            h = now * factor
        else:
            h = max(h, now * factor)
    return h


@njit(cache=True)
def _simulate(p, force, slope, initial, step, scale):
    states = np.empty((len(force) + 1, 2))
    accelerations = np.empty(len(force) + 1)
    s = initial.copy()
    K, new = np.empty((_STAGES + 1, 2)), np.empty(2)
    states[0] = s
    _state_derivative(0.0, s, p, 0.0, 0.0, K[0])
    accelerations[0] = K[0, 1]
    h = step
    for k in range(len(force)):
        h = _advance_sample(s, p, force[k], slope[k], step, scale, h, K, new)
        states[k + 1] = s
        _state_derivative(step, s, p, force[k], slope[k], K[0])
        accelerations[k + 1] = K[0, 1]
    return states, accelerations


@njit(cache=True)
def state_sensitivities(p, force, slope, states, step, scale):
    """(T, 7, 2) derivatives of the state after each sample interval by each of `SENSITIVITY_DIRECTIONS` before it.

    The other arguments are as in `simulate`; ``states`` (T, 2) are the states before the intervals.
    """
    sensitivities = np.empty((len(force), 7, 2))
    s = np.empty(16)
    K, new = np.empty((_STAGES + 1, 16)), np.empty(16)
    h = step
    for k in range(len(force)):
        s[:] = 0.0
        s[:2] = states[k]
        s[2], s[5] = 1.0, 1.0
        h = _advance_sample(s, p, force[k], slope[k], step, scale, h, K, new)
        sensitivities[k] = s[2:].reshape(7, 2)
    return sensitivities


def simulate(
    parameters: FloatArray, force: FloatArray, slope: FloatArray, initial: FloatArray, step: float, scale: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Simulate T + 1 samples.

    Args:
        parameters: (5,) m, c, a, b and q.
        force: (T,) input and process noise at the start of each interval between samples.
        slope: (T,) its rate of change over the interval.
        initial: (2,) x and x' at sample 0.
        step: sampling step.
        scale: (2,) sizes of x and x'; errors are of the order of 1e-12 of them, or 1e-9 of the values, at most.

    Returns:
        The states (T + 1, 2), and the accelerations (T + 1,) at the end of the interval before each sample. No interval
        precedes sample 0, where no force acts.

    Raises:
        OverflowError: where the oscillator escapes.
    """
    states, accelerations = _simulate(parameters, force, slope, initial, step, scale)
    if not np.isfinite(states).all():
        raise OverflowError(f"the oscillator escapes at sample {int(np.argmin(np.isfinite(states).all(axis=1)))}")
    return states, accelerations


def output_derivatives(sensor_kind: str, parameters: FloatArray, states: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(T, 2) derivatives of each output by the state, and (T,) derivatives of an acceleration by the force, else 0."""
    m, c, a, b, q = parameters
    rows: Any = {"displacement": (1.0, 0.0), "velocity": (0.0, 1.0), "acceleration": (0.0, -c / m)}[sensor_kind]
    by_state = np.tile(np.array(rows), (len(states), 1))
    if sensor_kind == "acceleration":
        by_state[:, 0] = -(a + 3 * b * states[:, 0] ** 2 + 5 * q * states[:, 0] ** 4) / m
    return by_state, np.full(len(states), 1 / m if sensor_kind == "acceleration" else 0.0)
