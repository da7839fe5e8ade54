"""Printing loops over packed arrays: matrices whose entries are rows of a block, row by row.

A matrix of many rows as straight lines takes LLVM minutes; as a loop its source does not grow with the matrix.
`estimator.engine.printer_numba` prints what a model's own expressions need.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from estimator.compilation.scalar_jit.llvm_translation import INDEPENDENT_INDEX


class PackedArrays:
    """Source of statements on matrices in a block's rows.

    Args:
        layout: row number of each quantity; entries of a matrix follow one another.
        lanes: lanes of the block.
    """

    def __init__(self, layout: Mapping[str, int], lanes: int) -> None:
        self.layout, self.lanes = layout, lanes

    def entry(self, first_row: str, offset: str | int = 0) -> str:
        """The entry ``offset`` rows after a row, in the lane of the loop."""
        place = self.layout[first_row] * self.lanes
        shift = "" if offset == 0 else f" + ({offset})*{self.lanes}"
        return f"W[{place}{shift}{f' + {INDEPENDENT_INDEX}' if self.lanes > 1 else ''}]"

    def over_lanes(self, statements: Iterable[str]) -> list[str]:
        """Lines that execute statements in every lane."""
        return (
            nested([f"for {INDEPENDENT_INDEX} in range({self.lanes}):"], statements)
            if self.lanes > 1
            else list(statements)
        )

    def loop(self, ranges: Mapping[str, str | int], *statements: str) -> list[str]:
        """Lines of nested loops, over index names with their ends, and over the lanes within."""
        return nested([f"for {index} in range({end}):" for index, end in ranges.items()], self.over_lanes(statements))

    def copy(self, to_row: str, from_row: str, size: int) -> list[str]:
        """Lines that copy ``size`` rows."""
        return self.loop({"I": size}, f"{self.entry(to_row, 'I')} = {self.entry(from_row, 'I')}")


def nested(heads: Iterable[str], body: Iterable[str]) -> list[str]:
    """Lines of a body within loops, indented."""
    lines, indent = [], ""
    for head in heads:
        lines.append(indent + head)
        indent += "    "
    return lines + [indent + line for line in body]


def define(signature: str, doc: str, lines: Iterable[str]) -> str:
    """Source of a function of lines."""
    head = ["@scalar_jit", f"def {signature}:", f'    """{doc}"""']
    return "\n".join([*head, *(f"    {line}" for line in lines)]) + "\n"


def sum_of(terms: Iterable[str]) -> str:
    """Source of a sum; ``0.0`` without terms."""
    return " + ".join(terms) or "0.0"


def upper_triangle_offset(n: int, row: str, column: str) -> str:
    """Offset of an entry in the packed upper triangle of an n × n matrix; the row is at most the column."""
    return f"{row}*({2 * n - 1} - {row})//2 + {column}"
