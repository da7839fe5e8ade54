"""Build wheel and sdist from the commit that is checked out, twice, in two clones: `make release`.

Both builds must be the same, byte for byte, and go into ``dist``. All times in them are the commit's. The wheel must
hold the packages, the trained policies, the rigs and the licence, and have the version of ``pyproject.toml``. twine
checks that an index can show the metadata. ``make release`` then tests the wheel in a clean environment
(`tests/test_wheel.py`).
"""

import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
import tomllib
import zipfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
TWINE = "twine==7.0.0"  # not in the lock: only this script needs it and its dependencies
WANTED = ("estimator/py.typed", "estimator/rigs/beam.toml", "agents/policies/trained/ppo/short/policy.json")


def git(*words: str) -> str:
    """Run git in this checkout; return its output."""
    return subprocess.run(["git", "-C", str(ROOT), *words], check=True, capture_output=True, text=True).stdout.strip()


def build(folder: Path) -> dict[str, bytes]:
    """Clone the commit into a folder and build there; return the files' contents by name."""
    subprocess.run(["git", "clone", "--quiet", str(ROOT), str(folder)], check=True)
    subprocess.run(["git", "-C", str(folder), "checkout", "--quiet", git("rev-parse", "HEAD")], check=True)
    environment = os.environ | {"SOURCE_DATE_EPOCH": git("log", "-1", "--format=%ct")}
    subprocess.run([sys.executable, "-m", "hatchling", "build"], check=True, cwd=folder, env=environment)
    return {path.name: path.read_bytes() for path in sorted((folder / "dist").iterdir())}


def check(wheel: Path) -> None:
    """Refuse a wheel that lacks a file or has another version."""
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    missing = [name for name in (*WANTED, f"duffing_env-{version}.dist-info/licenses/LICENSE") if name not in names]
    if missing:
        sys.exit(f"{wheel.name} must hold {missing}, but does not")


def check_metadata(files: list[Path]) -> None:
    """Refuse files whose metadata an index would not show."""
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run([sys.executable, "-m", "venv", folder], check=True)
        python = Path(folder) / "bin" / "python"
        subprocess.run([python, "-m", "pip", "install", "--quiet", TWINE], check=True)
        subprocess.run([python, "-m", "twine", "check", "--strict", *files], check=True)


def main() -> None:
    """Build twice, compare, check, and put the files into ``dist``."""
    if git("status", "--porcelain"):
        sys.exit("the checkout must be clean, but has changes: commit them, because a release is built from a commit")
    with tempfile.TemporaryDirectory() as folder:
        first, second = (build(Path(folder) / name) for name in ("first", "second"))
    if first != second:
        sys.exit(
            f"two builds must be the same, but differ: {[name for name in first if first[name] != second.get(name)]}"
        )
    shutil.rmtree(ROOT / "dist", ignore_errors=True)
    (ROOT / "dist").mkdir()
    for name, content in first.items():
        (ROOT / "dist" / name).write_bytes(content)
        print(f"{hashlib.sha256(content).hexdigest()}  dist/{name}")
    check(next((ROOT / "dist").glob("*.whl")))
    check_metadata(sorted((ROOT / "dist").iterdir()))
    print("two builds in two clones gave the same files")


if __name__ == "__main__":
    main()
