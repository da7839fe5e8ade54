"""The leaderboard: policies side by side, every figure with its interval; as a table, JSON and figures."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from agents.evaluation import Evaluation, evaluate
from estimator.files import write_atomically

#: What a new policy is compared with: the paper's regimes, and two classical excitations.
BASELINES = ("silverbox-multisine", "silverbox-arrow", "uniform", "prbs")

_RESAMPLES = 2000


@dataclass(frozen=True)
class Metric:
    """A column of the table.

    Attributes:
        title: with its unit.
        digits: decimals that are printed.
        scale: from the stored to the printed unit.
        center: the statistic over systems, and its name.
    """

    title: str
    digits: int
    scale: float = 1.0
    center: tuple[str, Callable[..., Any]] = ("mean", np.mean)


_MEDIAN = ("median", np.median)

METRICS = {
    "information_gain": Metric("information gained / nat", 2),
    "log_posterior_gain": Metric("log posterior gain / nat", 2),
    "error_m": Metric("error of m / %", 3, 100, _MEDIAN),
    "error_c": Metric("error of c / %", 2, 100, _MEDIAN),
    "error_a": Metric("error of a / %", 3, 100, _MEDIAN),
    "error_b": Metric("error of b / %", 2, 100, _MEDIAN),
    "coverage_50": Metric("50 % intervals that cover / %", 1, 100),
    "coverage": Metric("90 % intervals that cover / %", 1, 100),
    "coverage_95": Metric("95 % intervals that cover / %", 1, 100),
    "nees": Metric("NEES per coefficient", 2),
    "ended_early": Metric("episodes ended early / %", 1, 100),
    "input_power": Metric("input power / mV²", 0, 1e6),
    "input_peak": Metric("input peak / mV", 1, 1e3),
    "crest_factor": Metric("crest factor", 2),
    "decision_time": Metric("time per decision / µs", 2, 1e6),
    "fisher_gain": Metric("Fisher information / nat", 2),
    "efficiency": Metric("D-efficiency / %", 1, 100),
    "silverbox_equivalent": Metric("Silverbox equivalent / samples", 0, 1.0, _MEDIAN),
    "simulation_rmse": Metric("RMSE on the twin's arrow / mV", 3, 1e3, _MEDIAN),
    "arrow_rmse": Metric("RMSE on the real arrow / mV", 2, 1e3, _MEDIAN),
}

#: What the table of estimators shows.
ESTIMATOR_METRICS = ("error_m", "error_c", "error_a", "error_b", "coverage", "nees")


def compare(
    policies: Sequence[str],
    env_id: str,
    systems: int,
    options: dict[str, Any],
    folder: Path,
    *,
    seed: int = 0,
    report: bool = False,
) -> list[Evaluation]:
    """Evaluate policies; print the tables, and write ``evaluation.json`` and the figures or the report."""
    from rich.console import Console

    from agents.figures import draw_contraction, draw_excitations

    console = Console()
    with console.status("Evaluating") as status:
        evaluations = evaluate(
            policies, env_id, systems, seed, options, lambda name: status.update(f"Evaluating {name}")
        )
    title = f"{env_id}, {systems} systems"
    print_table(evaluations, title)
    print_estimators(evaluations)
    settings = {"env": env_id, "systems": systems, "seed": seed, "options": options}
    write_json(folder / "evaluation.json", evaluations, settings)
    written = ["evaluation.json"]
    if report:
        from agents.report import write_report

        write_report(folder / "report.html", evaluations, settings, [Path(sys.argv[0]).name, *sys.argv[1:]])
        written += ["report.html"]
    else:
        draw_contraction(folder / "contraction.png", evaluations, title)
        draw_excitations(folder / "excitations.png", evaluations)
        written += ["contraction.png", "excitations.png"]
    for name in written:
        print(folder / name)
    return evaluations


def summarise(evaluation: Evaluation, seed: int = 0) -> dict[str, dict[str, float]]:
    """The centre of each metric over systems, with a 95 % bootstrap interval (percentile, 2000 resamples)."""
    summary: dict[str, dict[str, float]] = {}
    for name, values in evaluation.metrics.items():
        kind, statistic = METRICS[name].center
        if (values == values[0]).all():  # SciPy warns of samples without spread
            summary[name] = dict.fromkeys((kind, "low", "high"), float(values[0]))
            continue
        with np.errstate(invalid="ignore"):  # values may be infinite, and SciPy takes their standard deviation
            low, high = stats.bootstrap(
                (values,), statistic, n_resamples=_RESAMPLES, method="percentile", vectorized=True,
                rng=np.random.default_rng(seed),
            ).confidence_interval  # fmt: skip
        summary[name] = {kind: float(statistic(values)), "low": float(low), "high": float(high)}
    return summary


def write_json(path: Path, evaluations: list[Evaluation], settings: dict[str, Any]) -> None:
    """Write summaries and the settings that they were made with; a number that is not finite, as null."""
    results = {
        evaluation.policy: {
            **_finite(summarise(evaluation)),
            "estimators": {
                estimator: _finite(summarise(replace(evaluation, metrics=values)))
                for estimator, values in evaluation.estimators.items()
            },
        }
        for evaluation in evaluations
    }
    write_atomically(path, json.dumps({"settings": settings, "policies": results}, indent=2, allow_nan=False))


def _finite(summary: dict[str, dict[str, float]]) -> dict[str, dict[str, float | None]]:
    return {
        name: {key: value if np.isfinite(value) else None for key, value in entry.items()}
        for name, entry in summary.items()
    }


def print_table(evaluations: list[Evaluation], title: str) -> None:
    """Print the leaderboard: a column for each policy, the best log posterior gain first; intervals below."""
    from rich.console import Console
    from rich.table import Table

    summaries = {evaluation.policy: summarise(evaluation) for evaluation in evaluations}
    order = [evaluation.policy for evaluation in in_order(evaluations)]
    table = Table(title=title, caption="means, errors as medians; [95 % bootstrap intervals over systems]")
    table.add_column("", no_wrap=True)
    for policy in order:
        table.add_column(policy, justify="right", overflow="fold")
    for name, metric in METRICS.items():
        if any(name in summary for summary in summaries.values()):
            table.add_row(metric.title, *(cell_of(metric, summaries[policy].get(name)) for policy in order))
    console = Console(markup=False)  # the brackets of the intervals are no markup
    console.width = max(console.width, 36 + 20 * len(order))
    console.print(table)


def print_estimators(evaluations: list[Evaluation]) -> None:
    """Print the two-way table, policies by estimators: who identified what from the same inputs and outputs."""
    from rich.console import Console
    from rich.table import Table

    titles = [METRICS[name].title for name in ESTIMATOR_METRICS]
    table = Table("policy", "estimator", *titles, title="the same inputs and outputs in other hands")
    for evaluation in evaluations:
        for estimator, values in evaluation.estimators.items():
            cells = []
            for name in ESTIMATOR_METRICS:
                metric = METRICS[name]
                cells.append(f"{metric.scale * float(metric.center[1](values[name])):.{metric.digits}f}")
            table.add_row(evaluation.policy, estimator.replace("_", " "), *cells)
        table.add_section()
    if table.rows:
        console = Console(markup=False)
        console.width = max(console.width, 110)
        console.print(table)


def in_order(evaluations: list[Evaluation]) -> list[Evaluation]:
    """The best log posterior gain first."""
    return sorted(evaluations, key=lambda evaluation: -float(evaluation.metrics["log_posterior_gain"].mean()))


def _center(entry: dict[str, float]) -> float:
    return next(value for key, value in entry.items() if key in ("mean", "median"))


def cell_of(metric: Metric, entry: dict[str, float] | None) -> str:
    """What a table says of a metric: its centre, and its interval on the next line; a dash where there is none."""
    if entry is None:
        return "-"
    center, low, high = (metric.scale * value for value in (_center(entry), entry["low"], entry["high"]))
    return f"{center:.{metric.digits}f}\n[{low:.{metric.digits}f}, {high:.{metric.digits}f}]"
