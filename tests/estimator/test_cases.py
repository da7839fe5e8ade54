"""Records as people have them are right, or named for the right reason; and the manual says which is which."""

from pathlib import Path

import pytest
from cases import CASES

#: Kind to its first case; tests/research has all.
FIRST = {case.kind: case for case in reversed(CASES)}


@pytest.mark.parametrize("case", [case for case in CASES if FIRST[case.kind] is case], ids=str)
def test_a_record_as_people_have_it_is_right_or_named(case, tmp_path):
    case.check(tmp_path)


def test_the_manual_has_the_answer_to_every_case():
    page = (Path(__file__).parents[2] / "docs" / "cases.md").read_text(encoding="utf-8")
    rows = [[cell.strip(" `") for cell in line.split("|")[1:-1]] for line in page.splitlines() if line.startswith("| ")]
    assert rows[1:] == [[str(case), case.answer, case.then] for case in CASES]
