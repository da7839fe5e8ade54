"""Ship a trained policy: the median of its training seeds, with a card of the scores of all seeds.

    python -m research.studies.ship_policy --name ppo/amplitude --runs runs/ppo-amplitude-v0-[0-4]

evaluates the runs on the same 256 systems (seed 0), and writes the weights of the median one by D-efficiency, or by
information gain on a track without an oracle, to `agents/policies/trained/NAME`. The card is that of its run, with the
track, the version of this package, the reward and the seeds, and with the scores over all seeds: interquartile mean,
interval, median of seeds and each seed's own.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from agents import policies
from agents.cli import run_script
from agents.console_output import print_texts_and_tables
from agents.evaluation.comparison_tables import print_comparison_table
from agents.evaluation.metric_summary import summarise_metrics
from agents.evaluation.policy_evaluation import evaluate_policies, pool_seeds
from agents.policies.networks.trained_policy import CARD_FILE, WEIGHTS_FILE
from agents.result_files import write_json
from agents.training.environments.oscillator_family import FAMILY
from estimator.support.file_io import write_atomically
from research.studies.unseen_oscillators import draw_unseen_rigs, play_episode


@dataclass(frozen=True)
class Config:
    """Ship the median of the training seeds."""

    name: str
    """What it ships as: ALGORITHM/TRACK, such as ppo/amplitude; what ships under that name is replaced."""
    runs: tuple[Path, ...]
    """Run folders of one recipe, which differ by their seeds only."""
    systems: int = 256
    """Systems to evaluate on, with seed 0."""

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[a-z0-9-]+/[a-z0-9-]+", self.name):
            raise ValueError(f"name must be ALGORITHM/TRACK in small letters, but is {self.name!r}; e.g. ppo/amplitude")
        if not self.runs:
            raise ValueError("runs must be run folders, but there are none; name those of all seeds")


def ship_median(config: Config) -> Path:
    """Evaluate, choose and write; the folder that the policy ships in.

    Raises:
        ValueError: for runs that are not policy folders, are of several recipes, or have a seed in common; for a name
            of another algorithm, or one under which a policy of another track ships.
    """
    cards = [card_of(run) for run in config.runs]
    env, options, seeds = _shared_recipe(config.runs, cards)
    folder = policies.TRAINED / config.name
    _check_name(config.name, cards[0].get("algorithm"), env, folder / CARD_FILE)
    if env == FAMILY:
        scores, by = _on_the_family(config), "information_gain"
    else:
        evaluations = evaluate_policies([str(run) for run in config.runs], env, config.systems, options=options)
        together = pool_seeds(config.name, evaluations)
        scores = summarise_metrics(together)
        by = "efficiency" if "efficiency" in scores else "information_gain"
        print_comparison_table([together], f"{env}, {config.systems} systems")
    chosen = median_index(scores[by].get("seeds", [0.0]))  # a single seed has no list of scores
    card = cards[chosen] | {
        "track": env,
        "version": version("duffing-env"),
        "reward": cards[chosen]["config"]["reward"],
        "seeds": seeds,
        "shipped": {"seed": seeds[chosen], "median_by": by},
        "scores": {
            "settings": {"env": env, "systems": config.systems, "seed": 0, "options": options},
            # The time of a decision is a property of the machine, not of the policy.
            **{name: entry for name, entry in scores.items() if name != "decision_time"},
        },
    }
    write_shipped_policy(folder, config.runs[chosen], card)
    print_texts_and_tables(f"{folder}: seed {seeds[chosen]} of {seeds}, the median by {by.replace('_', ' ')}")
    return folder


def _on_the_family(config: Config) -> dict[str, Any]:
    """The information that every seed gains on unseen oscillators of the family, as the other scores are written."""
    members = draw_unseen_rigs(config.systems)
    gains = [[play_episode(member, str(run), i)[0] for i, member in enumerate(members)] for run in config.runs]
    seeds = [float(np.mean(gained)) for gained in gains]
    return {"information_gain": {"mean": float(np.mean(seeds)), "seeds": seeds}}


def _check_name(name: str, algorithm: str | None, env: str, card: Path) -> None:
    """Refuse a name that belongs to other runs."""
    if name.partition("/")[0] != algorithm:
        raise ValueError(f"name must begin with the runs' algorithm, {algorithm}, but is {name!r}")
    if card.is_file() and (of := json.loads(card.read_text(encoding="utf-8"))["track"]) != env:
        raise ValueError(f"name must be one for {env}, but {name!r} is of {of}; ship the runs under another")


def median_index(values: list[float]) -> int:
    """The index of the median value; of an even number of values, the lower one of the middle two."""
    return int(np.argsort(values, kind="stable")[(len(values) - 1) // 2])


def card_of(run: Path) -> dict[str, Any]:
    """The card of a finished run; of absolute paths, which depend on the machine, it keeps only the file names.

    Raises:
        ValueError: for a folder that holds no policy.
    """
    if not (run / WEIGHTS_FILE).is_file() or not (run / CARD_FILE).is_file():
        raise ValueError(
            f"runs must hold {WEIGHTS_FILE} and {CARD_FILE}, but {run} does not; pass finished run folders"
        )
    card: dict[str, Any] = json.loads((run / CARD_FILE).read_text(encoding="utf-8"))
    card["command"] = [_path_name(word) for word in card.get("command", [])]
    if card["config"].get("output"):
        card["config"]["output"] = _path_name(card["config"]["output"])
    return card


def _path_name(word: str) -> str:
    return Path(word).name if Path(word).is_absolute() else word


def write_shipped_policy(folder: Path, run: Path, card: dict[str, Any]) -> None:
    """Write a run's weights and a card into a folder of the package."""
    # The weights come first: a second attempt repairs an older card, and a card without weights is not a policy.
    write_atomically(folder / WEIGHTS_FILE, (run / WEIGHTS_FILE).read_bytes())
    write_json(folder / CARD_FILE, card)


def _shared_recipe(runs: tuple[Path, ...], cards: list[dict[str, Any]]) -> tuple[str, dict[str, Any], list[int]]:
    """Track, options and seeds of runs that differ only by their seeds and folders."""
    recipes = [
        {"algorithm": card.get("algorithm"), **card["config"]} | {"seed": None, "output": None, "systems": None}
        for card in cards
    ]
    for run, recipe in zip(runs, recipes, strict=True):
        differing = sorted(name for name in recipes[0] | recipe if recipe.get(name) != recipes[0].get(name))
        if differing:
            raise ValueError(f"runs must be of one recipe, but {run} has another {', '.join(differing)} than {runs[0]}")
    seeds = [int(card["config"]["seed"]) for card in cards]
    if len(set(seeds)) < len(seeds):
        raise ValueError(f"runs must have a seed each, but have {seeds}; leave out what is there twice")
    return recipes[0]["env"], recipes[0]["options"], seeds


if __name__ == "__main__":
    run_script(ship_median, Config, __doc__)
