"""Tables of the benchmark's sections: ratios, then rows, then notes."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from benchmarks.timed_rounds import Result


@dataclass(frozen=True)
class Claim:
    """A ratio or a number that a reader wants first, with its bar if it has one.

    Attributes:
        text: its name.
        value: its value; NaN where a row that it needs is not available.
        bar: the value to reach, or not to exceed.
        at_most: whether the bar must not be exceeded.
        unit: its unit; ``×`` for ratios.
    """

    text: str
    value: float
    bar: float | None = None
    at_most: bool = False
    unit: str = "×"

    @property
    def verdict(self) -> str:
        """PASS, MISS, ``not available``, or empty without a bar."""
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
    """Results of one section of the benchmark."""

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

    Medians, not the median of ratios of rounds: even within a round the machine's load changes.
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
    """Print all claims that have a bar."""
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
