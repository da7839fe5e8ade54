"""Strategies of Hypothesis for bad arguments: values of every type, and damaged files."""

from decimal import Decimal
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies as st

_PLAIN = [
    *(None, True, False, 0, 1, -1, 2, 3, 7, 2**31, 2**63, 10**400, -(10**400), -0.0, 0.5, 1e-3, -0.3),
    *(float("nan"), float("inf"), -float("inf"), 1e308, -1e308, 5e-324, 1e-300, 1e-200, 1e-12, 1e12, 1e30, 1e300),
    *("", "abc", "1.5", "nan", "a" * 300, "\0", "\ud800", "../x", "=1+1", "$\\frac{$", "\x1b[31m", "é", b"x"),
    *([], [None], [1.0, 2.0], [[1.0], [2.0, 3.0]], (), (1,), {}, {"a": 1}, set(), 1j, Decimal("1.5"), Fraction(1, 3)),
    *(Path("x"), range(3), object, print, np.float32(0.5), np.float64(1e300), np.int64(3), np.bool_(True)),
    *(np.datetime64("2020-01-01"), np.ma.masked, np.complex128(1j)),
]

_ARRAYS: list[Any] = [
    *(np.array([]), np.array(1.0), np.ones(1), np.ones(3), np.ones((2, 2)), np.ones((3, 1)), np.ones((2, 3, 4))),
    *(np.full(3, np.nan), np.full(3, np.inf), np.full(5, 1e300), np.full(4, 1e-300), np.arange(6)),
    *(np.array([None, 1.0]), np.array(["x"]), np.array([{}]), np.array([1j]), np.ones(3, dtype=np.float16)),
    *(np.ma.masked_array([1.0, 2.0], [False, True]), np.ones(4, dtype=bool), np.ones(3, dtype=">f8")),
]

#: A value of any type.
anything: st.SearchStrategy[Any] = st.one_of(
    st.sampled_from(_PLAIN),
    st.sampled_from(_ARRAYS),
    st.floats(),
    st.integers(-(10**20), 10**20),
    st.text(max_size=8),
    st.lists(st.floats(), max_size=5),
)

#: A number of any size.
sizes = st.one_of(st.floats(allow_nan=False), st.floats(-40, 40).map(lambda power: 10.0**power))


def options(good: dict[str, Any]) -> st.SearchStrategy[dict[str, Any]]:
    """Arguments of which one to three have any value; sometimes one has an unknown name."""
    some = st.dictionaries(st.sampled_from([*good, "unknown"]), st.one_of(anything, sizes), min_size=1, max_size=3)
    return some.map(lambda changed: {**good, **changed})


@st.composite
def damaged(draw: st.DrawFn, whole: bytes) -> bytes:
    """A file's content: cut, doubled, with bits flipped, bytes inserted or removed, or replaced."""
    kind = draw(st.sampled_from(["cut", "flipped", "inserted", "removed", "doubled", "replaced"]))
    at = draw(st.integers(0, max(0, len(whole) - 1)))
    if kind == "cut":
        return whole[:at]
    if kind == "flipped":
        content = bytearray(whole)
        for place in draw(st.lists(st.integers(0, max(0, len(whole) - 1)), min_size=1, max_size=12)):
            content[place] ^= 1 << draw(st.integers(0, 7))
        return bytes(content)
    if kind == "inserted":
        return whole[:at] + draw(st.binary(min_size=1, max_size=20)) + whole[at:]
    if kind == "removed":
        return whole[:at] + whole[at + draw(st.integers(1, 200)) :]
    return whole * 2 if kind == "doubled" else draw(st.binary(max_size=200))


#: Values for a place in JSON or TOML.
_HELD = [
    *(None, True, 0, -1, 1, 3, 2**40, 10**400, 0.5, -2.5, 1e300, 1e-300),
    *("", "abc", "u*x", [], [1], [[]], {}, {"a": 1}),
]


@st.composite
def changed(draw: st.DrawFn, held: Any) -> Any:
    """Nested lists and dictionaries with one place changed, removed or added."""
    if isinstance(held, dict) and held and draw(st.integers(0, 3)):
        key = draw(st.sampled_from(sorted(held)))
        rest = {name: value for name, value in held.items() if name != key}
        return rest if draw(st.integers(0, 4)) == 0 else {**rest, key: draw(changed(held[key]))}
    if isinstance(held, list) and held and draw(st.booleans()):
        at = draw(st.integers(0, len(held) - 1))
        return [*held[:at], draw(changed(held[at])), *held[at + 1 :]]
    return draw(st.sampled_from(_HELD))


@st.composite
def another_array(draw: st.DrawFn, array: Any) -> Any:
    """An array with another shape, data type, sign or value."""
    change = draw(st.integers(0, 8))
    if change == 0:
        return array[:-1] if array.ndim else np.ones(3)
    if change == 1:
        return np.ones(draw(st.sampled_from([(0,), (50,), (3, 3), (2, 1, 2)])))
    if change == 2:
        return array.astype(draw(st.sampled_from([np.float32, np.int64, np.complex128, ">f8", "U8", bool])))
    with np.errstate(all="ignore"):
        if change in (3, 4) and array.dtype.kind != "f":
            return array[::-1].copy()
        if change == 3:
            return array * draw(st.sampled_from([-1, 0, 2, 1e300, 1e-300, np.nan, np.inf]))
        if change == 4:
            return array + draw(st.sampled_from([-1, 1, 1e300, -1e300]))
    flat = np.array(array, copy=True).reshape(-1)
    if flat.size:
        flat[draw(st.integers(0, flat.size - 1))] = draw(st.sampled_from([0, 1, 100, 255]))
    return flat.reshape(array.shape)
