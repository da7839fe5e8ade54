"""Calibration of `identify`: errors against the Cramér-Rao bound, coverage of intervals, and trials in processes."""

import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field
from multiprocessing import get_context
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from benchmarks.rigs.bench_catalogue import PARAMETERS, Bench
from benchmarks.rigs.dop853_simulator import FloatArray
from benchmarks.rigs.simulated_records import SimulatedRecord, write_record, write_rig

#: Probability of the intervals that are judged.
INTERVAL_PROBABILITY = 0.9

#: Bounds of the pooled coverage.
POOLED_COVERAGE_BAR = (0.87, 0.93)

#: Bounds that the confidence interval of each cell's coverage must reach.
CELL_COVERAGE_BAR = (0.85, 0.95)
#: Median relative error that always passes.
MIN_ERROR_BAR = 0.003

#: Median relative error over the Cramér-Rao deviation, at most.
MAX_RATIO_TO_BOUND = 1.2


@dataclass(frozen=True)
class TrialOutcome:
    """The result of `identify` on a record.

    Attributes:
        error: (4,) relative errors of m, c, a and b; infinite after a failure.
        deviation: (4,) stated standard deviations, relative to the truth.
        inside: (4,) whether the 90 % intervals hold the truth.
        bound: (4,) Cramér-Rao standard deviations, relative to the truth.
        warnings: name of a warning to its message.
        seconds: run time with reading of the files [s].
        failure: type and message of an exception; empty without one.
    """

    error: list[float]
    deviation: list[float]
    inside: list[bool]
    bound: list[float]
    warnings: dict[str, str] = field(default_factory=dict)
    seconds: float = 0.0
    failure: str = ""


def identify_from_files(
    simulated: SimulatedRecord, guess: dict[str, tuple[float, float]] | None, n_pieces: int = 1, **rig_changes: Any
) -> TrialOutcome:
    """Write a record and its rig file, and identify from these files.

    Args:
        simulated: the record.
        guess: parameter to its 90 % interval, or None.
        n_pieces: number of files that the record is cut into.
        rig_changes: settings of the rig file that differ from the truth.
    """
    from estimator import Rig, identify

    truth, bound = np.array(simulated.bench.truth), simulated.cramer_rao_stds
    with tempfile.TemporaryDirectory() as folder:
        rig_file = Path(folder) / "rig.toml"
        data_files = [Path(folder) / f"data-{number}.csv" for number in range(n_pieces)]
        write_rig(rig_file, simulated.bench, guess, **rig_changes)
        parts = zip(*(np.array_split(series, n_pieces) for series in (simulated.u, simulated.y)), strict=True)
        for data_file, (u, y) in zip(data_files, parts, strict=True):
            write_record(data_file, u, y)
        started = time.perf_counter()
        try:
            result = identify(Rig.from_file(str(rig_file)), [str(data_file) for data_file in data_files])
        except Exception as failure:  # any error of a user
            failed = f"{type(failure).__name__}: {failure}"
            return TrialOutcome([np.inf] * 4, [np.nan] * 4, [False] * 4, bound.tolist(), failure=failed)
        seconds = time.perf_counter() - started
    error, std, inside = compare_to_truth(result.parameters, result.interval(INTERVAL_PROBABILITY), truth)
    return TrialOutcome(
        np.where(np.isfinite(error) & np.isfinite(std), error, np.inf).tolist(),
        (std / np.abs(truth)).tolist(),
        inside.tolist(),
        bound.tolist(),
        {warning.name: warning.message for warning in result.warnings},
        seconds,
    )


