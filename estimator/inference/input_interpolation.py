"""Interpolation of recorded inputs: the taps of a sample, or the coefficients of its polynomial.

Both are linear in a window of the inputs: row j of `estimator.engine.storage_layout.input_rows` is the sum of
``stencil[j]`` times the window, which holds all inputs of a sample next to one another, sample after sample.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
import numpy.typing as npt

from estimator.engine.storage_layout import known_inputs, n_older_inputs
from estimator.models.interpolation import CAUSAL_INTERPOLATION_DEGREES, INTERPOLATION_DEGREES
from estimator.models.model import Model
from estimator.rigs.rig import Rig
from estimator.support.array_types import FloatArray

#: Window of the look-ahead interpolation [inputs]: the last nine and the next.
_LOOK_AHEAD_WINDOW = 10

#: Degree of the spline, for inputs with power up to two thirds of the Nyquist frequency.
_SPLINE_DEGREE = INTERPOLATION_DEGREES["spline"]


@dataclass(frozen=True, eq=False)
class InputStencil:
    """Weights of a window of inputs in the input of a sample.

    Attributes:
        stencil: (rows, window * inputs) weights of the inputs in the window: the oldest sample first, and of each
            sample the inputs in the model's order.
        n_inputs: number of inputs of the model.
        n_past: number of stored samples of the inputs before the newest.
        lookahead: whether a sample waits for the next input.
        repeats_first: whether the input before the record is its first input, or 0.
        needs_whole_record: whether all inputs must be known; each sample has then the window of `spline_coefficients`.
        delay: delay of the rig [samples].
    """

    stencil: FloatArray
    n_inputs: int
    n_past: int
    lookahead: bool = False
    repeats_first: bool = False
    needs_whole_record: bool = False
    delay: int = 0

    @property
    def stride(self) -> int:
        """Distance between the windows of two samples [numbers]."""
        return len(self.stencil) if self.needs_whole_record else self.n_inputs

    @property
    def n_stored(self) -> int:
        """Number of all stored inputs before the newest sample."""
        return self.n_past * self.n_inputs

    def spline_coefficients(self, u: FloatArray) -> FloatArray:
        """(T, ..., 6) coefficients of the quintic splines through all inputs (T, ...), over each sample.

        Raises:
            ValueError: for too few inputs.
        """
        from scipy.interpolate import make_interp_spline

        if len(u) <= _SPLINE_DEGREE:
            raise ValueError(
                f"u must have more than {_SPLINE_DEGREE} samples for interpolation 'spline', but has {len(u)}"
            )
        spline = make_interp_spline(np.arange(len(u)), u, k=_SPLINE_DEGREE)
        begins = np.arange(len(u)) - 1.0 - self.delay
        pieces = np.stack(
            [spline(np.maximum(begins, 0), nu=n) / math.factorial(n) for n in range(_SPLINE_DEGREE + 1)], axis=-1
        )
        pieces[begins < 0] = 0.0
        pieces[begins < 0, ..., 0] = u[0]
        return pieces


def input_stencil(model: Model, rig: Rig) -> InputStencil:
    """Weights of the inputs in a sample of a model on a rig. Without inputs no sample waits for a later one.

    Raises:
        ValueError: for a fractional delay or a lag, which only `identify` supports.
    """
    delay, count = rig.integer_delay, model.n_inputs
    if not count:
        return InputStencil(np.zeros((0, 0)), 0, 0)
    if rig.interpolation in CAUSAL_INTERPOLATION_DEGREES or not model.is_continuous:
        first_effect = int(model.is_continuous and rig.interpolation == "zero_order")
        return _lagged_stencil(_causal_stencil(model, rig_input_degree(model, rig)), count, delay + first_effect)
    if rig.interpolation == "look_ahead":
        return _lagged_stencil(_look_ahead_stencil(count), count, delay - 1, repeats_first=True)
    rows = np.eye((_SPLINE_DEGREE + 1) * count)
    return InputStencil(rows, count, 0, repeats_first=True, needs_whole_record=True, delay=delay)


def _causal_stencil(model: Model, degree: int) -> FloatArray:
    """(rows, window * inputs) weights of the values that `known_inputs` has, oldest sample first."""
    rows = known_inputs(model, degree)
    window = 1 + max(n_older_inputs(model, degree).values(), default=0)
    stencil = np.zeros((len(rows), window, model.n_inputs))
    for i, row in enumerate(rows):
        stencil[i, window - 1 - row.age, row.channel] = 1.0
        if row.subtracted_age is not None:
            stencil[i, window - 1 - row.subtracted_age, row.channel] = -1.0
    return stencil.reshape(len(rows), -1)


def record_lengths(series: FloatArray) -> npt.NDArray[np.int64]:
    """(n,) number of samples of each series (n, T, channels) before its first NaN in any channel."""
    return (~np.logical_or.accumulate(np.isnan(series).any(axis=2), axis=1)).sum(axis=1)


def rig_input_degree(model: Model, rig: Rig) -> int:
    """Degree of the input's polynomial over a sample; 0 for a difference equation, or without inputs."""
    return INTERPOLATION_DEGREES[rig.interpolation] if model.is_continuous and model.inputs else 0


def _lagged_stencil(stencil: FloatArray, n_inputs: int, lag: int, repeats_first: bool = False) -> InputStencil:
    """A stencil whose newest input for y[k] is u[k - lag]."""
    window = stencil.shape[1] // n_inputs
    return InputStencil(np.ascontiguousarray(stencil), n_inputs, window - 1 + max(lag, 0), lag < 0, repeats_first)


@cache
def _look_ahead_stencil(n_inputs: int) -> FloatArray:
    """(6 * inputs, window * inputs) weights of a window in the polynomials of its last interval but one."""
    from scipy.interpolate import make_interp_spline

    spline = make_interp_spline(np.arange(_LOOK_AHEAD_WINDOW), np.eye(_LOOK_AHEAD_WINDOW), k=_SPLINE_DEGREE)
    of_one = np.stack([spline(_LOOK_AHEAD_WINDOW - 3, nu=n) / math.factorial(n) for n in range(_SPLINE_DEGREE + 1)])
    of_all = np.einsum("kw,ij->ikwj", of_one, np.eye(n_inputs))
    return of_all.reshape((_SPLINE_DEGREE + 1) * n_inputs, -1)
