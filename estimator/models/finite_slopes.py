"""Slopes of expressions that must be finite: of roots, powers and quotients where they are 0."""

from __future__ import annotations

import ast
import math
from collections.abc import Collection, Mapping

from estimator.models.expression import name_of, names_in, parse, replaced
from estimator.models.expression_range import Range, range_of_power, range_of_sum, ranges_of_functions


def check_slopes(text: str, varying: Collection[str], constants: Mapping[str, float], owner: str) -> None:
    """Refuse an expression whose slope is not finite where a root, a power or a divisor is 0.

    A quotient such as ``1/x``, whose value is not finite either, is left to its writer.

    Args:
        text: the expression.
        varying: names whose value may be 0: states, inputs and time. Coefficients count as positive.
        constants: names of numbers.
        owner: name of the model, for messages.

    Raises:
        ValueError: with the part of the expression, and the way to write it.
    """
    for node in ast.walk(
        replaced(parse(text, owner), {name: ast.Constant(value) for name, value in constants.items()})
    ):
        base: ast.AST | None
        exponent: float | None
        match node:
            case ast.Call(func=ast.Name(id="sqrt"), args=[ast.expr() as base]):
                exponent, shown = 0.5, "1/2"
            case ast.BinOp(left=ast.expr() as base, op=ast.Pow(), right=power):
                exponent, shown = _number_of(power), _in_brackets(power)
            case ast.BinOp(op=ast.Div(), right=divisor):
                base = next((part for part in _factors(divisor) if _is_magnitude(part)), None)
                exponent, shown = -1.0, "1"
            case _:
                continue
        if base is None or exponent == 0 or not _may_be_zero(base, varying):
            continue
        inner, order = _without_magnitudes(base)
        if exponent is not None and (exponent * order >= 1 or (exponent.is_integer() and not _is_magnitude(base))):
            continue
        smooth = f"{_in_brackets(inner)}**2 + 1e-9"
        half = {1.0: f"{shown}/2", 2.0: shown}.get(order, f"{order / 2:g}*{shown}")
        if _range(inner, varying).low >= 0:
            smooth, half = f"{ast.unparse(inner)} + 1e-9", shown
        smooth = f"({smooth})**({half})".replace("1/2/2", "1/4")
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Div):
            smooth = f"{_in_brackets(node.left)}/{smooth}"
        raise ValueError(
            f"expressions of {owner} must have finite slopes, but the slope of {ast.unparse(node)!r} is not finite "
            f"where {ast.unparse(inner)} is 0; write {smooth}"
        )


def _in_brackets(node: ast.AST) -> str:
    """A formula's text, in brackets unless it is a name, a positive number or a call."""
    text = ast.unparse(node)
    return text if isinstance(node, ast.Name | ast.Constant | ast.Call | ast.Subscript) else f"({text})"


def _number_of(node: ast.AST) -> float | None:
    """The number that a formula is; None where it has names of coefficients or states."""
    if names_in(node):
        return None
    found = _range(node, ())
    return float(found.low) if found.low == found.high else None


def _factors(node: ast.AST) -> list[ast.AST]:
    """The factors of a product, without whole powers and signs."""
    match node:
        case ast.BinOp(left=left, op=ast.Mult(), right=right):
            return _factors(left) + _factors(right)
        case ast.BinOp(left=base, op=ast.Pow(), right=ast.Constant()):
            return [node] if _is_magnitude(node) else _factors(base)
        case ast.UnaryOp(operand=operand):
            return _factors(operand)
    return [node]


def _is_magnitude(node: ast.AST) -> bool:
    """Whether a formula is the magnitude of another, or a power of it: ``abs(x)``, ``sqrt(x**2)`` or ``abs(x)**3``."""
    match node:
        case ast.Call(func=ast.Name(id="abs")):
            return True
        case ast.Call(func=ast.Name(id="sqrt")):
            return _without_magnitudes(node)[1] >= 1
        case ast.BinOp(left=left, op=ast.Pow()):
            return _is_magnitude(left)
        case ast.UnaryOp(operand=operand):
            return _is_magnitude(operand)
    return False


def _without_magnitudes(node: ast.AST) -> tuple[ast.AST, float]:
    """The base and the exponent of a formula that is a power, near the place where it is 0."""
    match node:
        case ast.Call(func=ast.Name(id="abs"), args=[inner]):
            return _without_magnitudes(inner)
        case ast.Call(func=ast.Name(id="sqrt"), args=[inner]):
            base, order = _without_magnitudes(inner)
            return base, order / 2
        case ast.BinOp(left=left, op=ast.Pow(), right=right):
            exponent = _number_of(right)
            if exponent is not None and exponent > 0:
                base, order = _without_magnitudes(left)
                return base, order * exponent
        case ast.BinOp(left=left, op=ast.Mult(), right=right) if ast.dump(left) == ast.dump(right):
            base, order = _without_magnitudes(left)
            return base, 2 * order
        case ast.UnaryOp(operand=operand):
            return _without_magnitudes(operand)
    return node, 1.0


def _may_be_zero(node: ast.AST, varying: Collection[str]) -> bool:
    found = _range(node, varying)
    return found.varies and found.may_be_zero


def _range(node: ast.AST, varying: Collection[str]) -> Range:
    """The range of a formula's values."""
    name = name_of(node)
    if name is not None:
        if name == "pi":
            return Range.of_number(math.pi)
        if name in varying:
            return Range(-math.inf, math.inf, True, True)
        return Range(0.0, math.inf, False, False)
    inner = lambda part: _range(part, varying)  # noqa: E731
    match node:
        case ast.Constant(value=int() | float() as value):
            return Range.of_number(value)
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            return inner(operand).negated()
        case ast.UnaryOp(operand=operand):
            return inner(operand)
        case ast.BinOp(left=left, op=ast.Pow(), right=right):
            return range_of_power(inner(left), _number_of(right), inner(right).varies)
        case ast.BinOp(left=left, op=ast.Mult(), right=right) if ast.dump(left) == ast.dump(right):
            return range_of_power(inner(left), 2.0, False)
        case ast.BinOp(left=left, op=op, right=right):
            a, b = inner(left), inner(right)
            if isinstance(op, ast.Mult | ast.Div):
                return a.times(b if isinstance(op, ast.Mult) else b.inverted())
            return range_of_sum(a, b if isinstance(op, ast.Add) else b.negated())
        case ast.Call(func=ast.Name(id=called), args=arguments):
            return ranges_of_functions(called, [inner(part) for part in arguments if not isinstance(part, ast.Compare)])
    raise TypeError(f"a formula must have names, numbers and functions, but has {ast.dump(node):.80}; parse it first")
