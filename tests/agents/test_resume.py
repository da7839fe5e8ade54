"""Tests of checkpoints and resuming: a kill loses only the samples since the latest checkpoint."""

import csv
import json
import os
import runpy
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file, save_file

import agents
from agents import make_policy
from agents.interruption import Interrupted
from agents.policies.networks.feature_names import FEATURE_NAMES
from agents.sb3_vec_env import DuffingVecEnv
from agents.training import ALGORITHMS, TrainConfig, resume, train
from agents.training.checkpoints import (
    STATE_FILE,
    TENSORS_FILE,
    TrainingProgress,
    latest_checkpoint,
    load_progress,
    restore_training_state,
    save_checkpoint,
)

ENV = "duffing_env/Short-v0"
OFF_POLICY = {
    "num_envs": 8, "batch_size": 16, "hidden": (4,), "buffer_size": 400, "learning_starts": 32, "train_freq": 4,
    "gradient_steps": 2,
}  # fmt: skip
ON_POLICY = {"num_envs": 8, "batch_size": 64, "hidden": (4,), "n_steps": 16}
#: Eight roll-outs of 128 samples (on-policy), 32 of 32 (off-policy); a checkpoint every 256.
STEPS, CHECKPOINTS = 1024, 4


def tiny(algo):
    if algo in ("tqc", "recurrent_ppo"):
        pytest.importorskip("sb3_contrib", reason="sb3-contrib is not installed; it is the extra contrib")
    return ALGORITHMS[algo](**(ON_POLICY if "ppo" in algo else OFF_POLICY))


def config(algo, output, **settings):
    settings = {"hyperparameters": tiny(algo)} | settings
    return TrainConfig(algo=algo, env=ENV, steps=STEPS, checkpoints=CHECKPOINTS, output=output, **settings)


def log(folder):
    return list(csv.DictReader((folder / "progress.csv").read_text().splitlines()))


def test_a_run_that_began_with_a_policy_sees_as_it_did_after_a_stop(tmp_path):
    first = train(config("ppo", tmp_path / "first", seed=5)).folder
    folder = resume(stopped("ppo", tmp_path / "run", at=640, begin=first)).folder
    whole = train(config("ppo", tmp_path / "whole", eval_every=128, begin=first)).folder
    runs = [load_file(path / "policy.safetensors") for path in (first, folder, whole)]
    for name in ("normalizer.mean", "normalizer.std"):
        assert all(np.array_equal(run[name], runs[0][name]) for run in runs)
    assert (folder / "policy.safetensors").read_bytes() == (whole / "policy.safetensors").read_bytes()


@pytest.fixture(scope="module", autouse=True)
def few_systems():
    """What is evaluated on the way is no subject here: on 4 systems instead of 128."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("agents.training.heldout_evaluation._N_SYSTEMS", 4)
        yield


class Stop(Exception):
    """Ends a training from within."""


def stopped(algo, folder, at, **settings):
    """A run that ends by an exception after its evaluation at ``at`` samples, before a checkpoint there."""

    def stop(steps, found):
        if steps >= at:
            raise Stop

    with pytest.raises(Stop):
        train(config(algo, folder, eval_every=128, **settings), stop)
    return folder


@pytest.fixture(scope="module")
def stopped_once(tmp_path_factory):
    """A run of PPO that ended at 400 samples."""
    return stopped("ppo", tmp_path_factory.mktemp("stopped") / "run", at=400)


@pytest.fixture
def run_of_400(stopped_once, tmp_path):
    """A copy of it, in a folder whose name has a space."""
    return Path(shutil.copytree(stopped_once, tmp_path / "my run"))


KILLED = """
import os, signal, sys
from pathlib import Path
from tests.agents.test_resume import config, train

rename = os.replace

def replace(source, target):
    if Path(target).name == "000000768":
        os.kill(os.getpid(), signal.SIGKILL)
    rename(source, target)

