"""Compare the speed of this version with an older one: ``python -m benchmarks.version_comparison --commit REV``.

Each version runs in its own tree and process, and both are timed in turns.
"""

import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from agents.cli import run_script
from benchmarks.__main__ import describe_machine
from benchmarks.peer_process import ROOT, Child, unpack_version
from benchmarks.section_tables import Claim, Section, print_section, ratio
from benchmarks.timed_rounds import measure

#: Unit of each row, and the smallest ratio of the new speed to the old one that passes.
ROWS = {
    "inference Eq. (2)": ("env-steps/s", 1.0),
    "inference Eq. (1)": ("env-steps/s", 0.95),
    "steps Eq. (2)": ("env-steps/s", 1.3),
    "steps Eq. (1)": ("env-steps/s", None),
    "steps Eq. (1), noises unknown": ("env-steps/s", None),
    "samples Eq. (2)": ("µs/sample", None),
    "samples Eq. (1)": ("µs/sample", None),
}


@dataclass(frozen=True)
class Config:
    """Time inference of 1,024 systems, steps of as many environments with 2 threads, and one estimator's samples."""

    commit: str = "f55658e"
    """The older version; the default is the last whose kernels were written by hand."""
    repetitions: int = 9
    """Rounds; every row is run once in each."""


def main(config: Config) -> None:
    """Unpack the old version, time both, print."""
    with tempfile.TemporaryDirectory() as folder:
        unpack_version(config.commit, Path(folder))
        command = [sys.executable, "-P", Path(__file__).with_name("version_rows.py")]
        trees = {"old": Path(folder), "new": ROOT}
        children = {age: Child(command, tree, {"PYTHONPATH": str(tree)}) for age, tree in trees.items()}
        machine = describe_machine()
        print(f"{machine['processor']}, {machine['cores']} cores. Load before: {machine['load_before']}")
        print(f"Old is {config.commit}. Median [minimum, maximum] of {config.repetitions} repetitions, in turns.")
        with children["old"], children["new"]:
            rows = [
                child.row(name, f"{name}, {age}", unit)
                for name, (unit, _) in ROWS.items()
                for age, child in children.items()
            ]
            results = measure(rows, config.repetitions)
    claims = []
    for name, (unit, bar) in ROWS.items():
        old, new = results[f"{name}, old"], results[f"{name}, new"]
        faster = ratio(old, new) if unit == "µs/sample" else ratio(new, old)
        claims.append(Claim(f"{name}: new over old", faster, bar))
    print_section(Section("Versions", list(results.values()), claims))


if __name__ == "__main__":
    run_script(main, Config, __doc__ or "")
