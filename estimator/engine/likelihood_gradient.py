"""The exact gradient of the linearised filter's likelihood by the adjoint method, in SIMD lanes.

The gradient of `estimator.engine.linearised_filter` holds covariances and gains fixed. This one is the derivative of
the whole arithmetic, with dS and dK, by the reverse of each Runge-Kutta step and each update. Its cost does not depend
on the number of coefficients. A sample's Runge-Kutta steps are computed again on the way back.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

from estimator.compilation.simd import number_rows
from estimator.engine.information_gradient import with_reverse
from estimator.engine.kernels import RUNTIME_FUNCTIONS
from estimator.engine.source_cache import load_generated
from estimator.engine.storage_layout import (
    input_rows,
    integrator_rows,
    noise_ratio_rows,
    upper_triangle_names,
)
from estimator.models.model import Model


@dataclass(frozen=True)
class LikelihoodAdjoint:
    """Compiled functions of a block ``W``, whose rows ``ADJ_<row>`` hold the adjoints of others.

    Attributes:
        forward: ``forward(W, STEPS)``: one sample of every lane, in that many Runge-Kutta steps.
        backward: ``backward(W, STEPS, tape)``: the reverse of a sample that begins as ``W`` does. It reads the adjoints
            of ``LOSS`` and ``NIS``, replaces the adjoints of states and covariance after the sample by those before it,
            and adds to the adjoints of the coefficients.
        layout: row number of each quantity; states and covariance come first, and their adjoints are neighbours too.
        n_filter_state: rows of states and covariance.
        n_integrated: rows of the integrator, which ``tape`` (STEPS + 1, n_integrated · lanes) stores.
    """

    forward: Any
    backward: Any
    layout: Mapping[str, int]
    n_filter_state: int
    n_integrated: int


@cache
def compile_likelihood_adjoint(
    model: Model, degree: int, lanes: int, variable_step: bool = False, noise_ratios: bool = False
) -> LikelihoodAdjoint:
    """Compile the adjoint of a model; the arguments are as for `estimator.engine.kernels.compile_linearised_filter`."""
    state = [*model.states, *upper_triangle_names("P", model.states)]
    sensed = {f"F_{i}_{c}" for i in model.states for c in model.coefficients}
    integrated = [row for row in integrator_rows(model) if row not in sensed]
    layout = number_rows(
        *state,
        "LOSS",
        "NIS",
        *model.coefficients,
        *input_rows(model, degree),
        *(f"Y_{y}" for y in model.outputs),
        "IS_COUNTED",
        "PROCESS_VARIANCE",
        *(f"R_{y}" for y in model.outputs),
        *(noise_ratio_rows(model) if noise_ratios else ()),
        *(["SAMPLE_LENGTH"] if variable_step else ()),
        *integrated,
    )
    # In one array with the rest: the compiler does not vectorise loops over two.
    with_adjoints = [*state, *model.coefficients, "LOSS", "NIS", *integrated]
    layout |= number_rows(*(f"ADJ_{row}" for row in with_adjoints), first_row=len(layout))
    key = repr((replace(model, substeps=1).digest, degree, lanes, variable_step, noise_ratios))
    code = load_generated(
        model.name,
        "likelihood-gradient",
        key,
        lambda: _source(model, degree, lanes, layout, state, integrated),
        RUNTIME_FUNCTIONS,
    )
    return LikelihoodAdjoint(code.forward, code.backward, layout, len(state), len(integrated))


def _source(
    model: Model, degree: int, lanes: int, layout: Mapping[str, int], state: list[str], integrated: list[str]
) -> str:
    from estimator.engine import printer_numba, symbolic, variational_rk4
    from estimator.engine.linearised_filter import linearised_filter_step

    has_ratios = any(row in layout for row in noise_ratio_rows(model))
    coefficients = list(model.coefficients)
    lines, propagation = symbolic.propagate_sample(model, has_ratios)
    more, results = linearised_filter_step(model, propagation, degree, follows_outputs=True)
    lines = [*lines, *more]
    moved = {row: results[row] for row in state}
    source = printer_numba.print_lane_loop("finish", lines, moved, layout, lanes, doc="Predict and condition.")
    followed = moved | {row: results[row] for row in ("LOSS", "NIS")}
    back, adjoints = with_reverse(lines, followed, [*state, *integrated, *coefficients], coefficients)
    source += printer_numba.print_lane_loop("finish_back", back, adjoints, layout, lanes, doc="The reverse of finish.")
    if model.is_continuous:
        length = symbolic.symbol("SAMPLE_LENGTH") if "SAMPLE_LENGTH" in layout else symbolic.ONE
        step = variational_rk4.variational_rk4_step(model, degree, length, has_ratios, symbolic.symbol("STEP"))
        ends = {row: f"{row}_END" for row in integrated}
        uniform = ("TAU", "STEP")
        source += printer_numba.print_lane_loop("move", step, ends, layout, lanes, uniform, "One Runge-Kutta step.")
        back, adjoints = with_reverse(step, ends, [*integrated, *coefficients], coefficients)
        source += printer_numba.print_lane_loop(
            "move_back", back, adjoints, layout, lanes, uniform, "The reverse of a Runge-Kutta step."
        )
        start = symbolic.integrator_start(model)
        begun = {row: printer_numba.print_expression(start[row]) for row in integrated}
        source += printer_numba.print_lane_loop("begin", [], begun, layout, lanes, doc="The start of a sample.")
        started = {f"ADJ_{i}": f"ADJ_M_{i}" for i in model.states}
        source += printer_numba.print_lane_loop("begin_back", [], started, layout, lanes, doc="The reverse of begin.")
    source += printer_numba.print_sample("forward(W, STEPS)", model, "finish(W)", steps="STEPS")
    return source + _backward_source(layout[integrated[0]] * lanes if integrated else 0, len(integrated) * lanes)


def _backward_source(first: int, count: int) -> str:
    """Source of ``backward``, with the integrator's numbers from ``first`` on; none for a difference equation."""
    if not count:
        return "@jit\ndef backward(W, STEPS, tape):\n    finish_back(W)\n"
    return (
        "@jit\ndef backward(W, STEPS, tape):\n    begin(W)\n"
        f"    for s in range(STEPS):\n        for i in range({count}):\n            tape[s, i] = W[{first} + i]\n"
        "        move(W, s / STEPS, 1.0 / STEPS)\n"
        "    finish_back(W)\n"
        f"    for s in range(STEPS - 1, -1, -1):\n        for i in range({count}):\n"
        f"            W[{first} + i] = tape[s, i]\n"
        "        move_back(W, s / STEPS, 1.0 / STEPS)\n    begin_back(W)\n"
    )
