"""The linearised Kalman filter over whole records at known coefficients: likelihood, gradient and Fisher information.

The records run side by side in SIMD lanes. `estimator.engine.linearised_filter` has the arithmetic of a sample.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from estimator.compilation.simd import kernel
from estimator.engine.kernels import compile_linearised_filter
from estimator.engine.storage_layout import first_input_row, known_inputs, likelihood_total_rows
from estimator.inference.input_interpolation import record_lengths
from estimator.inference.record_lanes import (
    FIT_LANES,
    RowOffsets,
    initial_state_moments,
    load_records,
    load_sample,
    store_results,
    upper_triangle,
)
from estimator.models.model import MAX_INPUT_AGE, Model
from estimator.support.argument_checks import check_mapping, to_float_array
from estimator.support.array_types import FloatArray


class RecordLikelihoods(NamedTuple):
    """Totals of `record_likelihoods` over n series.

    Attributes:
        loss: (n,) minus the log likelihood, up to a constant; zeros without outputs.
        gradient: (n, K) its gradient by the coefficients, likewise.
        information: (n, K, K) Fisher information.
        innovations_squared: (n,) Σ ν²/S, near the number of outputs if the noise variances are right.
    """

    loss: FloatArray
    gradient: FloatArray
    information: FloatArray
    innovations_squared: FloatArray


def inputs_by_sample(model: Model, u: FloatArray, degree: int = 0) -> FloatArray:
    """(n, T, rows) inputs of each sample, from inputs (n, T) or (n, T, inputs) that are 0 before the first.

    The rows are `estimator.engine.storage_layout.input_rows`, for the degree 0 (held) or 1 (linear).
    """
    channels = u if u.ndim == 3 else u[..., None]
    ages = [
        np.concatenate([np.zeros((len(u), age, model.n_inputs)), channels[:, : u.shape[1] - age]], axis=1)
        for age in range(MAX_INPUT_AGE + 1)
    ]
    rows = known_inputs(model, degree)
    found = np.empty((*u.shape[:2], len(rows)))
    for i, row in enumerate(rows):
        value = ages[row.age][..., row.channel]
        value = value if row.subtracted_age is None else value - ages[row.subtracted_age][..., row.channel]
        found[..., i] = value + 0.0 * channels[..., row.channel]  # NaN beyond the end
    return found


def record_likelihoods(
    model: Model,
    coefficients: FloatArray,
    inputs: FloatArray,
    y: FloatArray | None,
    noises: FloatArray,
    initial_state_cov: FloatArray,
    initial_state: FloatArray | float = 0.0,
    sample_lengths: FloatArray | None = None,
    forecasts: FloatArray | None = None,
    initial_state_slopes: FloatArray | None = None,
) -> RecordLikelihoods:
    """Run the linearised Kalman filter over n series.

    States of `Model.initial_states` begin at their coefficients, without variance, whatever the other arguments say.

    Args:
        model: the equation.
        coefficients: (n, K) coefficients.
        inputs: (n, T, rows) inputs of each sample (`inputs_by_sample`); a series ends before its first NaN.
        y: (n, T, p) outputs, NaN where one is missing; None for the noise-free response.
        noises: (1 + p,) or (n, 1 + p) variances of the process noise and of each sensor; then, of a model with
            independent noise, the ratio of each source's variance to the declared one (`noise_variances`).
        initial_state_cov: (n_states, n_states) covariance of the states at the start.
        initial_state: (n, n_states) mean of the states at the start; 0 is at rest.
        sample_lengths: (n, T) length of each sample of a differential equation, in sampling steps; None for all 1.
        forecasts: (n, T, p, 2) receives the predictive mean and variance of each output.
        initial_state_slopes: (n, n_states, K) derivatives of ``initial_state`` by the coefficients; None for all 0.
    """
    begin = initial_state_moments(model, coefficients, initial_state_cov, initial_state, initial_state_slopes)
    k, upper = model.n_coefficients, upper_triangle(model.n_coefficients)
    lengths = record_lengths(inputs)
    totals = np.zeros((len(inputs), len(likelihood_total_rows(model))))
    noise_rows = np.broadcast_to(noises, (len(inputs), 1 + model.n_outputs + len(model.noise_sources))).copy()
    degree = inputs.shape[2] // model.n_inputs - 1 if model.is_continuous and model.inputs else 0
    outputs = np.zeros((0, 0, 0)) if y is None else y
    forecast_array = np.zeros((0, 0, 0, 0)) if forecasts is None else forecasts
    lengths_in_steps = np.zeros((0, 0)) if sample_lengths is None else sample_lengths
    run = compile_record_filter(with_substeps(model, 1), degree, y is not None, sample_lengths is not None)
    steps = model.substeps
    run(coefficients, inputs, outputs, lengths_in_steps, lengths, begin, noise_rows, steps, totals, forecast_array)
    information = np.empty((len(inputs), k, k))
    information[:, upper[0], upper[1]] = information[:, upper[1], upper[0]] = totals[:, 1 + k : -1]
    return RecordLikelihoods(totals[:, 0], totals[:, 1 : 1 + k], information, totals[:, -1])


@cache
def with_substeps(model: Model, substeps: int) -> Model:
    """The model with a number of Runge-Kutta steps per sample; 1 for code that takes the number as an argument."""
    return replace(model, substeps=substeps)


@cache
def compile_record_filter(model: Model, degree: int, follows_outputs: bool, variable_step: bool = False) -> Any:
    """Compile the loop of `record_likelihoods`, with totals (n, 2 + K + K (K + 1)/2) packed.

    The number of Runge-Kutta steps is an argument, and the model's own does not count: `with_substeps`.
    """
    linearised_filter = compile_linearised_filter(
        model,
        degree,
        follows_outputs=follows_outputs,
        lanes=FIT_LANES,
        variable_step=variable_step,
        noise_ratios=model.independent_noise,
    )
    sample, rows, size = linearised_filter.sample, linearised_filter.layout, len(linearised_filter.layout)
    sensor = next(iter(model.outputs))
    at = RowOffsets(
        n_coefficients=model.n_coefficients,
        n_outputs=model.n_outputs,
        n_noises=1 + model.n_outputs + len(model.noise_sources),
        n_totals=len(likelihood_total_rows(model)),
        coefficient=rows[next(iter(model.coefficients))],
        noise=rows["PROCESS_VARIANCE"],
        input=first_input_row(rows, model),
        sample_length=rows["SAMPLE_LENGTH"] if variable_step else -1,
        is_counted=rows["IS_COUNTED"],
        first_total=rows["LOSS"],
        output=rows[f"Y_{sensor}"] if follows_outputs else -1,
        predicted_output=rows[f"Y_PRED_{sensor}"] if follows_outputs else -1,
        predicted_variance=rows[f"HPH_{sensor}"] if follows_outputs else -1,
    )

    @kernel(variant=f"{model.name}_{model.digest}_{degree}_{int(follows_outputs)}_{int(variable_step)}")
    def run(points, inputs, y, spans, lengths, begin, noises, steps, totals, forecasts):
        W = np.empty(size * FIT_LANES)
        for first in range(0, len(inputs), FIT_LANES):
            lanes = min(FIT_LANES, len(inputs) - first)
            for t in range(load_records(W, at, first, lanes, points, lengths, begin, noises)):
                load_sample(W, at, first, lanes, t, inputs, y, spans, lengths, noises)
                sample(W, steps)
                store_results(W, at, first, lanes, t, lengths, noises, totals, forecasts)

    return run


def noise_variances(
    model: Model,
    process_noise: npt.ArrayLike,
    measurement_noise: npt.ArrayLike,
    process_ratios: Mapping[str, npt.ArrayLike] | None = None,
) -> FloatArray:
    """Variances of the process noise and of each sensor from standard deviations, for `record_likelihoods`.

    Args:
        model: the equation.
        process_noise: standard deviation of the process noise; (n,) of a batch.
        measurement_noise: the sensors' standard deviations: one number, or one for each; (n, p) of a batch.
        process_ratios: state with independent noise to the factor on its strength, 0 or more; (n,) of a batch.
            Others have 1.

    Returns:
        (1 + p + sources,), or (n, 1 + p + sources) of a batch; the last are the squared ratios of
        `Model.noise_sources`.

    Raises:
        ValueError: for a value out of range, ratios of other states, or another number of sensors than the model has.
    """
    ratios = {} if process_ratios is None else process_ratios
    check_mapping("process_ratios", ratios)
    unknown = sorted(set(ratios).difference(model.noise_sources))
    if unknown:
        raise ValueError(
            f"process_ratios must be of states with independent noise, {list(model.noise_sources)}, but have {unknown};"
            f" declare the model with independent_noise=True"
        )
    given = {"process_noise": process_noise}
    given |= {f"process_ratios[{state!r}]": ratios.get(state, 1.0) for state in model.noise_sources}
    columns = [to_float_array(name, value) for name, value in given.items()]
    for (name, value), column in zip(given.items(), columns, strict=True):
        if column.ndim > 1 or not (np.all(column >= 0) and np.isfinite(column).all()):
            raise ValueError(
                f"{name} must be 0 or more and finite, but is {value!r}; pass a standard deviation"
                f"{'' if name == 'process_noise' else ' in parts of the declared one'}"
            )
    stds = to_float_array("measurement_noise", measurement_noise)
    if stds.ndim > 2 or (stds.ndim and stds.shape[-1] != model.n_outputs):
        raise ValueError(
            f"measurement_noise must be one number, or one for each of {list(model.outputs)}, but has shape "
            f"{stds.shape}"
        )
    if not (np.all(stds > 0) and np.isfinite(stds).all()):
        raise ValueError(
            f"measurement_noise must be positive and finite, but is {stds.tolist()}; pass a standard deviation"
        )
    try:
        shape = np.broadcast_shapes(*(column.shape for column in columns), stds.shape[:-1])
    except ValueError:
        sizes = [column.shape for column in columns], stds.shape[:-1]
        raise ValueError(
            f"process_noise and measurement_noise must be batches of one size, but have {sizes}; repeat the smaller"
        ) from None
    sensors = np.broadcast_to(stds, (*shape, model.n_outputs))
    process, *sources = (np.broadcast_to(column, shape)[..., None] for column in columns)
    return np.concatenate([process, sensors, *sources], axis=-1) ** 2
