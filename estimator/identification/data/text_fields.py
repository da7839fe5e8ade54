"""Fields of a text file: numbers, missing and over-range values, dates and times of day."""

from __future__ import annotations

import math
import re
from datetime import date
from pathlib import Path

#: Words for a missing number, in lower case.
_MISSING_WORDS = ("", "na", "n/a", "#n/a", "null", "none", "-", "nan")

#: Words for a number beyond the range of an instrument, in lower case and without a sign.
_OVER_RANGE_WORDS = ("∞", "inf", "infinity", "1.#inf", "over", "overrange", "overload", "ol")

#: Separators in files whose numbers may have a decimal comma.
DECIMAL_COMMA_SEPARATORS = (";", "\t")

_DATE_PATTERN = r"(?:(\d{4})-(\d\d?)-(\d\d?)|(\d\d?)\.(\d\d?)\.(\d{4})|(\d\d?)/(\d\d?)/(\d{4}))"
_CLOCK_PATTERN = r"(\d\d?):(\d\d):(\d\d)(?:[.,](\d{1,12}))?"
_TIMESTAMP_PATTERN = re.compile(rf"\s*(?:{_DATE_PATTERN}[T ]\s*)?{_CLOCK_PATTERN}\s*(?:Z|UTC|[+-]\d\d:?\d\d)?\s*")


def parse_number(word: str, separator: str | None = None) -> float | None:
    """The number in a field; NaN for a missing one, ±inf for an over-range one, None for another text.

    Args:
        word: the field.
        separator: separator of the fields, beside some of which a comma is a decimal mark.

    Example:
        >>> parse_number("0,5", ";"), parse_number("-∞"), parse_number(" n/a "), parse_number("12:30:01")
        (0.5, -inf, nan, None)
    """
    bare = word.strip().lower()
    if bare in _MISSING_WORDS:
        return math.nan
    if bare.lstrip("+-") in _OVER_RANGE_WORDS:
        return -math.inf if bare.startswith("-") else math.inf
    if "_" in bare:  # separates thousands in Python alone
        return None
    if separator in DECIMAL_COMMA_SEPARATORS:
        bare = bare.replace(",", ".")
    try:
        value = float(bare)
    except ValueError:
        return None
    return None if math.isinf(value) else value


def parse_timestamp(word: str) -> tuple[int, float] | None:
    """Whole seconds and their fraction of a date with a time of day, or of a time of day; None of another text.

    One float64 of the seconds since year 1 would resolve microseconds only.

    Example:
        >>> first, second = parse_timestamp("2026-05-01T23:59:59.75Z"), parse_timestamp("02.05.2026 00:00:00,25")
        >>> second[0] - first[0] + second[1] - first[1]
        0.5
    """
    found = _TIMESTAMP_PATTERN.fullmatch(word)
    if found is None:
        return None
    year, month, day, day_2, month_2, year_2, month_3, day_3, year_3, hours, minutes, seconds, rest = found.groups()
    whole = int(hours) * 3600 + int(minutes) * 60 + int(seconds)
    if year or year_2 or year_3:
        try:
            when = date(int(year or year_2 or year_3), int(month or month_2 or month_3), int(day or day_2 or day_3))
        except ValueError:
            return None
        whole += when.toordinal() * 86400
    return whole, float(f"0.{rest or 0}")


def read_text(path: Path) -> str:
    """The text of a file in UTF-8, UTF-16 or Windows cp1252, the encodings of instruments and spreadsheets.

    Raises:
        ValueError: for a file that is no text.
    """
    content = path.read_bytes()
    if content[:2] in (b"\xff\xfe", b"\xfe\xff"):
        encoding = "utf-16"
    elif content[1:2] == b"\x00" and content[3:4] == b"\x00":
        encoding = "utf-16-le"
    else:
        try:
            content.decode("utf-8-sig")
            encoding = "utf-8-sig"
        except UnicodeDecodeError:
            encoding = "cp1252"
    try:
        text = content.decode(encoding)
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} must be text, but is none: {error}; save it as CSV UTF-8") from error
    strange = next((c for c in text[:65536] if ord(c) < 32 and c not in "\t\n\r\f\v"), None)
    if strange is not None:
        raise ValueError(f"{path} must be text, but holds the control character {strange!r}; save it as CSV UTF-8")
    return text
