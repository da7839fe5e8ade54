"""Evaluations on the way: the same metrics as `evaluate.py`, on other systems, without touching the training."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from agents import make_policy
from agents.evaluation.policy_evaluation import evaluate_policies
from agents.training import PPOSettings, TrainConfig, train
from agents.training.heldout_evaluation import HeldOutScores

TINY = PPOSettings(num_envs=8, n_steps=16, batch_size=64, hidden=(4,), learning_rate=0.01)
ENV = "duffing_env/Short-v0"


def tiny(output, **settings):
    return TrainConfig(**{"env": ENV, "steps": 512, "output": output, "hyperparameters": TINY, **settings})


def rows(folder):
    table = csv.DictReader((folder / "evaluations.csv").read_text().splitlines())
    return [{name: float(value) for name, value in row.items()} for row in table]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """An evaluated run, and the scores that its evaluations reported."""
    reported = []
    folder = tmp_path_factory.mktemp("runs") / "run"
    return train(
        tiny(folder, eval_every=200, checkpoints=4), lambda steps, found: reported.append((steps, found))
    ), reported


def test_evaluations_are_reported_and_written(run):
    made, reported = run
    assert [steps for steps, _ in reported] == [
        0,
        256,
        512,
    ]  # before all updates, and the first after 200 and 400 samples
    assert rows(made.folder) == [{"steps": steps, **found._asdict()} for steps, found in reported]
    assert isinstance(reported[0][1], HeldOutScores)
    assert reported[0] != reported[1]


def test_they_are_the_metrics_of_evaluate(run):
    made, reported = run
    best = json.loads((made.folder / "best" / "policy.json").read_text())
    told_of = best["evaluation"]
    options = {"branch": "validation"}
    (evaluation,) = evaluate_policies([str(made.folder)], ENV, told_of["systems"], told_of["seed"], options)
    for name in HeldOutScores._fields:
        assert evaluation.metrics[name].mean() == pytest.approx(getattr(reported[-1][1], name), rel=1e-12), name


def test_the_best_policy_is_kept(run):
    made, reported = run
    steps, found = max(reported, key=lambda entry: entry[1].log_posterior_gain)
    card = make_policy(str(made.folder / "best")).card
    assert card["steps"] == steps
    assert {name: card["evaluation"][name] for name in HeldOutScores._fields} == found._asdict()


def test_evaluating_does_not_move_the_training(run, tmp_path):
    alone = train(tiny(tmp_path / "alone"))
    assert not (alone.folder / "evaluations.csv").exists()
    assert not (alone.folder / "best").exists()
    first, second = ((folder / "policy.safetensors").read_bytes() for folder in (alone.folder, run[0].folder))
    assert first == second


def test_training_refuses_systems_of_the_comparison(tmp_path):
    with pytest.raises(ValueError, match="options must not hold branch"):
        tiny(tmp_path, options={"branch": "test"})


def test_tensorboard_holds_both_logs(tmp_path):
    pytest.importorskip("tensorboard", reason="tensorboard is not installed; it is an extra")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    made = train(tiny(tmp_path / "run", eval_every=256, tensorboard=True))
    (events,) = Path(made.folder).glob("events.out.tfevents.*")
    accumulator = EventAccumulator(str(events)).Reload()
    for name in HeldOutScores._fields:
        scalars = accumulator.Scalars(f"evaluation/{name}")
        assert [scalar.step for scalar in scalars] == [0, 256, 512]
        np.testing.assert_allclose([s.value for s in scalars], [row[name] for row in rows(made.folder)], rtol=1e-6)
    assert [scalar.step for scalar in accumulator.Scalars("train/learning_rate")] == [256, 384, 512]


def test_tensorboard_is_asked_for_before_anything_is_written(tmp_path, monkeypatch):
    monkeypatch.setattr("estimator.support.optional_dependencies.find_spec", lambda name: None)
    with pytest.raises(ModuleNotFoundError, match=r"tensorboard is not installed; get it with: pip .*\[train\]"):
        train(tiny(tmp_path / "run", tensorboard=True))
    assert not (tmp_path / "run").exists()
