"""The study: which estimator and which reward to learn by, and what that gives in nats and in true error.

    python -m agents.studies.rewards --steps 600000

trains PPO on Amplitude-v0 with the mean-field and with the structured estimator, for each of the rewards
`information_gain`, `log_posterior` and `fisher`, 5 seeds each, and evaluates all on the same systems. PPO learns from
the observation and the reward as they are, without foresight, which would tell it what the reward is to teach. What is
finished is not done again, so a study that was stopped goes on where it was.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from agents.cli import run_script
from agents.evaluation.leaderboard import MEDIAN, METRICS, Metric, cell_of, center_and_interval, finite
from agents.evaluation.rollout import AUDITOR, FACTORISATIONS, FloatArray, evaluate, pooled
from agents.policies.learned import CARD
from agents.training import PPOSettings, TrainConfig, train
from estimator.files import write_atomically

TRACK = "duffing_env/Amplitude-v0"
REWARDS = ("information_gain", "log_posterior", "fisher")

#: What the recipes are compared by: what the belief says it gained, what it gained at the truth, what its estimator and
#: what an auditor made of the outputs.
MEASURES = {
    "information_gain": METRICS["information_gain"],
    "log_posterior_gain": METRICS["log_posterior_gain"],
    "fisher_gain": METRICS["fisher_gain"],
    "own_error": Metric("error of its own estimator / %", 3, 100, MEDIAN),
    "auditor_error": Metric("error of the auditor / %", 3, 100, MEDIAN),
    "coverage": METRICS["coverage"],
}


@dataclass(frozen=True)
class Config:
    """Compare estimators and rewards as teachers."""

    steps: int = 600_000
    """Samples of each training."""
    seeds: int = 5
    """Training seeds of each recipe: 0, 1, ..."""
    systems: int = 256
    """Systems to evaluate on, with seed 0."""
    folder: Path = Path("runs/study")
    """Where the trainings and the results are."""

    def __post_init__(self) -> None:
        for name in ("steps", "seeds"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, but is {getattr(self, name)}")


@dataclass(frozen=True)
class Recipe:
    """An estimator and a reward.

    Attributes:
        factorisation: of the estimator whose belief is the observation.
        reward: its name.
    """

    factorisation: str
    reward: str

    @property
    def name(self) -> str:
        """As it is printed."""
        return f"{self.factorisation.replace('_', ' ')}, {self.reward.replace('_', ' ')}"

    def run_folder(self, config: Config, seed: int) -> Path:
        """Where the training of a seed is."""
        return config.folder / f"{self.factorisation}-{self.reward}-{seed}"


RECIPES = tuple(Recipe(factorisation, reward) for factorisation in FACTORISATIONS for reward in REWARDS)


def learn(recipe: Recipe, config: Config, seed: int) -> Path:
    """Train a policy, unless it is there already; one that was stopped begins anew.

    Raises:
        ValueError: for a run of another number of steps.
    """
    folder = recipe.run_folder(config, seed)
    if (folder / CARD).is_file():
        steps = json.loads((folder / CARD).read_text())["config"]["steps"]
        if steps != config.steps:
            raise ValueError(f"steps must be those of the runs that are there, {steps}, but are {config.steps}")
        return folder
    if folder.exists():
        shutil.rmtree(folder)
    train(
        TrainConfig(
            env=TRACK,
            reward=recipe.reward,
            steps=config.steps,
            seed=seed,
            options={"factorisation": recipe.factorisation},
            output=folder,
            hyperparameters=PPOSettings(),
        )
    )
    return folder


def appraise(recipe: Recipe, runs: list[Path], systems: int) -> dict[str, FloatArray]:
    """What the policies of a recipe are worth: values (seeds, systems) by the names of `MEASURES`.

    Errors are means over m, c, a and b of the relative ones.
    """
    options = {"factorisation": recipe.factorisation}
    group = pooled(recipe.name, evaluate([str(run) for run in runs], TRACK, systems, options=options))
    values = {name: group.metrics[name] for name in MEASURES if name in group.metrics}
    values |= {"own_error": _error(group.metrics), "auditor_error": _error(group.estimators[AUDITOR])}
    return {name: values[name].reshape(len(runs), -1) for name in MEASURES}


def _error(values: dict[str, FloatArray]) -> FloatArray:
    error: FloatArray = np.mean([values[f"error_{parameter}"] for parameter in "mcab"], axis=0)
    return error


def run(config: Config, on_run: Callable[[str], None] = print) -> dict[str, dict[str, Any]]:
    """Train and evaluate everything: name of a recipe to the summary of each of `MEASURES`."""
    results = {}
    for recipe in RECIPES:
        runs = []
        for seed in range(config.seeds):
            on_run(f"{recipe.name}, seed {seed}")
            runs.append(learn(recipe, config, seed))
        values = appraise(recipe, runs, config.systems)
        results[recipe.name] = {name: center_and_interval(values[name], metric) for name, metric in MEASURES.items()}
    return results


def show(results: dict[str, dict[str, Any]], config: Config) -> None:
    """Print the table, in the format of docs/study.md."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    titles = (metric.title for metric in MEASURES.values())
    table = Table("learned by", *titles, box=box.MARKDOWN)
    for recipe, summary in results.items():
        cells = (cell_of(metric, summary[name]).split("\n")[:2] for name, metric in MEASURES.items())
        table.add_row(recipe, *(" ".join(cell) for cell in cells))
    console = Console(markup=False)
    console.width = max(console.width, 180)
    console.print(table)
    over = f"{config.seeds} seeds of {config.steps:,} samples, {config.systems} systems"
    console.print(f"Interquartile means over {over}; [95 % bootstrap intervals over systems].")


def main(config: Config) -> None:
    """Train, evaluate, print, and write ``study.json`` and ``study.png``."""
    from agents.evaluation.figures import draw_study

    results = run(config)
    show(results, config)
    settings = {"steps": config.steps, "seeds": config.seeds, "systems": config.systems, "track": TRACK}
    written = {"settings": settings, "recipes": finite(results)}
    write_atomically(config.folder / "study.json", json.dumps(written, indent=1, allow_nan=False) + "\n")
    draw_study(config.folder / "study.png", results, MEASURES)
    print(config.folder / "study.json")
    print(config.folder / "study.png")


if __name__ == "__main__":
    run_script(main, Config, __doc__ or "")
