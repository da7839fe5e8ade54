"""Rows of a text table: separator, headings, numbers, dates and times of day."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np

from estimator.identification.data.column_units import is_unit
from estimator.identification.data.text_fields import DECIMAL_COMMA_SEPARATORS, parse_number, parse_timestamp
from estimator.support.array_types import FloatArray

#: A number, or the whole seconds and their fraction of a timestamp.
TableValue: TypeAlias = float | tuple[int, float]

#: Lines of numbers in a row that mark the beginning of the numbers.
_N_FIRST_ROWS = 3


def guess_separator(lines: Sequence[str]) -> str | None:
    """The separator of the fields, by the last lines, which hold numbers; None for blanks."""
    last = "".join(lines[-2:])
    return next((mark for mark in "\t;," if mark in last), None)


def split_fields(lines: Sequence[str], separator: str | None) -> list[list[str]]:
    """The fields of each line."""
    if separator is None:
        return [line.split() for line in lines]
    return list(csv.reader(lines, delimiter=separator))


def _is_number_row(words: Sequence[str], separator: str | None) -> bool:
    """Whether a line holds numbers, missing numbers and timestamps alone, and at least one number."""
    values = [parse_number(word, separator) for word in words]
    return any(value is not None and math.isfinite(value) for value in values) and all(
        value is not None or parse_timestamp(word) for word, value in zip(words, values, strict=True)
    )


def find_first_row(fields: Sequence[Sequence[str]], separator: str | None) -> int | None:
    """Index of the first of several lines in a row that hold the same number of numbers; None without numbers."""
    for k, words in enumerate(fields):
        following = [one for one in fields[k : k + 2 * _N_FIRST_ROWS] if any(word.strip() for word in one)][
            :_N_FIRST_ROWS
        ]
        alike = all(len(one) == len(words) and _is_number_row(one, separator) for one in following)
        if len(following) > 1 and _is_number_row(words, separator) and alike:
            return k
    # A file with few lines, or with a faulty line among the first.
    return next((k for k, words in enumerate(fields) if _is_number_row(words, separator)), None)


def read_headings(
    path: Path, fields: Sequence[list[str]], line_numbers: Sequence[int], width: int, separator: str | None
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names and units above the numbers; empty where the file has none.

    Args:
        path: the file, for messages.
        fields: fields of the lines above the numbers.
        line_numbers: their line numbers.
        width: number of columns.
        separator: of the fields.

    Raises:
        ValueError: for a faulty line above the numbers.
    """
    headings = list[tuple[list[str], int]]()
    for words, line in zip(reversed(fields), reversed(line_numbers[: len(fields)]), strict=True):
        stripped = [word.strip() for word in words]
        while len(stripped) > width and not stripped[-1]:
            stripped.pop()
        values = [parse_number(word, separator) for word in stripped]
        if any(value is not None and not math.isnan(value) for value in values):
            if not headings and len(stripped) == width:
                bad = stripped[values.index(None)] if None in values else stripped[0]
                raise ValueError(f"{path}, line {line}: {bad!r:.40} must be a number; {_number_remedy(bad)}")
            break
        headings.append((stripped, line))
        if len(headings) == 1 and len(stripped) == width and all(map(is_unit, stripped)):
            continue
        break
    if not headings:
        return (), ()
    (words, line), *above = headings
    units: tuple[str, ...] = ()
    if above and len(above[0][0]) >= width:
        units, (words, line) = tuple(words), above[0]
    if len(words) < width:
        raise ValueError(f"{path}, line {line}: must have {width} names, but has {len(words)}; mend the line")
    return tuple(words[:width]), units


