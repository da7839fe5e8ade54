"""Command of the rig benchmarks: ``python -m benchmarks.rigs accuracy --seeds 200``; ``--help`` lists the parts."""

import json
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from benchmarks.rigs import (
    closed_loop,
    designed_experiment,
    faults,
    peer_comparison,
    peer_methods,
    random_rigs,
    rig_accuracy,
    sampling_sweep,
    unseen_rigs,
)
from benchmarks.rigs.bench_catalogue import BENCHES
from estimator.support.file_io import write_atomically

CORES = os.cpu_count() or 1


@dataclass(frozen=True)
class OutputConfig:
    """Output of a part."""

    json: Path | None = None
    """File for all results."""


@dataclass(frozen=True)
class ParallelConfig(OutputConfig):
    """A part that runs in several processes."""

    workers: int = CORES
    """Processes."""


@dataclass(frozen=True)
class AccuracyConfig(ParallelConfig):
    """Errors and coverage on every rig: with guesses off by up to 30 %, with none, and from records in pieces."""

    seeds: int = 200
    """Records of each rig and setting."""
    rigs: tuple[str, ...] = tuple(BENCHES)
    """Names of rigs."""
    settings: tuple[str, ...] = rig_accuracy.SETTINGS
    """With a guess, without, and without from 16 pieces that begin in motion."""

    def run(self) -> dict[str, Any]:
        """Run, print, and return what goes into the file."""
        cells = rig_accuracy.run_trials(self.rigs, self.settings, self.seeds, self.workers)
        return {"verdict": rig_accuracy.print_report(cells), "cells": [cell.to_dict() for cell in cells]}


@dataclass(frozen=True)
class FaultsConfig(ParallelConfig):
    """Deliberate faults on rigs a and e: the share that is named, and the share of good records that is flagged."""

    seeds: int = 100
    """Records of each rig and fault."""
    faults: tuple[str, ...] = tuple(faults.EXPECTED)
    """Names of faults."""

    def run(self) -> dict[str, Any]:
        """Run, print, and return what goes into the file."""
        return faults.print_report(faults.run_trials(self.faults, self.seeds, self.workers))


@dataclass(frozen=True)
class PeersConfig(OutputConfig):
    """Errors, times and user statements against dynamax, SciPy and pysindy, in .venv-peers."""

    seeds: int = 20
    """Records of each rig."""
    rigs: tuple[str, ...] = tuple(BENCHES)
    """Names of rigs."""
    against: tuple[str, ...] = tuple(peer_methods.PEERS)
    """Peers: dynamax as in its documentation, dynamax-jit compiled by a JAX expert, scipy, pysindy."""

    def run(self) -> dict[str, Any]:
        """Run, print, and return what goes into the file."""
        results = peer_comparison.run_comparison(self.rigs, self.seeds, self.against)
        whole = peer_comparison.script_time_ratios(
            self.rigs, [peer for peer in peer_comparison.TIMED_PEERS if peer in self.against]
        )
        return {"verdict": peer_comparison.print_report(results, whole), "results": results}


@dataclass(frozen=True)
class SweepConfig(ParallelConfig):
    """From 6 to 800 samples per period, and from the linear range to the limit."""

    seeds: int = 50
    """Records of each cell."""

    def run(self) -> dict[str, Any]:
        """Run, print, and return what goes into the file."""
        cells = sampling_sweep.run_trials(self.seeds, self.workers)
        return {"verdict": sampling_sweep.print_report(cells), "cells": [cell.to_dict() for cell in cells]}


@dataclass(frozen=True)
class ClosedLoopConfig(ParallelConfig):
    """Closed-loop runs of 256 samples, through Rig-v0 and in blocks, by signals and by the planner."""

    seeds: int = 100
    """Runs of each rig, policy and mode."""
    rigs: tuple[str, ...] = tuple(BENCHES)
    """Names of rigs."""
    policies: tuple[str, ...] = closed_loop.POLICIES
    """Policies: the planner efe, and signals."""
    ways: tuple[str, ...] = closed_loop.PLAY_MODES
    """Sample by sample, and in blocks of 64."""

    def run(self) -> dict[str, Any]:
        """Run, print, and return what goes into the file."""
        runs = closed_loop.run_trials(self.rigs, self.policies, self.ways, self.seeds, self.workers)
        written = {" ".join(cell): [vars(one) for one in found] for cell, found in runs.items()}
        return {"verdict": closed_loop.print_report(runs), "runs": written}


