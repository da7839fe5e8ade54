"""Several trainings of one recipe, which differ by their seeds: one after the other, or on a Ray cluster."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from agents.policies.learned import CONFIG
from agents.training.cluster import spread
from agents.training.config import TrainConfig, claim, read_config
from agents.training.hyperparameters import track_of
from agents.training.runs import carry_on
from estimator.extras import need


def train_seeds(config: TrainConfig, seeds: int, *, on_ray: bool = False) -> Iterator[Path]:
    """Train with a seed and those after it, each into a run folder of its own; tells each that is finished.

    The folders are ``OUTPUT/SEED``, where the output is runs/ALGO-TRACK if none is named. What an earlier call left
    there is gone on with, or is finished. The weights do not depend on where a seed is trained, nor on how often it was
    stopped.

    Args:
        config: of the first.
        seeds: how many.
        on_ray: whether they are tasks on a cluster, see `agents.training.cluster`; all its nodes must see the folder.

    Raises:
        ModuleNotFoundError: without Ray, where it is asked for.
        ValueError: where a folder holds another run.
    """
    if on_ray:
        need("ray")
    folder = (config.output or Path("runs") / f"{config.algo}-{track_of(config.env).lower()}").resolve()
    runs = [folder / str(seed) for seed in range(config.seed, config.seed + seeds)]
    begin = None if config.begin is None else config.begin.resolve()
    for run in runs:
        claim(run / CONFIG, replace(config, seed=int(run.name), output=run, begin=begin))
    if on_ray:
        yield from (run for run, _ in spread(_carry_on, runs))
        return
    for run in runs:
        _carry_on(run)
        yield run


def _carry_on(run: Path) -> None:
    carry_on(read_config(run))
