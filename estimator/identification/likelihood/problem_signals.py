"""Signals of an identification problem: bridged gaps, masked outputs, input rows of the filter, shifted origins."""

from __future__ import annotations

import math

import numpy as np

from estimator.inference.input_interpolation import input_stencil
from estimator.models.duffing import DERIVATIVE_ORDER_OF_SENSOR
from estimator.models.model import Model
from estimator.rigs.rig import Rig
from estimator.support.array_types import FloatArray


def interpolate_gaps(y: FloatArray, max_gap: float) -> FloatArray:
    """Outputs (T,) with straight lines through gaps of at most ``max_gap`` samples.

    Example:
        >>> interpolate_gaps(np.array([0.0, np.nan, 2.0, np.nan, np.nan, 5.0, np.nan]), 1)
        array([ 0.,  1.,  2., nan, nan,  5., nan])
    """
    observed = np.flatnonzero(np.isfinite(y))
    filled = y.copy()
    gaps = np.diff(observed) - 1
    for gap in np.flatnonzero((gaps > 0) & (gaps <= max_gap)):
        before, after = observed[gap], observed[gap + 1]
        filled[before : after + 1] = np.linspace(y[before], y[after], after - before + 1)
    return filled


def sliding_sums(values: FloatArray, samples: int) -> FloatArray:
    """Sums of ``samples`` values in a row, one for each begin."""
    sums = np.concatenate([[0.0], np.cumsum(values)])
    samples = min(samples, len(values))
    return np.asarray(sums[samples:] - sums[: len(sums) - samples])


def mask_unexplained_outputs(y: FloatArray, rig: Rig, extra_delay: int = 0) -> FloatArray:
    """Outputs (T,) of a record, with NaN where inputs from before the record act.

    The effect of those inputs on later outputs is part of the unknown initial state.

    Args:
        y: (T,) outputs.
        rig: the rig of the record.
        extra_delay: samples by which the input may be later than the rig says.
    """
    # An accelerometer measures the force itself, not only its effect.
    n_masked = max(0, math.ceil(rig.delay)) + extra_delay + (DERIVATIVE_ORDER_OF_SENSOR[rig.output.kind] == 2)
    masked = y.copy()
    masked[: min(n_masked, len(y) - 1)] = np.nan
    return masked


def filter_input_rows(model: Model, rig: Rig, u: FloatArray) -> FloatArray:
    """(T, rows) input of a model over the sample before each output; after the last input it stays constant."""
    input_feed = input_stencil(model, rig)
    if input_feed.needs_whole_record:
        return input_feed.spline_coefficients(u)
    window = input_feed.stencil.shape[1]
    lag = -1 if input_feed.lookahead else input_feed.n_past - (window - 1)
    places = np.arange(len(u))[:, None] - lag - (window - 1) + np.arange(window)
    acting = u[np.clip(places, 0, len(u) - 1)]
    if not input_feed.repeats_first:
        acting = np.where(places < 0, 0.0, acting)
    return np.asarray(acting @ input_feed.stencil.T)


def shift_output_origin(
    model: Model, mean: FloatArray, cov: FloatArray, origin: float
) -> tuple[FloatArray, FloatArray]:
    """Moments of the coefficients for displacements from another origin: z'' = force - stiffness z + ...."""
    jacobian, offset = np.eye(len(mean)), np.zeros(len(mean))
    names = list(model.coefficients)
    jacobian[names.index("force"), names.index("stiffness")] = -origin
    offset[names.index("output_offset")] = -origin
    shifted_cov = jacobian @ cov @ jacobian.T
    # The inverse of a nearly singular matrix, such as of few samples, is symmetric to fewer digits than it has.
    return jacobian @ mean + offset, (shifted_cov + shifted_cov.T) / 2


def stack_padded(series: list[FloatArray], columns: int) -> FloatArray:
    """(n, T, columns) of n series: missing columns are 0, and a shorter series ends with NaN."""
    stacked = np.full((len(series), max(map(len, series)), columns), np.nan)
    for row, one in zip(stacked, series, strict=True):
        row[: len(one)] = 0.0
        row[: len(one), : one.shape[1]] = one
    return stacked
