"""The next experiment, designed, played and identified: what was expected beside what came."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from benchmarks.rigs.catalogue import BENCHES, PARAMETERS, Bench
from benchmarks.rigs.judge import LEVEL, binomial_interval, in_processes
from benchmarks.rigs.loop import ASKED, SAMPLES, BenchPlant
from benchmarks.rigs.records import guess, record
from estimator.rig import Channel, Rig

#: Seeds of the noises of a second experiment: those of the first, and so much.
_AGAIN = 1_000_000

Task = tuple[str, str, int, int]


@dataclass(frozen=True)
class Trial:
    """What came of one experiment.

    Attributes:
        before, expected, after: (4,) standard deviations of m, c, a and b, relative to the truth: before it, expected
            after it, and as `identify` states them after it, from both records.
        error: (4,) of the estimates after it, relative.
        inside: (4,) whether the 90 % intervals hold the truth.
        left: whether the output left its range.
    """

    before: list[float]
    expected: list[float]
    after: list[float]
    error: list[float]
    inside: list[bool]
    left: bool


def described(bench: Bench, seed: int, noise: bool) -> Rig:
    """The rig of a bench, its input held, with a guess that is off; with its noises, or without."""
    return Rig(
        bench.step,
        input=Channel(bench.units[0], limit=bench.limit, noise=bench.process_noise if noise else None),
        output=Channel(bench.units[1], kind=bench.kind, range=bench.output_range,
                       noise=bench.sensor_noise if noise else None),
        guess=guess(bench, seed),
    )  # fmt: skip


def trial(task: Task) -> Trial:
    """A record of some samples, or none; the next experiment by a policy; its answer; and both identified."""
    from agents.running.experiment import design
    from estimator import identify

    name, policy, samples, seed = task
    bench = replace(BENCHES[name], decimate=1, interpolation="zero_order")
    rig, records, prior = described(bench, seed, not samples), [], None
    if samples:
        first = record(bench, seed, samples)
        records, prior = [(first.u, first.y)], identify(rig, (first.u, first.y)).belief
    found = design(rig, prior, policy, SAMPLES, ASKED, seed)
    u, y = BenchPlant(bench, _AGAIN + seed).play(found.u)
    result = identify(rig, [*records, (u, y)])
    truth = np.array(bench.truth)
    mean, std = np.array([result.parameters[p] for p in PARAMETERS]).T
    low, high = np.array([result.interval(LEVEL)[p] for p in PARAMETERS]).T
    before = np.array([found.before.parameters()[p][1] for p in PARAMETERS])
    expected = np.array([found.after[p] for p in PARAMETERS])
    return Trial(
        *((np.asarray(stds) / np.abs(truth)).tolist() for stds in (before, expected, std)),
        (mean / truth - 1).tolist(), ((low <= truth) & (truth <= high)).tolist(),
        bool((np.abs(y) > bench.output_range).any()),
    )  # fmt: skip


def run(
    names: Sequence[str], policies: Sequence[str], samples: int, seeds: int, workers: int
) -> dict[tuple[str, str], list[Trial]]:
    """Trials by rig and policy."""
    cells = [(name, policy) for name in names for policy in policies]
    tasks = [(*cell, samples, seed) for cell in cells for seed in range(seeds)]
    trials = in_processes(trial, tasks, workers, "Designing")
    return {cell: [trials[*cell, samples, seed] for seed in range(seeds)] for cell in cells}


def show(found: dict[tuple[str, str], list[Trial]]) -> dict[str, Any]:
    """Print the table and the verdict; return the verdict for the JSON file."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    console = Console(width=170)
    table = Table("rig", "policy", "times narrower, expected", "stated / expected", "RMS error / expected",
                  "coverage of 90 %", "left its range", box=box.MARKDOWN)  # fmt: skip

    def cells(values: Any) -> str:
        return ", ".join(f"{value:.2f}" if value < 9.95 else f"{value:.0f}" for value in values)

    for (name, policy), trials in found.items():
        before, expected, after, error = (
            np.array([getattr(one, part) for one in trials]) for part in ("before", "expected", "after", "error")
        )
        table.add_row(
            name, policy, cells(np.median(before / expected, axis=0)), cells(np.median(after / expected, axis=0)),
            cells(np.sqrt(np.mean((error / expected) ** 2, axis=0))),
            cells(np.mean([one.inside for one in trials], axis=0)),
            f"{sum(one.left for one in trials)} of {len(trials)}",
        )  # fmt: skip
    console.print(table)
    every = [one for trials in found.values() for one in trials]
    ratios = np.array([one.after for one in every]) / np.array([one.expected for one in every])
    left = sum(one.left for one in every)
    verdict = {
        "stated over expected, median": float(np.median(ratios)),
        "the central 80 %": np.quantile(ratios, (0.1, 0.9)).tolist(),
        "left": left,
        "of": len(every),
        "at most, with 95 %": binomial_interval(left, len(every), 0.9)[1],
    }
    console.print(verdict)
    return verdict
