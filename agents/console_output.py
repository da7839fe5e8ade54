"""Printing of wrapped texts, warnings and tables on a terminal."""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, TextIO

from estimator.support.argument_checks import mask_control_codes
from estimator.support.progress import MAX_LINE_WIDTH

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

#: Width in which the width of a table is measured [characters].
_UNBOUNDED_WIDTH = 10_000

#: Largest width of a label [characters].
_MAX_LABEL_WIDTH = 32


def rich_console() -> Console:
    """A console of rich, as wide as the terminal, but at most `MAX_LINE_WIDTH`."""
    from rich.console import Console

    made = Console(highlight=False, markup=False, emoji=False)
    made.width = min(MAX_LINE_WIDTH, made.width)
    return made


def print_in_80_columns(text: str, file: TextIO | None = None) -> None:
    """Print a text in lines of at most `MAX_LINE_WIDTH` characters; a longer word, such as a path, is not broken."""
    for line in mask_control_codes(text, "\n").split("\n"):
        whole = textwrap.wrap(line, MAX_LINE_WIDTH, break_long_words=False, break_on_hyphens=False)
        print("\n".join(whole), file=file)


def print_warning(text: str) -> None:
    """Print a warning on stderr."""
    print_in_80_columns(f"duffing-env: warning: {text}", sys.stderr)


def print_texts_and_tables(*parts: str | list[Table]) -> None:
    """Print texts (`print_in_80_columns`) and tables (`format_table`)."""
    for part in parts:
        if isinstance(part, str):
            print_in_80_columns(part)
        else:
            for k, one_table in enumerate(part):
                if k:
                    print()
                rich_console().print(one_table)


def format_table(
    headings: Sequence[str],
    rows: Iterable[Sequence[str]],
    *,
    markdown: bool = False,
    title: str = "",
    n_labels: int = 1,
) -> list[Table]:
    """A table of texts for `print_texts_and_tables`: the first column left-aligned, the others right-aligned.

    A table wider than `MAX_LINE_WIDTH` is split into several, which begin with the same columns.

    Args:
        headings: of the columns.
        rows: cells of the rows; a shorter row is filled with empty cells.
        markdown: whether to format the table as Markdown.
        title: above the table.
        n_labels: number of first columns that name a row, and are in each of several tables.
    """
    from rich.box import MARKDOWN, SIMPLE_HEAD
    from rich.table import Table

    cells = [[mask_control_codes(cell, "\n") for cell in row] + [""] * (len(headings) - len(row)) for row in rows]

    def make_table(columns: Sequence[int]) -> Table:
        rich_table = Table(
            box=MARKDOWN if markdown else SIMPLE_HEAD, show_edge=markdown, padding=(0, 1) if markdown else (0, 1, 0, 0),
            title=title or None,
        )  # fmt: skip
        for column in columns:
            below = "\n".join(cell for row in cells for cell in row[column : column + 1]).splitlines()
            width = max([7, *map(len, below)])
            broken = (textwrap.fill(line, width, break_long_words=False) for line in headings[column].splitlines())
            heading = headings[column] if markdown else "\n".join(broken)
            is_label = column < n_labels
            rich_table.add_column(
                heading, justify="left" if markdown or column == 0 else "right", overflow="fold",
                max_width=_MAX_LABEL_WIDTH if is_label else None,
            )  # fmt: skip
        for row in cells:
            rich_table.add_row(*(row[column] for column in columns))
        return rich_table

    return split_to_width(make_table, len(headings), n_labels)


def split_to_width(make_table: Callable[[Sequence[int]], Table], n_columns: int, n_labels: int = 1) -> list[Table]:
    """Split a table into several, each at most `MAX_LINE_WIDTH` wide.

    Args:
        make_table: makes the table of some columns.
        n_columns: number of columns of the whole table.
        n_labels: number of first columns, which each table has.
    """
    from rich.console import Console
    from rich.measure import Measurement

    unbounded_console, max_width = Console(width=_UNBOUNDED_WIDTH, markup=False, emoji=False), rich_console().width
    first, groups = list(range(n_labels)), [list[int]()]
    for column in range(n_labels, n_columns):
        candidate = make_table([*first, *groups[-1], column])
        if groups[-1] and Measurement.get(unbounded_console, unbounded_console.options, candidate).maximum > max_width:
            groups.append([])
        groups[-1].append(column)
    tables = [make_table([*first, *group]) for group in groups]
    for later in tables[1:]:
        later.title = None
    for earlier in tables[:-1]:
        earlier.caption = None
    return tables
