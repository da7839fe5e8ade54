"""Checks of what a caller passes in: an error names the argument, the value and the remedy."""

from __future__ import annotations

import difflib
import math
from collections.abc import Collection, Mapping

import numpy as np
import numpy.typing as npt

from estimator.parameters import FloatArray

#: Options that are sizes lie between these: squares and products of some of them neither overflow nor vanish.
SMALLEST, LARGEST = 1e-12, 1e12

#: The largest seed.
MOST_SEED = 2**128


def shown(value: object) -> str:
    """A value as a message shows it, whatever it is."""
    try:
        return f"{value!r:.80}"
    except Exception:  # such as a whole number of more digits than Python writes
        return f"a {type(value).__name__}"


def is_finite(value: object) -> bool:
    """Whether it is one finite number, and no truth value."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # a whole number beyond all floats
        return False


def number(name: str, value: object, low: float = SMALLEST, high: float = LARGEST, remedy: str = "") -> None:
    """Refuse what is not a number from ``low`` to ``high``; the remedy ends the message."""
    if not (is_finite(value) and low <= value <= high):  # type: ignore[operator]
        end = f"; {remedy}" if remedy else ""
        raise ValueError(f"{name} must be a number from {low:.10g} to {high:.10g}, but is {shown(value)}{end}")


def whole(name: str, value: object, most: int, least: int = 1) -> None:
    """Refuse what is not a whole number from ``least`` to ``most``."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or not least <= value <= most:
        high = f"2**{most.bit_length() - 1}" if most > 2**53 and most & (most - 1) == 0 else str(most)
        raise ValueError(f"{name} must be a whole number from {least} to {high}, but is {shown(value)}")


def flag(name: str, value: object) -> None:
    """Refuse what is neither True nor False."""
    if not isinstance(value, bool | np.bool_):
        raise ValueError(f"{name} must be True or False, but is {shown(value)}")


def one_of(name: str, value: object, known: Collection[str]) -> None:
    """Refuse what is not a name among those that are known."""
    if not isinstance(value, str) or value not in known:
        raise ValueError(f"{name} must be one of {list(known)}, but is {shown(value)}{hint(value, known)}")


def hint(value: object, known: Collection[str]) -> str:
    """The end of a message: what name may have been meant, where one is near; capitals do not count."""
    names = {name.lower(): name for name in known}
    near = difflib.get_close_matches(value.lower(), names, 1) if isinstance(value, str) else []
    return f"; did you mean {names[near[0]]!r}?" if near else ""


def mapping(name: str, value: object, kind: type = object) -> None:
    """Refuse what is not a dictionary from names to values of a kind."""
    if not isinstance(value, Mapping) or not all(isinstance(k, str) and isinstance(v, kind) for k, v in value.items()):
        raise ValueError(f"{name} must be a dictionary from names to values, but is {shown(value)}")


def scalar(name: str, value: npt.ArrayLike) -> float:
    """One number."""
    found = numbers(name, value)
    if found.size != 1:
        raise ValueError(f"{name} must be one number, but has shape {found.shape}; use run() for many samples")
    return float(found.reshape(()))


def series(name: str, values: npt.ArrayLike, missing: bool = False) -> FloatArray:
    """A finite series (T,), copied; with ``missing`` it may hold NaN."""
    checked, short = numbers(name, values), name.split(" of ")[0]  # of "u of record 0", u
    if checked.ndim != 1:
        raise ValueError(
            f"{name} must have shape (T,), but has {checked.shape}; pass one channel, e.g. {short}.ravel()"
        )
    finite = np.isfinite(checked) | (missing & np.isnan(checked))
    if not finite.all():
        bad = int(np.argmin(finite))
        raise ValueError(
            f"{name} must be finite, but {short}[{bad}] is {checked[bad]}; remove or interpolate the sample"
        )
    return checked


def numbers(name: str, values: npt.ArrayLike) -> FloatArray:
    """A float64 copy: writeable, because read-only arrays are another type to Numba, and would compile kernels anew."""
    if isinstance(values, np.ma.MaskedArray):
        raise ValueError(
            f"{name} must not be a masked array, whose hidden values would be used; pass {name}.filled(np.nan) to "
            f"run(..., missing=True)"
        )
    try:
        if np.iscomplexobj(values):
            raise TypeError("they are complex")
        if _has_text(values):  # which NumPy reads as numbers
            raise TypeError("text is no number; convert it")
        return np.array(values, dtype=np.float64, order="C")
    except (TypeError, ValueError, OverflowError, RuntimeError) as error:  # torch's, of a tensor with a gradient
        raise ValueError(f"{name} must be numbers, but is {shown(values)}; {error}") from error


def _has_text(values: object) -> bool:
    """Whether there is text among values, nested or not."""
    if isinstance(values, np.ndarray):
        return values.dtype.kind in "US" or (values.dtype.kind == "O" and any(map(_has_text, values.flat)))
    return isinstance(values, str | bytes) or (isinstance(values, list | tuple) and any(map(_has_text, values)))


def printable(text: str, kept: str = "") -> str:
    """Text for people: control codes, which a terminal would obey and which break lines, become question marks.

    Args:
        text: whatever a user or a file calls something.
        kept: control codes that stay.
    """
    return "".join(letter if letter.isprintable() or letter in kept else "?" for letter in text)
