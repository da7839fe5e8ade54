"""The search for hyperparameters: it goes on where it stopped, and what it writes can be trained with."""

import csv
import json
import re
import signal

import pytest

import agents.commands.train_command
from agents.commands.train_command import main
from agents.interruption import Interrupted
from agents.training import PPOSettings, TrainConfig, train, tune_hyperparameters
from agents.training.heldout_evaluation import HeldOutScores
from agents.training.hyperparameters import read_hyperparameters

ENV = "duffing_env/Short-v0"
TINY = PPOSettings(num_envs=8, n_steps=16, batch_size=128, hidden=(4,))


@pytest.fixture(scope="module", autouse=True)
def few_systems():
    """Trials are scored on 8 systems instead of 128."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("agents.training.heldout_evaluation._N_SYSTEMS", 8)
        yield


@pytest.fixture
def optuna():
    return pytest.importorskip("optuna", reason="Optuna is not installed; it is the extra tune")


def tiny(output, **settings):
    return TrainConfig(**{"env": ENV, "steps": 512, "output": output, "hyperparameters": TINY, **settings})


def scores(folder):
    """Score of every trial at its end."""
    return {
        int(path.parent.name): float(list(csv.DictReader(path.read_text().splitlines()))[-1]["log_posterior_gain"])
        for path in folder.glob("trials/*/evaluations.csv")
    }


def test_a_search_finds_what_was_best_and_goes_on(tmp_path, optuna, capsys):
    folder = tmp_path / "search"
    best = tune_hyperparameters(tiny(folder), 2)
    assert best == folder / "best.toml"
    first = scores(folder)
    assert set(first) == {0, 1}
    used = json.loads((folder / "trials" / "000" / "config.json").read_text())["config"]["hyperparameters"]
    assert used == {
        "num_envs": 8, "batch_size": 128, "learning_rate": 1e-3, "gamma": 0.99, "hidden": [4], "n_steps": 16,
        "n_epochs": 4, "gae_lambda": 0.95, "log_std_init": -0.5, "activation": "relu",
        "features": True, "own": True, "levels": 0, "entropy_bonus": 0.0, "advantages_by_time": True,
    }  # fmt: skip
    tune_hyperparameters(tiny(folder), 2)  # nothing is left to do
    assert scores(folder) == first
    folder = folder.rename(tmp_path / "moved")
    tune_hyperparameters(tiny(folder), 3)
    found = scores(folder)
    assert set(found) == {0, 1, 2}
    assert {number: found[number] for number in first} == first

    winner = max(found, key=found.__getitem__)
    best = folder / best.name
    assert best.read_text().startswith(f"# ppo, trial {winner} of ")
    settings = read_hyperparameters("ppo", ENV, best)
    again = train(tiny(tmp_path / "again", settings=best, hyperparameters=settings))
    same = folder / "trials" / f"{winner:03d}"
    assert (again.folder / "policy.safetensors").read_bytes() == (same / "policy.safetensors").read_bytes()

    printed = capsys.readouterr().out
    assert "3 complete trials, 0 pruned" in printed
    rows = [line.split()[0] for line in printed.splitlines() if re.match(r"\d+ +\d", line)][-3:]
    assert [int(row) for row in rows] == sorted(found, key=lambda number: -found[number])
    with pytest.raises(ValueError, match="output must be a new folder or the folder of the same command"):
        tune_hyperparameters(tiny(folder, seed=1), 4)


@pytest.mark.parametrize("at_once", [False, True], ids=["trained", "began"])
def test_a_trial_that_was_killed_is_made_again(tmp_path, optuna, monkeypatch, at_once):
    """The same holds for a trial that was killed between two of its hyperparameters."""

    def stand_in(run, report):
        report(run.steps, HeldOutScores(0.0, 1.0, 0.9, 0.0))

    folder = tmp_path / "search"
    monkeypatch.setattr("agents.training.hyperparameter_search.train_or_resume", stand_in)
    monkeypatch.setattr("agents.training.hyperparameter_search.final_score", lambda output: 1.0)
    tune_hyperparameters(tiny(folder), 1)
    journal = folder / "study.log"
    lines = journal.read_text().splitlines()
    reported = [k for k, line in enumerate(lines) if json.loads(line)["op_code"] == 5]  # a hyperparameter of a trial
    kept = lines[: reported[0] + 1] if at_once else lines[:-1]  # without its last line, the trial is still running
    journal.write_text("\n".join(kept) + "\n")
    tune_hyperparameters(tiny(folder), 1)
    tune_hyperparameters(tiny(folder), 2)
    storage = optuna.storages.JournalStorage(optuna.storages.journal.JournalFileBackend(str(folder / "study.log")))
    first, again, other = optuna.load_study(study_name=None, storage=storage).trials
    assert [trial.state.name for trial in (first, again, other)] == ["FAIL", "COMPLETE", "COMPLETE"]
    assert first.params.items() <= again.params.items()
    assert (len(first.params) == 1) == at_once
    assert again.params == {name: getattr(TINY, name) for name in again.params} != other.params


def test_trials_below_the_median_are_given_up(tmp_path, optuna, monkeypatch):
    """A training whose score falls from trial to trial; the median of five is needed first."""
    ended = []

    def fake(run, report):
        score = -float(run.output.name)
        for steps in range(run.eval_every, run.steps + 1, run.eval_every):
            report(steps, HeldOutScores(0.0, score, 0.9, 0.0))
        ended.append(run.output.name)

    monkeypatch.setattr("agents.training.hyperparameter_search.train_or_resume", fake)
    monkeypatch.setattr("agents.training.hyperparameter_search.final_score", lambda output: -float(output.name))
    tune_hyperparameters(tiny(tmp_path / "search", steps=1000), 8)
    assert ended == ["000", "001", "002", "003", "004"]


def test_optuna_is_asked_for_before_anything_is_written(tmp_path, monkeypatch):
    monkeypatch.setattr("estimator.support.optional_dependencies.find_spec", lambda name: None)
    with pytest.raises(ModuleNotFoundError, match=r"optuna is not installed; get it with: pip install .*\[tune\]"):
        tune_hyperparameters(tiny(tmp_path / "search"), 2)
    assert not (tmp_path / "search").exists()


@pytest.mark.parametrize(
    ("words", "work"), [(["--tune", "3"], "tune_hyperparameters"), (["--seeds", "2"], "train_seeds")]
)
def test_several_stopped_trainings_continue_with_the_same_command(words, work, monkeypatch, capsys):
    def stopped(*arguments, **options):
        raise Interrupted(signal.SIGTERM, "go on with: duffing-env train --resume one of them")

    monkeypatch.setattr(agents.commands.train_command, work, stopped)
    with pytest.raises(SystemExit) as caught:
        main("duffing-env train", ["--env", "Short-v0", *words])
    assert caught.value.code == 128 + signal.SIGTERM
    messages = capsys.readouterr().err
    assert messages == "duffing-env train: stopped; the same command goes on with what is left\n"


def test_a_search_says_how_its_best_is_trained_with(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(
        agents.commands.train_command, "tune_hyperparameters", lambda *arguments, **options: tmp_path / "the best.toml"
    )
    main("duffing-env train", ["--env", "Short-v0", "--tune", "3"])
    assert " ".join(capsys.readouterr().out.split()).endswith(
        f"the same command, with --settings '{tmp_path / 'the best.toml'}' in place of --tune and --output"
    )
