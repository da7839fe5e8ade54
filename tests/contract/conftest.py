"""Environments on the Silverbox record are left out where it is absent."""

import pytest


@pytest.fixture(autouse=True)
def record_where_it_is_played(request):
    """Skip a test of an environment that plays the record, where the record is missing."""
    environment = getattr(request.node, "callspec", None) and request.node.callspec.params.get("environment")
    if environment is not None and environment.on_record:
        request.getfixturevalue("record")
