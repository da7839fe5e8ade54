"""Sweep over 6 to 800 samples per period and over the amplitude: failures, calibration, and false identifiability."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np

from agents import console_output
from benchmarks.rigs.bench_catalogue import DESK_BENCH, PARAMETERS, Bench
from benchmarks.rigs.calibration import (
    BenchmarkCell,
    TrialOutcome,
    identify_from_files,
    judge_coverage,
    run_in_processes,
)
from benchmarks.rigs.rig_accuracy import count_warnings, format_percents
from benchmarks.rigs.simulated_records import draw_guess, simulate_record

#: Samples per period of the sweep.
SAMPLES_PER_PERIOD = (6, 12, 25, 50, 100, 200, 400, 800)

#: Amplitudes of the sweep, as fractions of the limit of rig a.
AMPLITUDE_FRACTIONS = (0.001, 0.01, 0.1, 0.5, 1.0)

#: Relative Cramér-Rao deviation from which a parameter is out of reach.
MIN_OPEN_BOUND = 0.5

#: Relative Cramér-Rao deviation up to which a parameter is within reach; between the two either verdict is right.
MAX_IDENTIFIABLE_BOUND = 0.1

#: Name of the warning for parameters out of reach.
NOT_IDENTIFIED = "not_identified"
#: Share of the records out of reach that are reported, at least.
MIN_DETECTION_RATE = 0.95

#: Share of the records within reach that are reported, at most.
MAX_FALSE_ALARM_RATE = 0.05


def bench_with_sampling(samples_per_period: int, amplitude: float) -> Bench:
    """Rig a at another sampling rate and amplitude, with an input that is held for a quarter of a period.

    The input is held for one sample at least. The power density of the process noise stays the same.

    Args:
        samples_per_period: sampling rate.
        amplitude: of the input, as a fraction of the limit.
    """
    step = DESK_BENCH.samples_per_period * DESK_BENCH.step / samples_per_period
    return replace(
        DESK_BENCH,
        name=f"{samples_per_period}/{amplitude}",
        step=step,
        amplitude=amplitude * DESK_BENCH.limit,
        hold=max(1, round(samples_per_period / 4)),
        output_range=3 * DESK_BENCH.output_range,
        process_noise=DESK_BENCH.process_noise * float(np.sqrt(DESK_BENCH.step / step)),
    )


def run_trial(task: tuple[int, float, int]) -> TrialOutcome:
    """Identify one record, with a guess for even seeds; the task is samples per period, amplitude and seed."""
    per_period, amplitude, seed = task
    chosen = bench_with_sampling(per_period, amplitude)
    return identify_from_files(simulate_record(chosen, seed), None if seed % 2 else draw_guess(chosen, seed))


def run_trials(seeds: int, workers: int) -> list[BenchmarkCell]:
    """A cell for each sampling and amplitude."""
    found = run_in_processes(
        run_trial, list(product(SAMPLES_PER_PERIOD, AMPLITUDE_FRACTIONS)), seeds, workers, "Identifying"
    )
    return [
        BenchmarkCell(bench_with_sampling(rate, amplitude), f"{rate} samples, {amplitude:g}", outcomes)
        for (rate, amplitude), outcomes in found.items()
    ]


def is_said_open(outcomes: Sequence[TrialOutcome]) -> tuple[list[bool], list[bool]]:
    """Whether each parameter out of reach is named as not identified, and whether each parameter within reach is.

    A warning begins with the names of the parameters.
    """
    said_when_open, said_when_identifiable = [], []
    for outcome in outcomes:
        message = outcome.warnings.get(NOT_IDENTIFIED, "").split(":")[0].replace(",", " ").split()
        for name, bound in zip(PARAMETERS, outcome.bound, strict=True):
            if bound > MIN_OPEN_BOUND:
                said_when_open.append(name in message)
            if bound < MAX_IDENTIFIABLE_BOUND:
                said_when_identifiable.append(name in message)
    return said_when_open, said_when_identifiable


def print_report(cells: Sequence[BenchmarkCell]) -> dict[str, Any]:
    """Print the table and the verdict; return the verdict for the JSON file."""
    hits = [count for cell in cells for count in cell.hits]
    pooled, meets, is_calibrated = judge_coverage(hits, [len(cell.outcomes) for cell in cells for _ in PARAMETERS])
    rows, all_said, all_wrong = [], [], []
    for cell in cells:
        said, wrongly = is_said_open(cell.outcomes)
        all_said += said
        all_wrong += wrongly
        shares = (f"{sum(part)} of {len(part)}" if part else "" for part in (said, wrongly))
        rows.append((
            cell.setting, format_percents(cell.errors), format_percents(cell.bounds),
            ", ".join(f"{count / len(cell.outcomes):.3g}" for count in cell.hits), *shares,
            f"{np.median([outcome.seconds for outcome in cell.outcomes]):.2f}", count_warnings(cell.outcomes),
        ))  # fmt: skip
    titles = ("samples per period, share of the limit", "median error of m, c, a, b, %", "bound (1 σ), %",
              "coverage of 90 %", "out of reach, said", "within, denied", "s", "warnings and failures")  # fmt: skip
    failures = sum(bool(outcome.failure) for cell in cells for outcome in cell.outcomes)
    lines = {
        f"{failures} records failed": failures == 0,
        f"calibrated; pooled coverage {pooled:.3f}, {len(meets) - sum(meets)} of {len(meets)} cells outside": (
            is_calibrated
        ),
        f"out of reach, said: {sum(all_said)} of {len(all_said)}": sum(all_said) >= MIN_DETECTION_RATE * len(all_said),
        f"within reach, denied: {sum(all_wrong)} of {len(all_wrong)}": sum(all_wrong)
        <= MAX_FALSE_ALARM_RATE * len(all_wrong),
    }
    verdicts = (f"{'PASS' if good else 'MISS'}: {text}" for text, good in lines.items())
    console_output.print_texts_and_tables(console_output.format_table(titles, rows, markdown=True), *verdicts)
    return {text: bool(good) for text, good in lines.items()}
