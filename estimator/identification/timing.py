"""When inputs act and outputs are seen: a record as samples that each have a length of their own.

Between two of its knots, which are the times of outputs and of changes of the input, the input is a polynomial, and the
filter takes one sample. So times may be uneven, a delay may be a part of a step, and a record may have another step
than the rig. Times are counted in the rig's steps, from the first output on.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from estimator.parameters import FloatArray
from estimator.rig import INTERPOLATIONS

#: A sample is no longer than this [steps]: the steps of integration are chosen for one of length 1.
_LONGEST = 1.5

#: Knots that are nearer than this are one [steps].
_NEAR = 1e-6

#: Places in [0, 1] through which the polynomial of a lagging input goes, and what makes coefficients of the values.
_NODES = (1 - np.cos(np.pi * np.arange(6) / 5)) / 2
_TO_COEFFICIENTS = np.linalg.inv(np.vander(_NODES, increasing=True))


class Laid(NamedTuple):
    """A record on its knots.

    Attributes:
        inputs: (N, rows) coefficients of the input's polynomial over each sample, in parts of the sample.
        outputs: (N,) at the end of each sample; NaN where none was seen.
        spans: (N,) lengths [steps].
        places: (T,) the sample that ends with each output.
    """

    inputs: FloatArray
    outputs: FloatArray
    spans: FloatArray
    places: npt.NDArray[np.intp]


def laid(
    times: FloatArray, u: FloatArray, y: FloatArray, interpolation: str, delay: float = 0.0, lag: float = 0.0
) -> Laid:
    """Lay a record on its knots. It begins a step before its first output.

    Args:
        times: (T,) of inputs and outputs [steps], which grow from 0 on.
        u: (T,) inputs. Before the first there is none; after the last it stays.
        y: (T,) outputs; NaN where one is missing.
        interpolation: of the input: ``zero_order``, ``linear`` or ``spline``.
        delay: of the input [steps].
        lag: time constant of a first-order lag of the input [steps], 0 for none; not with a spline.
    """
    acting = times + delay
    knots = np.union1d(np.append(times, times[0] - 1.0), acting[(acting > times[0] - 1.0) & (acting < times[-1])])
    knots = _split(knots[np.diff(knots, prepend=-np.inf) > _NEAR])
    begins, spans = knots[:-1], np.diff(knots)
    # Knots that fell together keep the first of them.
    places = np.minimum(np.searchsorted(knots, times - 2 * _NEAR), len(knots) - 1) - 1
    inputs = _pieces(acting, u, begins, spans, interpolation)
    outputs = np.full(len(spans), np.nan)
    outputs[places] = y
    return Laid(_lagging(inputs, spans, lag) if lag else inputs, outputs, spans, places)


def _split(knots: FloatArray) -> FloatArray:
    """With more knots where two are far apart."""
    parts = np.maximum(1, np.ceil(np.diff(knots) / _LONGEST - _NEAR)).astype(np.intp)
    which = np.repeat(np.arange(len(parts)), parts)
    within = np.arange(len(which)) - np.repeat(np.cumsum(parts) - parts, parts)
    return np.append(knots[which] + within / parts[which] * np.diff(knots)[which], knots[-1])


def _pieces(acting: FloatArray, u: FloatArray, begins: FloatArray, spans: FloatArray, interpolation: str) -> FloatArray:
    """(N, degree + 1) polynomials of the input over samples that no change of it interrupts."""
    if interpolation == "spline":
        from scipy.interpolate import make_interp_spline

        degree = INTERPOLATIONS[interpolation]
        if len(u) <= degree:
            raise ValueError(f"u must have more than {degree} samples for interpolation 'spline', but has {len(u)}")
        spline = make_interp_spline(acting, u, k=degree)
        inside = np.clip(begins, acting[0], acting[-1])
        pieces = np.stack([spline(inside, nu=n) * spans**n / math.factorial(n) for n in range(degree + 1)], axis=1)
        pieces[(begins < acting[0]) | (begins >= acting[-1]), 1:] = 0.0
        return pieces
    if interpolation == "linear":
        first, last = (_ramped(acting, u, at) for at in (begins, begins + spans))
        return np.stack([first, last - first], axis=1)
    place = np.searchsorted(acting, begins + _NEAR, side="right") - 1
    return np.where(place < 0, 0.0, u[np.maximum(place, 0)])[:, None]


def _ramped(acting: FloatArray, u: FloatArray, at: FloatArray) -> FloatArray:
    """The input that goes linearly from one to the next, from 0 a step before the first."""
    return np.interp(at, np.append(acting[0] - 1.0, acting), np.append(0.0, u))


def _lagging(inputs: FloatArray, spans: FloatArray, lag: float) -> FloatArray:
    """(N, 6) polynomials of v, where lag v' = u - v, of held or linear u; v begins at u."""
    first = inputs[:, 0]
    slope = (inputs[:, 1] if inputs.shape[1] > 1 else np.zeros(len(inputs))) * lag / spans
    # v = u(s) - slope + (v_0 - u_0 + slope) exp(-s span/lag)
    kept = np.exp(-spans / lag)
    ends = first + slope * spans / lag - slope
    begin = np.empty(len(spans))
    value = first[0]
    for k, (here, decay, steady, incline) in enumerate(zip(first, kept, ends, slope, strict=True)):
        begin[k] = value
        value = steady + (value - here + incline) * decay
    fading = np.exp(-np.outer(spans / lag, _NODES))
    values = first[:, None] + slope[:, None] * (np.outer(spans / lag, _NODES) - 1.0)
    values += (begin - first + slope)[:, None] * fading
    return np.asarray(values @ _TO_COEFFICIENTS.T)
