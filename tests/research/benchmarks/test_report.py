import math

import pytest

from benchmarks.section_tables import Claim, Section, print_section, print_verdicts, ratio
from benchmarks.timed_rounds import Result

FAST, SLOW = Result("fast", "env-steps/s", (9e6, 1e7, 1.1e7)), Result("slow", "env-steps/s", (1e6, 1.2e6, 9e5))
MISSING = Result("missing", "env-steps/s", reason="ImportError: No module named 'envpool'")


@pytest.mark.parametrize(
    ("claim", "verdict"),
    [
        (Claim("", 8.0, bar=8), "PASS"),
        (Claim("", 7.9, bar=8), "MISS"),
        (Claim("", 0.7, bar=0.7, at_most=True), "PASS"),
        (Claim("", 0.71, bar=0.7, at_most=True), "MISS"),
        (Claim("", math.nan, bar=8), "not available"),
        (Claim("", 3.0), ""),
    ],
)
def test_verdicts(claim: Claim, verdict: str) -> None:
    assert claim.verdict == verdict


def test_ratios_are_of_medians() -> None:
    assert ratio(FAST, SLOW) == pytest.approx(10.0)
    assert math.isnan(ratio(FAST, MISSING))


def test_a_section_prints_ratios_first_and_says_what_is_missing(capsys: pytest.CaptureFixture[str]) -> None:
    section = Section("Steps", [FAST, MISSING], [Claim("fast over slow", 10.0, bar=8)], ["A note."])
    print_section(section)
    lines = [line for line in capsys.readouterr().out.splitlines() if line]
    assert lines[0] == "== Steps"
    assert lines[1].split() == ["PASS", "10.0", "×", "fast", "over", "slow", "(at", "least", "8)"]
    assert lines[2].split() == ["fast", "10.0", "M", "env-steps/s", "[9.00", "M,", "11.0", "M]"]
    assert lines[3].split(maxsplit=1) == ["missing", "not available: ImportError: No module named 'envpool'"]
    assert lines[4] == "A note."


def test_targets_are_claims_with_a_bar(capsys: pytest.CaptureFixture[str]) -> None:
    print_verdicts([Section("Steps", [], [Claim("with", 1.0, bar=2), Claim("without", 1.0)])])
    printed = capsys.readouterr().out
    assert "MISS" in printed
    assert "without" not in printed


@pytest.mark.parametrize(
    ("value", "printed"),
    [(0.00123, "0.00123"), (0.0716, "0.0716"), (7.16, "7.16"), (71.6, "71.6"), (999.6, "1.00 k"), (1.2e7, "12.0 M")],
)
def test_numbers_have_three_digits(value: float, printed: str) -> None:
    assert f" {printed} " in str(Claim("text", value))
