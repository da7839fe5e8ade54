"""The study: what is finished is kept, what is stopped begins anew, and the figures are those of the runs."""

import json

import numpy as np
import pytest

from agents.evaluation.rollout import evaluate
from agents.studies import rewards as study
from agents.studies.rewards import MEASURES, RECIPES, Config, learn, main
from agents.training import train

UPDATE = 32_768  # samples between two updates of PPO
#: Two of the recipes, whose kernels other tests need too: a kernel is seconds of compilation.
FIRST, OTHER = RECIPES[0], next(recipe for recipe in RECIPES if recipe.name == "structured, fisher")


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    return Config(steps=UPDATE, seeds=2, systems=4, folder=tmp_path_factory.mktemp("study"))


@pytest.fixture
def trained(monkeypatch):
    """Trainings that were asked for; each is one update."""
    asked = []

    def once(of):
        asked.append(of.output.name)
        return train(of)

    monkeypatch.setattr(study, "train", once)
    return asked


def test_a_run_that_is_finished_is_kept_and_one_that_was_stopped_begins_anew(config, trained):
    recipe = OTHER
    folder = learn(recipe, config, 0)
    assert trained == [f"{recipe.factorisation}-{recipe.reward}-0"] == [folder.name]
    learn(recipe, config, 0)
    assert len(trained) == 1
    (folder / "policy.json").unlink()
    learn(recipe, config, 0)
    assert len(trained) == 2
    card = json.loads((folder / "policy.json").read_text())["config"]
    assert (card["reward"], card["options"]) == ("fisher", {"factorisation": "structured"})
    with pytest.raises(ValueError, match="steps must be those of the runs that are there, 32768, but are 2"):
        learn(recipe, Config(steps=2, folder=config.folder), 0)


def test_it_compares_every_recipe(config, trained, monkeypatch, capsys):
    monkeypatch.setattr(study, "RECIPES", (FIRST, OTHER))
    main(config)
    printed = capsys.readouterr().out
    written = json.loads((config.folder / "study.json").read_text())
    assert list(written["recipes"]) == ["structured, information gain", "structured, fisher"]
    assert all(name in printed for name in written["recipes"])
    assert (config.folder / "study.png").read_bytes().startswith(b"\x89PNG")
    for recipe in (FIRST, OTHER):
        summary = written["recipes"][recipe.name]
        assert set(summary) == set(MEASURES)
        options = {"factorisation": recipe.factorisation}
        runs = [str(config.folder / f"{recipe.factorisation}-{recipe.reward}-{seed}") for seed in range(2)]
        each = evaluate(runs, study.TRACK, 4, options=options)
        assert summary["fisher_gain"]["seeds"] == pytest.approx([e.metrics["fisher_gain"].mean() for e in each])
        errors = [np.median(np.mean([e.estimators["auditor"][f"error_{p}"] for p in "mcab"], axis=0)) for e in each]
        assert summary["auditor_error"]["seeds"] == pytest.approx(errors)
