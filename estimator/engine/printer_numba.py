"""Printing assignments as Python source that is compiled across SIMD lanes.

All quantities of independent systems lie in one flat float64 array, the *block* ``W``: the quantity in row r of lane j
is ``W[r * lanes + j]``. The constant offsets into one array let the compiler vectorise the loop over the lanes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar

import sympy as sp
from sympy.printing.pycode import PythonCodePrinter

from estimator.engine.symbolic import Assignments
from estimator.models.model import Model

#: Function to its source, which is written in place of a call: a call would take longer to compile. An argument that
#: occurs twice must be a name.
_INLINE_TEMPLATES = {
    "present": "(1.0 if {0} == {0} else 0.0)",
    "finite": "(1.0 if {0} - {0} == 0.0 else 0.0)",
    "zero_if_finite": "({0} - {0})",
    "below": "(0.0 if {0} >= 0.0 else 1.0)",
    "positive": "(1.0 if {0} > 0.0 else 0.0)",
    "positive_part": "(0.0 if {0} < 0.0 else {0})",
    "exceeds": "(1.0 if {0} > {1} else 0.0)",
    "reaches": "(1.0 if {0} >= {1} else 0.0)",
    "select": "({1} if {0} > 0.0 else {2})",
    "where_valid": "({0} if {1} > 0.0 and {2} > 0.0 and {3} > 0.0 and {4} >= 0.0 and {5} >= 0.0 else NAN)",
    "magnitude": "abs({0})",
    "if_greater": "({2} if {0} > {1} else {3})",
    "unless_less": "({2} if {0} >= {1} else {3})",
    "clip": "({1} if not {0} > {1} else ({0} if {0} < {2} else {2}))",
}

#: The same functions for arrays, where maps between coefficients and parameters have them.
_ARRAY_TEMPLATES = {
    "magnitude": "abs({0})",
    "if_greater": "where({0} > {1}, {2}, {3})",
    "unless_less": "where({0} >= {1}, {2}, {3})",
}


class _NumbaPrinter(PythonCodePrinter):
    """Prints numbers as floats, small powers as products, and functions by bare names or templates."""

    templates: ClassVar[Mapping[str, str]] = _INLINE_TEMPLATES

    def _print_Integer(self, expr: sp.Integer) -> str:
        return f"{int(expr)}.0"

    def _print_Rational(self, expr: sp.Rational) -> str:
        return repr(float(expr))

    def _print_Float(self, expr: sp.Float) -> str:
        return repr(float(expr))

    def _print_NumberSymbol(self, expr: sp.NumberSymbol) -> str:
        return repr(float(expr))

    _print_Pi = _print_Exp1 = _print_NumberSymbol

    def _print_Pow(self, expr: sp.Pow, rational: bool = False) -> str:
        base, exponent = expr.as_base_exp()
        if not (2 * exponent).is_Integer:
            return f"exp(({self._print(exponent)})*log({self._print(base)}))"
        whole, half = divmod(2 * abs(exponent), 2)
        inner = self._print(base) if base.is_Symbol else f"({self._print(base)})"
        factors = [inner] * int(whole) + [f"sqrt({self._print(base)})"] * int(half)
        product = "*".join(factors)
        return f"(1.0/({product}))" if exponent < 0 else f"({product})" if len(factors) > 1 else product

    def _print_Function(self, expr: sp.Function) -> str:
        name, given = expr.func.__name__, [self._print(argument) for argument in expr.args]
        if name in self.templates:
            return self.templates[name].format(*given)
        return f"{name}({', '.join(given)})"

    _print_sin = _print_cos = _print_tanh = _print_atan = _print_exp = _print_log = _print_sign = _print_Function


class _ArrayPrinter(_NumbaPrinter):
    """Prints expressions of arrays, for NumPy."""

    templates = _ARRAY_TEMPLATES


_PRINTER = _NumbaPrinter({"fully_qualified_modules": False})
_ARRAY_PRINTER = _ArrayPrinter({"fully_qualified_modules": False})


def print_expression(expression: sp.Expr) -> str:
    """Python source of an expression."""
    return str(_PRINTER.doprint(expression))


def print_array_expression(expression: sp.Expr) -> str:
    """NumPy source of an expression of arrays."""
    return str(_ARRAY_PRINTER.doprint(expression))


def print_lane_loop(
    name: str,
    assignments: Assignments,
    results: Mapping[str, str],
    layout: Mapping[str, int | str],
    lanes: int,
    uniform: Sequence[str] = (),
    doc: str = "",
    single_lane: bool = False,
    shared_rows: Mapping[str, int] | None = None,
    lane_index: str = "LANE",
) -> str:
    """Source of ``name(W, *uniform)``, which executes assignments in every lane of a block.

    Args:
        name: name of the function.
        assignments: in the order of execution; assignments without effect on the results are left out.
        results: row to the name (or number) of its new value.
        layout: row to its number, or to an expression of the number in uniform names.
        lanes: lanes of a block; 1 leaves the loop out.
        uniform: names that are the same in all lanes, and become arguments.
        doc: docstring of the function.
        single_lane: write ``name(W, LANE, *uniform)``, for one lane.
        shared_rows: rows of another block ``B``, the second argument, that several blocks may share.
        lane_index: name of the lane's number; `INDEPENDENT_INDEX` where the layout has expressions.

    Raises:
        ValueError: for a name that is neither assigned, nor a row, nor uniform.
    """
    kept, used = _without_dead_code(assignments, set(results.values()))
    clashing = sorted({target for target, _ in kept} & set(layout))
    if clashing:
        raise ValueError(f"{name} assigns {clashing}, which are rows; give the results other names first")
    read = sorted(used - set(uniform), key=lambda row: (str(layout.get(row.removeprefix("ADJ_"))), row))
    adjoint = any(row not in layout and row.removeprefix("ADJ_") in layout for row in (*read, *results))

    def entry(row: str) -> str:
        """A row's entry; the adjoint of a row, ``ADJ_<row>``, lies in the same place of the block ``A``."""
        if shared_rows and row in shared_rows:
            return f"B[{shared_rows[row] * lanes}{f' + {lane_index}' if lanes > 1 else ''}]"
        block, bare = ("W", row) if row in layout else ("A", row.removeprefix("ADJ_"))
        if bare not in layout:
            raise ValueError(
                f"{name} uses {row}, which is neither assigned, nor a row, nor an argument; add it to the layout"
            )
        row_number = layout[bare]
        start = str(row_number * lanes) if isinstance(row_number, int) else f"({row_number}) * {lanes}"
        return f"{block}[{start}{f' + {lane_index}' if lanes > 1 else ''}]"

    body = [f"{row} = {entry(row)}" for row in read]
    body += [f"{target} = {print_expression(e)}" for target, e in kept]
    body += [f"{entry(row)} = {value}" for row, value in results.items()]
    blocks = ["W", *(["A"] if adjoint else []), *(["B"] if shared_rows else []), *([lane_index] if single_lane else [])]
    source = ["@scalar_jit", f"def {name}({', '.join([*blocks, *uniform])}):", f'    """{doc}"""']
    if lanes > 1 and not single_lane:
        source.append(f"    for {lane_index} in range({lanes}):")
    indent = "        " if lanes > 1 and not single_lane else "    "
    return "\n".join(source + [indent + line for line in body]) + "\n"


