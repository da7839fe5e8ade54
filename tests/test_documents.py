"""The documents' examples run, and what they point to is there."""

import doctest
import importlib
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
# Pages that the manual is built with, out of docstrings; `make docs` fails where a link among them leads nowhere.
GENERATED = ("tracks/", "reference/", "rewards.md")
DOCUMENTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]


@pytest.mark.parametrize("document", ["README.md", "docs/estimators.md", "docs/own_plant.md", "docs/quickstart.md"])
def test_examples_run(document):
    failures, examples = doctest.testfile(str(ROOT / document), module_relative=False, verbose=False)
    assert examples > 10
    assert failures == 0


@pytest.mark.parametrize(
    "module",
    [
        *("duffing_env.continuous", "duffing_env.limited", "duffing_env.model_env"),
        *("estimator.models.model", "estimator.offline", "estimator.rig"),
    ],
)
def test_examples_of_the_docstrings_run(module):
    failures, examples = doctest.testmod(importlib.import_module(module))
    assert examples > 0
    assert failures == 0


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_links_lead_somewhere(document):
    for target in re.findall(r"\]\(([^)#]+)\)", document.read_text()):
        if "://" not in target and not target.startswith(GENERATED):
            assert (document.parent / target).exists(), f"{document.name} points to {target}, which is not there"


def test_nothing_else_stands_at_the_top():
    import subprocess

    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True)
    if listed.returncode:
        pytest.skip("not a git checkout")
    top = {line.split("/")[0] for line in listed.stdout.splitlines()}
    expected = {"estimator", "duffing_env", "agents", "tests", "benchmarks", "docs"}
    expected |= {"train.py", "evaluate.py", "reproduce.py", "pyproject.toml", "requirements.lock", "Makefile"}
    expected |= {"README.md", "CHANGELOG.md", "CONTRIBUTING.md", "LICENSE"}
    assert {name for name in top if not name.startswith(".")} <= expected
