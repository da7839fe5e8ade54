"""The leaderboard: policies side by side, every figure with its interval; as a table, JSON and figures."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
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
    "coverage": Metric("90 % intervals that cover / %", 1, 100),
    "ended_early": Metric("episodes ended early / %", 1, 100),
    "input_power": Metric("input power / mV²", 0, 1e6),
    "arrow_rmse": Metric("RMSE on the real arrow / mV", 2, 1e3, _MEDIAN),
}


def compare(
    policies: Sequence[str],
    env_id: str,
    systems: int,
    options: dict[str, Any],
    folder: Path,
    *,
    seed: int = 0,
) -> list[Evaluation]:
    """Evaluate policies; print the table, write ``evaluation.json`` and the figures into ``folder``."""
    from rich.console import Console

    from agents.figures import draw_contraction, draw_excitations

    console = Console()
    with console.status("Evaluating") as status:
        evaluations = evaluate(
            policies, env_id, systems, seed, options, lambda name: status.update(f"Evaluating {name}")
        )
    title = f"{env_id}, {systems} systems"
    print_table(evaluations, title)
    settings = {"env": env_id, "systems": systems, "seed": seed, "options": options}
    write_json(folder / "evaluation.json", evaluations, settings)
    draw_contraction(folder / "contraction.png", evaluations, title)
    draw_excitations(folder / "excitations.png", evaluations)
    for name in ("evaluation.json", "contraction.png", "excitations.png"):
        print(folder / name)
    return evaluations


def summarise(evaluation: Evaluation, seed: int = 0) -> dict[str, dict[str, float]]:
    """The centre of each metric over systems, with a 95 % bootstrap interval (percentile, 2000 resamples)."""
    summary: dict[str, dict[str, float]] = {}
    for name, values in evaluation.metrics.items():
        kind, statistic = METRICS[name].center
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
            name: {key: value if np.isfinite(value) else None for key, value in entry.items()}
            for name, entry in summarise(evaluation).items()
        }
        for evaluation in evaluations
    }
    write_atomically(path, json.dumps({"settings": settings, "policies": results}, indent=2, allow_nan=False))


def print_table(evaluations: list[Evaluation], title: str) -> None:
    """Print the leaderboard: a column for each policy, the best log posterior gain first; intervals below."""
    from rich.console import Console
    from rich.table import Table

    summaries = {evaluation.policy: summarise(evaluation) for evaluation in evaluations}
    order = sorted(summaries, key=lambda policy: -_center(summaries[policy]["log_posterior_gain"]))
    table = Table(title=title, caption="means, errors as medians; [95 % bootstrap intervals over systems]")
    table.add_column("", no_wrap=True)
    for policy in order:
        table.add_column(policy, justify="right", overflow="fold")
    for name, metric in METRICS.items():
        if any(name in summary for summary in summaries.values()):
            table.add_row(metric.title, *(_cell(metric, summaries[policy].get(name)) for policy in order))
    console = Console(markup=False)  # the brackets of the intervals are no markup
    console.width = max(console.width, 30 + 20 * len(order))
    console.print(table)


def _center(entry: dict[str, float]) -> float:
    return next(value for key, value in entry.items() if key in ("mean", "median"))


def _cell(metric: Metric, entry: dict[str, float] | None) -> str:
    if entry is None:
        return "-"
    center, low, high = (metric.scale * value for value in (_center(entry), entry["low"], entry["high"]))
    return f"{center:.{metric.digits}f}\n[{low:.{metric.digits}f}, {high:.{metric.digits}f}]"
