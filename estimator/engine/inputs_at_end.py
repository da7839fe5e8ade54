"""The inputs at the time of the outputs, in symbols."""

from __future__ import annotations

import sympy as sp

from estimator.engine.storage_layout import input_row
from estimator.engine.symbolic import check_input_is_continuous, symbol
from estimator.models.model import Model


def inputs_at_end(model: Model, degree: int) -> dict[sp.Symbol, sp.Expr]:
    """Each symbol of an input to its value at the end of a sample: a tap, or the value or slope of the polynomial."""
    if not model.is_continuous:
        return {symbol(written): symbol(input_row(*tap)) for written, tap in model.input_ages.items()}
    check_input_is_continuous(model, degree)
    return {
        symbol(written): sum((k**order * symbol(input_row(i, k)) for k in range(degree + 1)), sp.S.Zero)
        for written, (i, order) in model.acting_inputs.items()
    }
