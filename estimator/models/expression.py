"""The language of a model's expressions: names, functions, conditions, and slopes that must be finite.

An expression is a formula of Python in the names that it may use. A name may also be written ``u[-1]``, an older input,
or ``derivative(u)``, the time derivative of an input: both count as names of their own.
"""

from __future__ import annotations

import ast
import math
import operator
from collections.abc import Callable, Collection, Mapping
from typing import Any

from estimator.models.expression_range import Range, range_of_power, range_of_sum, ranges_of_functions

#: Function to its least and largest number of arguments.
FUNCTIONS = {
    "sin": (1, 1), "cos": (1, 1), "exp": (1, 1), "log": (1, 1), "sqrt": (1, 1), "tanh": (1, 1), "atan": (1, 1),
    "abs": (1, 1), "sign": (1, 1), "min": (2, 9), "max": (2, 9), "where": (3, 3),
}  # fmt: skip

#: Functions that generated code calls: the others are written out.
GENERATED_FUNCTIONS = ("sin", "cos", "exp", "log", "sqrt", "tanh", "atan", "sign")

#: Comparisons in the condition of ``where``.
COMPARISONS: dict[type[ast.cmpop], str] = {ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">="}

#: Function that makes a name of an input: its time derivative.
DERIVATIVE = "derivative"

_OPERATORS: dict[type, Callable[..., Any]] = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Div: operator.truediv,
    ast.Pow: operator.pow, ast.USub: operator.neg, ast.UAdd: operator.pos,
}  # fmt: skip

#: Largest length of an expression [characters].
_MAX_LENGTH = 10_000


def older_input(name: str, samples: int) -> str:
    """The name of an input some samples before the newest; the input's own name for 0."""
    return f"{name}[-{samples}]" if samples else name


def input_derivative(name: str) -> str:
    """The name of the time derivative of an input."""
    return f"{DERIVATIVE}({name})"


def _name_of(node: ast.AST) -> str | None:
    """The name that a node stands for; None for another node."""
    match node:
        case ast.Name(id=name):
            return name
        case ast.Subscript(
            value=ast.Name(id=name), slice=ast.UnaryOp(op=ast.USub(), operand=ast.Constant(value=int(k)))
        ):
            return f"{name}[-{k}]"
        case ast.Call(func=ast.Name(id="derivative"), args=[ast.Name(id=name)], keywords=[]):
            return input_derivative(name)
    return None


def _function_name(node: ast.Call) -> str | None:
    """Name of a called function, where it is a function of the language; with the right number of arguments."""
    if isinstance(node.func, ast.Name) and node.func.id in FUNCTIONS and not node.keywords:
        least, most = FUNCTIONS[node.func.id]
        if least <= len(node.args) <= most:
            return node.func.id
    return None


def parse(text: object, owner: str) -> ast.expr:
    """The syntax tree of an expression.

    Args:
        text: the expression.
        owner: name of the model, for messages.

    Raises:
        ValueError: naming the text, for a text that is no formula in functions of the language.
    """
    if not isinstance(text, str) or "__" in text or len(text) > _MAX_LENGTH:
        raise ValueError(f"expressions of {owner} must be short strings without '__', but one is {text!r:.80}")
    try:
        tree = ast.parse(text.strip(), mode="eval").body
        fault = _fault(tree)
    except (SyntaxError, ValueError, RecursionError) as error:
        raise ValueError(f"expressions of {owner} must be formulas, but {text!r} is not one: {error}") from error
    if fault:
        raise ValueError(
            f"expressions of {owner} may use + - * / **, brackets and {[*FUNCTIONS]}, but {text!r} uses something "
            f"else: {fault}"
        )
    return tree


def _fault(node: ast.AST) -> str:
    """What a formula may not have, in words; empty for a formula."""
    if _name_of(node) is not None:
        return ""
    match node:
        case ast.Constant(value=value):
            return "" if type(value) in (int, float) else f"{value!r} is no number"
        case ast.UnaryOp(op=op, operand=operand) if type(op) in _OPERATORS:
            return _fault(operand)
        case ast.BinOp(left=left, op=op, right=right) if type(op) in _OPERATORS:
            return _fault(left) or _fault(right)
        case ast.Call():
            name = _function_name(node)
            if name is None:
                return f"{ast.unparse(node)} is no function with its arguments"
            if name != "where":
                return next(filter(None, map(_fault, node.args)), "")
            condition, *branches = node.args
            match condition:
                case ast.Compare(left=left, ops=[order], comparators=[right]) if type(order) in COMPARISONS:
                    return next(filter(None, map(_fault, (left, right, *branches))), "")
            return (
                f"the condition of where must be a comparison by {' '.join(COMPARISONS.values())}, but is "
                f"{ast.unparse(condition)}"
            )
    return f"{ast.unparse(node)}"


def names_in(tree: ast.AST) -> set[str]:
    """The names in a formula, without functions and ``pi``."""
    name = _name_of(tree)
    if name is not None:
        return {name} - {"pi"}
    parts = ast.iter_child_nodes(tree)
    skipped = tree.func if isinstance(tree, ast.Call) else None
    return set().union(*(names_in(part) for part in parts if part is not skipped))


def names_in_expression(text: object, allowed: Collection[str], owner: str) -> set[str]:
    """The names in an expression, without `FUNCTIONS` and ``pi``.

    Args:
        text: the expression.
        allowed: names that it may use.
        owner: name of the model, for messages.

    Raises:
        ValueError: naming the text, for a text that is no formula or uses another name.
    """
    used = names_in(parse(text, owner))
    unknown = sorted(used.difference(allowed))
    if unknown:
        raise ValueError(
            f"expressions of {owner} may use {sorted(allowed)} and {sorted(FUNCTIONS)}, but {text!r} uses {unknown}"
        )
    return used


def evaluate(tree: ast.AST, values: Mapping[str, Any], functions: Mapping[str, Callable[..., Any]]) -> Any:
    """The value of a formula.

    Args:
        tree: the formula.
        values: name to its value; with ``pi``.
        functions: function to its implementation. ``where`` takes a comparison's sign, its two sides, and the two
            branches.
    """
    name = _name_of(tree)
    if name is not None:
        return values[name]
    match tree:
        case ast.Constant(value=value):
            return value
        case ast.UnaryOp(op=op, operand=operand):
            return _OPERATORS[type(op)](evaluate(operand, values, functions))
        case ast.BinOp(left=left, op=by, right=right):
            return _OPERATORS[type(by)](evaluate(left, values, functions), evaluate(right, values, functions))
        case ast.Compare(left=left, ops=[order], comparators=[right]):
            return COMPARISONS[type(order)], evaluate(left, values, functions), evaluate(right, values, functions)
        case ast.Call(func=ast.Name(id=called), args=arguments):
            given = [evaluate(argument, values, functions) for argument in arguments]
            return functions[called](*given[0], *given[1:]) if called == "where" else functions[called](*given)
    raise TypeError(f"a formula must have names, numbers and functions, but has {ast.dump(tree):.80}; parse it first")


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
    for node in ast.walk(_with_numbers(parse(text, owner), constants)):
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


def _with_numbers(tree: ast.expr, constants: Mapping[str, float]) -> ast.expr:
    """The formula with numbers in place of their names."""

    class Replacing(ast.NodeTransformer):
        def visit_Name(self, node: ast.Name) -> ast.expr:
            return ast.Constant(constants[node.id]) if node.id in constants else node

    replaced: ast.expr = Replacing().visit(tree)
    return replaced


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
    """What a formula is a power of, and the exponent, at the place where it is 0."""
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
    name = _name_of(node)
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
