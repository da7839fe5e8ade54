"""The factorisation L D Lᵀ of a symmetric matrix, as assignments."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import sympy as sp

from estimator.engine.algebra import select
from estimator.engine.derive import Assignments, symbol


class Factor(NamedTuple):
    """A factorisation.

    Attributes:
        lines: the assignments.
        below: (i, j) with j < i to the symbol of L's entry.
        pivots: the symbols of D.
        inverse: the symbols of 1/D.
    """

    lines: Assignments
    below: Mapping[tuple[int, int], Any]
    pivots: list[Any]
    inverse: list[Any]

    @property
    def determinant(self) -> Any:
        """Of the matrix."""
        return sp.Mul(*self.pivots)


def factorise(entries: Mapping[tuple[int, int], Any], size: int, tag: str, known: bool = False) -> Factor:
    """Factorise a matrix.

    Args:
        entries: (i, j) with j <= i to the entry.
        size: of the matrix.
        tag: of the names that are assigned.
        known: whether a pivot may be 0, of what is known; it counts as 1.
    """
    lines: Assignments = []
    below: dict[tuple[int, int], Any] = {}
    scaled: dict[tuple[int, int], Any] = {}  # L D
    pivots: list[Any] = []
    inverse: list[Any] = []
    for i in range(size):
        for j in range(i + 1):
            rest = entries[i, j] - sum(below[i, m] * scaled[j, m] for m in range(j))
            scaled[i, j] = symbol(f"{tag}D_{i}_{j}")
            if j == i and known:
                left = symbol(f"{tag}R_{i}")
                lines.append((f"{tag}R_{i}", rest))
                rest = select(left**2, left, sp.S.One)
            lines.append((f"{tag}D_{i}_{j}", rest))
            if j < i:
                below[i, j] = symbol(f"{tag}L_{i}_{j}")
                lines.append((f"{tag}L_{i}_{j}", scaled[i, j] * inverse[j]))
        pivots.append(scaled[i, i])
        inverse.append(symbol(f"{tag}I_{i}"))
        lines.append((f"{tag}I_{i}", 1 / pivots[i]))
    return Factor(lines, below, pivots, inverse)
