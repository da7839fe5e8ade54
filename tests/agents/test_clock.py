"""A wall clock that is set back or forward: durations come from the monotonic clock."""

import csv
import itertools
import time

import numpy as np
import pytest

from agents.hardware.clock import JumpingClock, RealClock
from agents.hardware.experiment_run import RunSettings, run_experiment
from agents.hardware.simulated_plant import SimulatedPlant
from agents.sb3_vec_env import DuffingVecEnv
from agents.training import ALGORITHMS, TrainConfig, train
from estimator import Channel, Rig

RIG = Rig(
    5e-3, input=Channel("N", limit=6.0), output=Channel("m", range=0.03, noise=5e-6),
    guess={"m": (0.3, 0.5), "c": (0.4, 0.8), "a": (2e3, 3e3), "b": (2e7, 6e7)},
)  # fmt: skip


@pytest.fixture(params=[-3600, 864_000], ids=["back", "forward"])
def set_anew(monkeypatch, request):
    """Every look at the clock finds it an hour earlier than the last one, or ten days later."""
    seconds = itertools.count(0, request.param)
    now = time.time()
    monkeypatch.setattr(time, "time", lambda: now + next(seconds))
    monkeypatch.setattr(time, "time_ns", lambda: int(1e9 * (now + next(seconds))))
    assert time.time() != time.time()


@pytest.mark.parametrize("algo", ["ppo", "sac"])
def test_a_training_lasts_as_long_as_it_does(set_anew, tmp_path, monkeypatch, algo):
    monkeypatch.setattr("agents.training.heldout_evaluation._N_SYSTEMS", 4)
    own = {"n_steps": 16} if algo == "ppo" else {"buffer_size": 400, "learning_starts": 32}
    small = ALGORITHMS[algo](num_envs=8, batch_size=64, hidden=(4,), **own)
    began = time.perf_counter()
    found = train(
        TrainConfig(
            env="duffing_env/Short-v0", algo=algo, steps=512, output=tmp_path, eval_every=256, hyperparameters=small
        )
    )
    longest = time.perf_counter() - began
    seconds = np.array(found.curve)[:, 1]
    assert (np.diff(seconds) > 0).all()
    assert 0 < seconds[0] < found.seconds < longest
    rows = list(csv.DictReader((tmp_path / "progress.csv").read_text().splitlines()))
    assert rows
    assert all(0 <= float(row["time/time_elapsed"]) <= longest for row in rows)
    assert all(float(row["time/fps"]) * longest >= 8 for row in rows)


def test_episodes_last_forward(set_anew):
    envs = DuffingVecEnv("duffing_env/Short-v0", 2, horizon=4)
    envs.reset()
    times = [info["episode"]["t"] for _ in range(12) for info in envs.step(np.zeros((2, 1)))[3] if "episode" in info]
    assert len(times) == 6
    assert min(times) > 0
    assert (np.diff(times) >= 0).all()


def test_the_clock_of_a_run_goes_forward(set_anew):
    clock = RealClock()
    begun = clock.now()
    clock.wait(begun + 0.01)
    assert clock.now() >= begun + 0.01


def test_a_run_meets_its_ticks(set_anew, tmp_path):
    clock = JumpingClock()
    found = run_experiment(
        RIG, SimulatedPlant(RIG, clock=clock), tmp_path / "run", RunSettings("prbs", 40), clock=clock
    )
    assert (found.outcome, found.exit_status, found.late_ticks) == ("complete", 0, 0)
    due, seen = np.loadtxt(tmp_path / "run/samples.csv", delimiter=",", skiprows=1, usecols=(1, 7), unpack=True)
    np.testing.assert_allclose(seen, due, rtol=0, atol=1e-9)
