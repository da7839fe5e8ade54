"""Datasets for offline learning."""

import re
from pathlib import Path

import numpy as np
import pytest

from agents import minari_datasets
from agents.evaluation.track_batch import make_track_batch
from agents.minari_datasets import Config, collect_episodes, main

ROOT = Path(__file__).parents[2]
SHORT = "duffing_env/Short-v0"


@pytest.mark.parametrize("grade", ["random", "medium"])
def test_episodes_are_whole(grade):
    episodes = collect_episodes(Config(grade, SHORT, episodes=300))
    assert len(episodes) == 300
    for episode in episodes:
        length = len(episode["actions"])
        assert 1 <= length <= 48
        assert episode["observations"].shape == (length + 1, 22)
        assert episode["rewards"].shape == episode["terminations"].shape == episode["truncations"].shape == (length,)
        ended = episode["terminations"] | episode["truncations"]
        assert ended.sum() == 1
        assert ended[-1]
    assert len({episode["observations"][1].tobytes() for episode in episodes}) == 300  # no episode twice


def test_recorded_actions_reproduce_observations_and_rewards():
    """A dataset holds consistent episodes: the same seed and actions give the same observations and rewards."""
    (episode, *_) = collect_episodes(Config("medium", SHORT, episodes=4))
    envs = make_track_batch(SHORT, 4)
    envs.reset(seed=int(np.random.SeedSequence(0).generate_state(1)[0]))
    for t, action in enumerate(episode["actions"]):
        observations, rewards, *_ = envs.step(np.tile(action, (4, 1)))
        np.testing.assert_array_equal(observations[0], episode["observations"][t + 1])
        assert rewards[0] == episode["rewards"][t]


def test_a_track_without_an_expert_has_none():
    with pytest.raises(ValueError, match="grade must not be expert on duffing_env/WienerHammerstein-v0"):
        collect_episodes(Config("expert", "duffing_env/WienerHammerstein-v0", episodes=1))


def test_a_track_is_known_by_its_name():
    assert Config("random", "Short-v0") == Config("random", SHORT)
    assert Config("random", "Pendulum-v0").name == "duffing/pendulum-v0/random-v0"


def test_a_dataset_is_not_replaced(tmp_path, monkeypatch):
    """What is there is found before anything is played."""
    pytest.importorskip("minari", reason="minari is not installed; it is the extra datasets")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    monkeypatch.setattr(minari_datasets, "collect_episodes", lambda config: pytest.fail("it is refused before"))
    (tmp_path / "duffing/short-v0/random-v0").mkdir(parents=True)
    with pytest.raises(ValueError, match=r"random-v0 must be a new dataset, but is in .*random-v0; delete that folder"):
        main(Config("random", "Short-v0"))


def test_a_learner_learns_from_a_dataset(tmp_path, monkeypatch, capsys):
    """The page's example, on a dataset that the command makes."""
    pytest.importorskip("minari", reason="minari is not installed; it is the extra datasets")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    main(Config("expert", SHORT, episodes=256))
    assert "duffing/short-v0/expert-v0: 256 episodes" in capsys.readouterr().out
    (code,) = re.findall(r"```\n(import minari.*?)```", (ROOT / "docs/datasets.md").read_text(), re.DOTALL)
    names = {}
    exec(compile(code, "datasets.md", "exec"), names)
    cloned, noise = names["evaluations"]
    assert cloned.metrics["information_gain"].mean() > noise.metrics["information_gain"].mean() + 1
