"""LDLᵀ factorisation of a symmetric matrix, as assignments."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import sympy as sp

from estimator.engine.branch_functions import select
from estimator.engine.symbolic import Assignments, symbol


class LdlFactors(NamedTuple):
    """An LDLᵀ factorisation.

    Attributes:
        lines: the assignments.
        lower: (i, j) with j < i to the symbol of L's entry.
        pivots: symbols of D.
        inverse: symbols of 1/D.
    """

    lines: Assignments
    lower: Mapping[tuple[int, int], Any]
    pivots: list[Any]
    inverse: list[Any]

    @property
    def determinant(self) -> Any:
        """Determinant of the matrix."""
        return sp.Mul(*self.pivots)


def ldl_factorise(
    entries: Mapping[tuple[int, int], Any], size: int, name_prefix: str, allow_zero_pivots: bool = False
) -> LdlFactors:
    """Factorise a matrix.

    Args:
        entries: (i, j) with j <= i to the entry.
        size: number of rows.
        name_prefix: prefix of the assigned names.
        allow_zero_pivots: whether a pivot of 0 counts as 1, for quantities of variance 0.
    """
    lines: Assignments = []
    lower: dict[tuple[int, int], Any] = {}
    scaled: dict[tuple[int, int], Any] = {}  # L D
    pivots: list[Any] = []
    inverse: list[Any] = []
    for i in range(size):
        for j in range(i + 1):
            rest = entries[i, j] - sum(lower[i, m] * scaled[j, m] for m in range(j))
            scaled[i, j] = symbol(f"{name_prefix}D_{i}_{j}")
            if j == i and allow_zero_pivots:
                candidate_pivot = symbol(f"{name_prefix}R_{i}")
                lines.append((f"{name_prefix}R_{i}", rest))
                rest = select(candidate_pivot**2, candidate_pivot, sp.S.One)
            lines.append((f"{name_prefix}D_{i}_{j}", rest))
            if j < i:
                lower[i, j] = symbol(f"{name_prefix}L_{i}_{j}")
                lines.append((f"{name_prefix}L_{i}_{j}", scaled[i, j] * inverse[j]))
        pivots.append(scaled[i, i])
        inverse.append(symbol(f"{name_prefix}I_{i}"))
        lines.append((f"{name_prefix}I_{i}", 1 / pivots[i]))
    return LdlFactors(lines, lower, pivots, inverse)
