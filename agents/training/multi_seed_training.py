"""Trainings of one configuration with several seeds, one after the other or on a Ray cluster."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from agents.policies.networks.trained_policy import CONFIG_FILE
from agents.training.hyperparameters import track_name
from agents.training.ray_tasks import run_on_ray
from agents.training.training_config import TrainConfig, claim_run_folder, read_config
from agents.training.training_run import train_or_resume
from estimator.support.optional_dependencies import require_packages


def train_seeds(config: TrainConfig, seeds: int, *, on_ray: bool = False) -> Iterator[Path]:
    """Train with consecutive seeds, each into a run folder of its own; yields each folder when its run is finished.

    The folders are ``OUTPUT/SEED``; without an output, runs/ALGO-TRACK/SEED. Runs of an earlier call go on from their
    checkpoints, and finished ones stay. The weights depend neither on the machine nor on how often a run was stopped.

    Args:
        config: of the first seed.
        seeds: number of seeds.
        on_ray: whether they are tasks on a cluster, see `agents.training.ray_tasks`; all nodes must have access to the
            folder.

    Raises:
        ModuleNotFoundError: without Ray, if ``on_ray``.
        ValueError: where a folder holds another run.
    """
    if on_ray:
        require_packages("ray")
    folder = (config.output or Path("runs") / f"{config.algo}-{track_name(config.env).lower()}").resolve()
    runs = [folder / str(seed) for seed in range(config.seed, config.seed + seeds)]
    begin = None if config.begin is None else config.begin.resolve()
    for run in runs:
        claim_run_folder(run / CONFIG_FILE, replace(config, seed=int(run.name), output=run, begin=begin))
    if on_ray:
        yield from (run for run, _ in run_on_ray(_train_or_resume_folder, runs))
        return
    for run in runs:
        _train_or_resume_folder(run)
        yield run


def _train_or_resume_folder(run: Path) -> None:
    train_or_resume(read_config(run))