def print_sample(
    signature: str, model: Model, finish_call: str, step_function: str = "move", steps: str | None = None
) -> str:
    """Source of a function over a sample: ``begin(W)``, all Runge-Kutta steps, and the call that finishes it.

    Args:
        signature: name and arguments of the function.
        model: the equation; for a difference equation the function is ``finish_call`` alone.
        finish_call: the last call.
        step_function: name of ``step_function(W, TAU)``, one Runge-Kutta step from TAU in [0, 1) of the sample.
        steps: name of the argument with the number of steps, of which ``step_function`` takes the length too; None for
            the model's own number.
    """
    length = "" if steps is None else f", 1.0 / {steps}"
    steps = steps or str(model.substeps)
    body = ["begin(W)", f"for s in range({steps}):", f"    {step_function}(W, s / {steps}{length})"]
    body = [*(body if model.is_continuous else []), finish_call]
    return f"@scalar_jit\ndef {signature}:\n" + "".join(f"    {line}\n" for line in body)


def _without_dead_code(assignments: Assignments, wanted: set[str]) -> tuple[Assignments, set[str]]:
    """The assignments with effect on the wanted names, and the names that have to come from elsewhere."""
    kept: Assignments = []
    needed = set(wanted)
    for name, expression in reversed(assignments):
        if name in needed:
            kept.append((name, expression))
            needed |= {str(s) for s in expression.free_symbols}
    return kept[::-1], {name for name in needed - {target for target, _ in kept} if not is_numeral(name)}


def is_numeral(text: str) -> bool:
    """Whether a text is a number."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def print_scalar_function(
    name: str,
    assignments: Assignments,
    results: Sequence[Sequence[str]],
    arguments: Mapping[str, Sequence[str]],
    uniform: Sequence[str] = (),
    doc: str = "",
) -> str:
    """Source of ``name(*arguments, *uniform)`` on tuples of scalars, which stay in registers.

    Args:
        name: name of the function.
        assignments: in the order of execution; assignments without effect on the results are left out.
        results: for each returned tuple, the names (or numbers) of its entries; a single tuple is returned bare.
        arguments: name of a tuple to the names of its entries.
        uniform: further arguments, each a scalar.
        doc: docstring of the function.

    Raises:
        ValueError: for a name that is neither assigned nor an argument.
    """
    kept, used = _without_dead_code(assignments, {value for group in results for value in group})
    available = {held for group in arguments.values() for held in group} | set(uniform)
    if unknown := sorted(used - available):
        raise ValueError(f"{name} uses {unknown}, which are neither assigned nor arguments; add them to an argument")
    body = [f"({', '.join(held)},) = {group}" for group, held in arguments.items() if used & set(held)]
    body += [f"{target} = {print_expression(e)}" for target, e in kept]
    gathered = [f"({', '.join(group)},)" for group in results]
    source = ["@scalar_jit", f"def {name}({', '.join([*arguments, *uniform])}):", f'    """{doc}"""']
    return "\n".join([*source, *(f"    {line}" for line in body), f"    return {', '.join(gathered)}"]) + "\n"
