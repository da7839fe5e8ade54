"""Fixtures for all tests, and where they find the Silverbox record.

The record is never in the repository. The tests look for it where `load_record` does, and in
`shared/data/silverbox` beside the checkout when `SILVERBOX_DATA` is unset.
"""

import os
from pathlib import Path

import pytest

from duffing_env.silverbox import SilverboxRecord, load_record, record_available

BESIDE_THE_CHECKOUT = Path(__file__).parents[2] / "shared" / "data" / "silverbox"

if not os.environ.get("SILVERBOX_DATA") and BESIDE_THE_CHECKOUT.is_dir():
    os.environ["SILVERBOX_DATA"] = str(BESIDE_THE_CHECKOUT)


@pytest.fixture(scope="session")
def record() -> SilverboxRecord:
    """The Silverbox record; the test is skipped where it is absent."""
    if not record_available():
        pytest.skip("the Silverbox record is not on this machine; set SILVERBOX_DATA")
    return load_record()
