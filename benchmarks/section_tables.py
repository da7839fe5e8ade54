"""Tables of the benchmark's sections, printed and written: ratios first, then rows, then notes."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from benchmarks.timed_rounds import Result


@dataclass(frozen=True)
class Claim:
    """A ratio or a figure that a reader wants first, with the bar it is to clear where there is one.

    Attributes:
        text: what it is.
        value: NaN where what it is made from is not available.
        bar: its target, if it has one.
        at_most: whether the value is to stay below the bar.
        unit: printed behind the value; ``×`` for ratios.
    """

    text: str
    value: float
    bar: float | None = None
    at_most: bool = False
    unit: str = "×"

    @property
    def verdict(self) -> str:
        """PASS, MISS, ``not available``, or nothing without a bar."""
        if math.isnan(self.value):
            return "not available"
        if self.bar is None:
            return ""
        return "PASS" if (self.value <= self.bar if self.at_most else self.value >= self.bar) else "MISS"

    def __str__(self) -> str:
        bar = "" if self.bar is None else f"  ({'at most' if self.at_most else 'at least'} {self.bar:g})"
        return f"{self.verdict:<6}{_number(self.value):>9} {self.unit:<3} {self.text}{bar}"


@dataclass(frozen=True)
class Section:
    """One part of the benchmark, finished."""

    title: str
    results: Sequence[Result]
    claims: Sequence[Claim] = ()
    notes: Sequence[str] = ()
    data: dict[str, Any] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """For the JSON file."""
        return {
            "claims": [{**vars(claim), "verdict": claim.verdict} for claim in self.claims],
            "rows": [result.to_dict() for result in self.results],
            "notes": list(self.notes),
            "data": self.data,
        }


def ratio(over: Result, under: Result) -> float:
    """Ratio of medians, NaN where one is missing.

    Medians, and not the median of per-round ratios: a round is too short for its rows to have met the same weather.
    """
    return over.median / under.median


def print_section(section: Section) -> None:
    """Print a finished section."""
    print(f"\n== {section.title}\n")
    for claim in section.claims:
        print(claim)
    if section.claims and section.results:
        print()
    width = max((len(result.name) for result in section.results), default=0)
    for result in section.results:
        if result.values:
            low, high = _number(min(result.values)), _number(max(result.values))
            figures = f"{_number(result.median):>9} {result.unit:<12} [{low}, {high}]"
        else:
            figures = f"not available: {result.reason}"
        print(f"{result.name:<{width}}  {figures}")
    for note in section.notes:
        print(f"\n{note}")


def print_verdicts(sections: Sequence[Section]) -> None:
    """Print every claim that has a bar, once more, together."""
    print("\n== Targets\n")
    for section in sections:
        for claim in section.claims:
            if claim.bar is not None:
                print(claim)


def _number(value: float) -> str:
    """Three significant digits, with k, M and G above a thousand."""
    if math.isnan(value):
        return "-"
    rounded = float(f"{value:.3g}")
    for limit, suffix in ((1e9, " G"), (1e6, " M"), (1e3, " k"), (1.0, "")):
        if abs(rounded) >= limit:
            return f"{rounded / limit:#.3g}".rstrip(".") + suffix
    return f"{rounded:g}"
