"""Records of instruments are identified, or their fault is named; the manual has the answer to each."""

from dataclasses import replace
from pathlib import Path

import pytest
from cases import CASES, Case, answered
from tables import table

#: Kinds with a required answer, to their first case; tests/research runs all cases of all kinds, twice.
ANSWERED = {case.kind: case for case in reversed(CASES) if case.answer == "right" and not case.then}


@pytest.mark.parametrize("case", ANSWERED.values(), ids=str)
def test_a_record_of_an_instrument_is_identified_or_its_fault_is_named(case, tmp_path):
    case.check(tmp_path)


@table(
    ("case", "interpolation", "delay", "verdict", "name"),
    [
        (Case("voice_coil", {}, ""), "linear", 1, "named", "interpolation"),  # which resembles what is held and lags
        (Case("half_sample", {"smoothly": True, "part": 0.75, "samples": 2000}, ""), "spline", -0.75, "right", ""),
    ],
)
def test_the_interpolation_that_a_check_advised_is_judged_again(tmp_path, case, interpolation, delay, verdict, name):
    made = replace(case.make(), interpolation=interpolation, delay=delay)
    found, result = next(answered(made, tmp_path))
    assert (found, [warning.name for warning in result.warnings][:1]) == (verdict, [name] if name else [])


def test_two_amplitudes_of_a_sine_identify_what_one_leaves_open(tmp_path):
    one, other = (Case("settled_sine", {"part": 0.8, "size": size}, "", seed=4).make() for size in (0.3, 0.9))
    both = replace(one, files={"one.csv": one.files["r.csv"], "other.csv": other.files["r.csv"]})
    assert next(answered(one, tmp_path))[1].unidentified == ("m", "a", "b")
    verdict, result = next(answered(both, tmp_path))
    assert (verdict, result.unidentified) == ("right", ())


def test_the_manual_has_the_answer_to_every_case():
    page = (Path(__file__).parents[2] / "docs" / "evidence" / "cases.md").read_text(encoding="utf-8")
    rows = [[cell.strip(" `") for cell in line.split("|")[1:-1]] for line in page.splitlines() if line.startswith("| ")]
    assert rows[1:] == [[str(case), case.answer, case.then] for case in CASES]