os.replace = replace
train(config(sys.argv[1], Path(sys.argv[2])))
"""


@pytest.mark.parametrize("algo", ["ppo", pytest.param("sac", marks=pytest.mark.slow)])
def test_a_kill_loses_at_most_one_checkpoint_interval(tmp_path, algo):
    """Killed by SIGKILL while the third of four checkpoints is half-written, it goes on from the second."""
    folder = tmp_path / "run"
    finished = subprocess.run(
        [sys.executable, "-c", KILLED, algo, folder],
        cwd=Path(agents.__file__).parents[1], env=os.environ | {"OMP_NUM_THREADS": "1"},
        capture_output=True, text=True, timeout=600,
    )  # fmt: skip
    assert finished.returncode == -signal.SIGKILL, finished.stderr
    assert list(folder.glob(".checkpoint-*"))
    assert not (folder / "policy.json").exists()
    assert sorted(path.name for path in (folder / "checkpoints").iterdir()) == ["000000256", "000000512"]
    begun = (folder / "config.json").read_bytes()

    run = resume(folder)

    assert run.folder == folder
    assert run.config == config(algo, folder)
    assert (folder / "config.json").read_bytes() == begun
    names = [f"{steps:09d}" for steps in range(256, 1025, 256)]
    assert sorted(path.name for path in (folder / "checkpoints").iterdir()) == names
    assert [make_policy(str(folder / "checkpoints" / name)).card["steps"] for name in names] == [256, 512, 768, 1024]
    assert make_policy(str(folder)).card["steps"] == STEPS
    assert not list(folder.rglob("training.*")) + list(folder.glob(".*"))
    steps, seconds, _ = np.array(run.curve).T
    np.testing.assert_array_equal(steps, np.arange(1, 1 + len(steps)) * STEPS / len(steps))
    assert np.all(np.diff(seconds) > 0)
    assert run.seconds > seconds[-1]


def test_the_schedule_and_the_log_go_on(tmp_path):
    folder = stopped("ppo", tmp_path / "run", at=640)
    assert len(log(folder)) == 5  # rows up to 640 samples, of which 512 are in a checkpoint
    with open(folder / "progress.csv", "a") as file:
        file.write("1,2")  # a row that the kill cut off
    resume(folder)
    rows = log(folder)
    assert [int(row["time/total_timesteps"]) for row in rows] == list(range(128, STEPS + 1, 128))
    rates = {int(row["time/total_timesteps"]): row["train/learning_rate"] for row in rows}
    assert rates.pop(128) == rates.pop(640) == ""  # the update before them is in no log of theirs
    for steps, rate in rates.items():
        assert float(rate) == pytest.approx(1e-3 * (1 - (steps - 128) / STEPS))
    updates = [int(row["train/n_updates"]) for row in rows if row["train/n_updates"]]
    assert updates == [4, 8, 12, 20, 24, 28]


@pytest.mark.parametrize(
    ("algo", "settings"),
    [
        *((algo, {}) for algo in ALGORITHMS),
        ("ppo", {"hyperparameters": ALGORITHMS["ppo"](**ON_POLICY, levels=4, entropy_bonus=0.1)}),
        ("ppo", {"hyperparameters": ALGORITHMS["ppo"](**ON_POLICY, features=False)}),
        ("ppo", {"imitate": "velocity-sign", "imitations": 512}),
        ("sac", {"hyperparameters": ALGORITHMS["sac"](**OFF_POLICY | {"learning_starts": 600})}),
    ],
)
def test_a_resumed_run_is_the_one_that_was_never_stopped(tmp_path, algo, settings):
    folder = stopped(algo, tmp_path / "run", at=640, **settings)
    before = load_progress(latest_checkpoint(folder))
    starts = getattr(settings.get("hyperparameters", tiny(algo)), "learning_starts", 0)
    assert (before.steps, before.updates > 0) == (512, starts < 512)
    run = resume(folder)
    assert make_policy(str(folder)).card["steps"] == STEPS
    assert [point[:2] for point in run.curve[: len(before.curve)]] == [point[:2] for point in before.curve]
    rows = (folder / "evaluations.csv").read_text().splitlines()
    assert [int(row.split(",")[0]) for row in rows[1:]] == list(range(0, STEPS + 1, 128))
    whole = train(config(algo, tmp_path / "whole", eval_every=128, **settings)).folder
    for name in ("policy.safetensors", "evaluations.csv"):
        assert (folder / name).read_bytes() == (whole / name).read_bytes(), name
    returns, others = ([row["rollout/ep_rew_mean"] for row in log(path)] for path in (folder, whole))
    assert returns == others


def test_a_run_that_was_stopped_before_its_first_checkpoint_begins_again(tmp_path):
    folder = stopped("ppo", tmp_path / "run", at=128)
    assert latest_checkpoint(folder) is None
    assert not (folder / "checkpoints").exists()
    resume(folder)
    whole = train(config("ppo", tmp_path / "whole", eval_every=128))
    assert (folder / "policy.safetensors").read_bytes() == (whole.folder / "policy.safetensors").read_bytes()
    first, second = ([row["time/total_timesteps"] for row in log(path)] for path in (folder, whole.folder))
    assert first == second


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_a_restored_model_learns_as_the_one_that_was_saved(tmp_path, algo):
    """Weights, targets, moments, entropy weight and buffer: after the same update, the same weights."""

    def update(model):
        torch.manual_seed(0)
        np.random.seed(0)  # noqa: NPY002  Stable-Baselines3 samples with it
        model._current_progress_remaining = 0.5
        model.train() if "ppo" in algo else model.train(gradient_steps=4, batch_size=16)
        return {name: value.clone() for name, value in model.policy.state_dict().items()}

    first, second = (tiny(algo).make(DuffingVecEnv(ENV, 8, seed=0), seed) for seed in (0, 1))
    first.learn(512)
    save_checkpoint(tmp_path, first, {}, TrainingProgress(steps=512, updates=first._n_updates, episodes=3))
    restore_training_state(latest_checkpoint(tmp_path), second)
    assert (second.num_timesteps, second._n_updates, second._episode_num) == (512, first._n_updates, 3)
    if "ppo" in algo:
        second.rollout_buffer = first.rollout_buffer
    else:
        assert first.replay_buffer.full  # of 400 samples
        assert second.replay_buffer.pos == first.replay_buffer.pos > 0
    second.set_logger(first.logger)
    before = {name: value.clone() for name, value in first.policy.state_dict().items()}
    expected, found = update(first), update(second)
    for name, value in expected.items():
        assert torch.equal(value, found[name]), name
    assert any(not torch.equal(before[name], expected[name]) for name in before)
    if algo in ("sac", "tqc"):
        assert torch.equal(first.log_ent_coef, second.log_ent_coef)


def test_only_the_latest_checkpoint_holds_the_state(tmp_path):
    folder = stopped("sac", tmp_path / "run", at=640)
    found = {path.parent.name: path.name for path in folder.rglob("training.*")}
    assert set(found) == {"000000512"}
    assert latest_checkpoint(folder) == folder / "checkpoints" / "000000512"
    buffer = load_file(latest_checkpoint(folder) / TENSORS_FILE)
    assert buffer["buffer/observations"].shape == (
        50,
        8,
        len(FEATURE_NAMES) + 22,
    )  # of 64 samples of each, the buffer holds 50
    earlier = make_policy(str(folder / "checkpoints" / "000000256"))
    assert earlier.card["steps"] == 256


def test_the_script_resumes(run_of_400, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "400")
    monkeypatch.setattr(sys, "argv", ["train.py", "--resume", str(run_of_400), "--systems", "0"])
    runpy.run_path(str(Path(agents.__file__).parents[1] / "train.py"), run_name="__main__")
    assert f"The run is in {run_of_400}" in " ".join(capsys.readouterr().out.split())
    assert make_policy(str(run_of_400)).card["steps"] == STEPS


def test_a_finished_run_is_not_resumed(tmp_path):
    train(replace(config("ppo", tmp_path / "run"), steps=128))
    with pytest.raises(
        ValueError, match=r"must be a run that was stopped, but .*run is finished; .* train --begin .*run"
    ):
        resume(tmp_path / "run")
    with pytest.raises(ValueError, match=r"resume must be a run folder, .* but .*none is not one; name a"):
        resume(tmp_path / "none")


def test_a_configuration_of_something_else_is_refused(tmp_path):
    for content in ("{", "[]", '{"config": {"env": 3}}'):
        (tmp_path / "config.json").write_text(content)
        with pytest.raises(
            ValueError, match=r"config.json of .* must hold the settings of a training run, but does not"
        ):
            resume(tmp_path)


def test_a_damaged_checkpoint_is_refused(run_of_400):
    folder = run_of_400
    checkpoint = latest_checkpoint(folder)
    whole = (checkpoint / TENSORS_FILE).read_bytes()
    for damage in (whole[:-10], b""):
        (checkpoint / TENSORS_FILE).write_bytes(damage)
        with pytest.raises(ValueError, match=r"checkpoint must hold this algorithm's state"):
            resume(folder)
    save_file({"policy/weight": np.zeros(3)}, checkpoint / TENSORS_FILE)
    with pytest.raises(ValueError, match=r"checkpoint must hold this algorithm's state"):
        resume(folder)
    (checkpoint / TENSORS_FILE).write_bytes(whole)
    for damage in ("{", json.dumps({"steps": 3}), json.dumps({"curve": [], "speed": 1})):
        (checkpoint / STATE_FILE).write_text(damage)
        with pytest.raises(ValueError, match=r"checkpoint must hold a sound training.json"):
            resume(folder)


@pytest.mark.parametrize(("number", "algo"), [(signal.SIGINT, "ppo"), (signal.SIGTERM, "sac")])
def test_after_a_signal_the_update_is_finished_and_all_is_kept(tmp_path, number, algo):
    """The signal comes while it learns: what is left is said, nothing is lost, and the run goes on from there."""

    def send(steps, found):
        if steps == 384:
            os.kill(os.getpid(), number)

    with pytest.raises(Interrupted) as caught:
        train(replace(config(algo, tmp_path / "run", eval_every=128), checkpoints=1), send)
    assert caught.value.signum == number
    assert caught.value.resume_hint == f"go on with: duffing-env train --resume {tmp_path / 'run'}"
    checkpoint = latest_checkpoint(tmp_path / "run")
    assert load_progress(checkpoint).steps == 384
    assert resume(tmp_path / "run").curve[-1][0] == STEPS


@pytest.mark.parametrize(
    ("where", "left"),
    [
        ("environments.training_envs.make_training_envs", "nothing was kept"),
        ("training_loop.TrainingLoop._learn", "nothing was kept; begin again with: duffing-env train"),
    ],
)
def test_a_stop_before_the_first_update_says_that_nothing_was_kept(tmp_path, monkeypatch, where, left):
    for number, error in ((signal.SIGINT, KeyboardInterrupt()), (signal.SIGTERM, Interrupted(signal.SIGTERM))):

        def stop(*arguments, error=error):
            raise error

        monkeypatch.setattr(f"agents.training.{where}", stop)
        folder = tmp_path / f"run-{number}"
        with pytest.raises(Interrupted) as caught:
            train(config("ppo", folder))
        assert caught.value.signum == number
        assert caught.value.resume_hint == left + (f" --resume {folder}" if "begin" in left else "")


def test_a_stop_before_the_first_update_of_a_resumed_run_says_how_to_go_on(run_of_400, monkeypatch):
    monkeypatch.setattr(
        "agents.training.training_loop.TrainingLoop._learn", lambda self: signal.raise_signal(signal.SIGINT)
    )
    with pytest.raises(Interrupted) as caught:
        resume(run_of_400)
    assert caught.value.resume_hint == f"go on with: duffing-env train --resume '{run_of_400}'"
