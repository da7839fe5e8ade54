"""The input over a sample: held, linear, or the taps of a difference equation, written into a block."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from estimator.compilation.simd import jit_closure
from estimator.models.interpolation import CAUSAL_INTERPOLATION_DEGREES
from estimator.models.model import Model
from estimator.support.argument_checks import check_choice


def input_degree(model: Model, interpolation: str) -> int:
    """Degree of the input's polynomial over a sample.

    Raises:
        ValueError: for an unknown interpolation, or one that is not ``zero_order`` for a difference equation.
    """
    check_choice("interpolation", interpolation, CAUSAL_INTERPOLATION_DEGREES)
    if not model.is_continuous and interpolation != "zero_order":
        raise ValueError(
            f"interpolation must be 'zero_order' for the difference equation {model.name!r}, whose inputs are samples, "
            f"but is {interpolation!r}"
        )
    return CAUSAL_INTERPOLATION_DEGREES[interpolation]


def n_older_inputs(model: Model, degree: int) -> int:
    """Number of inputs before the newest one in a sample's equation."""
    return degree if model.is_continuous else model.taps - 1


def compile_input_writer(model: Model, degree: int, input_rows: Sequence[int], lanes: int) -> Any:
    """Compile ``feed(W, j, now, last, older)``, which writes a sample's inputs, newest first, into lane j of a block.

    Args:
        model: the equation.
        degree: degree of the input's polynomial over a sample, 0 or 1.
        input_rows: row numbers of ``U_0``, ``U_1``, ...
        lanes: lanes of the block.

    Raises:
        ValueError: for another degree.
    """
    if degree > 1:
        raise ValueError(f"degree must be 0 or 1, but is {degree}; a spline needs the whole record")
    rows = [place * lanes for place in input_rows]
    first, second, third = [*rows, 0, 0][:3]
    count, is_line = len(rows), model.is_continuous and degree == 1

    @jit_closure("_".join(map(str, (*rows, is_line, lanes))))
    def feed(W, j, now, last, older):
        if is_line:
            W[first + j] = last
            W[second + j] = now - last
        else:
            W[first + j] = now
            if count > 1:
                W[second + j] = last
            if count > 2:
                W[third + j] = older

    return feed
