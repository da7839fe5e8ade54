"""Compare the numbers of two versions of this project: ``python -m benchmarks.regression --commit REV``.

It compares episodes of every track, `identify` on every shipped rig, decisions of ``efe`` and of every shipped policy,
and ``reproduce.py``, number by number. Each version runs in its own tree and process.
"""

import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from agents.cli import run_script
from benchmarks.peer_process import ROOT, unpack_version


@dataclass(frozen=True)
class Config:
    """Compare the numbers of two versions of this project; exit 1 where one differs by more than the tolerance."""

    commit: str
    """The older version."""
    tolerance: float = 0.0
    """Largest difference that passes, relative to the largest number of its array. 0 asks for equal bits."""


def results_of(tree: Path, archive: Path) -> dict[str, Any]:
    """The arrays of one version, by row and name."""
    command = [sys.executable, "-P", Path(__file__).with_name("regression_rows.py"), tree, archive]
    subprocess.run(command, cwd=tree, env=os.environ | {"PYTHONPATH": str(tree)}, check=True)
    with np.load(archive, allow_pickle=False) as stored:
        return {name: stored[name] for name in stored.files}


def difference(old: Any, new: Any) -> float:
    """The largest difference over the largest old number; 0 for equal bits, infinity for another shape or type."""
    if old.shape != new.shape or old.dtype != new.dtype:
        return np.inf
    if old.tobytes() == new.tobytes():
        return 0.0
    return float(np.nanmax(np.abs(new - old)) / max(np.nanmax(np.abs(old)), np.finfo(float).tiny))


def main(config: Config) -> None:
    """Unpack the old version, compute both, compare, print a line for every row."""
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "tree"
        tree.mkdir()
        unpack_version(config.commit, tree)
        old = results_of(tree, Path(folder) / "old.npz")
        new = results_of(ROOT, Path(folder) / "new.npz")
    rows: dict[str, float] = {}
    for name in {**old, **new}:
        row = name.partition("|")[0]
        worst = difference(old[name], new[name]) if name in old and name in new else np.inf
        rows[row] = max(rows.get(row, 0.0), worst)
    print(f"\n{'':44}largest relative difference to {config.commit}")
    for row, worst in rows.items():
        print(f"{row:44}{'none: the same bits' if worst == 0 else f'{worst:.1e}'}")
    if failed := [row for row, worst in rows.items() if worst > config.tolerance]:
        sys.exit(f"{len(failed)} of {len(rows)} rows differ by more than {config.tolerance:g}: {', '.join(failed)}")


if __name__ == "__main__":
    run_script(main, Config, __doc__ or "")
