"""Maps between the coefficients of a model and physical parameters, with Jacobians, compiled from its expressions."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np

from estimator.models.expression import GENERATED_FUNCTIONS
from estimator.models.model import Model
from estimator.rigs.units import VOLT_SCALES, Scales
from estimator.support.argument_checks import check_mapping, to_float_array
from estimator.support.array_types import FloatArray

#: Error of a parameter after a round trip through the coefficients, relative to its terms, at most.
_ROUND_TRIP_TOLERANCE = 1e-6


def to_physical(model: Model, coefficients: FloatArray, scales: Scales = VOLT_SCALES) -> FloatArray:
    """Physical parameters (..., p) of coefficients (..., K); the coefficients themselves, for a model without any.

    Args:
        model: the model, with `Model.physical`.
        coefficients: (..., K) scaled coefficients.
        scales: physical values of the scaled units.
    """
    points = to_float_array("coefficients", coefficients)
    if points.shape[-1:] != (Model.require_model(model).n_coefficients,):
        raise ValueError(f"coefficients must be of {list(model.coefficients)}, but have shape {points.shape}")
    if not model.physical:
        return points
    return _evaluate(_compiled_map(model, "physical")[0], points, scales.step) * _physical_scales(model, scales)


def physical_jacobian(model: Model, coefficients: FloatArray, scales: Scales = VOLT_SCALES) -> FloatArray:
    """Jacobian (..., p, K) of the physical parameters by the coefficients; arguments as `to_physical`."""
    k = model.n_coefficients
    if not model.physical:
        return np.broadcast_to(np.eye(k), (*np.shape(coefficients), k)).copy()
    flat = _evaluate(_compiled_map(model, "physical")[1], coefficients, scales.step)
    return flat.reshape(*flat.shape[:-1], len(model.physical), k) * _physical_scales(model, scales)[:, None]


def propagate_to_physical(
    model: Model, mean: FloatArray, cov: FloatArray, scales: Scales = VOLT_SCALES
) -> tuple[FloatArray, FloatArray]:
    """Moments (..., p) and (..., p, p) of the physical parameters from moments of the coefficients, to first order."""
    slopes = physical_jacobian(model, mean, scales)
    return to_physical(model, mean, scales), slopes @ cov @ np.swapaxes(slopes, -1, -2)


def coefficients_of(model: Model, parameters: Mapping[str, Any], scales: Scales = VOLT_SCALES) -> FloatArray:
    """Coefficients (..., K) of physical parameters of shape (...), by name; themselves, for a model without any.

    Args:
        model: the model, with `Model.inverse`.
        parameters: name to value, such as `estimator.Parameters`; further names are ignored.
        scales: physical values of the scaled units.

    Raises:
        ValueError: for a missing parameter; or where the model's two maps contradict each other at the first of the
            parameters.
    """
    names = list(model.physical if Model.require_model(model).inverse else model.coefficients)
    check_mapping("parameters", parameters)
    missing = [name for name in names if name not in parameters]
    if missing:
        raise ValueError(f"parameters must have {names}, but {missing} are missing from {list(parameters)}; add them")
    columns = [to_float_array(f"parameters[{name!r}]", parameters[name]) for name in names]
    points = np.stack(np.broadcast_arrays(*columns), axis=-1)
    if not model.inverse:
        return points
    inside = points / _physical_scales(model, scales)
    found = _evaluate(_compiled_map(model, "inverse")[0], inside, scales.step)
    if found.size:
        first = inside.reshape(-1, len(names))[0], found.reshape(-1, model.n_coefficients)[0]
        _check_inverse(model, *first, scales.step)
    return found


def _check_inverse(model: Model, parameters: FloatArray, coefficients: FloatArray, step: float) -> None:
    """Refuse a model whose ``physical`` does not return the (p,) parameters that (K,) coefficients came from."""
    values, slopes = (_evaluate(function, coefficients, step) for function in _compiled_map(model, "physical"))
    # The rounding error of a parameter is relative to the terms of its sum.
    terms = np.abs(slopes.reshape(-1, len(coefficients))) @ np.abs(coefficients)
    for name, expected, recovered, size in zip(model.physical, parameters, values, terms, strict=True):
        if abs(recovered - expected) > _ROUND_TRIP_TOLERANCE * (abs(expected) + size):
            given = ", ".join(f"{c}={value:.6g}" for c, value in zip(model.coefficients, coefficients, strict=True))
            raise ValueError(
                f"inverse must undo physical, but the inverse of {model.name!r} turns {name}={expected:.6g} into "
                f"{given}, and physical turns these into {name}={recovered:.6g}, at a step of {step:g} s; mend one of "
                f"them"
            )


@cache
def _physical_scales(model: Model, scales: Scales) -> FloatArray:
    """(p,) factors from scaled to physical numbers of the parameters."""
    return np.array([scales.factor(dimension) for dimension in model.dimensions.values()])


def _evaluate(function: Any, points: FloatArray, step: float) -> FloatArray:
    """Results of a function, stacked along the last axis, for points (..., n) of its n arguments."""
    columns = np.moveaxis(np.asarray(points, dtype=np.float64), -1, 0)
    found = [np.broadcast_to(value, columns.shape[1:]) for value in function(*columns, step)]
    return np.stack(found, axis=-1).astype(np.float64)


@cache
def _compiled_map(model: Model, direction: str) -> tuple[Any, Any]:
    """Values and slopes of a map between coefficients and parameters, as functions of all of them and the step."""
    from estimator.engine.source_cache import load_generated

    mapped = getattr(model, direction)
    names = list(model.coefficients if direction == "physical" else model.physical)

    def make() -> str:
        from estimator.engine import printer_numba, symbolic
        from estimator.engine.expression_parser import parse_expression

        known = {name: symbolic.symbol(name) for name in (*names, "step")}
        expressions = [parse_expression(text, known, model) for text in mapped.values()]
        slopes = [e.diff(known[name]) for e in expressions for name in names]
        source = ""
        for title, values in (("values", expressions), ("slopes", slopes)):
            lines = symbolic.eliminate_common_subexpressions({f"V_{i}": e for i, e in enumerate(values)}, "CSE")
            body = "".join(f"    {name} = {printer_numba.print_array_expression(e)}\n" for name, e in lines)
            gathered = ", ".join(f"V_{i}" for i in range(len(values)))
            source += f"def {title}({', '.join([*names, 'step'])}):\n{body}    return ({gathered},)\n"
        return source

    functions = {name: getattr(np, {"atan": "arctan"}.get(name, name)) for name in (*GENERATED_FUNCTIONS, "where")}
    code = load_generated(model.name, direction, model.digest, make, functions)
    return code.values, code.slopes