def compare_to_truth(
    parameters: Mapping[str, tuple[Any, ...]], intervals: Mapping[str, tuple[float, float]], truth: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Relative errors (4,) of m, c, a and b, standard deviations (4,), and whether intervals hold the truth (4,)."""
    mean, std = np.array([parameters[name][:2] for name in PARAMETERS]).T
    low, high = np.array([intervals[name] for name in PARAMETERS]).T
    return mean / truth - 1, std, (low <= truth) & (truth <= high)


@dataclass(frozen=True)
class BenchmarkCell:
    """The outcomes of one bench in one setting.

    Attributes:
        bench: the bench.
        setting: name of the setting.
        outcomes: one outcome per seed.
    """

    bench: Bench
    setting: str
    outcomes: Sequence[TrialOutcome]

    @property
    def errors(self) -> FloatArray:
        """(4,) medians of the absolute relative errors."""
        return np.asarray(np.median(np.abs([outcome.error for outcome in self.outcomes]), axis=0))

    @property
    def error_bars(self) -> FloatArray:
        """(4,) largest errors that pass: 0.3 %, or 1.2 times the median Cramér-Rao deviation where that is more."""
        return np.maximum(MIN_ERROR_BAR, MAX_RATIO_TO_BOUND * self.bounds)

    @property
    def bounds(self) -> FloatArray:
        """(4,) medians of the Cramér-Rao deviations."""
        return np.asarray(np.median([outcome.bound for outcome in self.outcomes], axis=0))

    @property
    def hits(self) -> list[int]:
        """(4,) numbers of outcomes whose intervals hold the truth."""
        return np.sum([outcome.inside for outcome in self.outcomes], axis=0).tolist()

    def to_dict(self) -> dict[str, Any]:
        """The cell for a JSON file."""
        return {
            "rig": self.bench.name,
            "setting": self.setting,
            "errors": self.errors.tolist(),
            "bounds": self.bounds.tolist(),
            "hits": self.hits,
            "outcomes": [vars(outcome) for outcome in self.outcomes],
        }


def judge_coverage(hits: Sequence[int], trials: Sequence[int]) -> tuple[float, list[bool], bool]:
    """Pooled coverage, whether each cell's 99.9 % binomial interval meets 0.85 to 0.95, and whether both bars pass.

    Example:
        >>> judge_coverage([180, 190, 120], [200, 200, 200])
        (0.8166666666666667, [True, True, False], False)
    """
    is_within = []
    for count, number in zip(hits, trials, strict=True):
        low, high = binomial_interval(count, number)
        is_within.append(bool(low <= CELL_COVERAGE_BAR[1] and high >= CELL_COVERAGE_BAR[0]))
    pooled = sum(hits) / sum(trials)
    return pooled, is_within, POOLED_COVERAGE_BAR[0] <= pooled <= POOLED_COVERAGE_BAR[1] and all(is_within)


def binomial_interval(count: int, number: int, level: float = 0.999) -> tuple[float, float]:
    """Clopper-Pearson interval of a share, ``count`` of ``number``."""
    from scipy.stats import binomtest

    interval = binomtest(count, number).proportion_ci(level, "exact")
    return float(interval.low), float(interval.high)


CellName = TypeVar("CellName", bound=tuple[Any, ...])
Answer = TypeVar("Answer")


def run_in_processes(
    work: Callable[[Any], Answer], cells: Sequence[CellName], seeds: int, workers: int, title: str
) -> dict[CellName, list[Answer]]:
    """Run a function on every cell and seed in processes; the first task runs alone, because it compiles.

    Args:
        work: function of a task, which is a cell's name followed by a seed.
        cells: names of the cells.
        seeds: number of seeds.
        workers: number of processes.
        title: of the progress bar on stderr.

    Returns:
        Name of a cell to the results of its seeds.
    """
    from rich.console import Console
    from rich.progress import track

    tasks = [(*cell, seed) for cell in cells for seed in range(seeds)]
    answers: dict[tuple[Any, ...], Answer] = {}
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        answers[tasks[0]] = pool.submit(work, tasks[0]).result()
        futures = {pool.submit(work, task): task for task in tasks[1:]}
        for future in track(as_completed(futures), title, len(futures), console=Console(stderr=True)):
            answers[futures[future]] = future.result()
    return {cell: [answers[*cell, seed] for seed in range(seeds)] for cell in cells}
