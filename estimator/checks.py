"""Checks of what a caller passes in: an error names the argument, the value and the remedy."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from estimator.parameters import FloatArray


def scalar(name: str, value: npt.ArrayLike) -> float:
    """One number."""
    number = _numbers(name, value)
    if number.size != 1:
        raise ValueError(f"{name} must be one number, but has shape {number.shape}; use run() for many samples")
    return float(number.reshape(()))


def series(name: str, values: npt.ArrayLike, missing: bool = False) -> FloatArray:
    """A finite series (T,), copied; with ``missing`` it may hold NaN."""
    checked = _numbers(name, values)
    if checked.ndim != 1:
        raise ValueError(f"{name} must have shape (T,), but has {checked.shape}; pass one channel, e.g. {name}.ravel()")
    finite = np.isfinite(checked) | (missing & np.isnan(checked))
    if not finite.all():
        bad = int(np.argmin(finite))
        raise ValueError(
            f"{name} must be finite, but {name}[{bad}] is {checked[bad]}; remove or interpolate the sample"
        )
    return checked


def _numbers(name: str, values: npt.ArrayLike) -> FloatArray:
    """A float64 copy: writeable, because read-only arrays are another type to Numba, and would compile kernels anew."""
    if isinstance(values, np.ma.MaskedArray):
        raise ValueError(
            f"{name} must not be a masked array, whose hidden values would be used; pass {name}.filled(np.nan) to "
            f"run(..., missing=True)"
        )
    try:
        return np.array(values, dtype=np.float64, order="C")
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} must be numbers, but is {values!r:.60}; {error}") from error
