"""Runs through an instrument: the faults that happen on benches, and the instrument's output after them."""

import csv
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from loopback import RIG, RIG_FILE, TABLE, TRUTH, Scpi
from tables import table

from agents.hardware import visa_instrument
from agents.hardware.experiment_run import RunSettings, run_experiment
from estimator import Rig, identify

pytest.importorskip("pyvisa", reason="pip install 'duffing-env[instrument]'")
ROOT = Path(__file__).parents[3]
#: The run's clock jumps; the instrument's clock, in another process, follows it.
COMMAND = """
import agents.hardware.experiment_run
from agents.commands import main
from agents.hardware.clock import JumpingClock
agents.hardware.experiment_run.RealClock = JumpingClock
main()
"""


@pytest.fixture
def scpi(request):
    made = Scpi(**getattr(request, "param", {}))
    yield made
    made.close()


def rows(folder):
    with (folder / "samples.csv").open() as file:
        return list(csv.DictReader(file))


def measured(folder):
    """Outputs that were measured, in time or not."""
    return [row["y"] or row["late_output"] for row in rows(folder) if row["y"] or row["late_output"]]


def play(scpi, folder, **plan):
    plant = visa_instrument.plant(RIG, resource=scpi.resource, **TABLE)

    def impatient(samples):
        """Where no answer will come, however long it is waited for."""
        if scpi.fault in ("stall", "lose") and scpi.answered == scpi.after:
            plant._connection.timeout = 50

    plan = RunSettings(**{"policy": "prbs", "samples": 40, "listen": 8, "bound": 0.01, **plan})
    try:
        return run_experiment(RIG, plant, folder, plan, clock=scpi.clock, on_progress=impatient)
    finally:
        plant.close()


def the_watchdog_zeroes_after(scpi, seconds):
    """Since the last line that the instrument heard."""
    scpi.clock.wait(scpi.clock.now() + 0.9 * seconds)
    assert scpi.applied != 0.0
    scpi.clock.wait(scpi.clock.now() + 0.2 * seconds)
    assert scpi.applied == 0.0
    assert not scpi.plant._armed


def near_truth(parameters):
    return all(abs(parameters[name][0] - TRUTH[name]) < 4.5 * parameters[name][1] for name in TRUTH)


def test_a_run_by_samples(scpi, tmp_path):
    result = play(scpi, tmp_path / "run", samples=160)
    assert (result.outcome, result.exit_status, result.late_ticks) == ("complete", 0, 0)
    wait_for(lambda: scpi.lines[-1] == "OUTP OFF")  # the instrument reads when it comes to it
    wait_for(lambda: scpi.applied == 0.0)
    assert scpi.lines.index("WDOG 2.0") < scpi.lines.index("OUTP ON")
    assert scpi.lines.index("MEAS?") < scpi.lines.index("OUTP ON"), "the output is looked at before arming"
    assert near_truth(result.parameters)
    assert near_truth(identify(RIG, tmp_path / "run" / "samples.csv").parameters)


def test_a_run_by_blocks(scpi, tmp_path):
    result = play(scpi, tmp_path / "run", samples=128, block=64)
    assert result.outcome == "complete"
    wait_for(lambda: scpi.applied == 0.0)
    assert [row["u"] for row in rows(tmp_path / "run")].count("") == 3, "a pause after each block, the silent one too"
    assert near_truth(result.parameters)
    assert near_truth(identify(RIG, tmp_path / "run" / "samples.csv").parameters)


@pytest.mark.parametrize("scpi", [{"fault": "stall"}], indirect=True)
def test_a_sensor_that_stalls_ends_the_run(scpi, tmp_path):
    result = play(scpi, tmp_path / "run")
    assert (result.outcome, result.exit_status) == ("plant", 1)
    assert "read failed" in result.message
    assert len(measured(tmp_path / "run")) == scpi.answered == 30
    assert scpi.applied != 0.0
    scpi.quiet.set()  # the instrument comes to its senses, and finds the commands that it has not read
    wait_for(lambda: scpi.applied == 0.0)


@pytest.mark.parametrize("scpi", [{"fault": "lose"}], indirect=True)
def test_a_lost_connection_leaves_the_zero_to_the_watchdog(scpi, tmp_path):
    result = play(scpi, tmp_path / "run", watchdog=1.0)
    assert result.outcome == "plant"
    assert len(measured(tmp_path / "run")) == scpi.answered == 30
    the_watchdog_zeroes_after(scpi, 1.0)


@pytest.mark.parametrize("scpi", [{"fault": "slow", "after": 20}], indirect=True)
def test_late_samples_are_counted_marked_and_kept_from_the_estimator(scpi, tmp_path):
    result = play(scpi, tmp_path / "run", samples=200)
    assert result.outcome == "complete"
    late = [row for row in rows(tmp_path / "run") if row["late"] == "1"]
    assert len(late) == result.late_ticks >= 10
    untimely = [row for row in late if row["late_output"]]
    assert len(untimely) >= 5
    assert {row["y"] for row in untimely} == {""}
    assert all(row["u"] for row in late), "the input that stayed on is known"
    ticks = [int(row["sample"]) for row in rows(tmp_path / "run")]
    assert ticks == list(range(len(ticks)))
    assert json.loads((tmp_path / "run" / "manifest.json").read_text())["late"] == result.late_ticks
    wait_for(lambda: scpi.applied == 0.0)


