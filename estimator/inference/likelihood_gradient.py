"""The exact gradient of the records' likelihood by the coefficients, where `record_likelihoods` holds gains fixed."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from estimator.compilation.simd import kernel
from estimator.engine.likelihood_gradient import compile_likelihood_adjoint
from estimator.engine.storage_layout import first_input_row
from estimator.inference.input_interpolation import record_lengths
from estimator.inference.record_filter import with_substeps
from estimator.inference.record_lanes import FIT_LANES, RowOffsets, initial_state_moments, load_records, load_sample
from estimator.models.model import Model
from estimator.support.array_types import FloatArray


def likelihood_gradients(
    model: Model,
    coefficients: FloatArray,
    inputs: FloatArray,
    y: FloatArray,
    noises: FloatArray,
    initial_state_cov: FloatArray,
    initial_state: FloatArray | float = 0.0,
    sample_lengths: FloatArray | None = None,
    initial_state_slopes: FloatArray | None = None,
    misfit_weights: FloatArray | float = 1.0,
) -> FloatArray:
    """(n, K) exact gradients of the loss ½ Σ (w ν²/S + log S) of `estimator.inference.record_filter`, at w = 1.

    The derivative is by the computed numbers, integration steps and all. It takes 2.5 to 6 times as long as the
    loss with its Fisher information. Arguments that are not named here are as for `record_likelihoods`.

    Args:
        model: the equation.
        coefficients: (n, K) coefficients.
        inputs: (n, T, rows) inputs of each sample.
        y: (n, T, p) outputs.
        noises: variances of the noises.
        initial_state_cov: covariance of the states at the start.
        initial_state: mean of the states at the start.
        sample_lengths: (n, T) length of each sample.
        initial_state_slopes: (n, n_states, K) derivatives of ``initial_state``.
        misfit_weights: the weight w of each series, one or (n,).
    """
    n, k = model.n_states, model.n_coefficients
    begin = initial_state_moments(model, coefficients, initial_state_cov, initial_state, initial_state_slopes)
    n_moments = n + n * (n + 1) // 2
    slopes = begin[:, n_moments:].reshape(len(begin), -1, k)
    noise_rows = np.broadcast_to(noises, (len(inputs), 1 + model.n_outputs + len(model.noise_sources))).copy()
    degree = inputs.shape[2] // model.n_inputs - 1 if model.is_continuous and model.inputs else 0
    run = compile_gradient(with_substeps(model, 1), degree, sample_lengths is not None)
    adjoints = np.zeros((len(inputs), n + k))
    run(
        coefficients,
        inputs,
        y,
        np.zeros((0, 0)) if sample_lengths is None else sample_lengths,
        record_lengths(inputs),
        begin[:, :n_moments].copy(),
        noise_rows,
        np.broadcast_to((np.asarray(misfit_weights, dtype=np.float64) - 1) / 2, len(inputs)).copy(),
        model.substeps,
        adjoints,
    )
    gradient = adjoints[:, n:]
    return gradient + np.einsum("ni,nik->nk", adjoints[:, :n], slopes) if slopes.shape[1] else gradient


@cache
def compile_gradient(model: Model, degree: int, variable_step: bool = False) -> Any:
    """Compile the loop of `likelihood_gradients`: adjoints (n, n_states + K) of the first states and coefficients."""
    adjoint = compile_likelihood_adjoint(model, degree, FIT_LANES, variable_step, model.independent_noise)
    forward, backward, rows, size = adjoint.forward, adjoint.backward, adjoint.layout, len(adjoint.layout)
    n_kept, n_tape = adjoint.n_filter_state * FIT_LANES, adjoint.n_integrated * FIT_LANES
    n_filter_state, n_states, loss, misfit = adjoint.n_filter_state, model.n_states, rows["ADJ_LOSS"], rows["ADJ_NIS"]
    state_adjoint, coefficient_adjoint = (
        rows[f"ADJ_{next(iter(model.states))}"],
        rows[f"ADJ_{next(iter(model.coefficients))}"],
    )
    at = RowOffsets(
        n_coefficients=model.n_coefficients,
        n_outputs=model.n_outputs,
        n_noises=1 + model.n_outputs + len(model.noise_sources),
        n_totals=0,
        coefficient=rows[next(iter(model.coefficients))],
        noise=rows["PROCESS_VARIANCE"],
        input=first_input_row(rows, model),
        sample_length=rows["SAMPLE_LENGTH"] if variable_step else -1,
        is_counted=rows["IS_COUNTED"],
        first_total=rows["LOSS"],
        output=rows[f"Y_{next(iter(model.outputs))}"],
        predicted_output=-1,
        predicted_variance=-1,
    )

    @kernel(variant=f"{model.name}_{model.digest}_{degree}_{int(variable_step)}")
    def run(points, inputs, y, spans, lengths, begin, noises, misfit_adjoints, steps, adjoints):
        W = np.empty(size * FIT_LANES)
        step_tape = np.empty((steps, n_tape))
        for first in range(0, len(inputs), FIT_LANES):
            lanes = min(FIT_LANES, len(inputs) - first)
            longest = load_records(W, at, first, lanes, points, lengths, begin, noises)
            tape = np.empty((longest, n_kept))
            for t in range(longest):
                load_sample(W, at, first, lanes, t, inputs, y, spans, lengths, noises)
                for i in range(n_kept):
                    tape[t, i] = W[i]
                forward(W, steps)
            for j in range(FIT_LANES):
                W[loss * FIT_LANES + j] = 1.0
                W[misfit * FIT_LANES + j] = misfit_adjoints[first + min(j, lanes - 1)]
            for t in range(longest - 1, -1, -1):
                load_sample(W, at, first, lanes, t, inputs, y, spans, lengths, noises)
                for i in range(n_kept):
                    W[i] = tape[t, i]
                backward(W, steps, step_tape)
                for j in range(lanes):
                    if t >= lengths[first + j]:  # the series has ended before this sample
                        for c in range(n_filter_state):
                            W[(state_adjoint + c) * FIT_LANES + j] = 0.0
                        for c in range(at.n_coefficients):
                            W[(coefficient_adjoint + c) * FIT_LANES + j] = 0.0
            for j in range(lanes):
                for c in range(n_states):
                    adjoints[first + j, c] = W[(state_adjoint + c) * FIT_LANES + j]
                for c in range(at.n_coefficients):
                    adjoints[first + j, n_states + c] = W[(coefficient_adjoint + c) * FIT_LANES + j]

    return run
