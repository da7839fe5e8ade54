"""Reverse-mode differentiation of assignments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import sympy as sp

from estimator.engine.branch_functions import positive_part, select
from estimator.engine.symbolic import HALF, ZERO, Assignments, symbol


def reverse_mode_derivative(
    assignments: Assignments, inputs: Sequence[str], result_adjoints: Mapping[str, str]
) -> Assignments:
    """Reverse-mode differentiation of assignments: adjoints ``ADJ_<name>`` of ``inputs``.

    Args:
        assignments: forward, each name assigned once.
        inputs: names whose adjoints are wanted.
        result_adjoints: result to the name of its adjoint.

    Returns:
        Assignments to execute after the forward ones; the adjoints of ``inputs`` come last.

    Raises:
        ValueError: for a name that is assigned twice.
    """
    if len({name for name, _ in assignments}) < len(assignments):
        raise ValueError("assignments must assign every name once for the reverse derivative; rename the second")
    adjoints: dict[str, list[sp.Expr]] = {name: [symbol(seed)] for name, seed in result_adjoints.items()}
    lines: Assignments = []
    for name, expression in reversed(assignments):
        parts = adjoints.pop(name, None)
        if parts is None:
            continue
        adjoint = symbol(f"ADJ_{name}")
        lines.append((str(adjoint), sum(parts, sp.S.Zero)))
        base, factor = _outer_slope(name, expression)
        for used in sorted(expression.free_symbols, key=str):
            slope = factor * sp.diff(base, used)
            adjoints.setdefault(str(used), []).append(slope * adjoint)
    lines += [(f"ADJ_{name}", sum(adjoints.get(name, []), sp.S.Zero)) for name in inputs]
    return lines


def _outer_slope(name: str, expression: sp.Expr) -> tuple[sp.Expr, sp.Expr]:
    """An inner part of an expression, and the expression's slope by it, from the value that has been assigned."""
    if expression.is_Pow and expression.exp == -1:  # -(1/x)², without another division
        return expression.base, -(symbol(name) ** 2)
    if expression.is_Pow and expression.exp == HALF and isinstance(expression.base, positive_part):
        return expression.base, select(symbol(name), HALF / symbol(name), ZERO)  # finite at 0, where the value stays
    return expression, sp.S.One