def command(scpi, folder, *more):
    scpi.ticks = True
    table = "\n".join(f"{key} = {json.dumps(value)}" for key, value in {"resource": scpi.resource, **TABLE}.items())
    (folder / "rig.toml").write_text(f"{RIG_FILE}\n[instrument]\n{table}\n")
    words = ["run", "rig.toml", "--plant", "agents.hardware.visa_instrument:plant", "--out", "run", "--policy", "prbs"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.Popen(
        [sys.executable, "-c", COMMAND, *words, "--bound", "0.01", "--samples", "2000", *more],
        cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def wait_for(condition):
    """Ten minutes are for ever."""
    end = time.monotonic() + 600.0
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.01)


def wait_until_it_stalls(scpi, process):
    def stalls():
        assert process.poll() is None, process.communicate()
        return scpi.stalled.is_set()

    wait_for(stalls)


@pytest.mark.parametrize("scpi", [{"fault": "stall", "word": "SOUR", "after": 150}], indirect=True)
def test_a_kill_loses_at_most_a_sample_and_the_watchdog_zeroes(scpi, tmp_path):
    """It loses one where it is killed between an output and the row that it is written into."""
    process = command(scpi, tmp_path, "--watchdog", "1")
    wait_until_it_stalls(scpi, process)
    process.kill()
    process.communicate()
    the_watchdog_zeroes_after(scpi, 1.0)
    assert len(measured(tmp_path / "run")) == scpi.answered - 1 > 100
    assert json.loads((tmp_path / "run" / "manifest.json").read_text())["ended"] is None
    assert near_truth(identify(Rig.from_file(tmp_path / "rig.toml"), tmp_path / "run" / "samples.csv").parameters)


@pytest.mark.parametrize("scpi", [{"fault": "stall", "word": "FETC:IN?", "after": 3}], indirect=True)
def test_a_kill_between_blocks_loses_at_most_a_block(scpi, tmp_path):
    process = command(scpi, tmp_path, "--block", "16")
    wait_until_it_stalls(scpi, process)
    process.kill()
    process.communicate()
    assert len(measured(tmp_path / "run")) == 16 * 3
    wait_for(lambda: scpi.applied == 0.0)


@pytest.mark.parametrize("scpi", [{"fault": "stall", "after": 60}], indirect=True)
@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_signals_zero_the_input_and_give_parameters(scpi, tmp_path, number, status):
    process = command(scpi, tmp_path)
    wait_until_it_stalls(scpi, process)
    process.send_signal(number)
    scpi.quiet.set()
    out, err = process.communicate(timeout=600)
    assert process.returncode == status, err
    wait_for(lambda: scpi.lines[-1] == "OUTP OFF")
    wait_for(lambda: scpi.applied == 0.0)
    assert "90 % interval" in out
    assert json.loads((tmp_path / "run" / "manifest.json").read_text())["how"] == number.name


def test_an_instrument_without_a_watchdog_is_not_armed(scpi, tmp_path):
    table = {key: value for key, value in TABLE.items() if key != "watchdog"}
    plant = visa_instrument.plant(RIG, resource=scpi.resource, **table)
    with pytest.raises(ValueError, match="plant must have a watchdog"):
        run_experiment(RIG, plant, tmp_path / "run", RunSettings(policy="prbs", samples=20), clock=scpi.clock)
    assert "OUTP ON" not in scpi.lines
    plan = RunSettings(policy="prbs", samples=20, no_watchdog=True)
    assert run_experiment(RIG, plant, tmp_path / "run", plan, clock=scpi.clock).outcome == "complete"
    plant.close()


class Broken:
    """A connection over which nothing can be sent."""

    timeout, closed = 0.0, 0

    def write(self, line):
        raise OSError("cable")

    query = write

    def close(self):
        self.closed += 1


def test_a_connection_that_cannot_be_made_ready_is_closed(monkeypatch):
    link = Broken()
    monkeypatch.setattr("pyvisa.ResourceManager.open_resource", lambda *_, **__: link)
    with pytest.raises(ValueError, match="cannot be opened: cable"):
        visa_instrument.plant(RIG, resource="TCPIP::127.0.0.1::9::SOCKET", **TABLE)
    assert link.closed == 1


def test_the_usual_timeout_is_back_after_a_block_that_failed(monkeypatch):
    link = Broken()
    monkeypatch.setattr(link, "write", lambda line: None)
    monkeypatch.setattr("pyvisa.ResourceManager.open_resource", lambda *_, **__: link)
    plant = visa_instrument.plant(RIG, resource="TCPIP::127.0.0.1::9::SOCKET", **TABLE)
    with pytest.raises(OSError, match="cable"):
        plant.play(np.zeros(1000))
    assert link.timeout == 1000 * TABLE["timeout"], "what zeroes the input next would wait for a block's time"


@table(
    ("change", "message"),
    [
        ({"set": "SOUR?"}, r"instrument.set must have \['u'\] in braces"),
        ({"read": None, "measure": "MEAS?"}, "has .*measure"),
        ({"begin": "*RST"}, r"instrument.begin must be a list of texts, such as \['\*RST'\], but is '\*RST'"),
        ({"begin": ["*RST", 1]}, "instrument.begin must be a list of texts"),
        ({"timeout": "2"}, "instrument.timeout must be a number from 0.001 to 3600, but is '2'"),
        ({"timeout": 0}, "instrument.timeout must be a number"),
        ({"zero": None}, "instrument.zero must be a text, but is None"),
        ({"resource": 7}, "instrument.resource must be a text, but is 7"),
        ({"backend": True}, "instrument.backend must be a text"),
        ({"resource": "TCPIP::127.0.0.1::1::SOCKET"}, "cannot be opened"),
    ],
)
def test_tables_that_make_no_instrument_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        visa_instrument.plant(RIG, **{"resource": "TCPIP::127.0.0.1::9::SOCKET", **TABLE, **change})
