"""Kill commands at random moments with SIGKILL, start them again, and count what is lost.

$ python -m benchmarks.kills --kills 50 --seed 0
$ python -m benchmarks.kills --kills 6 --commands train run

Each command first runs to its end once. Half of the kills then come at a random moment of a run, the other half within
50 ms of a moment when the command wrote a file. After each kill every file is read, except under temporary names. The
command is started again as a user would start it. It must end well and must keep what was measured before the kill.
Where the documentation guarantees the same result, it is compared bit for bit. The exit status is 1 after any fault.
"""

import os
import shutil
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from agents.cli import run_script
from benchmarks.kills.file_integrity import half_written
from benchmarks.kills.killable_process import started
from benchmarks.kills.killed_commands import CASES, Case

#: Half of the kills are this near to the writing of a file [s].
_NEAR = 0.05

#: Longest run of a command [s].
_PATIENCE = 300.0

#: Runs that may end before their kill.
_TRIES = 50


@dataclass(frozen=True)
class Config:
    """Kill commands at random moments."""

    kills: int = 50
    """Number of kills, shared among the commands."""
    seed: int = 0
    """Seed of the moments."""
    commands: tuple[str, ...] = ()
    """Names of commands; none stands for all."""
    json: Path | None = None
    """File for the counts."""


def main(config: Config) -> None:
    """Kill the commands and print the table."""
    from agents.console_output import format_table, print_texts_and_tables
    from agents.result_files import write_json

    unknown = set(config.commands) - set(CASES)
    if unknown:
        raise ValueError(f"commands must be of {list(CASES)}, but are {sorted(unknown)}")
    os.environ["OMP_NUM_THREADS"] = "1"  # a training then repeats bit for bit
    chosen = {name: CASES[name]() for name in config.commands or CASES}
    tried = [name for name, case in chosen.items() if not case.missing]
    shares = [len(part) for part in np.array_split(np.arange(config.kills), len(tried))]
    found = {}
    for place, (name, kills) in enumerate(zip(tried, shares, strict=True)):
        with tempfile.TemporaryDirectory() as base:
            found[name] = play(chosen[name], Path(base), kills, np.random.default_rng((config.seed, place)))
        print(f"{name}: {found[name]}", file=sys.stderr)
    rows = []
    for name, case in chosen.items():
        if case.missing:
            rows.append([name, "0", f"left out: {case.missing}", "", "", ""])
            continue
        counts = found[name]
        equal = f"{counts['equal']} of {counts['kills']}" if case.promises else "not guaranteed"
        lost = f"{counts['lost']:g} {case.unit}"
        resumed = f"{counts['resumed']} of {counts['kills']}"
        rows.append([name, str(counts["kills"]), lost, str(counts["half-written"]), resumed, equal])
    heads = ("command", "kills", "lost at most", "half-written files", "resumed", "equal")
    print_texts_and_tables(format_table(heads, rows, markdown=True))
    for counts in found.values():
        for fault in counts["faults"]:
            print(fault, file=sys.stderr)
    if config.json is not None:
        write_json(config.json, found)
    sys.exit(any(counts["faults"] for counts in found.values()))


def play(case: Case, base: Path, kills: int, rng: np.random.Generator) -> dict[str, Any]:
    """Kill a command ``kills`` times, and count the outcomes."""
    whole = base / "whole"
    case.prepare(whole)
    _finish(case, whole, ["rig", "list"], "before")  # imports the packages
    began = time.time()
    _finish(case, whole, case.start(whole), "undisturbed")
    times = _times(whole, began)
    counts: Counter[str] = Counter(kills=kills)
    lost, faults = 0.0, []
    for k in range(kills):
        folder = base / str(k)
        times = _kill(case, folder, times, bool(k % 2), rng)
        bad = half_written(folder)
        measured = case.measured(folder)
        lost = max(lost, case.lost(folder))
        counts["half-written"] += len(bad)
        faults += [f"{case.name}, kill {k}: {path} is half-written: {why}" for path, why in bad]
        try:
            _finish(case, folder, case.again(folder), f"kill {k}")
            counts["resumed"] += 1
            gone = [what for what in measured if what not in case.measured(folder)]
            faults += [f"{case.name}, kill {k}: what was measured is gone: {gone}"] if gone else []
            same = not case.promises or case.result(folder) == case.result(whole)
            counts["equal"] += same
            faults += [] if same else [f"{case.name}, kill {k}: the result differs from the undisturbed command's"]
        except RuntimeError as error:
            faults.append(f"{case.name}: {error}")
        shutil.rmtree(folder)
    if lost > case.most:
        faults.append(f"{case.name}: {lost:g} {case.unit} were lost, more than {case.most:g}")
    return {"kills": 0, "half-written": 0, "resumed": 0, "equal": 0, **counts, "lost": lost, "faults": faults}


def _times(folder: Path, began: float) -> list[float]:
    """Seconds from the start of a command to the writing of each file and, last, to its end, which is now."""
    files = (path.stat().st_mtime for path in folder.rglob("*") if path.is_file())
    return [*(at - began for at in files if at > began), time.time() - began]


def _kill(case: Case, folder: Path, times: list[float], near: bool, rng: np.random.Generator) -> list[float]:
    """Start a command and kill it; return the times from which the moment was drawn.

    A command that ends before its kill runs again, with its new times: the machine may have become faster.
    """
    for _ in range(_TRIES):
        shutil.rmtree(folder, ignore_errors=True)
        case.prepare(folder)
        moment = rng.choice(times) + rng.uniform(-_NEAR, _NEAR) if near else rng.uniform(0.0, times[-1])
        began = time.time()
        process = started(folder, case.start(folder))
        process.join(max(0.0, moment))
        process.kill()
        process.join()
        if process.exitcode == -9:
            return times
        times = _times(folder, began)
    raise RuntimeError(f"{case.name} ended before each of {_TRIES} kills")


def _finish(case: Case, folder: Path, words: list[str], when: str) -> None:
    """Run a command to its end; raise RuntimeError unless its exit status is 0."""
    process = started(folder, words)
    process.join(_PATIENCE)
    if process.exitcode != 0:
        process.kill()
        said = (folder.parent / f"{folder.name}.log").read_text().strip().splitlines()
        raise RuntimeError(f"{case.name}, {when}: exit status {process.exitcode}: {' '.join(said[-1:])}")


if __name__ == "__main__":
    run_script(main, Config, __doc__)
