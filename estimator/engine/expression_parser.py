"""Expressions of a model in SymPy, with functions whose derivatives are code without branches."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import reduce

import sympy as sp

from estimator.models.expression import evaluate, names_in_expression, parse
from estimator.models.model import MAX_POWER, Model


class _RealFunction(sp.Function):
    """A function with a real value."""

    is_real = True


class sign(_RealFunction):
    """``sign(x)``: -1, 0 or 1; its derivative is 0, at the jump too."""

    nargs = 1

    @classmethod
    def eval(cls, x: sp.Expr) -> sp.Expr | None:
        """The value of a number, or of a negative."""
        if x.is_number:
            return sp.sign(x)
        return -cls(-x) if x.could_extract_minus_sign() else None

    def fdiff(self, argindex: int = 1) -> sp.Expr:
        """The derivative."""
        return sp.S.Zero


class magnitude(_RealFunction):
    """``magnitude(x)``: the absolute value; its derivative is the sign."""

    nargs = 1

    @classmethod
    def eval(cls, x: sp.Expr) -> sp.Expr | None:
        """The value of a number, or of a negative."""
        if x.is_number:
            return sp.Abs(x)
        return cls(-x) if x.could_extract_minus_sign() else None

    def fdiff(self, argindex: int = 1) -> sp.Expr:
        """The derivative."""
        return sign(self.args[0])


class _Branch(_RealFunction):
    """One of two values, by a comparison; its derivative is the value's."""

    nargs = 4

    def _eval_derivative(self, by: sp.Symbol) -> sp.Expr:
        x, y, first, second = self.args
        slopes = sp.diff(first, by), sp.diff(second, by)
        return slopes[0] if slopes[0] == slopes[1] else self.func(x, y, *slopes)


class if_greater(_Branch):
    """``if_greater(x, y, a, b)``: a where x > y, else b."""

    @classmethod
    def eval(cls, x: sp.Expr, y: sp.Expr, first: sp.Expr, second: sp.Expr) -> sp.Expr | None:
        """The branch, of two numbers."""
        return (first if x > y else second) if x.is_number and y.is_number else None


class unless_less(_Branch):
    """``unless_less(x, y, a, b)``: a where x >= y, else b."""

    @classmethod
    def eval(cls, x: sp.Expr, y: sp.Expr, first: sp.Expr, second: sp.Expr) -> sp.Expr | None:
        """The branch, of two numbers."""
        return (first if x >= y else second) if x.is_number and y.is_number else None


def _where(comparison: str, left: sp.Expr, right: sp.Expr, first: sp.Expr, second: sp.Expr) -> sp.Expr:
    """The first value where a comparison holds, else the second."""
    branch = if_greater if comparison in (">", "<") else unless_less
    return branch(*((left, right) if comparison[0] == ">" else (right, left)), first, second)


def _smallest(*values: sp.Expr) -> sp.Expr:
    return reduce(lambda a, b: if_greater(a, b, b, a), values)


def _largest(*values: sp.Expr) -> sp.Expr:
    return reduce(lambda a, b: if_greater(b, a, b, a), values)


#: Function of the language to its expression in symbols.
_FUNCTIONS: dict[str, Callable[..., sp.Expr]] = {
    "sin": sp.sin, "cos": sp.cos, "exp": sp.exp, "log": sp.log, "sqrt": sp.sqrt, "tanh": sp.tanh, "atan": sp.atan,
    "abs": magnitude, "sign": sign, "min": _smallest, "max": _largest, "where": _where,
}  # fmt: skip


def parse_expression(text: str, symbols: Mapping[str, sp.Symbol], model: Model) -> sp.Expr:
    """Parse an expression of a model.

    Args:
        text: the expression.
        symbols: name to its symbol.
        model: the model, for its constants, and for messages.

    Raises:
        ValueError: with the text, for anything but an expression in these names and the constants.
    """
    values = {**symbols, **{name: float(value) for name, value in model.constants.items()}}
    names_in_expression(text, values, model.name)
    try:
        parsed = sp.sympify(evaluate(parse(text, model.name), {**values, "pi": sp.pi}, _FUNCTIONS))
    except (ArithmeticError, TypeError, AttributeError, RecursionError, sp.SympifyError) as error:
        raise ValueError(f"expressions of {model.name} must be formulas, but {text!r} is not one: {error}") from error
    if not isinstance(parsed, sp.Expr):
        raise ValueError(f"expressions of {model.name} must be numbers, but {text!r} is {parsed!r}")
    if parsed.has(sp.I, sp.nan, sp.zoo, sp.oo, -sp.oo):
        raise ValueError(f"expressions of {model.name} must be finite and real, but {text!r} is {parsed}")
    parsed = parsed.replace(lambda part: part.is_Pow and part.exp.is_Float, lambda p: p.base ** sp.Rational(p.exp))
    parsed = parsed.replace(_is_power_of_square, lambda p: magnitude(p.base.base) ** (p.base.exp * p.exp))
    parsed = parsed.replace(sp.Abs, magnitude)
    for power in parsed.atoms(sp.Pow):
        if power.exp.is_Number and abs(power.exp) > MAX_POWER:
            raise ValueError(
                f"powers of {model.name} must be from -{MAX_POWER} to {MAX_POWER}, but {text!r} has {power}"
            )
    return parsed


def _is_power_of_square(part: sp.Expr) -> bool:
    """Whether an expression is a power of an even power, such as the root of a square."""
    return part.is_Pow and part.base.is_Pow and part.base.exp.is_Integer and part.base.exp % 2 == 0
