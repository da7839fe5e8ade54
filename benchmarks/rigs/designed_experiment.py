"""Designed experiments: expected and achieved standard deviations of the next experiment, after a record."""

from collections.abc import Sequence
from dataclasses import dataclass
from pprint import pprint
from typing import Any

import numpy as np

from agents import console_output
from benchmarks.rigs.bench_catalogue import PARAMETERS
from benchmarks.rigs.calibration import INTERVAL_PROBABILITY, binomial_interval, compare_to_truth, run_in_processes
from benchmarks.rigs.closed_loop import MAX_RANGE_EXIT_RATE, N_SAMPLES, BenchPlant, rig_of_bench, with_held_input
from benchmarks.rigs.simulated_records import simulate_record

#: Difference between the noise seeds of the second and the first experiment.
_SECOND_SEED_OFFSET = 1_000_000


@dataclass(frozen=True)
class ExperimentOutcome:
    """The result of one experiment; all standard deviations are of m, c, a and b, relative to the truth.

    Attributes:
        before: (4,) standard deviations before the experiment.
        expected: (4,) standard deviations that the design expects after it.
        after: (4,) standard deviations that `identify` states after it, from both records.
        error: (4,) relative errors of the estimates after it.
        inside: (4,) whether the 90 % intervals hold the truth.
        left: whether the output left its range.
    """

    before: list[float]
    expected: list[float]
    after: list[float]
    error: list[float]
    inside: list[bool]
    left: bool


def run_trial(task: tuple[str, str, int, int]) -> ExperimentOutcome:
    """Design an experiment after a record, play it, identify from both; the task is bench, policy, samples, seed."""
    from agents.hardware.next_experiment import design_experiment
    from estimator import identify

    name, policy, samples, seed = task
    bench = with_held_input(name)
    rig, records, prior = rig_of_bench(bench, seed, not samples), [], None
    if samples:
        first = simulate_record(bench, seed, samples)
        records, prior = [(first.u, first.y)], identify(rig, (first.u, first.y)).belief
    found = design_experiment(rig, prior, policy, N_SAMPLES, MAX_RANGE_EXIT_RATE, seed)
    u, y = BenchPlant(bench, _SECOND_SEED_OFFSET + seed).play(found.u)
    result = identify(rig, [*records, (u, y)])
    truth = np.array(bench.truth)
    error, std, inside = compare_to_truth(result.parameters, result.interval(INTERVAL_PROBABILITY), truth)
    before = np.array([found.prior.parameters()[p][1] for p in PARAMETERS])
    expected = np.array([found.expected_stds[p] for p in PARAMETERS])
    left = bool((np.abs(y) > bench.output_range).any())
    before, expected, after = (np.asarray(stds) / np.abs(truth) for stds in (before, expected, std))
    return ExperimentOutcome(before.tolist(), expected.tolist(), after.tolist(), error.tolist(), inside.tolist(), left)


def run_trials(
    names: Sequence[str], policies: Sequence[str], samples: int, seeds: int, workers: int
) -> dict[tuple[str, str], list[ExperimentOutcome]]:
    """Trials by bench and policy."""
    cells = [(name, policy, samples) for name in names for policy in policies]
    trials = run_in_processes(run_trial, cells, seeds, workers, "Designing")
    return {(name, policy): of_cell for (name, policy, _), of_cell in trials.items()}


def print_report(found: dict[tuple[str, str], list[ExperimentOutcome]]) -> dict[str, Any]:
    """Print the table and the verdict; return the verdict for the JSON file."""

    def cells(values: Any) -> str:
        return ", ".join(f"{value:.2f}" if value < 9.95 else f"{value:.0f}" for value in values)

    rows = []
    for (name, policy), trials in found.items():
        before, expected, after, error = (
            np.array([getattr(one, part) for one in trials]) for part in ("before", "expected", "after", "error")
        )
        rows.append((
            name, policy, cells(np.median(before / expected, axis=0)), cells(np.median(after / expected, axis=0)),
            cells(np.sqrt(np.mean((error / expected) ** 2, axis=0))),
            cells(np.mean([one.inside for one in trials], axis=0)),
            f"{sum(one.left for one in trials)} of {len(trials)}",
        ))  # fmt: skip
    titles = ("rig", "policy", "times narrower, expected", "stated / expected", "RMS error / expected",
              "coverage of 90 %", "left its range")  # fmt: skip
    console_output.print_texts_and_tables(console_output.format_table(titles, rows, markdown=True))
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
    pprint(verdict, width=170)
    return verdict
