"""Compiled filters of a model: the belief update, and the linearised Kalman filter at known coefficients.

Each comes with the layout of its block ``W`` (`estimator.compilation.simd`), to which callers may append rows.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from estimator.compilation import elementary_functions
from estimator.compilation.scalar_jit import scalar_jit
from estimator.compilation.simd import LANES, number_rows
from estimator.engine.source_cache import load_generated
from estimator.engine.storage_layout import (
    cubature_order,
    cubature_rows,
    integrator_rows,
    is_packed,
    linearised_filter_layout,
    packed_rows,
    trace_rows,
    update_layout,
)
from estimator.models.expression import GENERATED_FUNCTIONS
from estimator.models.model import Model
from estimator.support.argument_checks import check_choice, check_integer
from estimator.support.update_options import EXPECTATIONS, MAX_ITERATIONS


@scalar_jit
def sqrt(value):
    """Square root."""
    return np.sqrt(value)


#: Functions that generated code may call.
RUNTIME_FUNCTIONS = {"sqrt": sqrt} | {
    name: getattr(elementary_functions, name) for name in GENERATED_FUNCTIONS if name != "sqrt"
}


@dataclass(frozen=True)
class BeliefUpdate:
    """The belief update of a model.

    Attributes:
        update: ``update(W)``: updates the belief of every lane by its rows ``U_<input>_<k>`` and ``Y_<sensor>``.
        layout: row number of each quantity.
        count_unsound: with sigma points, ``count_unsound(W)`` increments the row ``INDEFINITE_COUNT`` of lanes
            whose covariance is not positive semi-definite; ``update`` does so at its start.
    """

    update: Any
    layout: Mapping[str, int]
    count_unsound: Any = None


def compile_belief_update(
    model: Model,
    degree: int = 0,
    *,
    iterations: int = 3,
    lanes: int = LANES,
    block_layout: Mapping[str, int] | None = None,
    keep_trace: bool = False,
    may_be_missing: bool = False,
    expectations: str = "first_order",
) -> BeliefUpdate:
    """Compile the structured update: q(states, coefficients) Gaussian, q(γ) and q(ξ) Gamma.

    Args:
        model: the equation.
        degree: degree of the input's polynomial over a sample of a differential equation: 0 held, 1 linear, 5 a spline.
        iterations: variational iterations per sample, 1 to 100.
        lanes: lanes of a block.
        block_layout: a layout with the rows of `update_layout` and perhaps more; None for `update_layout`.
        keep_trace: write the terms of every iteration's free energy into further rows.
        may_be_missing: outputs that are NaN are missing: the state is predicted, and nothing is updated.
        expectations: how the belief is propagated: ``first_order`` or ``sigma_points`` (`estimator.engine.cubature`).
            The latter counts indefinite covariances in the row ``INDEFINITE_COUNT``.

    Raises:
        ValueError: for iterations out of range, or other expectations.
    """
    frozen = None if block_layout is None else tuple(block_layout.items())
    return _compile_belief_update(model, degree, iterations, lanes, frozen, keep_trace, may_be_missing, expectations)


@cache
def _compile_belief_update(
    model: Model,
    degree: int,
    iterations: int,
    lanes: int,
    block_layout: Any,
    keep_trace: bool,
    may_be_missing: bool,
    expectations: str,
) -> BeliefUpdate:
    check_integer("iterations", iterations, MAX_ITERATIONS)
    check_choice("expectations", expectations, EXPECTATIONS)
    uses_cubature = expectations == "sigma_points"
    layout = dict(block_layout) if block_layout is not None else update_layout(model, degree)
    more_rows = [
        *(trace_rows(model, iterations) if keep_trace else ()),
        *(cubature_rows(model) if uses_cubature else ()),
    ]
    layout |= number_rows(*(row for row in more_rows if row not in layout), first_row=max(layout.values()) + 1)

    def make() -> str:
        from estimator.engine import gaussian_update, printer_numba, symbolic, variational_rk4
        from estimator.engine.cubature import point_moments

        lines, propagation = point_moments(model) if uses_cubature else symbolic.propagate_sample(model)
        more, results = gaussian_update.belief_update(
            model, propagation, degree, iterations, keep_trace, may_be_missing
        )
        # Every layer of functions takes time to compile, so the update of a difference equation is one function.
        whole = not (uses_cubature or model.is_continuous)
        name = "update" if whole else "finish"
        finish = printer_numba.print_lane_loop(name, lines + more, results, layout, lanes, doc="Predict and condition.")
        if whole:
            return finish
        if uses_cubature:
            return finish + _cubature_source(model, degree, layout, lanes)
        motion = variational_rk4.print_integrator(model, degree, layout, lanes)
        return motion + finish + printer_numba.print_sample("update(W)", model, "finish(W)")

    key = repr(
        (model.digest, degree, iterations, lanes, sorted(layout.items()), keep_trace, may_be_missing, expectations)
    )
    code = load_generated(model.name, "update", key, make, RUNTIME_FUNCTIONS)
    return BeliefUpdate(code.update, layout, code.cubature_columns if uses_cubature else None)


def _cubature_source(model: Model, degree: int, layout: Mapping[str, int], lanes: int) -> str:
    """Source of ``cubature_columns(W)``, and of ``update(W)`` with all sigma points."""
    from estimator.engine import cubature, printer_numba, symbolic, variational_rk4

    names = cubature_order(model)
    point_layout: dict[str, int | str] = dict(layout)
    point_layout |= {f"L_C_{i}": f"{layout[f'L_0_{names[0]}']} + C*{len(names)} + {k}" for k, i in enumerate(names)}
    first = layout[f"IMAGE_0_{next(iter(model.states))}"]
    point_layout |= {f"IMAGE_P_{i}": f"{first} + P*{model.n_states} + {k}" for k, i in enumerate(model.states)}

    def loop(name: str, lines: Any, results: Any, uniform: tuple[str, ...], doc: str) -> str:
        return printer_numba.print_lane_loop(name, lines, results, point_layout, lanes, uniform, doc)

    source = loop(
        "cubature_columns",
        *cubature.cubature_columns(model),
        (),
        "Columns of the covariance's factor, and their weights.",
    )
    if not model.is_continuous:
        sample = cubature.propagate_point_difference(model)
        source += loop("propagate_point", *sample, ("C", "SIGN", "P"), "One point over the sample.")
        return source + _loop_over_points(model, "", "        propagate_point(W, P // 2, 1.0 - 2.0 * (P % 2), P)\n")
    noise = [name for name in integrator_rows(model) if not name.startswith("F_")]
    start = {
        i: printer_numba.print_expression(value) for i, value in symbolic.integrator_start(model).items() if i in noise
    }
    source += loop("begin", [], start, (), "The mean, and its process noise.")
    step = variational_rk4.variational_rk4_step(model, degree)
    source += loop(
        "step_mean_and_noise", step, {i: f"{i}_END" for i in noise}, ("TAU",), "One Runge-Kutta step of mean and noise."
    )
    source += loop("place_point", *cubature.place_point(model), ("C", "SIGN"), "A point at the start of the sample.")
    step, moved = cubature.propagate_point(model, degree), {f"M_{i}": f"M_{i}_END" for i in model.states}
    source += loop("move", step, moved, ("TAU",), "One Runge-Kutta step of a point.")
    source += loop("keep_image", [], {f"IMAGE_P_{i}": f"M_{i}" for i in model.states}, ("P",), "A point at the end.")
    n = model.substeps
    noise_loop = f"    begin(W)\n    for s in range({n}):\n        step_mean_and_noise(W, s / {n})\n"
    body = "        place_point(W, P // 2, 1.0 - 2.0 * (P % 2))\n"
    body += f"        for s in range({n}):\n            move(W, s / {n})\n        keep_image(W, P)\n"
    return source + _loop_over_points(model, noise_loop, body)


def _loop_over_points(model: Model, before: str, body: str) -> str:
    """Source of ``update(W)`` with a loop over all sigma points."""
    n_points = 2 * len(model.dynamic_names)
    head = f"@scalar_jit\ndef update(W):\n    cubature_columns(W)\n{before}    for P in range({n_points}):\n"
    return head + body + "    finish(W)\n"


@dataclass(frozen=True)
class LinearisedFilter:
    """The linearised Kalman filter at known coefficients, with likelihood and Fisher information.

    Attributes:
        sample: ``sample(W, STEPS)``: one sample of every lane, in that many Runge-Kutta steps where it is continuous.
        layout: row number of each quantity: the coefficients, the input, outputs, ``IS_COUNTED``, the noise
            variances ``PROCESS_VARIANCE`` and ``R_<sensor>``, the filter's state and its totals.
        lanes: lanes of the block.
    """

    sample: Any
    layout: Mapping[str, int]
    lanes: int


@cache
def compile_linearised_filter(
    model: Model,
    degree: int = 0,
    *,
    follows_outputs: bool,
    lanes: int = LANES,
    variable_step: bool = False,
    noise_ratios: bool = False,
) -> LinearisedFilter:
    """Compile the linearised filter of a model (`estimator.engine.linearised_filter.linearised_filter_step`).

    Args:
        model: the equation.
        degree: degree of the input's polynomial over a sample.
        follows_outputs: whether the filter is updated by outputs, or follows the noise-free response.
        lanes: lanes of a block.
        variable_step: whether each sample of a differential equation has its own length, in the row ``SAMPLE_LENGTH``.
        noise_ratios: whether the rows `estimator.engine.storage_layout.noise_ratio_rows` scale the variances of
            independent noises.
    """
    layout = linearised_filter_layout(model, degree, follows_outputs, variable_step, noise_ratios)
    packed = is_packed(model)
    if packed:
        layout |= number_rows(*packed_rows(model), first_row=len(layout))

    def make() -> str:
        from estimator.engine import printer_numba, symbolic, variational_rk4
        from estimator.engine.linearised_filter import linearised_filter_step

        if packed:
            from estimator.engine.packed_filter import print_packed_filter

            return print_packed_filter(model, degree, follows_outputs, layout, lanes, variable_step, noise_ratios)

        lines, propagation = symbolic.propagate_sample(model, noise_ratios)
        more, results = linearised_filter_step(model, propagation, degree, follows_outputs)
        span = symbolic.symbol("SAMPLE_LENGTH") if variable_step else symbolic.ONE
        step = symbolic.symbol("STEP")
        source = variational_rk4.print_integrator(model, degree, layout, lanes, None, span, noise_ratios, step)
        source += printer_numba.print_lane_loop(
            "finish", lines + more, results, layout, lanes, doc="Predict, and add likelihood and information."
        )
        return source + printer_numba.print_sample("sample(W, STEPS)", model, "finish(W)", steps="STEPS")

    key = (replace(model, substeps=1).digest, degree, follows_outputs, lanes, variable_step, noise_ratios)
    key_text = repr((*key, *(["packed"] * packed)))
    return LinearisedFilter(load_generated(model.name, "path", key_text, make, RUNTIME_FUNCTIONS).sample, layout, lanes)
