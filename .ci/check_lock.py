"""Check that requirements.lock can be installed from binary files alone, for each given Python version.

``python .ci/check_lock.py 3.11 3.12`` prints a line for each version and exits with 1 if one fails. It downloads only
the index's metadata, for files of this machine's system and processor.

pip evaluates the conditions of dependencies for the Python that runs it. So pip resolves without dependencies, and this
script compares these with the lock: every package that another one needs must stand in it, with a fitting version.
"""

import json
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

from packaging.markers import Environment, default_environment
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]

# Packages that torch needs on machines with an accelerator. torch pins their versions.
LEFT_TO_TORCH = ("cuda-", "nvidia-", "triton")

# Extras that `make` does not install. One command needs each; its test is skipped without.
NOT_LOCKED = ("datasets", "ray")


def environment(version: str) -> Environment:
    """Values for the conditions of dependencies, in the first release of a Python version, which pip takes too."""
    here = default_environment()
    here["python_version"] = version
    here["python_full_version"] = here["implementation_version"] = f"{version}.0"
    return here


def resolve(version: str) -> list[dict]:
    """Return pip's metadata of every line of the lock.

    Raises:
        RuntimeError: if a line has no binary file for this version, with pip's message.
    """
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.json"
        command = [sys.executable, "-m", "pip", "install", "--dry-run", "--ignore-installed", "--no-deps", "--quiet"]
        command += ["--only-binary=:all:", "--python-version", version, "--target", folder, "--report", str(report)]
        command += ["--requirement", str(ROOT / "requirements.lock")]
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            raise RuntimeError(done.stderr.strip().splitlines()[-1])
        return [entry["metadata"] for entry in json.loads(report.read_text())["install"]]


def missing(packages: list[dict], version: str) -> list[str]:
    """Return the needs of the project and its packages that the lock does not meet, for a version of Python."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    locked = {canonicalize_name(package["name"]): package for package in packages}
    wanted = [("pyproject.toml", Requirement(line), "") for line in project["dependencies"]]
    for extra, lines in project["optional-dependencies"].items():
        wanted += [("pyproject.toml", Requirement(line), extra) for line in lines if extra not in NOT_LOCKED]
    for package in packages:
        wanted += [(package["name"], Requirement(line), "") for line in package.get("requires_dist", [])]

    faults, seen = [], set()
    while wanted:
        needs, requirement, extra = wanted.pop()
        if (needs, str(requirement), extra) in seen:
            continue
        seen.add((needs, str(requirement), extra))
        name = canonicalize_name(requirement.name)
        if name.startswith(LEFT_TO_TORCH):
            continue
        if requirement.marker and not requirement.marker.evaluate({**environment(version), "extra": extra}):
            continue
        if name not in locked:
            faults.append(f"{needs} needs {requirement}")
        elif not requirement.specifier.contains(locked[name]["version"], prereleases=True):
            faults.append(f"{needs} needs {requirement}, not {locked[name]['version']}")
        else:
            lines = locked[name].get("requires_dist", [])
            wanted += [(locked[name]["name"], Requirement(line), more) for more in requirement.extras for line in lines]
    return faults


def main(versions: list[str]) -> int:
    """Print a line for each version; return 1 if one fails."""
    failed = 0
    for version in versions:
        try:
            packages = resolve(version)
            faults = missing(packages, version)
        except RuntimeError as error:
            faults = [str(error)]
        failed |= bool(faults)
        verdict = "; ".join(faults) or f"{len(packages)} binary files, all that is needed"
        print(f"Python {version}: {verdict}", flush=True)
    return failed


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
