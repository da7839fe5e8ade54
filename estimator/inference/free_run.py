"""Free run: simulation of a model at given coefficients without noise."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from estimator.compilation.array_operations import copy
from estimator.compilation.simd import kernel, number_rows
from estimator.engine.input_hold import compile_input_writer, input_degree
from estimator.engine.kernels import RUNTIME_FUNCTIONS
from estimator.engine.source_cache import load_generated
from estimator.engine.storage_layout import input_rows
from estimator.inference.record_arrays import inputs_by_channel
from estimator.models.model import Model
from estimator.support.argument_checks import to_float_array
from estimator.support.array_types import FloatArray


def free_run(
    model: Model,
    coefficients: npt.ArrayLike,
    u: npt.ArrayLike,
    state: npt.ArrayLike | None = None,
    interpolation: str = "zero_order",
) -> FloatArray:
    """Simulate the first sensor's output over a series of inputs, for one system or S at once.

    Args:
        model: the equation.
        coefficients: (K,) or (S, K), time counted in samples.
        u: (T,) or (S, T) inputs, or (..., T, inputs) of several or none; the t-th acts over the sample that ends with
            the t-th output. Before the first the input is 0.
        state: (n,) or (S, n) initial state; None is at rest, or at the coefficients of `Model.initial_states`.
        interpolation: interpolation of the input between samples: ``zero_order``, or ``linear`` for a differential
            equation.

    Returns:
        (T,) outputs, or (S, T) if any argument has S systems; inf or NaN after the model diverges.

    Raises:
        ValueError: for shapes that do not fit, or anything but numbers.
    """
    values, inputs = to_float_array("coefficients", coefficients), inputs_by_channel(model, u)
    start = np.zeros(model.n_states) if state is None else to_float_array("state", state)
    batches = [given.shape[:-axes] for given, axes in ((values, 1), (inputs, 2), (start, 1)) if given.ndim >= axes]
    systems = {batch[0] for batch in batches if batch}
    is_odd = len(systems) > 1 or len(batches) < 3 or any(len(batch) > 1 for batch in batches)
    if is_odd or values.shape[-1] != model.n_coefficients or start.shape[-1] != model.n_states:
        raise ValueError(
            f"coefficients, u and state must have shapes {(model.n_coefficients,)}, (T,) and {(model.n_states,)}, or "
            f"one more axis for systems, but have {values.shape}, {inputs.shape[:-1]} and {start.shape}"
        )
    starts = np.empty((*systems, model.n_states + model.n_coefficients))
    starts[..., : model.n_states], starts[..., model.n_states :] = start, values
    for place, coefficient in model.initial_state_coefficients if state is None else ():
        starts[..., place] = values[..., coefficient]
    outputs = np.empty((*systems, inputs.shape[-2]))
    inputs = np.broadcast_to(inputs, (*systems, *inputs.shape[-2:])).copy()
    run, _ = _compile_free_run(model, input_degree(model, interpolation))
    run(np.atleast_2d(starts), inputs if systems else inputs[None], np.atleast_2d(outputs))
    return outputs


def output_at(model: Model, coefficients: FloatArray, state: FloatArray, u: npt.ArrayLike) -> float:
    """Output of the first sensor at a state, under constant inputs.

    Args:
        model: the equation.
        coefficients: (K,), time counted in samples.
        state: (n,).
        u: (inputs,) the inputs, which act on an accelerometer directly; a number of one.
    """
    _, output_of = _compile_free_run(model, 0)
    return float(output_of(np.concatenate([state, coefficients]), np.array(u, dtype=np.float64).reshape(-1)))


@cache
def _compile_free_run(model: Model, degree: int) -> tuple[Any, Any]:
    """Compile ``run(starts, u, y)`` and ``output_of(start, u)``; a start holds states and coefficients."""
    layout = number_rows(*model.names, *input_rows(model, degree), "Y_PRED")

    def make() -> str:
        from estimator.engine import printer_numba, symbolic
        from estimator.engine.inputs_at_end import inputs_at_end

        lines, results = symbolic.propagate_state(model, degree, {name: name for name in model.names})
        uniform = ("TAU",) if model.is_continuous else ()
        source = printer_numba.print_lane_loop(
            "move", lines, results, layout, 1, uniform, doc="One sample, or one Runge-Kutta step, of the state."
        )
        shown = symbolic.differentiate(model).outputs[0].xreplace(inputs_at_end(model, degree))
        return source + printer_numba.print_lane_loop(
            "sense", [("OUTPUT", shown)], {"Y_PRED": "OUTPUT"}, layout, 1, doc="The output."
        )

    code = load_generated(model.name, "free-run", repr((model.digest, degree)), make, RUNTIME_FUNCTIONS)
    move, sense, size, steps, n = code.move, code.sense, len(layout), model.substeps, len(model.names)
    shown, continuous, inputs = layout["Y_PRED"], model.is_continuous, model.n_inputs
    feed = compile_input_writer(model, degree, [layout[row] for row in input_rows(model, degree)], 1)

    @kernel(variant=f"{model.name}_{model.digest}_{degree}")
    def run(starts, u, y):
        W = np.zeros(size)
        for i in range(len(starts)):
            copy(W, 0, starts[i], n)
            for t in range(u.shape[1]):
                for c in range(inputs):
                    feed(W, 0, c, u[i, t, c], u[i, t - 1, c] if t > 0 else 0.0, u[i, t - 2, c] if t > 1 else 0.0)
                if continuous:
                    for s in range(steps):
                        move(W, s / steps)
                else:
                    move(W)
                sense(W)
                y[i, t] = W[shown]

    @kernel(variant=f"{model.name}_{model.digest}_{degree}")
    def output_of(start, u):
        W = np.zeros(size)
        copy(W, 0, start, n)
        for c in range(inputs):
            feed(W, 0, c, u[c], u[c], u[c])
        sense(W)
        return W[shown]

    return run, output_of
