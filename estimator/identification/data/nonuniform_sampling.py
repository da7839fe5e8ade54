"""Resampling of records with uneven times, fractional delays or a lag: samples of individual length.

The knots of a record are the times of its outputs and of the changes of its input. Between two knots the input is a
polynomial, and the filter takes one sample. Therefore times may be uneven, a delay may be a fraction of a step, and a
record may have another step than the rig. Times are counted in the rig's steps, from the first output on.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from estimator.models.interpolation import INTERPOLATION_DEGREES
from estimator.support.array_types import FloatArray

#: Longest sample [steps]: the substeps of the integration are chosen for a length of 1.
_MAX_SPAN = 1.5

#: Distance below which two knots are one [steps].
_KNOT_TOLERANCE = 1e-6

#: Nodes in [0, 1] of the polynomial that interpolates a lagged input.
_CHEBYSHEV_NODES = (1 - np.cos(np.pi * np.arange(6) / 5)) / 2

#: Matrix from values at the nodes to coefficients of the polynomial.
_NODE_VALUES_TO_COEFFICIENTS = np.linalg.inv(np.vander(_CHEBYSHEV_NODES, increasing=True))


class NonuniformSamples(NamedTuple):
    """A record on its knots.

    Attributes:
        inputs: (N, rows) coefficients of the input's polynomial over each sample, whose length counts as 1.
        outputs: (N,) outputs at the end of each sample; NaN where there is none.
        spans: (N,) lengths [steps].
        output_indices: (T,) index of the sample that ends with each output.
    """

    inputs: FloatArray
    outputs: FloatArray
    spans: FloatArray
    output_indices: npt.NDArray[np.intp]


def resample_on_knots(
    times: FloatArray, u: FloatArray, y: FloatArray, interpolation: str, delay: float = 0.0, lag: float = 0.0
) -> NonuniformSamples:
    """Resample a record on its knots, from one step before its first output.

    Args:
        times: (T,) times of inputs and outputs [steps], increasing from 0.
        u: (T,) inputs. Before the first the input is 0; after the last it stays.
        y: (T,) outputs; NaN where one is missing.
        interpolation: of the input: ``zero_order``, ``linear`` or ``spline``.
        delay: of the input [steps].
        lag: time constant of a first-order lag of the input [steps], 0 for none; not with a spline.
    """
    input_times = times + delay
    knots = np.union1d(
        np.append(times, times[0] - 1.0), input_times[(input_times > times[0] - 1.0) & (input_times < times[-1])]
    )
    knots = _split_long_gaps(knots[np.diff(knots, prepend=-np.inf) > _KNOT_TOLERANCE])
    sample_starts, spans = knots[:-1], np.diff(knots)
    # Of several knots that count as one, the first remains.
    output_indices = np.minimum(np.searchsorted(knots, times - 2 * _KNOT_TOLERANCE), len(knots) - 1) - 1
    inputs = _input_polynomials(input_times, u, sample_starts, spans, interpolation)
    outputs = np.full(len(spans), np.nan)
    outputs[output_indices] = y
    return NonuniformSamples(_lagged_polynomials(inputs, spans, lag) if lag else inputs, outputs, spans, output_indices)


def _split_long_gaps(knots: FloatArray) -> FloatArray:
    """The knots, with more of them where two are farther apart than the longest sample."""
    n_parts = np.maximum(1, np.ceil(np.diff(knots) / _MAX_SPAN - _KNOT_TOLERANCE)).astype(np.intp)
    which = np.repeat(np.arange(len(n_parts)), n_parts)
    within = np.arange(len(which)) - np.repeat(np.cumsum(n_parts) - n_parts, n_parts)
    return np.append(knots[which] + within / n_parts[which] * np.diff(knots)[which], knots[-1])


def _input_polynomials(
    input_times: FloatArray, u: FloatArray, sample_starts: FloatArray, spans: FloatArray, interpolation: str
) -> FloatArray:
    """(N, degree + 1) polynomials of the input over samples within which it does not change its piece."""
    if interpolation == "spline":
        from scipy.interpolate import make_interp_spline

        degree = INTERPOLATION_DEGREES[interpolation]
        if len(u) <= degree:
            raise ValueError(f"u must have more than {degree} samples for interpolation 'spline', but has {len(u)}")
        spline = make_interp_spline(input_times, u, k=degree)
        inside = np.clip(sample_starts, input_times[0], input_times[-1])
        pieces = np.stack([spline(inside, nu=n) * spans**n / math.factorial(n) for n in range(degree + 1)], axis=1)
        pieces[(sample_starts < input_times[0]) | (sample_starts >= input_times[-1]), 1:] = 0.0
        return pieces
    if interpolation == "linear":
        first, last = (_linear_input(input_times, u, at) for at in (sample_starts, sample_starts + spans))
        return np.stack([first, last - first], axis=1)
    input_index = np.searchsorted(input_times, sample_starts + _KNOT_TOLERANCE, side="right") - 1
    return np.where(input_index < 0, 0.0, u[np.maximum(input_index, 0)])[:, None]


def _linear_input(input_times: FloatArray, u: FloatArray, times: FloatArray) -> FloatArray:
    """The linearly interpolated input, from 0 one step before the first."""
    return np.interp(times, np.append(input_times[0] - 1.0, input_times), np.append(0.0, u))


def _lagged_polynomials(inputs: FloatArray, spans: FloatArray, lag: float) -> FloatArray:
    """(N, 6) polynomials of the lagged input v, where lag v' = u - v with a held or linear u; v starts at u."""
    first = inputs[:, 0]
    slope = (inputs[:, 1] if inputs.shape[1] > 1 else np.zeros(len(inputs))) * lag / spans
    # v = u(s) - slope + (v_0 - u_0 + slope) exp(-s span/lag)
    decays = np.exp(-spans / lag)
    ends = first + slope * spans / lag - slope
    begin = np.empty(len(spans))
    value = first[0]
    for k, (here, decay, steady, incline) in enumerate(zip(first, decays, ends, slope, strict=True)):
        begin[k] = value
        value = steady + (value - here + incline) * decay
    node_decay = np.exp(-np.outer(spans / lag, _CHEBYSHEV_NODES))
    values = first[:, None] + slope[:, None] * (np.outer(spans / lag, _CHEBYSHEV_NODES) - 1.0)
    values += (begin - first + slope)[:, None] * node_decay
    return np.asarray(values @ _NODE_VALUES_TO_COEFFICIENTS.T)
