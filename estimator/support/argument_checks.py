"""Checks of arguments: an error names the argument, its value and the remedy."""

from __future__ import annotations

import difflib
import math
from collections.abc import Collection, Mapping

import numpy as np
import numpy.typing as npt

from estimator.support.array_types import FloatArray

#: Smallest size that an option may have: squares and products of two sizes do not underflow.
MIN_MAGNITUDE = 1e-12

#: Largest size that an option may have: squares and products of two sizes do not overflow.
MAX_MAGNITUDE = 1e12

#: Largest seed.
MAX_SEED = 2**128


def short_repr(value: object) -> str:
    """The text of any value for a message, of at most 80 characters."""
    try:
        return f"{value!r:.80}"
    except Exception:  # such as an integer with more digits than Python prints
        return f"a {type(value).__name__}"


def is_finite_number(value: object) -> bool:
    """Whether a value is one finite number, and no bool."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # an integer beyond all floats
        return False


def check_number(
    name: str, value: object, minimum: float = MIN_MAGNITUDE, maximum: float = MAX_MAGNITUDE, remedy: str = ""
) -> None:
    """Refuse a value that is not a number from ``minimum`` to ``maximum``; the remedy ends the message."""
    if not (is_finite_number(value) and minimum <= value <= maximum):  # type: ignore[operator]
        end = f"; {remedy}" if remedy else ""
        raise ValueError(
            f"{name} must be a number from {minimum:.10g} to {maximum:.10g}, but is {short_repr(value)}{end}"
        )


def check_integer(name: str, value: object, maximum: int, minimum: int = 1) -> None:
    """Refuse a value that is not an integer from ``minimum`` to ``maximum``."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or not minimum <= value <= maximum:
        high = f"2**{maximum.bit_length() - 1}" if maximum > 2**53 and maximum & (maximum - 1) == 0 else str(maximum)
        raise ValueError(f"{name} must be a whole number from {minimum} to {high}, but is {short_repr(value)}")


def check_bool(name: str, value: object) -> None:
    """Refuse a value that is neither True nor False."""
    if not isinstance(value, bool | np.bool_):
        raise ValueError(f"{name} must be True or False, but is {short_repr(value)}")


def check_choice(name: str, value: object, choices: Collection[str]) -> None:
    """Refuse a value that is not one of the choices."""
    if not isinstance(value, str) or value not in choices:
        raise ValueError(
            f"{name} must be one of {list(choices)}, but is {short_repr(value)}{did_you_mean(value, choices)}"
        )


def did_you_mean(value: object, choices: Collection[str]) -> str:
    """The end of a message with the most similar choice, if there is one; case does not count."""
    names = {name.lower(): name for name in choices}
    matches = difflib.get_close_matches(value.lower(), names, 1) if isinstance(value, str) else []
    return f"; did you mean {names[matches[0]]!r}?" if matches else ""


def check_mapping(name: str, value: object, value_type: type = object) -> None:
    """Refuse a value that is not a dictionary from names to values of a type."""
    if not isinstance(value, Mapping) or not all(
        isinstance(k, str) and isinstance(v, value_type) for k, v in value.items()
    ):
        raise ValueError(f"{name} must be a dictionary from names to values, but is {short_repr(value)}")


def to_scalar(name: str, value: npt.ArrayLike) -> float:
    """One number from a number or an array of one element."""
    found = to_float_array(name, value)
    if found.size != 1:
        raise ValueError(f"{name} must be one number, but has shape {found.shape}; use run() for many samples")
    return float(found.reshape(()))


def to_finite_series(name: str, values: npt.ArrayLike, allow_nan: bool = False) -> FloatArray:
    """A finite series (T,), copied; with ``allow_nan`` it may hold NaN."""
    array, label = to_float_array(name, values), name.split(" of ")[0]  # "u of record 0" has the label "u"
    if array.ndim != 1:
        raise ValueError(f"{name} must have shape (T,), but has {array.shape}; pass one channel, e.g. {label}.ravel()")
    finite = np.isfinite(array) | (allow_nan & np.isnan(array))
    if not finite.all():
        bad = int(np.argmin(finite))
        raise ValueError(f"{name} must be finite, but {label}[{bad}] is {array[bad]}; remove or interpolate the sample")
    return array


def to_float_array(name: str, values: npt.ArrayLike) -> FloatArray:
    """A float64 copy, writeable, because Numba would compile kernels again for read-only arrays."""
    if isinstance(values, np.ma.MaskedArray):
        raise ValueError(
            f"{name} must not be a masked array, whose hidden values would be used; pass {name}.filled(np.nan) to "
            f"run(..., missing=True)"
        )
    try:
        if np.iscomplexobj(values):
            raise TypeError("they are complex")
        if _contains_text(values):  # NumPy would read it as numbers
            raise TypeError("text is no number; convert it")
        return np.array(values, dtype=np.float64, order="C")
    except (TypeError, ValueError, OverflowError, RuntimeError) as error:  # RuntimeError: torch tensor with a gradient
        raise ValueError(f"{name} must be numbers, but is {short_repr(values)}; {error}") from error


def _contains_text(values: object) -> bool:
    """Whether values, nested or not, contain text."""
    if isinstance(values, np.ndarray):
        return values.dtype.kind in "US" or (values.dtype.kind == "O" and any(map(_contains_text, values.flat)))
    return isinstance(values, str | bytes) or (isinstance(values, list | tuple) and any(map(_contains_text, values)))


def mask_control_codes(text: str, allowed: str = "") -> str:
    """Text with question marks in place of control codes, which a terminal would obey and which break lines.

    Args:
        text: a text from a user or a file.
        allowed: control codes that stay.
    """
    return "".join(character if character.isprintable() or character in allowed else "?" for character in text)
