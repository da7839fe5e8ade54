"""Fuzzing: try bad inputs in every area, and count results, clear errors and faults.

$ python -m benchmarks.fuzz --inputs 50000
$ python -m benchmarks.fuzz --inputs 500 --areas files commands --seed 7

Each area runs in a process of its own. A process that dies counts as a crash and does not end the others. The exit
status is 1 after a fault. The same seed and number give the same inputs.
"""

import importlib
import json
import subprocess
import sys
import tempfile
import time
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import hypothesis

from agents.cli import run_script

#: Share of the inputs of each area. An area is a module ``fuzz_<area>``.
AREAS = {
    "estimators": 0.25,
    "constructors": 0.32,
    "files": 0.2,
    "options": 0.05,
    "environments": 0.1,
    "policies": 0.06,
    "commands": 0.02,
}

#: Verdicts on calls.
KINDS = ("result", "clear error", "unclear error", "unsound result", "state changed", "hang", "crash")


@dataclass(frozen=True)
class Config:
    """Try bad inputs."""

    inputs: int = 5000
    """Number of inputs, over all areas."""
    seed: int = 0
    """Seed of the inputs."""
    areas: tuple[str, ...] = tuple(AREAS)
    """Areas to try."""
    json: Path | None = None
    """File for the counts and faults."""
    inside: bool = False
    """Whether this process tries the inputs of one area; set by the program itself."""

    def __post_init__(self) -> None:
        if self.inputs < 1 or self.seed < 0:
            raise ValueError(f"inputs and seed must be at least 1 and 0, but are {self.inputs} and {self.seed}")
        unknown = [area for area in self.areas if area not in AREAS]
        if unknown:
            raise ValueError(f"areas must be of {list(AREAS)}, but are {unknown}")


def main(config: Config) -> None:
    """Try the inputs, print the table, and exit with status 1 after a fault."""
    if config.inside:
        inside(config.areas[0], config.inputs, config.seed, config.json)
        return
    whole = sum(AREAS[area] for area in config.areas)
    found = {area: _in_process(area, round(config.inputs * AREAS[area] / whole), config.seed) for area in config.areas}
    faults = show(found, config.seed)
    if config.json is not None:
        config.json.write_text(json.dumps({"seed": config.seed, "areas": found}, indent=2))
    sys.exit(bool(faults))


def inside(area: str, inputs: int, seed: int, path: Path | None) -> None:
    """Try an area's inputs in this process."""
    from benchmarks.fuzz.call_verdicts import Judge

    warnings.simplefilter("ignore")
    began = time.perf_counter()
    judge, calls = Judge(), importlib.import_module(f"benchmarks.fuzz.fuzz_{area}").calls()
    settings = hypothesis.settings(
        max_examples=inputs, database=None, deadline=None, phases=[hypothesis.Phase.generate],
        suppress_health_check=list(hypothesis.HealthCheck),
    )  # fmt: skip

    @settings
    @hypothesis.seed(seed)
    @hypothesis.given(calls)
    def attempt(call: Any) -> None:
        if path is not None:
            path.with_suffix(".last").write_text(call.what)
        judge.judge(call)

    attempt()
    tally = judge.tally | {"seconds": time.perf_counter() - began}
    if path is not None:
        path.write_text(json.dumps(tally))


def _in_process(area: str, inputs: int, seed: int) -> dict[str, Any]:
    """Try an area's inputs in a process of its own, and return its counts; a crash where the process died."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "tally.json"
        words = ["--inside", "--areas", area, "--inputs", str(max(1, inputs)), "--seed", str(seed), "--json", str(path)]
        done = subprocess.run([sys.executable, "-m", "benchmarks.fuzz", *words], capture_output=True, text=True)
        if path.exists():
            tally: dict[str, Any] = json.loads(path.read_text())
            return tally
        last = path.with_suffix(".last")
        what = f"crash: {last.read_text() if last.exists() else 'before the first'}, exit status {done.returncode}"
        return {"counts": {"crash": 1}, "faults": {what: 1}, "examples": {what: done.stderr[-500:]}, "seconds": 0.0}


def show(found: dict[str, dict[str, Any]], seed: int) -> int:
    """Print the table and the faults; return the number of faults."""
    from agents.console_output import format_table
    from agents.console_output import print_texts_and_tables as print_all

    rows = []
    for area, tally in found.items():
        counts = [tally["counts"].get(kind, 0) for kind in KINDS]
        rows.append([area, str(sum(counts)), *map(str, counts), f"{tally['seconds']:.0f}"])
    total = [sum(int(row[k]) for row in rows) for k in range(1, 3 + len(KINDS))]
    rows.append(["all", *map(str, total)])
    print_all(format_table(("area", "inputs", *KINDS, "s"), rows, markdown=True), f"seed {seed}", width=140)
    faults = sorted(
        ((n, fault, area) for area, one in found.items() for fault, n in one["faults"].items()), reverse=True
    )
    for n, fault, area in faults:
        print(f"{n:6d}  {area}: {fault}\n        {found[area]['examples'].get(fault, '')!r}")
    return len(faults)


if __name__ == "__main__":
    run_script(main, Config, __doc__)
