"""All records of instruments; `make test` runs one of each kind with a required answer."""

from dataclasses import replace

import pytest
from cases import CASES


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("case", CASES, ids=str)
def test_a_record_of_an_instrument_is_identified_or_its_fault_is_named(case, seed, tmp_path):
    replace(case, seed=seed).check(tmp_path)
