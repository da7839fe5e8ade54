"""Comparison of `identify` with other methods on the same records: errors, run times, and statements of user code."""

from __future__ import annotations

import ast
import inspect
import math
import statistics
import subprocess
import sys
import tempfile
import textwrap
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.peer_process import NotAvailable, Peers
from benchmarks.rigs import peer_methods
from benchmarks.rigs.bench_catalogue import BENCHES
from benchmarks.rigs.dop853_simulator import FloatArray
from benchmarks.rigs.simulated_records import draw_guess, simulate_record, write_record, write_rig

#: Name of our method.
OURS = "identify"

#: Peer to the geometric mean of our error over its error, at most.
MAX_ERROR_RATIO = {"dynamax": 1.1, "dynamax-jit": 1.1, "scipy": 1.0, "pysindy": 1.0}

#: Peers whose times are compared.
TIMED_PEERS = ("dynamax", "dynamax-jit")

#: Their time over the time of `identify`, at least.
MIN_TIME_RATIO = 5.0

#: Statements that a user of `identify` writes, at most.
MAX_STATEMENTS = 5

#: Integration steps of the peers per period.
_STEPS_PER_PERIOD = 64

#: Runs of a whole script, for its median time.
_N_SCRIPT_RUNS = 5


def ours(rig_file: str, data_file: str) -> dict[str, tuple[float, float]]:
    """The code of a user of `identify`."""
    from estimator import Rig, identify

    return identify(Rig.from_file(rig_file), [data_file]).parameters


def script_time_ratios(names: Sequence[str], peer_names: Sequence[str]) -> dict[str, dict[str, float]]:
    """Peer and bench to the time of its script over ours, for one record, from the start of Python.

    The ratios are of medians over alternating runs. A first run of each does not count: afterwards our kernels are
    compiled on disk, whereas JAX compiles in every run. Empty where the peers are not available.
    """
    ratios: dict[str, dict[str, float]] = {method: {} for method in peer_names}
    with tempfile.TemporaryDirectory() as folder:
        rig, data, problems = (Path(folder) / file for file in ("rig.toml", "data.csv", "problems.npz"))
        write_problems(problems, names, 1)
        for name in names:
            bench = BENCHES[name]
            made = simulate_record(bench, 0)
            write_rig(rig, bench, draw_guess(bench, 0))
            write_record(data, made.u, made.y)
            code = f"{inspect.getsource(ours)}\nours({str(rig)!r}, {str(data)!r})"
            seconds_taken: dict[str, list[float]] = {method: [] for method in (OURS, *peer_names)}
            for _ in range(1 + _N_SCRIPT_RUNS):
                started = time.perf_counter()
                subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)
                seconds_taken[OURS].append(time.perf_counter() - started)
                for method in peer_names:
                    started = time.perf_counter()
                    try:
                        with Peers(problems) as peers:
                            peers.ask(f"rigs {method} {name}", 0)
                    except NotAvailable:
                        return {}
                    seconds_taken[method].append(time.perf_counter() - started)
            for method in peer_names:
                ratios[method][name] = statistics.median(seconds_taken[method][1:]) / statistics.median(
                    seconds_taken[OURS][1:]
                )
    return ratios


def count_statements(*functions: Callable[..., Any]) -> int:
    """Statements in the bodies of functions, without docstrings.

    Example:
        >>> count_statements(ours)
        2
    """
    count = 0
    for function in functions:
        tree = ast.parse(textwrap.dedent(inspect.getsource(function))).body[0]
        nodes = [node for node in ast.walk(tree) if isinstance(node, ast.stmt) and node is not tree]
        count += sum(not (isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)) for node in nodes)
    return count


def write_problems(path: Path, names: Sequence[str], seeds: int) -> None:
    """Write the problems for the peers: records, guesses and true noises of each bench."""
    arrays: dict[str, Any] = {}
    for name in names:
        bench = BENCHES[name]
        made = [simulate_record(bench, seed) for seed in range(seeds)]
        # A decimation filter averages over several samples: the peers get the noises after it.
        root = np.sqrt(bench.decimate)
        fields = {
            "u": np.stack([one.u for one in made]),
            "y": np.stack([one.y for one in made]),
            "guess": np.array([[sum(pair) / 2 for pair in draw_guess(bench, seed).values()] for seed in range(seeds)]),
            "step": bench.step, "kind": bench.kind, "interpolation": bench.interpolation,
            "substeps": math.ceil(_STEPS_PER_PERIOD / bench.samples_per_period),
            "offset": bench.offset != 0, "rest": bench.rest, "process_noise": bench.process_noise / root,
            "sensor_noise": bench.sensor_noise / root,
        }  # fmt: skip
        arrays |= {f"{name}_{field}": np.asarray(value) for field, value in fields.items()}
    np.savez(path, **arrays)


