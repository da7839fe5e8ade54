"""Run a part: ``python -m benchmarks.rigs accuracy --seeds 200``; ``--help`` names the others."""

import json
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from benchmarks.rigs import accuracy, drawn, experiment, faults, loop, peer_rows, peers, sweep, unseen
from benchmarks.rigs.catalogue import BENCHES
from estimator.files import write_atomically

CORES = os.cpu_count() or 1


@dataclass(frozen=True)
class Written:
    """What is kept of a part."""

    json: Path | None = None
    """File for all that came out."""


@dataclass(frozen=True)
class Spread(Written):
    """A part whose runs are spread over processes."""

    workers: int = CORES
    """Processes."""


@dataclass(frozen=True)
class Accuracy(Spread):
    """Errors and coverage on every rig: with guesses off by up to 30 %, with none, and from records in pieces."""

    seeds: int = 200
    """Records of each rig and setting."""
    rigs: tuple[str, ...] = tuple(BENCHES)
    """Names of rigs."""
    settings: tuple[str, ...] = accuracy.SETTINGS
    """With a guess, without, and without from 16 pieces that begin in motion."""

    def run(self) -> dict[str, Any]:
        """Run, print, and return what goes into the file."""
        cells = accuracy.run(self.rigs, self.settings, self.seeds, self.workers)
        return {"verdict": accuracy.show(cells), "cells": [cell.to_dict() for cell in cells]}


@dataclass(frozen=True)
class Faults(Spread):
    """Deliberate faults on rigs a and e: the share that is named, and of good records the share that is flagged."""

    seeds: int = 100
    """Records of each rig and fault."""
    faults: tuple[str, ...] = tuple(faults.EXPECTED)
    """Names of faults."""

    def run(self) -> dict[str, Any]:
        """Run, print, and return what goes into the file."""
        return faults.show(faults.run(self.faults, self.seeds, self.workers))


@dataclass(frozen=True)
class Against(Written):
    """Errors, times and statements against dynamax, SciPy and pysindy, in .venv-peers."""

    seeds: int = 20
    """Records of each rig."""
    rigs: tuple[str, ...] = tuple(BENCHES)
    """Names of rigs."""
    against: tuple[str, ...] = tuple(peer_rows.PEERS)
    """The others: dynamax as its documentation has it, dynamax-jit by somebody who knows JAX, scipy, pysindy."""

    def run(self) -> dict[str, Any]:
        """Run, print, and return what goes into the file."""
        results = peers.run(self.rigs, self.seeds, self.against)
        whole = peers.scripts(self.rigs, [peer for peer in peers.TIMED if peer in self.against])
        return {"verdict": peers.show(results, whole), "results": results}


@dataclass(frozen=True)
class Sweep(Spread):
    """From 6 to 800 samples per period, and from the linear range to the limit."""

    seeds: int = 50
    """Records of each cell."""

    def run(self) -> dict[str, Any]:
        """Run, print, and return what goes into the file."""
        cells = sweep.run(self.seeds, self.workers)
        return {"verdict": sweep.show(cells), "cells": [cell.to_dict() for cell in cells]}


@dataclass(frozen=True)
class Loop(Spread):
    """256 samples on the integrator, through Rig-v0 and in blocks, by signals and by the planner."""

    seeds: int = 100
    """Runs of each rig, policy and way."""
    rigs: tuple[str, ...] = tuple(BENCHES)
    """Names of rigs."""
    policies: tuple[str, ...] = loop.POLICIES
    """Who chooses: the planner efe, and signals."""
    ways: tuple[str, ...] = loop.WAYS
    """Sample by sample, and in blocks of 64."""

    def run(self) -> dict[str, Any]:
        """Run, print, and return what goes into the file."""
        runs = loop.run(self.rigs, self.policies, self.ways, self.seeds, self.workers)
        written = {" ".join(cell): [vars(one) for one in found] for cell, found in runs.items()}
        return {"verdict": loop.show(runs), "runs": written}


@dataclass(frozen=True)
class Unseen(Written):
    """256 samples on six rigs that no network was trained on, by policies for any oscillator and by the planner."""

    seeds: int = 20
    """Episodes of each rig and policy."""
    rigs: tuple[str, ...] = tuple(unseen.RIGS)
    """Names of rigs."""
    policies: tuple[str, ...] = ("ppo/universal", "shield", "prbs")
    """Who chooses, beside the planner efe."""

    def run(self) -> dict[str, Any]:
        """Run, print, and return what goes into the file."""
        gained = unseen.run(self.rigs, self.policies, self.seeds)
        return {"worth": unseen.show(gained), "gained": gained}


@dataclass(frozen=True)
class Experiment(Spread):
    """The next experiment of 256 samples, designed on a record: what was expected of it beside what came."""

    seeds: int = 20
    """Experiments of each rig and policy."""
    rigs: tuple[str, ...] = tuple(BENCHES)
    """Names of rigs."""
    policies: tuple[str, ...] = ("efe",)
    """Who designs."""
    samples: int = 512
    """Of the record before; 0: designed on the guess, with the noises known."""

    def run(self) -> dict[str, Any]:
        """Run, print, and return what goes into the file."""
        found = experiment.run(self.rigs, self.policies, self.samples, self.seeds, self.workers)
        written = {" ".join(cell): [vars(one) for one in trials] for cell, trials in found.items()}
        return {"verdict": experiment.show(found), "trials": written}


@dataclass(frozen=True)
class Drawn(Spread):
    """Rigs drawn at random and situations of other people's records, each without a guess."""

    classes: tuple[str, ...] = ("rigs",)
    """Classes: rigs, sines, pairs, hammer, wells-velocity, wells-acceleration."""
    count: int = 180
    """Seeds of each class."""
    first: int = 0
    """The first seed."""

    def run(self) -> dict[str, Any]:
        """Run, print, and return what goes into the file."""
        found = drawn.run(self.classes, self.count, self.first, self.workers)
        answers = {name: [vars(one) for one in of_class] for name, of_class in found.items()}
        return {"rows": drawn.show(found, self.first), "answers": answers}


Part = (
    Annotated[Accuracy, tyro.conf.subcommand("accuracy")]
    | Annotated[Faults, tyro.conf.subcommand("faults")]
    | Annotated[Against, tyro.conf.subcommand("peers")]
    | Annotated[Sweep, tyro.conf.subcommand("sweep")]
    | Annotated[Loop, tyro.conf.subcommand("loop")]
    | Annotated[Unseen, tyro.conf.subcommand("unseen")]
    | Annotated[Experiment, tyro.conf.subcommand("experiment")]
    | Annotated[Drawn, tyro.conf.subcommand("drawn")]
)


@dataclass(frozen=True)
class Config:
    """Judge `estimator.identify` on rigs that are simulated by an integrator of the benchmark's own."""

    part: tyro.conf.OmitSubcommandPrefixes[Part] = field(default_factory=Accuracy)


def main(config: Config) -> None:
    """Run a part, print it, and write its file."""
    found = config.part.run()
    if config.part.json is not None:
        write_atomically(config.part.json, json.dumps(found, indent=1))
        print(config.part.json)


if __name__ == "__main__":
    from agents.cli import run_script

    run_script(main, Config, __doc__ or "")
