"""All places name the same Python versions, and the commands accept only these."""

import importlib.util
import os
import re
import shutil
import subprocess
import sys
import tomllib
from importlib.metadata import version
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from tables import table

from estimator.support.optional_dependencies import EXTRA_OF_PACKAGE

ROOT = Path(__file__).parents[1]
SETTINGS = tomllib.loads((ROOT / "pyproject.toml").read_text())
VERSIONS = re.findall(r"Python :: (3\.\d+)", "\n".join(SETTINGS["project"]["classifiers"]))
WORKS = f"duffing-env works with Python {VERSIONS[0]} to {VERSIONS[-1]}"


def minor(version: str) -> int:
    return int(version.split(".")[1])


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A folder in which make can do no harm."""
    for name in ("Makefile", "pyproject.toml", "requirements.lock"):
        shutil.copy(ROOT / name, tmp_path)
    return tmp_path


def python(folder: Path, version: str) -> Path:
    """A script that reports a Python version, and does nothing else."""
    path = folder / "stand-in"
    path.write_text(f"#!/bin/sh\necho {version}\n")
    path.chmod(0o755)
    return path


def make(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    # The tests may run under a make that hands its own options on.
    mine = {key: value for key, value in os.environ.items() if not key.startswith(("MAKE", "MFLAGS", "PYTHON"))}
    return subprocess.run(["make", *arguments], cwd=folder, env=mine, capture_output=True, text=True)


def test_versions_agree():
    assert [minor(version) for version in VERSIONS] == list(range(minor(VERSIONS[0]), minor(VERSIONS[-1]) + 1))
    assert SETTINGS["project"]["requires-python"] == f">={VERSIONS[0]},<3.{minor(VERSIONS[-1]) + 1}"
    assert SETTINGS["tool"]["ruff"]["target-version"] == f"py3{minor(VERSIONS[0])}"
    assert SETTINGS["tool"]["mypy"]["python_version"] == VERSIONS[0]


@table("document", ["README.md", "docs/index.md"])
def test_documents_name_the_versions(document):
    assert f"Python {VERSIONS[0]} to {VERSIONS[-1]} and make" in (ROOT / document).read_text()


@table("target", ["demo", "test", "docs", "lint", "clean"])
def test_make_prints_the_version_first(project, target):
    assert make(project, "-n", target, f"PYTHON={python(project, VERSIONS[0])}").stdout.startswith(f"{WORKS}.\n")


@table("version", [f"3.{minor(VERSIONS[0]) - 1}", f"3.{minor(VERSIONS[-1]) + 1}", "2.7"])
def test_make_refuses_others(project, version):
    done = make(project, "test", f"PYTHON={python(project, version)}")
    assert done.returncode
    assert WORKS in done.stderr
    assert f"is Python {version}" in done.stderr
    assert not (project / ".venv").exists()


def test_make_says_that_python_is_missing(project):
    done = make(project, "test", "PYTHON=no-such-python")
    assert done.returncode
    assert f"{WORKS}; no-such-python is not to be found" in done.stderr


@table("version", VERSIONS)
def test_make_takes_each(project, version):
    done = make(project, "-n", "test", f"PYTHON={python(project, version)}")
    assert done.returncode == 0
    assert "-m venv --clear .venv" in done.stdout


def test_another_version_is_built_anew(project):
    (project / ".venv").mkdir()
    (project / ".venv" / ".locked").write_text(f"{VERSIONS[0]}\n")
    (project / ".venv" / ".ready").touch()
    assert "venv --clear" not in make(project, "-n", "test").stdout
    assert "venv --clear" not in make(project, "-n", "test", f"PYTHON={python(project, VERSIONS[0])}").stdout
    assert "venv --clear" in make(project, "-n", "test", f"PYTHON={python(project, VERSIONS[1])}").stdout


def test_lock_names_nothing_twice():
    lines = (ROOT / "requirements.lock").read_text().splitlines()
    names = [re.sub(r"[-_.]+", "-", line.split("==")[0].lower()) for line in lines if not line.startswith("#")]
    assert len(names) == len(set(names))
    assert "pygame" not in names, "pygame and pygame-ce are installed to the same place"


def test_lock_check_finds_what_is_missing():
    specification = importlib.util.spec_from_file_location("check_lock", ROOT / ".ci" / "check_lock.py")
    check_lock = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(check_lock)
    lines = ["a>=2", "b[x]", 'c; python_version >= "3.13"', "nvidia-a==1"]
    packages = [
        {"name": "a", "version": "1.0", "requires_dist": lines},
        {"name": "b", "version": "1.0", "requires_dist": ['d; extra == "x"', 'e; extra == "y"']},
    ]
    faults = set(check_lock.missing(packages, "3.12"))
    found = {fault for fault in faults if not fault.startswith("pyproject.toml")}
    assert found == {"a needs a>=2, not 1.0", 'b needs d; extra == "x"'}
    assert set(check_lock.missing(packages, "3.13")) - faults == {'a needs c; python_version >= "3.13"'}


def test_the_citation_has_the_version_of_the_package():
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text()


# --- Packages


NUMBA = next(Requirement(line) for line in SETTINGS["project"]["dependencies"] if line.startswith("numba"))


def test_numba_is_one_whose_insides_are_known():
    installed = version("numba")
    assert NUMBA.specifier.contains(installed, prereleases=True), (
        f"Numba {installed} is installed, and its insides are known with {NUMBA.specifier} only: see whether all tests "
        "pass with it, then raise the bound in pyproject.toml and in estimator/compilation/numba_internals.py"
    )


@pytest.mark.parametrize("package", ["estimator.online", "estimator.compilation.scalar_jit", "duffing_env.kernel"])
def test_another_numba_is_refused_by_name(package):
    (newest,) = (bound.version for bound in NUMBA.specifier if bound.operator == "<")
    (oldest,) = (bound.version for bound in NUMBA.specifier if bound.operator == ">=")

    def said(number):
        code = f"import numba; numba.__version__ = {number!r}; import {package}"
        return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT).stderr

    message = said(f"{newest}.0rc1").splitlines()[-1]
    assert message.startswith(f"ImportError: numba must be at least {oldest} and below {newest}, ")
    assert message.endswith(f"but is {newest}.0rc1; get one with: pip install 'numba>={oldest},<{newest}'")
    assert said(f"{oldest}.0") == said(f"0.{minor(newest) - 1}.9") == ""


def test_extras_are_those_that_are_named_where_a_package_is_missing():
    for package, extra in EXTRA_OF_PACKAGE.items():
        lines = SETTINGS["project"]["optional-dependencies"][extra]
        assert any(line.startswith(package.replace("_", "-")) for line in lines), package


def test_highspy_is_the_one_that_research_asks_for():
    (wanted,) = (line for line in SETTINGS["project"]["optional-dependencies"]["dev"] if line.startswith("highspy"))
    assert f"pip install '{wanted}'" in (ROOT / "research/oracles/linear_programme.py").read_text()