def parse_rows(
    path: Path, fields: Sequence[list[str]], line_numbers: Sequence[int], separator: str | None
) -> list[list[TableValue]]:
    """The numbers and timestamps of each line.

    Args:
        path: the file, for messages.
        fields: fields of the lines.
        line_numbers: their line numbers.
        separator: of the fields.

    Raises:
        ValueError: naming the line, for a field that is neither, or for another number of fields.
    """
    width, decimal_mark, rows = len(fields[0]), "", list[list[TableValue]]()
    for line, words in zip(line_numbers, fields, strict=True):
        if not any(word.strip() for word in words):
            rows.append([math.nan] * width)
            continue
        if len(words) > width and not any(word.strip() for word in words[width:]):
            words = words[:width]
        if len(words) != width:
            raise ValueError(f"{path}, line {line}: must have {width} columns, but has {len(words)}; mend the line")
        row = list[TableValue]()
        for word in words:
            number = parse_number(word, separator)
            value = parse_timestamp(word) if number is None else number
            if value is None:
                raise ValueError(f"{path}, line {line}: {word!r:.40} must be a number; {_number_remedy(word)}")
            row.append(value)
        for word, field in zip(words, row, strict=True) if separator in DECIMAL_COMMA_SEPARATORS else ():
            if isinstance(field, tuple):
                continue
            decimal_mark = decimal_mark or next((one for one in ",." if one in word), "")
            if decimal_mark and {",": ".", ".": ","}[decimal_mark] in word:
                raise ValueError(
                    f"{path}, line {line}: {word!r:.40} must have the decimal mark {decimal_mark!r} alone, as before; "
                    f"leave out marks of thousands"
                )
        rows.append(row)
    return rows


def timestamps_to_seconds(
    path: Path, rows: Sequence[Sequence[TableValue]], line_numbers: Sequence[int], names: Sequence[str]
) -> tuple[FloatArray, frozenset[int]]:
    """Columns (C, T) with timestamps as seconds from the first on, and the set of timestamp columns.

    Args:
        path: the file, for messages.
        rows: numbers and timestamps of each line.
        line_numbers: line numbers of the rows.
        names: names of the columns; empty where the file has none.

    Raises:
        ValueError: for a column that mixes timestamps and numbers.
    """
    first = rows[0]
    if not any(isinstance(value, tuple) for row in rows[:1] for value in row):
        for line, row in zip(line_numbers, rows, strict=True):
            if any(isinstance(value, tuple) for value in row):
                raise ValueError(f"{path}, line {line}: must hold numbers as the lines before, but holds a time of day")
        return np.array(rows, dtype=np.float64).T, frozenset()
    timestamp_columns = frozenset(k for k, value in enumerate(first) if isinstance(value, tuple))
    columns = np.empty((len(first), len(rows)))
    for k in range(len(first)):
        before = days = 0
        start = first[k]
        start_whole, start_rest = start if isinstance(start, tuple) else (0, 0.0)
        for t, row in enumerate(rows):
            value = row[k]
            if k not in timestamp_columns or not isinstance(value, tuple):
                if isinstance(value, tuple) or (k in timestamp_columns and not math.isnan(value)):
                    name = names[k] if names else f"column {k + 1}"
                    raise ValueError(
                        f"{path}, line {line_numbers[t]}: {name!r:.40} must hold dates or times of day throughout, or "
                        f"numbers; mend the line"
                    )
                columns[k, t] = value
                continue
            whole, rest = value
            if whole < 86400 and before - whole > 43200:  # past midnight, in times of day without a date
                days += 86400
            before = whole
            columns[k, t] = (whole + days - start_whole) + (rest - start_rest)
    return columns, timestamp_columns


def parse_regular_rows(lines: Sequence[str], separator: str | None, width: int) -> list[list[float]] | None:
    """The numbers of lines that hold finite numbers alone, many times faster than `parse_rows`; None of other lines."""
    if separator in DECIMAL_COMMA_SEPARATORS and any("," in line for line in lines):
        if any("." in line for line in lines):
            return None
        lines = [line.replace(",", ".") for line in lines]
    try:
        values = np.loadtxt(lines, delimiter=separator, comments=None, ndmin=2)
    except ValueError:
        return None
    return values.tolist() if values.shape[1] == width and np.isfinite(values).all() else None


def _number_remedy(word: str) -> str:
    """The remedy for a field that is no number."""
    if {",", "."} <= set(word):
        return "leave out marks of thousands"
    if re.fullmatch(r"\s*[-+]?\d+,\d+\s*", word):
        return "beside decimal commas let semicolons or tabs separate the fields"
    return "leave it empty where it is missing"
