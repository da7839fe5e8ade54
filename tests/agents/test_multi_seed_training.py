"""Several seeds of one recipe: each is the training of that seed alone, wherever it is trained."""

import importlib.util
import json
from dataclasses import replace

import pytest
from tables import table

from agents.commands.train_command import main
from agents.training import PPOSettings, TrainConfig, train, train_seeds, tune_hyperparameters
from agents.training.multi_seed_training import train_or_resume

ENV = "duffing_env/Short-v0"
TINY = PPOSettings(num_envs=8, n_steps=16, batch_size=64, hidden=(4,))

needs_ray = pytest.mark.skipif(
    importlib.util.find_spec("ray") is None, reason="ray is not installed here; make compat runs this one"
)


def config(output, **settings):
    return TrainConfig(env=ENV, steps=512, checkpoints=2, output=output, hyperparameters=TINY, **settings)


def weights(folder):
    return (folder / "policy.safetensors").read_bytes()


@pytest.mark.parametrize("on_ray", [False, pytest.param(True, marks=[needs_ray, pytest.mark.filterwarnings("ignore")])])
def test_each_seed_is_the_training_of_that_seed_alone(tmp_path, on_ray):
    folders = sorted(train_seeds(config(tmp_path / "all", seed=3), 2, on_ray=on_ray))
    assert folders == [tmp_path / "all" / "3", tmp_path / "all" / "4"]
    for folder in folders:
        alone = train(config(tmp_path / f"alone-{folder.name}", seed=int(folder.name))).folder
        assert weights(folder) == weights(alone)
        card = json.loads((folder / "policy.json").read_text())
        assert (card["config"]["seed"], card["command"]) == (int(folder.name), json.loads(
            (alone / "policy.json").read_text())["command"])  # fmt: skip


def test_the_same_call_goes_on_and_another_is_refused(tmp_path, monkeypatch):
    carried = []
    monkeypatch.setattr(
        "agents.training.multi_seed_training.train_or_resume", lambda run: carried.append(run) or train_or_resume(run)
    )
    assert len(list(train_seeds(config(tmp_path), 1))) == 1
    before = (tmp_path / "0" / "policy.json").stat().st_mtime_ns
    assert len(list(train_seeds(config(tmp_path), 2))) == 2
    assert (tmp_path / "0" / "policy.json").stat().st_mtime_ns == before
    assert [run.seed for run in carried] == [0, 0, 1]
    message = r"the folder of the same command, but in .*0/config.json reward is 'information_gain' instead of 'fisher'"
    with pytest.raises(ValueError, match=message):
        list(train_seeds(replace(config(tmp_path), reward="fisher"), 2))
    other = replace(config(tmp_path), hyperparameters=replace(TINY, gamma=0.5))
    with pytest.raises(ValueError, match=r"hyperparameters.gamma is 0.99 instead of 0.5; name another folder"):
        list(train_seeds(other, 2))


def test_what_was_moved_goes_on_where_it_is(tmp_path, monkeypatch):
    first = train(config(tmp_path / "a" / "first")).folder
    begun = config(tmp_path / "a" / "all", begin=first)
    assert next(train_seeds(begun, 2)) == tmp_path / "a" / "all" / "0"  # and the second is not trained
    (tmp_path / "a").rename(tmp_path / "b")
    moved = config(tmp_path / "b" / "all", begin=tmp_path / "b" / "first")
    folders = list(train_seeds(moved, 2))
    assert [(folder / "policy.json").is_file() for folder in folders] == [True, True]
    assert not (tmp_path / "a").exists()
    with pytest.raises(ValueError, match=r"0/config.json begin is '../../first' instead of '../../other'"):
        list(train_seeds(replace(moved, begin=tmp_path / "b" / "other"), 2))


@table(
    ("words", "message"),
    [
        (["--ray"], "ray spreads several trainings, but there is one"),
        (["--seeds", "0"], "seeds must be a whole number from 1 to 1000, but is 0"),
        (["--seeds", "2", "--tune", "2"], "seeds must be 1 in a search, but is 2"),
    ],
)
def test_settings_that_make_no_sense_are_refused(words, message, capsys):
    with pytest.raises(SystemExit):
        main("train", words)
    assert message in " ".join(capsys.readouterr().err.split())


def test_without_ray_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(
        "estimator.support.optional_dependencies.find_spec", lambda name: None if name == "ray" else name
    )
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'duffing-env\[ray\]'"):
        list(train_seeds(config(tmp_path), 2, on_ray=True))


@needs_ray
@pytest.mark.filterwarnings("ignore")
def test_a_search_on_ray_has_all_its_trials(tmp_path):
    pytest.importorskip("optuna", reason="Optuna is not installed; it is the extra tune")
    best = tune_hyperparameters(config(tmp_path / "search"), 5, on_ray=True)
    assert best.read_text().startswith("# ppo, trial ")
    assert len(list((tmp_path / "search" / "trials").iterdir())) == 5


@needs_ray
@pytest.mark.filterwarnings("ignore")
def test_the_error_of_a_task_is_raised_unchanged(tmp_path):
    checkpoint = tmp_path / "0" / "checkpoints" / "000000256"
    checkpoint.mkdir(parents=True)
    (checkpoint / "training.json").write_text("{")
    with pytest.raises(ValueError, match=r"checkpoint must hold a sound training.json"):
        list(train_seeds(config(tmp_path), 2, on_ray=True))
