"""Posteriors of many records at once: one record per SIMD lane.

The posteriors are the same as from `OnlineEstimator`, in a fraction of the time.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from estimator.belief import Belief
from estimator.compilation.simd import LANES, kernel
from estimator.engine import kernels
from estimator.engine.storage_layout import belief_rows, first_input_row
from estimator.inference import mean_field
from estimator.inference.input_interpolation import input_stencil, record_lengths, rig_input_degree
from estimator.inference.record_arrays import inputs_by_channel, outputs_by_sensor
from estimator.models.model import Model
from estimator.rigs.rig import Rig
from estimator.support.update_options import DEFAULT_ITERATIONS


def posteriors(u: npt.ArrayLike, y: npt.ArrayLike, prior: Belief, rig: Rig | None = None) -> list[Belief]:
    """Identify a system from each of n records, sample by sample.

    Args:
        u: (n, T) inputs, or (n, T, inputs) of several or none. A record ends before its first NaN, in the outputs of a
            model without inputs, so that episodes of different lengths fit into one array.
        y: (n, T) outputs, paired with u by index as the rig says; (n, T, sensors) of several sensors.
        prior: `Belief` before the first sample of every record; the updates use its factorisation.
        rig: timing and interpolation of the inputs. None is the timing of an environment: the t-th input of a
            difference equation acts on the state before the t-th output, and the input of a differential equation is
            linear between samples. ``look_ahead``, ``spline`` and a delay of -1 are refused, since their samples wait
            for a later input.

    Returns:
        The n posteriors, each after the last sample of its record.

    Raises:
        ValueError: for shapes that do not fit, a prior that is no `Belief`, or a rig that is refused.
    """
    if not isinstance(prior, Belief):
        raise ValueError(f"prior must be a Belief, but is {prior!r:.60}; see estimator.priors")
    inputs = inputs_by_channel(prior.model, u)
    outputs = outputs_by_sensor(prior.model, inputs, y)
    if inputs.ndim != 3:
        raise ValueError(f"u must be of n records, but has shape {np.shape(u)}; pass u[None] for one")
    rig = Rig(prior.step, "linear") if rig is None else rig
    input_window = input_stencil(prior.model, rig)
    if input_window.repeats_first:
        raise ValueError(f"interpolation must be 'zero_order' or 'linear', but is {rig.interpolation!r}; or use run()")
    if input_window.lookahead:
        raise ValueError(
            f"delay must be 0 or more for a difference equation, but is {rig.delay}; shift u by a sample, or use run()"
        )
    lengths = record_lengths(inputs if prior.model.inputs else outputs)
    for row, length in enumerate(lengths):
        if not (np.isfinite(inputs[row, :length]).all() and np.isfinite(outputs[row, :length]).all()):
            raise ValueError(
                f"u and y must be finite up to the end of a record, but in record {row} they are not; cut it before"
            )
    flat_inputs = inputs.reshape(len(inputs), inputs.shape[1] * prior.model.n_inputs)
    flat_inputs = np.concatenate([np.zeros((len(inputs), input_window.n_stored)), flat_inputs], axis=1)
    records = np.repeat(prior.record[None], len(inputs), axis=0)
    run = _compile_batch_filter(prior.model, rig_input_degree(prior.model, rig), prior.factorisation)
    run(flat_inputs, outputs, lengths, prior.record.copy(), input_window.stencil, records)
    records.flags.writeable = False
    return prior.with_records(records)


@cache
def _compile_batch_filter(model: Model, degree: int, factorisation: str) -> Any:
    """Compile ``run(inputs, outputs, lengths, prior, stencil, records)`` of a model."""
    iterations = DEFAULT_ITERATIONS[factorisation]
    if factorisation == "mean_field":
        layout = mean_field.mean_field_layout()
        update_all = mean_field.compile_mean_field_update(layout)
    else:
        belief_update = kernels.compile_belief_update(model, degree, iterations=iterations)
        layout, update_all = dict(belief_update.layout), belief_update.update
    is_structured = factorisation == "structured"
    u_row, y_row = first_input_row(layout, model) * LANES, layout[f"Y_{next(iter(model.outputs))}"] * LANES
    n_rows, size, stride = len(layout), len(belief_rows(model)), model.n_inputs

    @kernel(variant=f"{model.name}_{model.digest}_{degree}_{factorisation}")
    def run(inputs, outputs, lengths, prior, stencil, records):
        W = np.empty(n_rows * LANES)
        rows, window = stencil.shape
        for first in range(0, len(inputs), LANES):
            W[:] = 0.0
            count = min(LANES, len(inputs) - first)
            longest = 0
            for j in range(LANES):
                for i in range(size):
                    W[i * LANES + j] = prior[i]
            for j in range(count):
                longest = max(longest, lengths[first + j])
                for i in range(size):
                    records[first + j, i] = prior[i]
            for t in range(longest):
                for j in range(LANES):
                    is_active = j < count and t < lengths[first + j]
                    for i in range(rows):
                        value = 0.0
                        for w in range(window):
                            value += inputs[first + j, t * stride + w] * stencil[i, w] if is_active else 0.0
                        W[u_row + i * LANES + j] = value
                    for k in range(outputs.shape[2]):
                        W[y_row + k * LANES + j] = outputs[first + j, t, k] if is_active else 0.0
                if is_structured:
                    update_all(W)
                else:
                    update_all(W, iterations, False)
                for j in range(count):
                    if lengths[first + j] == t + 1:
                        for i in range(size):
                            records[first + j, i] = W[i * LANES + j]

    return run
