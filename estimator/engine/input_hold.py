"""The input over a sample: held, linear, or the taps of a difference equation, written into a block."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain
from typing import Any

from estimator.compilation.simd import jit_closure
from estimator.engine.storage_layout import known_inputs
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


def compile_input_writer(model: Model, degree: int, input_rows: Sequence[int], lanes: int) -> Any:
    """Compile ``feed(W, j, i, now, last, older)``, which writes the values of input i, newest first, into a block.

    Args:
        model: the equation.
        degree: degree of the input's polynomial over a sample, 0 or 1.
        input_rows: row numbers of `estimator.engine.storage_layout.input_rows`.
        lanes: lanes of the block.

    Raises:
        ValueError: for another degree.
    """
    rows = tuple(
        (row.channel, place * lanes, row.age, -1 if row.subtracted_age is None else row.subtracted_age)
        for row, place in zip(known_inputs(model, degree), input_rows, strict=True)
    )

    if not rows:  # Numba has no loop over an empty tuple

        @jit_closure("none")
        def feed_nothing(W, j, i, now, last, older):
            return None

        return feed_nothing

    @jit_closure("_".join(map(str, chain(*rows, (lanes,)))))
    def feed(W, j, i, now, last, older):
        values = (now, last, older)
        for channel, place, age, subtracted_age in rows:
            if channel == i:
                value = values[age]
                W[place + j] = value if subtracted_age < 0 else value - values[subtracted_age]

    return feed
