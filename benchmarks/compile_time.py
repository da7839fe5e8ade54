"""Time from a model's declaration to its first record likelihood: ``python -m benchmarks.compile_time --commit REV``.

The models are chains of masses, of 2 states and 4 coefficients each. Two versions derive and compile each in turns, in
processes of their own, with nothing cached. The times are the processor's, which other programs disturb less.
"""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from agents.cli import run_script
from benchmarks.__main__ import describe_machine
from benchmarks.peer_process import ROOT, unpack_version
from benchmarks.section_tables import Claim, Section, print_section, ratio
from benchmarks.timed_rounds import Row, measure

#: States of a chain to the part of the old version's time that it may take.
BARS = {4: 1.0, 8: 2 / 3, 10: 0.5}

#: States of the largest chain, and the seconds that it may take.
LARGEST, LARGEST_BAR = 12, 20.0


@dataclass(frozen=True)
class Config:
    """Time chains of 4, 8 and 10 states in two versions, and of 12 states in this one."""

    commit: str = "2403a7f"
    """The older version; the default is the last whose algebra is all in straight lines."""
    repetitions: int = 5
    """Rounds; every row is run once in each."""


def main(config: Config) -> None:
    """Unpack the old version, time both, print."""
    with tempfile.TemporaryDirectory() as folder:
        unpack_version(config.commit, Path(folder))
        machine = describe_machine()
        print(f"{machine['processor']}, {machine['cores']} cores. Load before: {machine['load_before']}")
        print(f"Old is {config.commit}. Median [minimum, maximum] of {config.repetitions} repetitions, in turns.")
        rows = [
            Row(f"{states} states, {age}", "s", first_likelihood(tree, states), at_least=0)
            for states in BARS
            for age, tree in (("old", Path(folder)), ("new", ROOT))
        ]
        rows.append(Row(f"{LARGEST} states, new", "s", first_likelihood(ROOT, LARGEST), at_least=0))
        results = measure(rows, config.repetitions)
    claims = [
        Claim(
            f"{states} states: new over old",
            ratio(results[f"{states} states, new"], results[f"{states} states, old"]),
            bar,
            at_most=True,
        )
        for states, bar in BARS.items()
    ]
    claims.append(
        Claim(f"{LARGEST} states", results[f"{LARGEST} states, new"].median, LARGEST_BAR, at_most=True, unit="s")
    )
    print_section(Section("Derive, compile and first likelihood", list(results.values()), claims))


def first_likelihood(tree: Path, states: int) -> Callable[[int], tuple[float, float]]:
    """A row's ``run``: the seconds of a chain in a version's tree, with nothing cached."""
    script = Path(__file__).with_name("compile_time_row.py")
    # An installed version must not come before the tree's.
    code = f"import runpy, sys; sys.path.insert(0, {str(tree)!r}); runpy.run_path({str(script)!r}, run_name='__main__')"

    def run(_: int) -> tuple[float, float]:
        with tempfile.TemporaryDirectory() as empty:
            done = subprocess.run(
                [sys.executable, "-P", "-c", code, str(states)],
                cwd=tree, env={**os.environ, "NUMBA_CACHE_DIR": empty}, capture_output=True, text=True,
            )  # fmt: skip
        if done.returncode:
            raise RuntimeError(done.stderr.strip().splitlines()[-1])
        return json.loads(done.stdout)["seconds"], 1

    return run


if __name__ == "__main__":
    run_script(main, Config, __doc__ or "")
