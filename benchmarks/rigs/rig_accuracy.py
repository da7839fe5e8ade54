"""Errors and coverage of `identify` on every bench, from CSV and rig files: with a guess, without, and in pieces."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from agents import console_output
from benchmarks.rigs.bench_catalogue import BENCHES, PARAMETERS
from benchmarks.rigs.calibration import (
    POOLED_COVERAGE_BAR,
    BenchmarkCell,
    TrialOutcome,
    identify_from_files,
    judge_coverage,
    run_in_processes,
)
from benchmarks.rigs.simulated_records import draw_guess, simulate_record

#: With a guess, without one, and without one from pieces of the record, of which all but the first begin in motion.
SETTINGS = ("guess", "no guess", "pieces")

#: Pieces of a record.
N_PIECES = 16


def run_trial(task: tuple[str, tuple[str, ...], int]) -> list[TrialOutcome]:
    """Simulate one record and identify it in each setting; the task is bench, settings and seed."""
    name, settings, seed = task
    bench = BENCHES[name]
    simulated = simulate_record(bench, seed)
    guesses = {"guess": draw_guess(bench, seed)}
    pieces = {"pieces": N_PIECES}
    return [identify_from_files(simulated, guesses.get(setting), pieces.get(setting, 1)) for setting in settings]


def run_trials(names: Sequence[str], settings: Sequence[str], seeds: int, workers: int) -> list[BenchmarkCell]:
    """A cell for each bench and setting."""
    outcomes = run_in_processes(run_trial, [(name, tuple(settings)) for name in names], seeds, workers, "Identifying")
    return [
        BenchmarkCell(BENCHES[name], setting, [of_seed[place] for of_seed in found])
        for (name, chosen), found in outcomes.items()
        for place, setting in enumerate(chosen)
    ]


def print_report(cells: Sequence[BenchmarkCell]) -> dict[str, Any]:
    """Print the table and the verdict; return the verdict for the JSON file."""
    trials = [len(cell.outcomes) for cell in cells for _ in PARAMETERS]
    hits = [count for cell in cells for count in cell.hits]
    pooled, meets, is_calibrated = judge_coverage(hits, trials)
    accurate = [cell.errors <= cell.error_bars for cell in cells]
    rows = []
    for place, cell in enumerate(cells):
        number = len(cell.outcomes)
        bad = [f"{p}: error" for p, good in zip(PARAMETERS, accurate[place], strict=True) if not good]
        bad += [
            f"{p}: coverage" for p, good in zip(PARAMETERS, meets[4 * place : 4 * place + 4], strict=True) if not good
        ]
        rows.append((
            cell.bench.name, cell.setting, format_percents(cell.errors), format_percents(cell.bounds),
            ", ".join(f"{count / number:.3g}" for count in cell.hits), "; ".join(bad) or "PASS",
            f"{np.median([outcome.seconds for outcome in cell.outcomes]):.2f}", count_warnings(cell.outcomes),
        ))  # fmt: skip
    titles = ("rig", "", "median error of m, c, a, b, %", "bound (1 σ), %", "coverage of 90 %", "verdict", "s",
              "warnings and failures")  # fmt: skip
    verdict = {
        "accurate": bool(np.all(accurate)),
        "calibrated": is_calibrated,
        "pooled coverage": pooled,
        "cells outside": int(np.size(meets) - np.sum(meets)),
    }
    console_output.print_texts_and_tables(
        console_output.format_table(titles, rows, markdown=True),
        f"{'PASS' if verdict['accurate'] else 'MISS'}: median errors at most 0.3 %, or 1.2 times the median bound\n"
        f"{'PASS' if is_calibrated else 'MISS'}: calibrated; pooled coverage {pooled:.3f} "
        f"({POOLED_COVERAGE_BAR[0]} to {POOLED_COVERAGE_BAR[1]}), {verdict['cells outside']} of {len(meets)} cells "
        f"outside of 0.85 to 0.95",
    )
    return verdict


def format_percents(values: Any) -> str:
    """Numbers as percents, with two digits each."""
    return ", ".join(f"{100 * value:.2g}" for value in values)


def count_warnings(outcomes: Sequence[TrialOutcome]) -> str:
    """Warnings and failures with the number of records that have them."""
    counts: dict[str, int] = {}
    for outcome in outcomes:
        for name in [*outcome.warnings, *([outcome.failure[:60]] if outcome.failure else [])]:
            counts[name] = counts.get(name, 0) + 1
    return ", ".join(f"{name} {count}" for name, count in sorted(counts.items(), key=lambda item: -item[1]))
