"""All records as people have them, of which `make test` runs one of each kind that must be answered."""

from dataclasses import replace

import pytest
from cases import CASES


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("case", CASES, ids=str)
def test_a_record_as_people_have_it_is_right_or_named(case, seed, tmp_path):
    replace(case, seed=seed).check(tmp_path)
