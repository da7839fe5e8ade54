"""How a path's block is filled: where its rows begin, and the input of a sample as the model takes it."""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

from estimator.engine.tasks import input_rows, path_layout
from estimator.lanes import part
from estimator.models.model import Model

#: Ways of the input between samples, and the degree of the polynomial that each takes.
INTERPOLATIONS = {"zero_order": 0, "linear": 1}


class Places(NamedTuple):
    """Numbers of a path's first rows, by what they hold, and how many there are.

    Attributes:
        n_path: rows of states, covariance and sensitivities, from 0 on; the states are the first.
        totals: minus the log likelihood, its slope, and the information's upper triangle.
        n_totals: of these.
        information: the upper triangle, row by row.
        coefficients: the model's.
        inputs: taps of a difference equation, or coefficients of the polynomial.
        shown: a row for each sensor: what it shows, or is to be followed.
        live: 0 where a series is over.
        spread: the first sensor's predictive variance; of no meaning where outputs are followed.
        carried: what a differential equation carries over a sample.
        n_carried: of these; they are the last.
        size: of the block.
    """

    n_path: int
    totals: int
    n_totals: int
    information: int
    coefficients: int
    inputs: int
    shown: int
    live: int
    spread: int
    carried: int
    n_carried: int
    size: int


@cache
def places(model: Model, degree: int, observed: bool) -> Places:
    """Where the rows of `estimator.engine.tasks.path` begin."""
    at = path_layout(model, degree, observed)
    first = next(iter(model.coefficients))
    sensor = next(iter(model.outputs))
    carried = at.get(f"M_{next(iter(model.states))}", len(at))
    return Places(
        n_path=at["LOSS"],
        totals=at["LOSS"],
        n_totals=at[first] - at["LOSS"],
        information=at[f"F_{first}_{first}"],
        coefficients=at[first],
        inputs=at["U_0"],
        shown=at[f"{'Y' if observed else 'SHOWN'}_{sensor}"],
        live=at["LIVE"],
        spread=at.get("SPREAD", -1),
        carried=carried,
        n_carried=len(at) - carried,
        size=len(at),
    )


def input_degree(model: Model, interpolation: str) -> int:
    """The degree of the input's polynomial over a sample.

    Raises:
        ValueError: for an unknown interpolation, or one that is not ``zero_order`` for a difference equation.
    """
    if interpolation not in INTERPOLATIONS:
        raise ValueError(f"interpolation must be one of {list(INTERPOLATIONS)}, but is {interpolation!r}")
    if not model.is_continuous and interpolation != "zero_order":
        raise ValueError(
            f"interpolation must be 'zero_order' for the difference equation {model.name!r}, whose inputs are samples, "
            f"but is {interpolation!r}"
        )
    return INTERPOLATIONS[interpolation]


def older_inputs(model: Model, degree: int) -> int:
    """Inputs before the newest one that a sample depends on."""
    return degree if model.is_continuous else model.taps - 1


@cache
def feeder(model: Model, degree: int, observed: bool, lanes: int) -> Any:
    """Compiled: ``feed(W, j, now, last, older)`` lays the inputs of a sample, newest first, into lane j of a path."""
    if degree > 1:
        raise ValueError(f"degree must be 0 or 1, but is {degree}; a spline's input is not known sample by sample")
    first, rows = places(model, degree, observed).inputs, len(input_rows(model, degree))
    is_line = model.is_continuous and degree == 1

    @part(f"{first}_{rows}_{is_line}_{lanes}")
    def feed(W, j, now, last, older):
        if is_line:
            W[first * lanes + j] = last
            W[(first + 1) * lanes + j] = now - last
        else:
            W[first * lanes + j] = now
            if rows > 1:
                W[(first + 1) * lanes + j] = last
            if rows > 2:
                W[(first + 2) * lanes + j] = older

    return feed
