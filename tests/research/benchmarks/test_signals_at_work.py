"""SIGINT and SIGTERM at random moments of every command, each in a process of its own."""

import itertools
import os
import re
import shutil
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from agents.hardware.clock import JumpingClock
from agents.hardware.experiment_run import RunSettings, run_experiment
from agents.hardware.simulated_plant import SimulatedPlant
from benchmarks.kills.file_integrity import half_written
from benchmarks.kills.killable_process import started
from benchmarks.kills.killed_commands import RIG, SMALL, Ship
from estimator import Rig

SHORT = "duffing_env/Short-v0"
COMMANDS = {
    "train": f"train --env {SHORT} --steps 8192 --systems 0 --output new/run {' '.join(SMALL)}",
    "tune": f"train --env {SHORT} --steps 1024 --tune 2 --output new/search {' '.join(SMALL)}",
    "evaluate": f"evaluate --env {SHORT} --policies uniform prbs --systems 16 --output new",
    "submit": "evaluate --protocol Short-v0 --policies prbs --submit mine --board new/board.jsonl",
    "export": "export prbs --samples 2000000 --output new/signal.csv",
    "design": "design rig.toml --policy efe --samples 64 -o new/next.csv",
    "identify": "identify rig.toml record.csv --report new/page.html --save new/known.npz",
    "run": "run rig.toml --plant lab:plant --policy prbs --samples 5000 --out new/run",
    "report": "report --output new/board.html",
    "ship": "ship --name new/mine --runs run-0 run-1 --systems 16",
}
#: The clock jumps, so that no run is late.
LAB = """
import agents.hardware.experiment_run
from agents.hardware.clock import JumpingClock
from agents.hardware.simulated_plant import SimulatedPlant

def plant(rig):
    clock = JumpingClock()
    agents.hardware.experiment_run.RealClock = lambda: clock
    return SimulatedPlant(rig, clock=clock)
"""


def listens(process):
    """Whether a process catches SIGTERM, as it does from the beginning of a command to its end."""
    try:
        said = Path(f"/proc/{process.pid}/status").read_text()
    except OSError:
        return False
    caught = re.search(r"SigCgt:\s*(\w+)", said)
    return caught is not None and bool(int(caught[1], 16) >> (signal.SIGTERM - 1) & 1)


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """A rig, a record and two runs."""
    place = tmp_path_factory.mktemp("base") / "bench"
    Ship().prepare(place)
    (place / "rig.toml").write_text(RIG)
    (place / "lab.py").write_text(LAB)
    rig = Rig.from_file(place / "rig.toml")
    plant = SimulatedPlant(rig, clock=JumpingClock())
    run_experiment(rig, plant, place / "measured", RunSettings("prbs", 512), clock=plant.clock)
    shutil.copy(place / "measured" / "samples.csv", place / "record.csv")
    process = started(place, ["rig", "list"])  # the packages are imported
    process.join()
    assert process.exitcode == 0
    return place


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="this system does not say what a process catches")
@pytest.mark.parametrize("name", COMMANDS)
def test_a_signal_at_work_is_one_line_and_its_exit_status(name, bench, tmp_path):
    words, rng, lasted = COMMANDS[name].split(), np.random.default_rng(list(name.encode())), 0.0
    for number in (signal.SIGINT, signal.SIGTERM):
        for k in itertools.count():  # until it is not too late; the first one tells how long it takes
            folder = tmp_path / f"{number.name}-{k}"
            shutil.copytree(bench, folder)
            process = started(folder, words)
            while process.is_alive() and not listens(process):
                time.sleep(0.001)
            began = time.perf_counter()
            process.join(float(rng.uniform(0.0, lasted)) if lasted else None)
            if listens(process):
                os.kill(process.pid, number)
            process.join()
            if process.exitcode not in (0, -number):  # what dies of the signal had ended its command
                break
            lasted = time.perf_counter() - began
        said = (tmp_path / f"{number.name}-{k}.log").read_text()
        assert process.exitcode == 128 + number, said
        assert "Traceback" not in said
        assert "Exception ignored" not in said
        # A table that came before the signal may have a row of episodes that ended early.
        ends = (": stopped", ": ended early (")
        assert sum(any(end in line for end in ends) for line in said.splitlines()) == 1, said
        assert half_written(folder) == []
        assert not list(folder.rglob(".*"))