@dataclass(frozen=True)
class UnseenConfig(OutputConfig):
    """256 samples on six rigs that no network was trained on, by policies and by the planner."""

    seeds: int = 20
    """Episodes of each rig and policy."""
    rigs: tuple[str, ...] = tuple(unseen_rigs.UNSEEN_RIGS)
    """Names of rigs."""
    policies: tuple[str, ...] = ("ppo/universal", "shield", "prbs")
    """Policies, beside the planner efe."""

    def run(self) -> dict[str, Any]:
        """Run, print, and return what goes into the file."""
        gained = unseen_rigs.run_episodes(self.rigs, self.policies, self.seeds)
        return {"worth": unseen_rigs.print_report(gained), "gained": gained}


@dataclass(frozen=True)
class ExperimentConfig(ParallelConfig):
    """The next experiment of 256 samples, designed on a record: expected and achieved standard deviations."""

    seeds: int = 20
    """Experiments of each rig and policy."""
    rigs: tuple[str, ...] = tuple(BENCHES)
    """Names of rigs."""
    policies: tuple[str, ...] = ("efe",)
    """Policies that design the experiment."""
    samples: int = 512
    """Samples of the record before; 0: designed on the guess, with the noises known."""

    def run(self) -> dict[str, Any]:
        """Run, print, and return what goes into the file."""
        found = designed_experiment.run_trials(self.rigs, self.policies, self.samples, self.seeds, self.workers)
        written = {" ".join(cell): [vars(one) for one in trials] for cell, trials in found.items()}
        return {"verdict": designed_experiment.print_report(found), "trials": written}


@dataclass(frozen=True)
class RandomRigsConfig(ParallelConfig):
    """Random rigs, and situations of real records, each without a guess."""

    classes: tuple[str, ...] = ("rigs",)
    """Classes: rigs, sines, pairs, hammer, wells-velocity, wells-acceleration."""
    count: int = 180
    """Seeds of each class."""
    first: int = 0
    """The first seed."""

    def run(self) -> dict[str, Any]:
        """Run, print, and return what goes into the file."""
        found = random_rigs.run_trials(self.classes, self.count, self.first, self.workers)
        answers = {name: [vars(one) for one in of_class] for name, of_class in found.items()}
        return {"rows": random_rigs.print_report(found, self.first), "answers": answers}


BenchmarkConfig = (
    Annotated[AccuracyConfig, tyro.conf.subcommand("accuracy")]
    | Annotated[FaultsConfig, tyro.conf.subcommand("faults")]
    | Annotated[PeersConfig, tyro.conf.subcommand("peers")]
    | Annotated[SweepConfig, tyro.conf.subcommand("sweep")]
    | Annotated[ClosedLoopConfig, tyro.conf.subcommand("loop")]
    | Annotated[UnseenConfig, tyro.conf.subcommand("unseen")]
    | Annotated[ExperimentConfig, tyro.conf.subcommand("experiment")]
    | Annotated[RandomRigsConfig, tyro.conf.subcommand("drawn")]
)


@dataclass(frozen=True)
class Config:
    """Judge `estimator.identify` on rigs that an independent integrator simulates."""

    part: tyro.conf.OmitSubcommandPrefixes[BenchmarkConfig] = field(default_factory=AccuracyConfig)


def main(config: Config) -> None:
    """Run a part, print it, and write its file."""
    found = config.part.run()
    if config.part.json is not None:
        write_atomically(config.part.json, json.dumps(found, indent=1))
        print(config.part.json)


if __name__ == "__main__":
    from agents.cli import run_script

    run_script(main, Config, __doc__ or "")
