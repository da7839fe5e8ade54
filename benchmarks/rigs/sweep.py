"""From 6 to 800 samples per period, from the linear range to the limit: no overflow, calibrated, nothing invented."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np

from agents import console_output
from benchmarks.rigs.accuracy import percents, remarks
from benchmarks.rigs.catalogue import PARAMETERS, A, Bench
from benchmarks.rigs.judge import Cell, Outcome, calibrated, identified, in_processes
from benchmarks.rigs.records import guess, record

PER_PERIOD = (6, 12, 25, 50, 100, 200, 400, 800)
#: Of rig a's limit.
AMPLITUDES = (0.001, 0.01, 0.1, 0.5, 1.0)

#: A parameter is out of reach where the bound exceeds the first of these, and within it below the second. Between them
#: both words are right.
OUT_OF_REACH, WITHIN_REACH = 0.5, 0.1
NOT_IDENTIFIED = "not_identified"
#: Share of records that must be told so, and that may be told so wrongly.
LEAST_SAID, MOST_FALSE = 0.95, 0.05


def bench(per_period: int, amplitude: float) -> Bench:
    """Rig a, sampled so, with an input of this share of its limit: held for a quarter of a period, at least a sample.

    The process noise has the same power in each second.
    """
    step = A.samples_per_period * A.step / per_period
    return replace(
        A,
        name=f"{per_period}/{amplitude}",
        step=step,
        amplitude=amplitude * A.limit,
        hold=max(1, round(per_period / 4)),
        output_range=3 * A.output_range,
        process_noise=A.process_noise * float(np.sqrt(A.step / step)),
    )


def trial(task: tuple[int, float, int]) -> Outcome:
    """Identify one record, with a guess for even seeds and without for odd ones."""
    per_period, amplitude, seed = task
    chosen = bench(per_period, amplitude)
    return identified(record(chosen, seed), None if seed % 2 else guess(chosen, seed))


def run(seeds: int, workers: int) -> list[Cell]:
    """A cell for each sampling and amplitude."""
    found = in_processes(trial, list(product(PER_PERIOD, AMPLITUDES)), seeds, workers, "Identifying")
    return [
        Cell(bench(rate, amplitude), f"{rate} samples, {amplitude:g}", outcomes)
        for (rate, amplitude), outcomes in found.items()
    ]


def words(outcomes: Sequence[Outcome]) -> tuple[list[bool], list[bool]]:
    """Of what is out of reach, whether that is said; of what is within it, whether the contrary is.

    A warning begins with the names of the parameters.
    """
    said, wrongly = [], []
    for outcome in outcomes:
        message = outcome.warnings.get(NOT_IDENTIFIED, "").split(":")[0].replace(",", " ").split()
        for name, bound in zip(PARAMETERS, outcome.bound, strict=True):
            if bound > OUT_OF_REACH:
                said.append(name in message)
            if bound < WITHIN_REACH:
                wrongly.append(name in message)
    return said, wrongly


def show(cells: Sequence[Cell]) -> dict[str, Any]:
    """Print the table and the verdict; return the verdict for the JSON file."""
    hits = [count for cell in cells for count in cell.hits]
    pooled, meets, is_calibrated = calibrated(hits, [len(cell.outcomes) for cell in cells for _ in PARAMETERS])
    rows, all_said, all_wrong = [], [], []
    for cell in cells:
        said, wrongly = words(cell.outcomes)
        all_said += said
        all_wrong += wrongly
        shares = (f"{sum(part)} of {len(part)}" if part else "" for part in (said, wrongly))
        rows.append((
            cell.setting, percents(cell.errors), percents(cell.bounds),
            ", ".join(f"{count / len(cell.outcomes):.3g}" for count in cell.hits), *shares,
            f"{np.median([outcome.seconds for outcome in cell.outcomes]):.2f}", remarks(cell.outcomes),
        ))  # fmt: skip
    titles = ("samples per period, share of the limit", "median error of m, c, a, b, %", "bound (1 σ), %",
              "coverage of 90 %", "out of reach, said", "within, denied", "s", "warnings and failures")  # fmt: skip
    failures = sum(bool(outcome.failure) for cell in cells for outcome in cell.outcomes)
    lines = {
        f"{failures} records failed": failures == 0,
        f"calibrated; pooled coverage {pooled:.3f}, {len(meets) - sum(meets)} of {len(meets)} cells outside": (
            is_calibrated
        ),
        f"out of reach, said: {sum(all_said)} of {len(all_said)}": sum(all_said) >= LEAST_SAID * len(all_said),
        f"within reach, denied: {sum(all_wrong)} of {len(all_wrong)}": sum(all_wrong) <= MOST_FALSE * len(all_wrong),
    }
    verdicts = (f"{'PASS' if good else 'MISS'}: {text}" for text, good in lines.items())
    console_output.print_texts_and_tables(console_output.format_table(titles, rows, markdown=True), *verdicts)
    return {text: bool(good) for text, good in lines.items()}
