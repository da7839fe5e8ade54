"""From assignments to Python source that Numba compiles across lanes: the only module that knows how code is written.

All quantities of some independent systems lie in one flat float64 array, the *block* ``W``: the quantity in row r of
lane j is ``W[r * lanes + j]``. One array with constant offsets is what makes the loop over the lanes vectorise.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import sympy as sp
from sympy.printing.pycode import PythonCodePrinter

from estimator.engine.symbolic import Assignments
from estimator.models.model import Model

#: Functions that are written out: a call is compiled on its own, and costs more than what it does. Arguments that stand
#: there twice must be names.
_INLINE_TEMPLATES = {
    "present": "(1.0 if {0} == {0} else 0.0)",
    "finite": "(1.0 if {0} - {0} == 0.0 else 0.0)",
    "below": "(0.0 if {0} >= 0.0 else 1.0)",
    "positive": "(1.0 if {0} > 0.0 else 0.0)",
    "rectified": "(0.0 if {0} < 0.0 else {0})",
    "reaches": "(1.0 if {0} >= {1} else 0.0)",
    "select": "({1} if {0} > 0.0 else {2})",
    "clip": "({1} if not {0} > {1} else ({0} if {0} < {2} else {2}))",
}


class _NumbaPrinter(PythonCodePrinter):
    """Floats for numbers, products for small powers, bare names for functions."""

    def _print_Integer(self, expr: sp.Integer) -> str:
        return f"{int(expr)}.0"

    def _print_Rational(self, expr: sp.Rational) -> str:
        return repr(float(expr))

    def _print_Float(self, expr: sp.Float) -> str:
        return repr(float(expr))

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
        if name in _INLINE_TEMPLATES:
            return _INLINE_TEMPLATES[name].format(*given)
        return f"{name}({', '.join(given)})"

    _print_sin = _print_cos = _print_tanh = _print_exp = _print_log = _print_sign = _print_Function

    def _print_DiracDelta(self, expr: sp.DiracDelta) -> str:
        # The slope of a sign, which no number is: it is 0 but at the jump, where a sign counts as 0, too.
        return "0.0"


_PRINTER = _NumbaPrinter({"fully_qualified_modules": False})


def print_expression(expression: sp.Expr) -> str:
    """Python source of an expression."""
    return str(_PRINTER.doprint(expression))


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
) -> str:
    """Source of a straight ``name(W, *uniform)``, which executes assignments in every lane of a block.

    Args:
        name: of the function.
        assignments: in the order of execution; those that no result needs are left out.
        results: row to the name (or number) whose value it receives.
        layout: row to its number, or to an expression of it in uniform names. Rows that the assignments use are read
            first.
        lanes: systems in a block; the loop is left out for 1.
        uniform: names that are the same in all lanes, and become arguments.
        doc: a line for the reader.
        single_lane: write ``name(W, j, *uniform)``, for lane j alone.
        shared_rows: rows of another block ``B``, the second argument, whose memory many blocks may share.

    Raises:
        ValueError: for a name that is neither assigned, nor a row, nor uniform.
    """
    kept, used = _without_dead_code(assignments, set(results.values()))
    clashing = sorted({target for target, _ in kept} & set(layout))
    if clashing:
        raise ValueError(f"{name} assigns {clashing}, which are rows; give the results other names first")
    read = sorted(used - set(uniform), key=lambda row: (str(layout.get(row.removeprefix("G_"))), row))
    adjoint = any(row not in layout and row.removeprefix("G_") in layout for row in (*read, *results))

    def entry(row: str) -> str:
        """Where a row lies; the adjoint of a row, ``G_<row>``, lies in the same place of the block ``A``."""
        if shared_rows and row in shared_rows:
            return f"B[{shared_rows[row] * lanes}{' + LANE' if lanes > 1 else ''}]"
        block, bare = ("W", row) if row in layout else ("A", row.removeprefix("G_"))
        if bare not in layout:
            raise ValueError(f"{name} uses {row}, which no line assigns, no row holds and no argument brings")
        row_number = layout[bare]
        start = str(row_number * lanes) if isinstance(row_number, int) else f"({row_number}) * {lanes}"
        return f"{block}[{start}{' + LANE' if lanes > 1 else ''}]"

    body = [f"{row} = {entry(row)}" for row in read]
    body += [f"{target} = {print_expression(e)}" for target, e in kept]
    body += [f"{entry(row)} = {value}" for row, value in results.items()]
    blocks = ["W", *(["A"] if adjoint else []), *(["B"] if shared_rows else []), *(["LANE"] if single_lane else [])]
    source = ["@scalar_jit", f"def {name}({', '.join([*blocks, *uniform])}):", f'    """{doc}"""']
    if lanes > 1 and not single_lane:
        source.append(f"    for LANE in range({lanes}):")
    indent = "        " if lanes > 1 and not single_lane else "    "
    return "\n".join(source + [indent + line for line in body]) + "\n"


def print_sample(signature: str, model: Model, finish_call: str, step_function: str = "move") -> str:
    """Source of a straight function over a sample: ``begin(W)``, all steps ``step_function(W, T)``, and the ``finish_call``.

    Of a difference equation the end is all.
    """
    steps = model.substeps
    body = ["begin(W)", f"for s in range({steps}):", f"    {step_function}(W, s / {steps})"]
    body = [*(body if model.is_continuous else []), finish_call]
    return f"@scalar_jit\ndef {signature}:\n" + "".join(f"    {line}\n" for line in body)


def _without_dead_code(assignments: Assignments, wanted: set[str]) -> tuple[Assignments, set[str]]:
    """The assignments that what is wanted depends on, and the names that these and it need from elsewhere."""
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
    """Source of a straight ``name(*arguments, *uniform)`` of tuples of scalars, which stay in registers.

    Args:
        name: of the function.
        assignments: in the order of execution; those that no result needs are left out.
        results: the names (or numbers) that each tuple returned holds; one tuple is returned by itself.
        arguments: name of a tuple to the names that it holds.
        uniform: further arguments, each a scalar.
        doc: a line for the reader.

    Raises:
        ValueError: for a name that is neither assigned nor an argument.
    """
    kept, used = _without_dead_code(assignments, {value for group in results for value in group})
    available = {held for group in arguments.values() for held in group} | set(uniform)
    if unknown := sorted(used - available):
        raise ValueError(f"{name} uses {unknown}, which no line assigns and no argument brings")
    body = [f"({', '.join(held)},) = {group}" for group, held in arguments.items() if used & set(held)]
    body += [f"{target} = {print_expression(e)}" for target, e in kept]
    gathered = [f"({', '.join(group)},)" for group in results]
    source = ["@scalar_jit", f"def {name}({', '.join([*arguments, *uniform])}):", f'    """{doc}"""']
    return "\n".join([*source, *(f"    {line}" for line in body), f"    return {', '.join(gathered)}"]) + "\n"
