"""The language of a model's expressions: names, functions and conditions.

An expression is a formula of Python in the names that it may use. A name may also be written ``u[-1]``, an older input,
or ``derivative(u)``, the time derivative of an input: both count as names of their own.
"""

from __future__ import annotations

import ast
import operator
from collections.abc import Callable, Collection, Mapping
from typing import Any

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


def name_of(node: ast.AST) -> str | None:
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
    """The first part that is not allowed in a formula, in words; empty where all is allowed."""
    if name_of(node) is not None:
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
    name = name_of(tree)
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


def replace_names(text: str, replacements: Mapping[str, ast.expr], owner: str) -> str:
    """An expression with formulas in place of names.

    Args:
        text: the expression.
        replacements: name to the formula in its place.
        owner: name of the model, for messages.
    """
    return ast.unparse(replaced(parse(text, owner), replacements))


def replaced(tree: ast.expr, replacements: Mapping[str, ast.expr]) -> ast.expr:
    """A formula with others in place of names."""

    class Replacing(ast.NodeTransformer):
        def visit(self, node: ast.AST) -> ast.AST:
            name = name_of(node)
            return replacements.get(name, node) if name is not None else self.generic_visit(node)

    found = Replacing().visit(tree)
    assert isinstance(found, ast.expr)
    return found


def evaluate(tree: ast.AST, values: Mapping[str, Any], functions: Mapping[str, Callable[..., Any]]) -> Any:
    """The value of a formula.

    Args:
        tree: the formula.
        values: name to its value; with ``pi``.
        functions: function to its implementation. ``where`` takes a comparison's sign, its two sides, and the two
            branches.
    """
    name = name_of(tree)
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
