"""Reverse-mode differentiation of assignments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import sympy as sp

from estimator.engine.symbolic import Assignments, symbol


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
        inverted = expression.base if expression.is_Pow and expression.exp == -1 else None
        for used in sorted(expression.free_symbols, key=str):
            # The slope of 1/x is -(1/x)², without another division.
            slope = sp.diff(expression, used) if inverted is None else -(symbol(name) ** 2) * sp.diff(inverted, used)
            adjoints.setdefault(str(used), []).append(slope * adjoint)
    lines += [(f"ADJ_{name}", sum(adjoints.get(name, []), sp.S.Zero)) for name in inputs]
    return lines
