"""The compiled update of the members of a noise grid about one common linearisation.

`estimator.engine.shared_linearisation` has the mathematics. Two blocks take part (`estimator.compilation.simd`): ``C``
holds the linearisation, and ``U`` a member in each lane. A member reads the lane of ``C`` that has its own number.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

from estimator.compilation.elementary_functions import gamma_half_ratio, log, log1p
from estimator.compilation.simd import LANES, number_rows
from estimator.engine import source_cache
from estimator.engine.kernels import RUNTIME_FUNCTIONS
from estimator.engine.storage_layout import belief_rows, input_rows, integrator_rows, upper_triangle_names
from estimator.models.model import Model


@dataclass(frozen=True)
class SharedUpdate:
    """Compiled functions, and the layouts of their blocks.

    Attributes:
        linearise: ``linearise(C)``: propagates the mean in every lane of C, with its Jacobian and process noise.
        update: ``update(U, C)``: predicts every member, conditions it on the outputs, and writes its free energies.
        layout: rows of U: the belief, ``WEIGHT`` and ``FREE_ENERGY_<iteration>``; with ``every_iteration`` also the
            forecast, ``MEAN_<sensor>`` and ``VARIANCE_<sensor>``.
        shared_layout: rows of C. Given are the mean of states and coefficients, the inputs, ``Y_<sensor>`` and the
            shapes of the precisions; ``linearise`` writes the others.
    """

    linearise: Any
    update: Any
    layout: Mapping[str, int]
    shared_layout: Mapping[str, int]


@cache
def compile_shared_update(
    model: Model, degree: int, iterations: int, *, may_be_missing: bool = False, every_iteration: bool = False
) -> SharedUpdate:
    """Compile the update for a model.

    Args:
        model: the equation.
        degree: degree of the input's polynomial over a sample.
        iterations: variational iterations per sample.
        may_be_missing: an output that is NaN is missing: the state is predicted, and nothing is updated.
        every_iteration: write the free energy of every iteration and the forecasts, not the last free energy alone.
    """
    reported = tuple(range(iterations)) if every_iteration else (iterations - 1,)
    forecasts = [f"{what}_{y}" for y in model.outputs for what in ("MEAN", "VARIANCE")] if every_iteration else []
    layout = number_rows(*belief_rows(model), "WEIGHT", *(f"FREE_ENERGY_{i}" for i in reported), *forecasts)
    shapes = ["GAMMA_SHAPE", *(f"XI_SHAPE_{y}" for y in model.outputs)]
    outputs = [f"Y_{y}" for y in model.outputs]
    shared_layout = number_rows(
        *model.names, *input_rows(model, degree), *outputs, *shapes, *_motion_rows(model), *_precision_rows(model)
    )

    def make() -> str:
        from estimator.engine import printer_numba, shared_linearisation, variational_rk4
        from estimator.engine.gaussian_update import belief_update

        lines, results, propagation = shared_linearisation.shared_propagation(model)
        source = variational_rk4.print_integrator(model, degree, shared_layout, LANES)
        source += printer_numba.print_lane_loop(
            "finish", lines, results, shared_layout, LANES, doc="Jacobian and noise at the end of the sample."
        )
        source += printer_numba.print_sample("propagate(W)", model, "finish(W)")
        source += _precision_terms_source(model, shared_layout)
        source += "@scalar_jit\ndef linearise(W):\n    propagate(W)\n    set_precision_terms(W)\n"
        lines, propagation = shared_linearisation.member_propagation(model, propagation)
        more, results = belief_update(
            model, propagation, degree, iterations, every_iteration, may_be_missing, free_energies=reported
        )
        if every_iteration:
            more, results = shared_linearisation.with_forecasts(model, iterations, more, results)
        shared_rows = {f"MIXTURE_{name}" if name in model.names else name: row for name, row in shared_layout.items()}
        shared_rows = {name: row for name, row in shared_rows.items() if name not in layout}
        doc = "Predict every member about the shared linearisation, and condition it."
        return source + printer_numba.print_lane_loop(
            "update", lines + more, results, {**layout, **shared_rows}, LANES, doc=doc, shared_rows=shared_rows
        )

    key = repr((model.digest, degree, iterations, may_be_missing, every_iteration))
    names = {**RUNTIME_FUNCTIONS, "NAN": float("nan"), "log": log, "log1p": log1p, "gamma_half_ratio": gamma_half_ratio}
    code = source_cache.load_generated(model.name, "shared-update", key, make, names)
    return SharedUpdate(code.linearise, code.update, layout, shared_layout)


def _motion_rows(model: Model) -> list[str]:
    """Rows of the propagated mean, its Jacobian and process noise, for a difference equation too."""
    if model.is_continuous:
        return integrator_rows(model)
    names = [f"M_{i}" for i in model.states] + [f"F_{i}_{j}" for i in model.states for j in model.dynamic_names]
    return names + upper_triangle_names("Q", model.states)


def _precision_rows(model: Model) -> list[str]:
    """Rows of the terms that depend on a precision's shape alone: r and t of `gamma_half_ratio`."""
    return [f"{what}_{noise}" for noise in ("GAMMA", *(f"XI_{y}" for y in model.outputs)) for what in ("RATIO", "TERM")]


def _precision_terms_source(model: Model, layout: Mapping[str, int]) -> str:
    """Source of ``set_precision_terms(W)``: the terms of the precisions' shapes, once for all members."""
    at = lambda row: f"W[{layout[row] * LANES} + LANE]"  # noqa: E731
    lines = [f"    for LANE in range({LANES}):"]
    for noise, shape in (("GAMMA", "GAMMA_SHAPE"), *((f"XI_{y}", f"XI_SHAPE_{y}") for y in model.outputs)):
        lines.append(f"        {at(f'RATIO_{noise}')}, {at(f'TERM_{noise}')} = gamma_half_ratio({at(shape)})")
    return "\n".join(["@scalar_jit", "def set_precision_terms(W):", *lines]) + "\n"