def run_comparison(names: Sequence[str], seeds: int, peer_names: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Bench and method to errors (seeds, 4), seconds (seeds,) and reasons of failures, for all methods in turns."""
    from rich.console import Console
    from rich.progress import track

    results: dict[str, dict[str, Any]] = {name: {} for name in names}
    with tempfile.TemporaryDirectory() as folder:
        problems = Path(folder) / "problems.npz"
        write_problems(problems, names, seeds)
        with Peers(problems) as peers:
            pairs = [(name, seed) for name in names for seed in range(seeds)]
            for name, seed in track(pairs, "Identifying in turns", console=Console(stderr=True)):
                truth = np.array(BENCHES[name].truth)
                for method in (OURS, *peer_names):
                    here = results[name].setdefault(method, {"errors": [], "seconds": [], "reasons": []})
                    try:
                        found, taken = _identify_one(method, name, seed, Path(folder), peers)
                        here["errors"].append(np.abs(found / truth - 1).tolist())
                    except (NotAvailable, ValueError, RuntimeError) as error:
                        here["reasons"].append(str(error))
                        here["errors"].append([np.nan] * 4)
                        taken = np.nan
                    here["seconds"].append(taken)
    return results


def _identify_one(method: str, name: str, seed: int, folder: Path, peers: Peers) -> tuple[FloatArray, float]:
    """Parameters (4,) and run time [s] of a method on one record."""
    if method != OURS:
        answer = peers.ask(f"rigs {method} {name}", seed)
        return np.array(answer["parameters"]), answer["seconds"]
    bench = BENCHES[name]
    write_rig(folder / "rig.toml", bench, draw_guess(bench, seed))
    made = simulate_record(bench, seed)
    write_record(folder / "data.csv", made.u, made.y)
    started = time.perf_counter()
    parameters = ours(str(folder / "rig.toml"), str(folder / "data.csv"))
    seconds = time.perf_counter() - started
    return np.array([parameters[key][0] for key in ("m", "c", "a", "b")]), seconds


def error_ratio(our_errors: Any, their_errors: Any) -> tuple[float, float]:
    """Geometric mean, over seeds and parameters, of our errors over theirs, and the factor of its 95 % interval.

    Both are NaN where the peer has no errors.
    """
    logs = np.log(np.array(our_errors)) - np.log(np.array(their_errors))
    is_finite = np.isfinite(logs)
    if not is_finite.any():
        return float("nan"), float("nan")
    known = np.array([row[good].mean() for row, good in zip(logs, is_finite, strict=True) if good.any()])
    return float(np.exp(known.mean())), float(np.exp(1.96 * known.std() / np.sqrt(max(len(known) - 1, 1))))


def print_report(results: dict[str, dict[str, Any]], script_ratios: dict[str, dict[str, float]]) -> dict[str, Any]:
    """Print the table, the script times and the verdict; return the verdict for the JSON file."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    console = Console(width=170)
    table = Table("rig", "method", "median error of m, c, a, b, %", "our error over theirs [95 %]", "s, the first",
                  "s, others", "failed", "verdict", box=box.MARKDOWN)  # fmt: skip
    verdict: dict[str, Any] = {}
    for name, methods in results.items():
        for method, method_results in methods.items():
            errors = ", ".join(f"{100 * value:.2g}" for value in np.nanmedian(method_results["errors"], axis=0))
            failed = f"{len(method_results['reasons'])}" + (
                f": {method_results['reasons'][0][:40]}" if method_results["reasons"] else ""
            )
            over, factor = error_ratio(methods[OURS]["errors"], method_results["errors"])
            good = over <= MAX_ERROR_RATIO.get(method, np.inf)
            word = "" if method == OURS else "not available" if np.isnan(over) else "PASS" if good else "MISS"
            first, others = first_and_other_seconds(method_results)
            shown = "" if method == OURS else f"{over:.3g} [{over / factor:.3g}, {over * factor:.3g}]"
            table.add_row(name, method, errors, shown, f"{first:.2f}", f"{others:.2f}", failed, word)
            verdict[f"{name}, {method}"] = {
                "ratio": over,
                "factor": factor,
                "first": first,
                "others": others,
                "verdict": word,
            }
    console.print(table)
    counts = {OURS: count_statements(ours)}
    counts |= {
        peer: count_statements(function, *peer_methods.HELPERS[peer]) for peer, function in peer_methods.PEERS.items()
    }
    console.print("Statements of user code: " + ", ".join(f"{name} {count}" for name, count in counts.items()))
    console.print(f"{'PASS' if counts[OURS] <= MAX_STATEMENTS else 'MISS'}: at most {MAX_STATEMENTS} of ours")
    slower: dict[str, dict[str, float]] = {}
    for peer in [peer for peer in TIMED_PEERS if all(peer in methods for methods in results.values())]:
        times = np.array(
            [
                [first_and_other_seconds(methods[peer]), first_and_other_seconds(methods[OURS])]
                for methods in results.values()
            ]
        )
        whens = ("a rig's first record, JAX's compilation included", "others")
        slower[peer] = dict(zip(whens, np.nanmedian(times[:, 0] / times[:, 1], axis=0).tolist(), strict=True))
        if script_ratios:
            slower[peer]["a script of one record, from the start of Python"] = statistics.median(
                script_ratios[peer].values()
            )
        for when, value in slower[peer].items():
            word = "PASS" if value >= MIN_TIME_RATIO else "MISS"
            console.print(
                f"{word}: {peer} takes {value:.3g} times as long as ours (at least {MIN_TIME_RATIO:g}), {when}"
            )
    return {"statements": counts, "slower": slower, "rows": verdict}


def first_and_other_seconds(method_results: dict[str, Any]) -> tuple[float, float]:
    """Run time of a bench's first record, which may include a compilation, and the median of the others [s]."""
    return float(method_results["seconds"][0]), float(np.nanmedian(method_results["seconds"][1:] or [np.nan]))
