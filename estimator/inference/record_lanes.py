"""Records side by side in the SIMD lanes of a block: their start, and each of their samples."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np

from estimator.compilation.simd import jit
from estimator.models.model import Model
from estimator.support.array_types import FloatArray

#: (rows, columns) of the upper triangle of a square matrix.
upper_triangle = cache(np.triu_indices)

#: Factor on the sensor's variance for a missing output [1].
_MISSING_VARIANCE_FACTOR = 1e18

#: Series side by side: one AVX-512 vector, since a fit has few series.
FIT_LANES = 8


def initial_state_moments(
    model: Model,
    coefficients: FloatArray,
    initial_state_cov: FloatArray,
    initial_state: FloatArray | float,
    slopes: FloatArray | None,
) -> FloatArray:
    """(n, rows) mean, packed covariance and, where there are slopes, sensitivities of the states at the start."""
    n, moments = model.n_states, model.n_states + model.n_states * (model.n_states + 1) // 2
    has_slopes = slopes is not None or bool(model.initial_states)
    begin = np.zeros((len(coefficients), moments + n * model.n_coefficients * has_slopes))
    begin[:, :n] = initial_state
    cov = initial_state_cov.copy()
    if has_slopes:
        sensitivities = begin[:, moments:].reshape(len(begin), n, model.n_coefficients)
        sensitivities[:] = 0.0 if slopes is None else slopes
        for state, coefficient in model.initial_state_coefficients:
            begin[:, state] = coefficients[:, coefficient]
            cov[state, :] = cov[:, state] = 0.0
            sensitivities[:, state] = np.arange(model.n_coefficients) == coefficient
        begin[:, moments:] = sensitivities.reshape(len(begin), -1)
    begin[:, n:moments] = cov[upper_triangle(n)]
    return begin


class RowOffsets(NamedTuple):
    """Sizes of the loop's quantities, and their first rows in the block; -1 for a row that is not there.

    Attributes:
        n_coefficients: coefficients.
        n_outputs: sensors.
        n_noises: noises of `record_likelihoods`.
        n_totals: rows of `RecordLikelihoods`.
        coefficient: first coefficient.
        noise: variance of the process noise; the sensors' follow.
        input: first row of the input.
        sample_length: length of the sample.
        is_counted: whether the sample counts.
        first_total: first of the totals.
        output: first output.
        predicted_output: first predicted output.
        predicted_variance: its variance without sensor noise.
    """

    n_coefficients: int
    n_outputs: int
    n_noises: int
    n_totals: int
    coefficient: int
    noise: int
    input: int
    sample_length: int
    is_counted: int
    first_total: int
    output: int
    predicted_output: int
    predicted_variance: int


# The next functions do not depend on the model, and are compiled once for all models.


@jit
def load_records(W, at, first, lanes, coefficients, lengths, moments, noises):
    """Load the series from ``first`` on side by side; returns the length of the longest."""
    W[:] = 0.0
    longest = 0
    for j in range(FIT_LANES):
        i = first + min(j, lanes - 1)  # a spare lane repeats the last one
        longest = max(longest, lengths[i])
        W[at.is_counted * FIT_LANES + j] = 1.0
        for c in range(at.n_coefficients):
            W[(at.coefficient + c) * FIT_LANES + j] = coefficients[i, c]
        for c in range(moments.shape[1]):
            W[c * FIT_LANES + j] = moments[i, c]
        for c in range(at.n_noises):
            W[(at.noise + c) * FIT_LANES + j] = noises[i, c]
    return longest


@jit
def load_sample(W, at, first, lanes, t, inputs, y, sample_lengths, lengths, noises):
    """Load sample t of each series."""
    for j in range(FIT_LANES):
        i = first + min(j, lanes - 1)
        is_active = t < lengths[i]
        for c in range(inputs.shape[2]):
            W[(at.input + c) * FIT_LANES + j] = inputs[i, t, c] if is_active else 0.0
        if at.sample_length >= 0:
            W[at.sample_length * FIT_LANES + j] = sample_lengths[i, t] if is_active else 1.0
        if at.output >= 0:
            is_complete = True
            for c in range(at.n_outputs):
                is_observed = is_active and not np.isnan(y[i, t, c])
                is_complete = is_complete and is_observed
                W[(at.output + c) * FIT_LANES + j] = y[i, t, c] if is_observed else 0.0
                W[(at.noise + 1 + c) * FIT_LANES + j] = noises[i, 1 + c] * (
                    1.0 if is_observed else _MISSING_VARIANCE_FACTOR
                )
            W[at.is_counted * FIT_LANES + j] = 1.0 if is_complete else 0.0


@jit
def store_results(W, at, first, lanes, t, lengths, noises, totals, forecasts):
    """Store the forecasts of sample t, and the totals of series that end with it."""
    for j in range(lanes):
        if at.output >= 0 and len(forecasts) and t < lengths[first + j]:
            for c in range(at.n_outputs):
                forecasts[first + j, t, c, 0] = W[(at.predicted_output + c) * FIT_LANES + j]
                forecasts[first + j, t, c, 1] = (
                    W[(at.predicted_variance + c) * FIT_LANES + j] + noises[first + j, 1 + c]
                )
        if t + 1 == lengths[first + j]:
            for c in range(at.n_totals):
                totals[first + j, c] = W[(at.first_total + c) * FIT_LANES + j]
            for c in range(at.first_total):  # a finished series goes on at rest
                W[c * FIT_LANES + j] = 0.0
