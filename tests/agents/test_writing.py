"""Commands that are disturbed while they write, by full disks, limits of the size of files, and signals.

One line says so, and everything of before is still there.
"""

import json
import os
import shutil
import signal
import subprocess
import sys
from contextlib import contextmanager, suppress

import numpy as np
import pytest
from stable_baselines3 import PPO

from agents import policies
from agents.cli import run_script
from agents.commands import main
from agents.hardware.clock import JumpingClock
from agents.hardware.experiment_run import RunSettings, run_experiment
from agents.hardware.simulated_plant import SimulatedPlant
from agents.leaderboard import leaderboard_file, protocol
from agents.policies.networks.policy_saving import save_policy
from agents.sb3_vec_env import DuffingVecEnv
from agents.training import TrainConfig, resume, train
from agents.training.algorithms import ALGORITHMS
from agents.training.checkpoints import latest_checkpoint
from estimator import Rig
from estimator.identification.data.text_tables import read_table
from research.studies import ship_policy

resource = pytest.importorskip("resource", reason="this system has no limits of the size of files")

RIG = """step = 1e-2
[input]
unit = "N"
limit = 6.0
[output]
unit = "m"
range = 0.03
noise = 5e-6
[guess]
m = [0.3, 0.5]
c = [0.4, 0.8]
a = [2e3, 3e3]
b = [2e7, 6e7]
"""
SHORT = "duffing_env/Short-v0"

#: Every command that writes, and the files that it writes over what is there; none where it asks for a new folder.
WRITERS = {
    "rig init rig.toml --from beam --force": ["rig.toml"],
    "export prbs --output signal.csv --force": ["signal.csv"],
    "design bench.toml --policy prbs --samples 64 -o next.csv --force": ["next.csv"],
    "identify bench.toml record.csv --save known.npz": ["known.npz"],
    "identify bench.toml record.csv --report page.html": ["page.html"],
    "report --output board.html": ["board.html"],
    "evaluate --policies uniform --systems 4 --output out": ["out/evaluation.json", "out/excitations.png"],
    "evaluate --policies uniform --systems 4 --report out": ["out/report.html"],
    "evaluate --protocol Short-v0 --policies uniform --submit noise --board board.jsonl": ["board.jsonl"],
    "run bench.toml --plant agents.hardware.simulated_plant:plant --policy prbs --samples 16 --out new": [],
    "ship --name ppo/mine --runs run --systems 4": ["ppo/mine/policy.json", "ppo/mine/policy.safetensors"],
    "train --env duffing_env/Short-v0 --steps 64 --systems 0 --output new --ppo.num-envs 2 --ppo.n-steps 8 "
    "--ppo.batch-size 16": [],
}


