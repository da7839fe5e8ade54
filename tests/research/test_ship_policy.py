"""Shipping: the median seed ships, with a card that has the scores of all seeds."""

import json
import shutil

import numpy as np
import pytest
from stable_baselines3 import PPO

from agents import make_policy, policies
from agents.evaluation.oracle import TrackSystems
from agents.evaluation.policy_evaluation import evaluate_policies
from agents.policies.networks.policy_saving import save_policy
from agents.policies.networks.trained_policy import CARD_FILE, load_policy
from agents.sb3_vec_env import DuffingVecEnv
from agents.training.environments.oscillator_family import FAMILY
from research.studies.ship_policy import Config, card_of, median_index, ship_median
from research.studies.unseen_oscillators import draw_unseen_rigs, play_episode

SHORT = "duffing_env/Short-v0"


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Three run folders of policies that nobody trained, of one recipe."""
    base, envs = tmp_path_factory.mktemp("runs"), DuffingVecEnv(SHORT, 2)
    for seed in range(3):
        settings = {"net_arch": [8], "log_std_init": -1.0}
        model = PPO("MlpPolicy", envs, n_steps=8, batch_size=16, policy_kwargs=settings, seed=seed, device="cpu")
        config = {"env": SHORT, "reward": "information_gain", "options": {}, "seed": seed, "output": str(seed)}
        save_policy(base / f"run-{seed}", model, {"algorithm": "ppo", "config": config, "command": ["train.py"]})
    return tuple(base / f"run-{seed}" for seed in range(3))


@pytest.fixture
def shelf(monkeypatch, tmp_path):
    monkeypatch.setattr(policies, "TRAINED", tmp_path / "trained")
    return tmp_path / "trained"


def changed(run, folder, **config):
    """A copy of a run with another configuration in its card."""
    folder.mkdir()
    card = json.loads((run / "policy.json").read_text())
    (folder / "policy.json").write_text(json.dumps(card | {"config": card["config"] | config}))
    (folder / "policy.safetensors").write_bytes((run / "policy.safetensors").read_bytes())
    return folder


def test_the_median_seed_ships_with_the_scores_of_all(runs, shelf, capsys):
    folder = ship_median(Config("ppo/short", runs, systems=8))
    assert folder == shelf / "ppo" / "short"
    assert sorted(path.name for path in folder.iterdir()) == ["policy.json", "policy.safetensors"]
    card = json.loads((folder / "policy.json").read_text())
    assert (card["track"], card["reward"], card["seeds"]) == (SHORT, "information_gain", [0, 1, 2])
    assert card["command"] == ["train.py"]
    scores = card["scores"]
    each = evaluate_policies([str(run) for run in runs], SHORT, systems=8)
    by = card["shipped"]["median_by"]
    assert by == ("efficiency" if TrackSystems.of(SHORT, 1).path.exists() else "information_gain")
    for name in {by, "information_gain"}:
        assert scores[name]["seeds"] == pytest.approx([float(e.metrics[name].mean()) for e in each])
        assert scores[name]["median_of_seeds"] == pytest.approx(sorted(scores[name]["seeds"])[1])
        assert scores[name]["low"] <= scores[name]["iqm"] <= scores[name]["high"]
    shipped = card["shipped"]["seed"]
    assert scores[by]["seeds"][shipped] == scores[by]["median_of_seeds"]
    assert card["config"]["seed"] == shipped
    weights = "policy.safetensors"
    assert (folder / weights).read_bytes() == (runs[shipped] / weights).read_bytes()
    assert make_policy("ppo/short").card == load_policy(folder).card
    assert "(3 seeds)" in capsys.readouterr().out


def test_a_single_seed_ships_as_one(runs, shelf):
    card = json.loads((ship_median(Config("ppo/short", runs[1:2], systems=8)) / "policy.json").read_text())
    assert (card["seeds"], card["shipped"]["seed"]) == ([1], 1)
    assert "seeds" not in card["scores"]["information_gain"]


def test_runs_of_different_recipes_do_not_ship(runs, shelf, tmp_path):
    other = changed(runs[1], tmp_path / "other", reward="fisher")
    with pytest.raises(ValueError, match=r"one recipe, but .*other has another reward"):
        ship_median(Config("ppo/short", (runs[0], other)))
    twice = changed(runs[1], tmp_path / "twice", seed=0)
    with pytest.raises(ValueError, match=r"a seed each, but have \[0, 0\]"):
        ship_median(Config("ppo/short", (runs[0], twice)))
    with pytest.raises(ValueError, match="finished run folders"):
        ship_median(Config("ppo/short", (runs[0], tmp_path)))
    with pytest.raises(ValueError, match="runs must be run folders, but there are none"):
        Config("ppo/short", ())
    with pytest.raises(ValueError, match="ALGORITHM/TRACK"):
        Config("../short", runs)
    assert not shelf.exists()


def test_runs_ship_under_their_own_name(runs, shelf):
    with pytest.raises(ValueError, match="name must begin with the runs' algorithm, ppo, but is 'sac/short'"):
        ship_median(Config("sac/short", runs))
    (shelf / "ppo" / "amplitude").mkdir(parents=True)
    (shelf / "ppo" / "amplitude" / CARD_FILE).write_text('{"track": "duffing_env/Amplitude-v0"}')
    with pytest.raises(ValueError, match=f"name must be one for {SHORT}, but 'ppo/amplitude' is of duffing_env/Amp"):
        ship_median(Config("ppo/amplitude", runs))


def test_the_median_of_an_even_number_is_the_lower_one():
    assert median_index([3.0, 1.0, 2.0]) == 2
    assert median_index([4.0, 1.0, 3.0, 2.0]) == 3


def test_no_shipped_card_names_a_machine(tmp_path, runs):
    for card in policies.TRAINED.glob(f"*/*/{CARD_FILE}"):
        assert '"/' not in card.read_text(), card
    run = shutil.copytree(runs[0], tmp_path / "mine")
    card = json.loads((run / CARD_FILE).read_text())
    card["config"]["output"], card["command"] = str(run), ["train.py", "--output", str(run), "--seed", "1"]
    (run / CARD_FILE).write_text(json.dumps(card))
    found = card_of(run)
    assert found["config"]["output"] == "mine"
    assert found["command"] == ["train.py", "--output", "mine", "--seed", "1"]


@pytest.mark.parametrize("name", policies.trained_policies())
def test_a_shipped_policy_scores_as_its_card_says(name):
    card = make_policy(name).card
    if card["config"]["env"] == FAMILY:
        gains = np.array([play_episode(member, name, i)[0] for i, member in enumerate(draw_unseen_rigs(8))])
        expected = card["scores"]["information_gain"]["mean"]
        assert abs(gains.mean() - expected) < 4 * gains.std() / np.sqrt(8)
        return
    (evaluation,) = evaluate_policies([name], card["config"]["env"], systems=16)
    # With several training seeds the card has the scores of all, and names the one that ships.
    place = card["seeds"].index(card["shipped"]["seed"])
    for metric, slack in (("information_gain", 0.05), ("coverage", 0.02)):
        values = evaluation.metrics[metric]
        scores = card["scores"][metric]
        expected = scores["seeds"][place] if "seeds" in scores else scores["mean"]
        assert abs(values.mean() - expected) < 4 * values.std() / np.sqrt(16) + slack
