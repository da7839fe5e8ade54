"""From recorded inputs to what a model takes over a sample: taps, or the coefficients of a polynomial.

All are linear in a window of the inputs: row ``U_j`` is the sum of ``stencil[j]`` times the window.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
import numpy.typing as npt

from estimator.models.interpolation import INTERPOLATION_DEGREES
from estimator.models.model import Model
from estimator.rigs.rig import Rig
from estimator.support.array_types import FloatArray

#: Inputs that the look-ahead interpolation passes through: the last nine, and the next.
_LOOK_AHEAD_WINDOW = 10

#: Of the spline through the inputs: they have power up to two thirds of the Nyquist frequency.
_SPLINE_DEGREE = INTERPOLATION_DEGREES["spline"]


@dataclass(frozen=True, eq=False)
class InputStencil:
    """How a window of inputs drives a sample.

    Attributes:
        stencil: (rows, window) of the inputs in the window, oldest first.
        n_past: inputs before the newest that must be kept.
        lookahead: whether a sample is used only when the next input is known.
        repeats_first: whether the input before the first is taken as the first; as 0 otherwise.
        needs_whole_record: whether all inputs must be known: then each sample has a window of its own, see `spline_coefficients`.
        delay: of the rig.
    """

    stencil: FloatArray
    n_past: int
    lookahead: bool = False
    repeats_first: bool = False
    needs_whole_record: bool = False
    delay: int = 0

    @property
    def stride(self) -> int:
        """From a sample's window to the next one's."""
        return len(self.stencil) if self.needs_whole_record else 1

    def spline_coefficients(self, u: FloatArray) -> FloatArray:
        """(T, 6) coefficients of the quintic spline through all inputs (T,), on the way to each sample.

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
            [spline(np.maximum(begins, 0), nu=n) / math.factorial(n) for n in range(_SPLINE_DEGREE + 1)], axis=1
        )
        pieces[begins < 0] = 0.0
        pieces[begins < 0, 0] = u[0]
        return pieces


def input_stencil(model: Model, rig: Rig) -> InputStencil:
    """The way of a model's input in a rig.

    Raises:
        ValueError: for a delay in parts of a sample, or a lag, which only `identify` follows.
    """
    delay = rig.integer_delay
    if not model.is_continuous:
        return _lagged_stencil(np.eye(model.taps)[::-1], delay)
    if rig.interpolation == "zero_order":
        return _lagged_stencil(np.ones((1, 1)), delay + 1)
    if rig.interpolation == "linear":
        return _lagged_stencil(np.array([[1.0, 0.0], [-1.0, 1.0]]), delay)
    if rig.interpolation == "look_ahead":
        return _lagged_stencil(_look_ahead_stencil(), delay - 1, repeats_first=True)
    return InputStencil(np.eye(_SPLINE_DEGREE + 1), 0, repeats_first=True, needs_whole_record=True, delay=delay)


def record_lengths(series: FloatArray) -> npt.NDArray[np.int64]:
    """Samples (n,) of each of some series (n, T), which may have none, before its first NaN."""
    return (~np.logical_or.accumulate(np.isnan(series), axis=1)).sum(axis=1)


def rig_input_degree(model: Model, rig: Rig) -> int:
    """Of the input's polynomial over a sample; 0 for a difference equation."""
    return INTERPOLATION_DEGREES[rig.interpolation] if model.is_continuous else 0


def _lagged_stencil(stencil: FloatArray, lag: int, repeats_first: bool = False) -> InputStencil:
    """A window whose newest input for y[k] is u[k - lag]."""
    lookahead = lag < 0
    return InputStencil(np.ascontiguousarray(stencil), stencil.shape[1] - 1 + max(lag, 0), lookahead, repeats_first)


@cache
def _look_ahead_stencil() -> FloatArray:
    """(6, _WINDOW) what each input of a window adds to the polynomial of its last interval but one."""
    from scipy.interpolate import make_interp_spline

    spline = make_interp_spline(np.arange(_LOOK_AHEAD_WINDOW), np.eye(_LOOK_AHEAD_WINDOW), k=_SPLINE_DEGREE)
    return np.stack([spline(_LOOK_AHEAD_WINDOW - 3, nu=n) / math.factorial(n) for n in range(_SPLINE_DEGREE + 1)])