@contextmanager
def limited(size):
    """Limit the size of files [bytes], as ``ulimit -f`` does."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@contextmanager
def filled(folder):
    """A disk without a free page."""
    with open(folder / "filler", "wb", buffering=0) as filler, suppress(OSError):
        while True:
            filler.write(bytes(4096))
    try:
        yield
    finally:
        (folder / "filler").unlink()


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """A rig, a record, and a policy that nobody trained."""
    place = tmp_path_factory.mktemp("bench")
    (place / "bench.toml").write_text(RIG)
    rig = Rig.from_file(place / "bench.toml")
    plant = SimulatedPlant(rig, clock=JumpingClock())
    run_experiment(rig, plant, place / "measured", RunSettings("prbs", 64), clock=plant.clock)
    shutil.copy(place / "measured" / "samples.csv", place / "record.csv")
    model = PPO("MlpPolicy", DuffingVecEnv(SHORT, 2), n_steps=8, batch_size=16, device="cpu")
    config = {"env": SHORT, "reward": "information_gain", "options": {}, "seed": 0, "output": "run"}
    save_policy(place / "run", model, {"algorithm": "ppo", "config": config, "command": ["train.py"]})
    return place


@pytest.fixture(scope="module", autouse=True)
def quick():
    """Figures are made and written, but not drawn, which takes most of a second for a page; clocks jump."""
    clock = JumpingClock()

    def savefig(figure, buffer, format, **options):
        buffer.write({"svg": "<svg></svg>", "png": bytes(1000)}[format])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("matplotlib.figure.Figure.savefig", savefig)
        patch.setattr(protocol, "N_SYSTEMS", 8)
        for module in ("experiment_run", "simulated_plant"):
            patch.setattr(f"agents.hardware.{module}.RealClock", lambda: clock)
        yield


@pytest.fixture(scope="module")
def written(bench, tmp_path_factory):
    """A folder in which every command has written."""
    place = tmp_path_factory.mktemp("written") / "place"
    shutil.copytree(bench, place)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(place)
        for words in WRITERS:
            assert command(words, patch, place) == 0, words
            shutil.rmtree(place / "new", ignore_errors=True)
    assert content(place).keys() >= {name for names in WRITERS.values() for name in names}
    return place


@pytest.fixture
def place(written, tmp_path, monkeypatch):
    """A copy of it."""
    monkeypatch.chdir(shutil.copytree(written, tmp_path / "place"))
    return tmp_path / "place"


@pytest.fixture
def small_disk(written, tmp_path, monkeypatch):
    """A copy on a disk of its own."""
    folder = tmp_path / "disk"
    folder.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=4m", "tmpfs", folder], capture_output=True).returncode:
        yield None  # this user can mount no disk
        return
    try:
        yield shutil.copytree(written, folder, dirs_exist_ok=True)
    finally:
        monkeypatch.chdir(tmp_path)
        subprocess.run(["umount", folder], check=True)


def content(folder):
    """Every file, by its name; not the one that fills the disk, nor the folder of a run that just began."""
    files = (path for path in folder.rglob("*") if path.is_file() and path.name != "filler")
    return {str(path.relative_to(folder)): path.read_bytes() for path in files if "new/" not in str(path)}


def command(words, monkeypatch, folder):
    """Exit status."""
    name, *rest = words.split()
    monkeypatch.setattr(sys, "argv", ["duffing-env", name, *rest])
    monkeypatch.setattr(policies, "TRAINED", folder)
    try:
        if name == "ship":
            monkeypatch.setattr(sys, "argv", ["ship.py", *rest])
            run_script(ship_policy.ship_median, ship_policy.Config)
        else:
            main()
    except SystemExit as stop:
        return stop.code
    return 0


every_command = pytest.mark.parametrize("words", WRITERS, ids=lambda words: " ".join(words.split()[:2]))


@every_command
def test_a_full_disk_is_one_line_and_leaves_everything_as_it_was(words, place, small_disk, monkeypatch, capsys):
    """With a limit of 100 bytes for a file, and on a disk that is full."""
    before = content(place)
    for folder, full in ((place, lambda: limited(100)), (small_disk, lambda: filled(small_disk))):
        if folder is None:
            continue
        monkeypatch.chdir(folder)
        capsys.readouterr()
        with full():
            status = command(words, monkeypatch, folder)
        messages = capsys.readouterr().err
        assert status == 2
        assert len(messages.splitlines()) == 1, messages
        assert "make room" in messages
        assert "File too large" in messages or "No space left" in messages
        assert content(folder) == before
        assert not [path for path in folder.rglob(".*") if path.is_file() or path.name.startswith(".checkpoint")]
    shutil.rmtree(place / "new", ignore_errors=True)
    monkeypatch.chdir(place)
    assert command(words, monkeypatch, place) == 0


@every_command
def test_a_signal_while_it_writes_is_one_line_and_leaves_everything_as_it_was(words, place, monkeypatch, capsys):
    """The signal comes when the first file is there under its temporary name, or a line is about to be added."""
    before = content(place)
    for number, status in ((signal.SIGINT, 130), (signal.SIGTERM, 143)):
        sent = []

        def disturbed(call, number=number, sent=sent):
            def first(*arguments, **options):
                if not sent:
                    sent.append(number)
                    os.kill(os.getpid(), number)
                return call(*arguments, **options)

            return first

        capsys.readouterr()
        with monkeypatch.context() as patch:
            patch.setattr(os, "replace", disturbed(os.replace))
            patch.setattr(leaderboard_file, "append_atomically", disturbed(leaderboard_file.append_atomically))
            found = command(words, patch, place)
        messages = capsys.readouterr().err
        assert sent
        assert found == status
        assert len(messages.splitlines()) == 1, messages
        assert "stopped" in messages
        assert content(place) == before
        assert not [path for path in place.rglob(".*") if path.is_file()]
        shutil.rmtree(place / "new", ignore_errors=True)


@pytest.mark.parametrize("algo", ["ppo", "sac"])
def test_a_training_goes_on_from_what_was_written_before_the_disk_was_full(tmp_path, monkeypatch, algo):
    monkeypatch.setattr("agents.training.heldout_evaluation._N_SYSTEMS", 4)
    small = {"num_envs": 8, "batch_size": 16, "hidden": (4,)}
    own = (
        {"n_steps": 16}
        if algo == "ppo"
        else {"buffer_size": 400, "learning_starts": 32, "train_freq": 4, "gradient_steps": 2}
    )
    config = TrainConfig(
        algo=algo, env=SHORT, steps=1024, checkpoints=4, eval_every=128, output=tmp_path / "run",
        hyperparameters=ALGORITHMS[algo](**small, **own),
    )  # fmt: skip
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)

    def fill(steps, found):
        if steps >= 384:
            size = (tmp_path / "run/checkpoints/000000256/training.safetensors").stat().st_size
            resource.setrlimit(resource.RLIMIT_FSIZE, (size - 1, hard))

    try:
        with pytest.raises(OSError, match=r"training\.safetensors.*File too large.*make room"):
            train(config, fill)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert latest_checkpoint(tmp_path / "run").name == "000000256"
    assert not list((tmp_path / "run").glob(".*"))
    assert resume(tmp_path / "run").curve[-1][0] == 1024


@pytest.mark.parametrize("room", [0, 1], ids=["log", "checkpoint"])
def test_a_training_whose_disk_is_full_before_its_first_checkpoint_leaves_nothing(tmp_path, room):
    """There is room for config.json: what does not fit is the log, or, after its rows, the policy."""
    small = ALGORITHMS["ppo"](num_envs=8, batch_size=16, hidden=(64,), n_steps=16)
    config = TrainConfig(
        env=SHORT, steps=1024, eval_every=1024, output=tmp_path / "made" / "run", hyperparameters=small
    )
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)

    def fill(steps, found):
        size = 5000 if room else 20
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))

    try:
        with pytest.raises(OSError, match=r"File too large; make room.*'.*" + ("policy" if room else "progress.csv")):
            train(config, fill)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert not list(tmp_path.iterdir())
    assert train(config).curve[-1][0] == 1024


def test_a_run_ends_with_its_input_at_zero_and_whole_rows(bench, tmp_path):
    rig, calls = Rig.from_file(bench / "bench.toml"), []
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)

    class Filling(SimulatedPlant):
        """Leaves room for half a row after 30 samples."""

        def read(self):
            calls.append("read")
            if len(calls) == 46:  # 16 of them while it listened
                size = (tmp_path / "out/samples.csv").stat().st_size
                resource.setrlimit(resource.RLIMIT_FSIZE, (size + 20, hard))
            return super().read()

        def disarm(self):
            calls.append(self._u)
            super().disarm()

    plant = Filling(rig, clock=JumpingClock())
    try:
        with pytest.raises(OSError, match=r"File too large; make room.*samples\.csv"):
            run_experiment(rig, plant, tmp_path / "out", RunSettings("prbs", 64), clock=plant.clock)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert calls[-1] == 0.0
    table = read_table(tmp_path / "out/samples.csv")
    np.testing.assert_array_equal(table.columns[0], np.arange(table.columns.shape[1]))
    assert table.columns.shape[1] >= 45
    assert json.loads((tmp_path / "out/manifest.json").read_text())["how"] == "error"
