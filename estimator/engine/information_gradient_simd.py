"""Gradient of the predicted Fisher information with respect to shared inputs, for many systems in SIMD lanes.

The arithmetic is the same as in `estimator.engine.information_gradient`. All lanes take the same inputs; each has its
own coefficients, noises and start.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

from estimator.compilation.simd import LANES
from estimator.engine.information_gradient import with_reverse
from estimator.engine.kernels import RUNTIME_FUNCTIONS
from estimator.engine.source_cache import load_generated
from estimator.engine.storage_layout import (
    input_rows,
    integrator_rows,
    linearised_filter_layout,
    linearised_filter_rows,
)
from estimator.models.model import Model


@dataclass(frozen=True)
class LaneAdjoint:
    """Compiled functions of blocks ``W`` and ``A`` of the same layout; ``A`` holds the adjoints of the rows of ``W``.

    A tape (T, n_tape) stores the start of every sample.

    Attributes:
        forward: ``forward(W, tape, t)``: sample t of every lane.
        backward: ``backward(W, A, tape, t)``: the reverse of sample t, with its input in ``W``. It reads from ``A`` the
            adjoints of the information and of the first sensor's mean, replaces the filter state's adjoints after the
            sample by the adjoints before it, and writes the adjoints of the input.
        layout: row number of each quantity, as in `estimator.engine.kernels.LinearisedFilter`.
        n_tape: numbers per sample on the tape.
    """

    forward: Any
    backward: Any
    layout: Mapping[str, int]
    n_tape: int


@cache
def compile_lane_adjoint(model: Model, degree: int = 0) -> LaneAdjoint:
    """Compile the adjoint in SIMD lanes; arguments as `estimator.engine.information_gradient.compile_adjoint`."""
    place = linearised_filter_layout(model, degree, follows_outputs=False)
    key = repr((model.digest, degree))
    code = load_generated(model.name, "gradient-lanes", key, lambda: _source(model, degree, place), RUNTIME_FUNCTIONS)
    return LaneAdjoint(code.forward, code.backward, place, code.n_tape)


def _source(model: Model, degree: int, layout: Mapping[str, int]) -> str:
    from estimator.engine import printer_numba, symbolic, variational_rk4
    from estimator.engine.linearised_filter import linearised_filter_step

    path_rows, integrated, inputs = linearised_filter_rows(model), integrator_rows(model), input_rows(model, degree)
    lines, propagation = symbolic.propagate_sample(model)
    more, results = linearised_filter_step(model, propagation, degree, follows_outputs=False)
    lines = [*lines, *more]
    shown = f"Y_PRED_{next(iter(model.outputs))}"
    source = printer_numba.print_lane_loop(
        "finish", lines, results, layout, LANES, doc="Predict, and add the information."
    )
    information_rows = [row for row in results if row.startswith("INFORMATION_")]
    followed = {row: results[row] for row in (*path_rows, *information_rows, shown) if row in results}
    wanted = [*path_rows, *integrated, *inputs]
    back, adjoints = with_reverse(lines, followed, wanted)
    source += printer_numba.print_lane_loop("finish_back", back, adjoints, layout, LANES, doc="The reverse derivative.")
    n, m, steps = len(path_rows), len(integrated), model.substeps
    if integrated:
        source += variational_rk4.print_integrator(model, degree, layout, LANES)
        step, ends = variational_rk4.variational_rk4_step(model, degree), {name: f"{name}_END" for name in integrated}
        back, adjoints = with_reverse(step, ends, [*integrated, *inputs], inputs)
        source += printer_numba.print_lane_loop(
            "move_back", back, adjoints, layout, LANES, ("TAU",), "The reverse of a Runge-Kutta step."
        )
        started = {f"ADJ_{i}": f"ADJ_M_{i}" for i in model.states}
        source += printer_numba.print_lane_loop("begin_back", [], started, layout, LANES, doc="The reverse of begin.")
    return source + _sample_source(n * LANES, m * LANES, layout[integrated[0]] * LANES if integrated else 0, steps)


def _sample_source(n_filter_state: int, n_integrated: int, first_integrated: int, steps: int) -> str:
    """Source of a whole sample, forward and backward.

    Args:
        n_filter_state: numbers of the filter's state in a block, from its start on.
        n_integrated: numbers of the integrator; 0 for a difference equation.
        first_integrated: place of the first of them.
        steps: Runge-Kutta steps per sample.
    """
    n, m, first = n_filter_state, n_integrated, first_integrated
    source = (
        f"n_tape = {n + (steps + 1) * m if m else n}\n"
        "@jit\ndef keep(W, first, tape, t, place, count):\n"
        "    for i in range(count):\n        tape[t, place + i] = W[first + i]\n"
        "@jit\ndef restore(W, first, tape, t, place, count):\n"
        "    for i in range(count):\n        W[first + i] = tape[t, place + i]\n"
    )
    if not m:
        return source + (
            f"@jit\ndef forward(W, tape, t):\n    keep(W, 0, tape, t, 0, {n})\n    finish(W)\n"
            f"@jit\ndef backward(W, A, tape, t):\n    restore(W, 0, tape, t, 0, {n})\n    finish_back(W, A)\n"
        )
    return source + (
        f"@jit\ndef forward(W, tape, t):\n    keep(W, 0, tape, t, 0, {n})\n    begin(W)\n"
        f"    for s in range({steps}):\n        keep(W, {first}, tape, t, {n} + {m} * s, {m})\n"
        f"        move(W, s / {steps})\n"
        f"    keep(W, {first}, tape, t, {n + m * steps}, {m})\n    finish(W)\n"
        f"@jit\ndef backward(W, A, tape, t):\n    restore(W, 0, tape, t, 0, {n})\n"
        f"    restore(W, {first}, tape, t, {n + m * steps}, {m})\n    finish_back(W, A)\n"
        f"    for s in range({steps - 1}, -1, -1):\n        restore(W, {first}, tape, t, {n} + {m} * s, {m})\n"
        f"        move_back(W, A, s / {steps})\n    begin_back(W, A)\n"
    )
