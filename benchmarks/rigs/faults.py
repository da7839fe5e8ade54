"""Detection of faults: deliberate faults in records of rigs a and e, and false alarms on good records."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np

from agents import console_output
from benchmarks.rigs.bench_catalogue import DESK_BENCH, SILVERBOX_HELD
from benchmarks.rigs.calibration import TrialOutcome, identify_from_files, run_in_processes
from benchmarks.rigs.rig_accuracy import count_warnings
from benchmarks.rigs.simulated_records import SimulatedRecord, draw_guess, rng_stream, simulate_record

#: Name to bench.
FAULT_BENCHES = {"a": DESK_BENCH, "e": SILVERBOX_HELD}

#: Fault to the warnings that are right for it.
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
#: Level at which an output is clipped, as a fraction of its largest value.
CLIPPING_FRACTION = 0.7

#: Noise of the recorded input, as a fraction of the input.
INPUT_NOISE_FRACTION = 0.05

#: Quintic force at the peak, as a fraction of the cubic force there.
QUINTIC_FRACTION = 0.2

#: Weak input, as a fraction of the amplitude: by the bound of a hundred records, b is open by 75 % or more, and m, c
#: and a are known to 10 %.
WEAK_AMPLITUDE_FRACTION = 0.01
#: Share of the faults that are named, at least.
MIN_DETECTION_RATE = 0.95

#: Share of the good records that are flagged, at most.
MAX_FALSE_ALARM_RATE = 0.05


def make_faulty_record(fault: str, name: str, seed: int) -> tuple[SimulatedRecord, dict[str, Any]]:
    """A record with a fault, and the wrong settings of its rig file."""
    bench = FAULT_BENCHES[name]
    clean = simulate_record(bench, seed)
    if fault == "one sample late":
        return simulate_record(bench, seed, extra_delay=1), {}
    if fault == "held, but taken as linear":
        return clean, {"interpolation": "linear"}
    if fault == "linear, but taken as held":
        return simulate_record(bench, seed, interpolation="linear"), {}
    if fault == "output clipped":
        top = CLIPPING_FRACTION * np.abs(clean.y).max()
        return replace(clean, y=np.clip(clean.y, -top, top)), {}
    if fault == "input noise of 5 %":
        noise = rng_stream(bench, seed, "fault").standard_normal(len(clean.u))
        return replace(clean, u=clean.u + INPUT_NOISE_FRACTION * clean.u.std() * noise), {}
    if fault == "step twice too long":
        return clean, {"step": 2 * bench.step}
    if fault == "step half as long":
        return clean, {"step": bench.step / 2}
    if fault == "quintic stiffness":
        return simulate_record(
            replace(bench, quintic=QUINTIC_FRACTION * bench.truth[3] / np.abs(clean.states[:, 0]).max() ** 2), seed
        ), {}
    if fault == "b not excited":
        return simulate_record(replace(bench, amplitude=WEAK_AMPLITUDE_FRACTION * bench.amplitude), seed), {}
    return clean, {}


def run_trial(task: tuple[str, str, int]) -> TrialOutcome:
    """Identify one record with a fault and a guess; the task is fault, bench and seed."""
    fault, name, seed = task
    faulty, rig_changes = make_faulty_record(fault, name, seed)
    return identify_from_files(faulty, draw_guess(FAULT_BENCHES[name], seed), **rig_changes)


def run_trials(chosen: Sequence[str], seeds: int, workers: int) -> dict[tuple[str, str], list[TrialOutcome]]:
    """Outcomes by fault and bench."""
    return run_in_processes(run_trial, list(product(chosen, FAULT_BENCHES)), seeds, workers, "Identifying")


def detection_rate(fault: str, outcomes: Sequence[TrialOutcome]) -> float:
    """Share of the records whose fault is named; without a fault, the share with any warning."""
    if not EXPECTED[fault]:
        return float(np.mean([bool(outcome.warnings) for outcome in outcomes]))
    return float(np.mean([not set(EXPECTED[fault]).isdisjoint(outcome.warnings) for outcome in outcomes]))


def passes_bar(fault: str, share: float) -> bool:
    """Whether a share passes its bar."""
    return share >= MIN_DETECTION_RATE if EXPECTED[fault] else share <= MAX_FALSE_ALARM_RATE


def print_report(found: dict[tuple[str, str], list[TrialOutcome]]) -> dict[str, Any]:
    """Print the table; return it for the JSON file."""
    rows, written = [], {}
    for (fault, name), outcomes in found.items():
        share = detection_rate(fault, outcomes)
        verdict = "PASS" if passes_bar(fault, share) else "MISS"
        right = " or ".join(EXPECTED[fault]) or "none"
        rows.append((fault, name, right, f"{share:.2f}", verdict, count_warnings(outcomes)))
        written[f"{fault}, {name}"] = {"share": share, "verdict": verdict, "outcomes": [vars(o) for o in outcomes]}
    titles = ("fault", "rig", "right name", "share", "verdict", "all warnings and failures")
    console_output.print_texts_and_tables(console_output.format_table(titles, rows, markdown=True))
    return written
