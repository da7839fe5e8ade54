"""Faults that users meet, put into records of rigs a and e on purpose: are they named, is a good record left alone?"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np

from agents import console_output
from benchmarks.rigs.accuracy import remarks
from benchmarks.rigs.catalogue import A, E
from benchmarks.rigs.judge import Outcome, identified, in_processes
from benchmarks.rigs.records import Record, generator, guess, record

BENCHES = {"a": A, "e": E}

#: Fault to the names of the warnings that are right for it.
EXPECTED: dict[str, tuple[str, ...]] = {
    "none": (),
    "one sample late": ("delay",),
    "held, but taken as linear": ("interpolation",),
    "linear, but taken as held": ("interpolation",),
    "output clipped": ("clipped",),
    "input noise of 5 %": ("process_noise",),
    "step twice too long": ("step",),
    "step half as long": ("step",),
    "quintic stiffness": ("quintic",),
    "b not excited": ("not_identified",),
}
CLIPPED_AT, INPUT_NOISE, QUINTIC = 0.7, 0.05, 0.2
#: Of the amplitude: no record of a hundred can then tell b to better than 75 %, but m, c and a to 10 %, by the bound.
WEAK = 0.01
LEAST_NAMED, MOST_FALSE = 0.95, 0.05


def faulty(fault: str, name: str, seed: int) -> tuple[Record, dict[str, Any]]:
    """A record with a fault, and what is wrong in its rig file."""
    bench = BENCHES[name]
    good = record(bench, seed)
    if fault == "one sample late":
        return record(bench, seed, late=1), {}
    if fault == "held, but taken as linear":
        return good, {"interpolation": "linear"}
    if fault == "linear, but taken as held":
        return record(bench, seed, interpolation="linear"), {}
    if fault == "output clipped":
        top = CLIPPED_AT * np.abs(good.y).max()
        return replace(good, y=np.clip(good.y, -top, top)), {}
    if fault == "input noise of 5 %":
        noise = generator(bench, seed, "fault").standard_normal(len(good.u))
        return replace(good, u=good.u + INPUT_NOISE * good.u.std() * noise), {}
    if fault == "step twice too long":
        return good, {"step": 2 * bench.step}
    if fault == "step half as long":
        return good, {"step": bench.step / 2}
    if fault == "quintic stiffness":
        # Of the cubic force at the peak of the record without it.
        return record(replace(bench, quintic=QUINTIC * bench.truth[3] / np.abs(good.states[:, 0]).max() ** 2), seed), {}
    if fault == "b not excited":
        return record(replace(bench, amplitude=WEAK * bench.amplitude), seed), {}
    return good, {}


def trial(task: tuple[str, str, int]) -> Outcome:
    """Identify one record with a fault; the rig file has a guess."""
    fault, name, seed = task
    made, changed = faulty(fault, name, seed)
    return identified(made, guess(BENCHES[name], seed), **changed)


def run(chosen: Sequence[str], seeds: int, workers: int) -> dict[tuple[str, str], list[Outcome]]:
    """(fault, rig) to the outcomes of all seeds."""
    return in_processes(trial, list(product(chosen, BENCHES)), seeds, workers, "Identifying")


def named(fault: str, outcomes: Sequence[Outcome]) -> float:
    """Share of records whose fault is named; of those without one, the share that is flagged by anything."""
    if not EXPECTED[fault]:
        return float(np.mean([bool(outcome.warnings) for outcome in outcomes]))
    return float(np.mean([not set(EXPECTED[fault]).isdisjoint(outcome.warnings) for outcome in outcomes]))


def passes(fault: str, share: float) -> bool:
    """Whether a share clears its bar."""
    return share >= LEAST_NAMED if EXPECTED[fault] else share <= MOST_FALSE


def show(found: dict[tuple[str, str], list[Outcome]]) -> dict[str, Any]:
    """Print the table; return it for the JSON file."""
    rows, written = [], {}
    for (fault, name), outcomes in found.items():
        share = named(fault, outcomes)
        verdict = "PASS" if passes(fault, share) else "MISS"
        right = " or ".join(EXPECTED[fault]) or "none"
        rows.append((fault, name, right, f"{share:.2f}", verdict, remarks(outcomes)))
        written[f"{fault}, {name}"] = {"share": share, "verdict": verdict, "outcomes": [vars(o) for o in outcomes]}
    titles = ("fault", "rig", "right name", "share", "verdict", "all warnings and failures")
    console_output.print_texts_and_tables(console_output.format_table(titles, rows, markdown=True))
    return written
