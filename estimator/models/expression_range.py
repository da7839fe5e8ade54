"""Ranges of the values of expressions, to find out where a power may have a slope that is not finite."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple, Self


class Range(NamedTuple):
    """The values that an expression may take.

    Attributes:
        low: greatest lower bound that is known.
        high: least upper bound that is known.
        has_zero: whether 0 is a value, where it lies within the bounds.
        varies: whether the expression has states, inputs or time. One of coefficients and numbers alone is taken not to
            be 0.
    """

    low: float
    high: float
    has_zero: bool
    varies: bool

    @classmethod
    def of_number(cls, value: float) -> Self:
        """The range of a number."""
        return cls(float(value), float(value), value == 0, False)

    @property
    def may_be_zero(self) -> bool:
        """Whether 0 is a value."""
        return self.low <= 0 <= self.high and self.has_zero

    def negated(self) -> Range:
        """The range of the negative."""
        return Range(-self.high, -self.low, self.has_zero, self.varies)

    def times(self, other: Range) -> Range:
        """The range of a product."""
        ends = [a * b if a and b else 0.0 for a in (self.low, self.high) for b in (other.low, other.high)]
        return Range(min(ends), max(ends), self.may_be_zero or other.may_be_zero, self.varies or other.varies)

    def inverted(self) -> Range:
        """The range of the reciprocal, which is never 0."""
        if self.low < 0 < self.high:
            return Range(-math.inf, math.inf, False, self.varies)
        ends = [math.copysign(math.inf, self.low + self.high) if end == 0 else 1 / end for end in (self.low, self.high)]
        return Range(min(ends), max(ends), False, self.varies)


def range_of_sum(a: Range, b: Range) -> Range:
    """The range of a sum."""
    low, high, varies = a.low + b.low, a.high + b.high, a.varies or b.varies
    if min(a.low, b.low) >= 0 or max(a.high, b.high) <= 0:
        has_zero = a.may_be_zero and b.may_be_zero
    else:
        has_zero = varies or low == high == 0
    return Range(low, high, has_zero, varies)


def range_of_power(base: Range, exponent: float | None, exponent_varies: bool) -> Range:
    """The range of a power; None for an exponent that is no number."""
    if exponent is None or not exponent.is_integer():
        base = Range(max(base.low, 0.0), max(base.high, 0.0), base.has_zero, base.varies)
    varies = base.varies or exponent_varies
    if exponent is None:
        return Range(0.0, math.inf, base.may_be_zero, varies)
    if exponent < 0:
        return range_of_power(base, -exponent, exponent_varies).inverted()
    if exponent == 0:
        return Range.of_number(1.0)
    ends = [_bounded(lambda x: x**exponent, base.low), _bounded(lambda x: x**exponent, base.high)]
    if exponent % 2 == 0 and base.low < 0 < base.high:
        ends.append(0.0)
    return Range(min(ends), max(ends), base.may_be_zero, varies)


def _bounded(function: Callable[[float], float], x: float) -> float:
    """A function's value, infinite where it overflows."""
    try:
        return function(x)
    except OverflowError:
        return math.inf


#: Monotone functions that are 0 at 0.
_ODD: dict[str, Callable[[float], float]] = {
    "tanh": math.tanh,
    "atan": math.atan,
    "sign": lambda x: float((x > 0) - (x < 0)),
}


def ranges_of_functions(name: str, given: Sequence[Range]) -> Range:
    """The range of a function of the language, of the ranges of its arguments; of both branches for ``where``."""
    first, varies = given[0], any(one.varies for one in given)
    if name in _ODD:
        return Range(_ODD[name](first.low), _ODD[name](first.high), first.may_be_zero, varies)
    if name == "exp":
        return Range(_bounded(math.exp, first.low), _bounded(math.exp, first.high), False, varies)
    if name == "sqrt":
        return range_of_power(first, 0.5, False)
    if name == "abs":
        low = 0.0 if first.low <= 0 <= first.high else min(abs(first.low), abs(first.high))
        return Range(low, max(abs(first.low), abs(first.high)), first.may_be_zero, varies)
    if name in ("min", "max", "where"):
        pick_low, pick_high = {"min": (min, min), "max": (max, max), "where": (min, max)}[name]
        low, high = pick_low(one.low for one in given), pick_high(one.high for one in given)
        return Range(low, high, any(one.may_be_zero for one in given), varies)
    if name in ("sin", "cos"):
        return Range(-1.0, 1.0, varies, varies)
    return Range(-math.inf, math.inf, varies, varies)
