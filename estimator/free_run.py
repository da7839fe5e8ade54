"""Free runs: what a plant with given coefficients does with an input, without noise; and what its sensor shows."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from estimator.arrays import copy
from estimator.checks import numbers
from estimator.engine import cache as stored
from estimator.engine.feeding import feeder, input_degree
from estimator.engine.rows import input_rows
from estimator.engine.tasks import NAMES
from estimator.lanes import kernel, rows
from estimator.models.model import Model
from estimator.parameters import FloatArray


def free_run(
    model: Model,
    coefficients: npt.ArrayLike,
    u: npt.ArrayLike,
    state: npt.ArrayLike | None = None,
    interpolation: str = "zero_order",
) -> FloatArray:
    """What the first sensor shows over a series of inputs.

    Args:
        model: the equation.
        coefficients: (K,), time counted in samples.
        u: (T,) inputs; the t-th acts over the sample that ends with the t-th output. Before the first there was none.
        state: (n,) where it starts; at rest where it is None.
        interpolation: of the input between samples: ``zero_order``, or ``linear`` for a differential equation.

    Returns:
        (T,) outputs; inf or NaN from where the model blows up.

    Raises:
        ValueError: for shapes that do not fit, or what is no numbers.
    """
    c, inputs = numbers("coefficients", coefficients), numbers("u", u)
    start = np.zeros(model.n_states) if state is None else numbers("state", state)
    if c.shape != (model.n_coefficients,) or inputs.ndim != 1 or start.shape != (model.n_states,):
        raise ValueError(
            f"coefficients, u and state must have shapes {(model.n_coefficients,)}, (T,) and {(model.n_states,)}, but "
            f"have {c.shape}, {inputs.shape} and {start.shape}"
        )
    outputs = np.empty(len(inputs))
    run, _ = _compiled(model, input_degree(model, interpolation))
    run(np.concatenate([start, c]), inputs, outputs)
    return outputs


def shown_at(model: Model, coefficients: FloatArray, state: FloatArray, u: float) -> float:
    """What the first sensor shows at a state, under an input that has been on for a while.

    Args:
        model: the equation.
        coefficients: (K,), time counted in samples.
        state: (n,).
        u: the input, which an accelerometer feels at once.
    """
    _, look = _compiled(model, 0)
    return float(look(np.concatenate([state, coefficients]), float(u)))


@cache
def _compiled(model: Model, degree: int) -> tuple[Any, Any]:
    """``run(start, u, y)`` and ``look(start, u)`` of a model; ``start`` holds states and coefficients."""
    place = rows(*model.names, *input_rows(model, degree), "SHOWN")

    def make() -> str:
        from estimator.engine import derive, emit

        lines, results = derive.state_step(model, degree, {name: name for name in model.names})
        uniform = ("T",) if model.is_continuous else ()
        source = emit.lane_loop("move", lines, results, place, 1, uniform, doc="The state moves.")
        end = derive.input_at_end(model, degree)
        shown = derive.renamed([("", derive.calculus(model).outputs[0])], {"u": end})[0][1]
        return source + emit.lane_loop("sense", [("S", shown)], {"SHOWN": "S"}, place, 1, doc="The sensor.")

    code = stored.load(model.name, "free-run", repr((model.digest, degree)), make, NAMES)
    move, sense, size, steps, n = code.move, code.sense, len(place), model.substeps, len(model.names)
    shown, continuous = place["SHOWN"], model.is_continuous
    feed = feeder(model, degree, [place[row] for row in input_rows(model, degree)], 1)

    @kernel(kind=f"{model.name}_{model.digest}_{degree}")
    def run(start, u, y):
        W = np.zeros(size)
        copy(W, 0, start, n)
        for t in range(len(u)):
            feed(W, 0, u[t], u[t - 1] if t > 0 else 0.0, u[t - 2] if t > 1 else 0.0)
            if continuous:
                for s in range(steps):
                    move(W, s / steps)
            else:
                move(W)
            sense(W)
            y[t] = W[shown]

    @kernel(kind=f"{model.name}_{model.digest}_{degree}")
    def look(start, u):
        W = np.zeros(size)
        copy(W, 0, start, n)
        feed(W, 0, u, u, u)
        sense(W)
        return W[shown]

    return run, look
