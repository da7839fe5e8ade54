"""The leaderboard: policies side by side, every figure with its interval; as a table, JSON and figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from agents.console_output import format_table, print_texts_and_tables, split_to_width
from agents.evaluation.metric_summary import (
    METRIC_COLUMNS,
    METRIC_EXPLANATIONS,
    center_and_interval,
    center_value,
    metric_cell,
    metric_columns,
    summarise_metrics,
)
from agents.evaluation.policy_evaluation import Evaluation
from agents.result_files import write_json

#: The chief ones, with titles for a table of 80 characters; and those whose spread it has.
HEADLINE_TITLES = {
    "information_gain": "information / nat",
    "efficiency": "D-efficiency / %",
    "coverage": "cover / %",
    "ended_early": "early / %",
    "decision_time": "µs",
}
_HEADLINE_WITH_INTERVAL = ("information_gain", "efficiency")


#: What the auditor of the second table is.
AUDITOR_EXPLANATION = "the auditor: an offline maximum a posteriori fit that knows the noises"


def write_evaluations(path: Path, evaluations: list[Evaluation], settings: dict[str, Any]) -> None:
    """Write summaries and the settings that they were made with."""
    results = {
        evaluation.policy: {
            **summarise_metrics(evaluation),
            "estimators": {
                estimator: summarise_metrics(replace(evaluation, metrics=values))
                for estimator, values in evaluation.estimator_metrics.items()
            },
        }
        for evaluation in evaluations
    }
    write_json(path, {"settings": settings, "policies": results})


HeadingsAndRows = tuple[list[str], list[list[str]]]

#: Of a column [characters].
_MAX_COLUMN_WIDTH = 36


def comparison_table(evaluations: list[Evaluation]) -> HeadingsAndRows:
    """Heads and rows: a column for each policy, the best log posterior gain first; `metric_cell` each metric."""
    ordered = sort_by_log_posterior_gain(evaluations)
    summaries = [summarise_metrics(evaluation) for evaluation in ordered]
    rows = [
        [metric.title, *(metric_cell(metric, summary.get(name)) for summary in summaries)]
        for name, metric in metric_columns(
            [name for summary in summaries for name in summary], ordered[0].scales.input_unit
        ).items()
    ]
    return ["", *(evaluation.title for evaluation in ordered)], rows


def policy_by_estimator_table(evaluations: list[Evaluation]) -> HeadingsAndRows:
    """Heads and rows, policies by estimators: who identified what from the same inputs and outputs."""
    found = [name for e in evaluations for values in e.estimator_metrics.values() for name in values]
    columns = {name: m for name, m in metric_columns(found).items() if name not in ("coverage_50", "coverage_95")}
    rows = []
    for evaluation in sort_by_log_posterior_gain(evaluations):
        for estimator, values in evaluation.estimator_metrics.items():
            centers = {name: float(metric.center[1](values[name])) for name, metric in columns.items()}
            cells = [metric.format_value(centers[name]) for name, metric in columns.items()]
            rows.append([evaluation.title, estimator.replace("_", " "), *cells])
    return ["policy", "estimator", *(metric.title for metric in columns.values())], rows


def print_comparison_table(evaluations: list[Evaluation], title: str) -> None:
    """Print the leaderboard, with the intervals below."""
    from rich.table import Table as RichTable

    headings, rows = comparison_table(evaluations)

    def make_table(columns: Sequence[int]) -> RichTable:
        rich_table = RichTable(title=title)
        for column in columns:
            rich_table.add_column(
                headings[column], justify="right" if column else "left", overflow="fold", max_width=_MAX_COLUMN_WIDTH
            )
        for row in rows:
            rich_table.add_row(*(row[column] for column in columns))
        return rich_table

    print_texts_and_tables(split_to_width(make_table, len(headings)), table_caption(evaluations))


def headline_table(evaluations: list[Evaluation]) -> HeadingsAndRows:
    """Heads and rows: a line for each policy, with the chief figures, which are in ``HEADLINE_TITLES``."""
    titles = {name: title for name, title in HEADLINE_TITLES.items() if name in evaluations[0].metrics}
    rows = []
    for evaluation in evaluations:
        cells = [evaluation.title]
        for name in titles:
            metric, values = METRIC_COLUMNS[name], evaluation.metrics[name].reshape(evaluation.seeds, -1)
            entry = center_and_interval(values, metric)
            spread = (
                f" ± {metric.format_value((entry['high'] - entry['low']) / 2)}"
                if name in _HEADLINE_WITH_INTERVAL
                else ""
            )
            cells.append(f"{metric.format_value(center_value(entry))}{spread}")
        rows.append(cells)
    return ["", *titles.values()], rows


def print_headline_table(evaluations: list[Evaluation], title: str) -> None:
    """Print the chief figures, in 80 columns."""
    headings, rows = headline_table(evaluations)
    caption = "means over systems ± half of the 95 % bootstrap interval; 90 % intervals that cover; "
    caption += "episodes that a limit ended early; time of a decision"
    if "efficiency" in evaluations[0].metrics:
        caption += f"\n{METRIC_EXPLANATIONS['efficiency']}"
    print_texts_and_tables(format_table(headings, rows, title=title), caption)


def print_estimator_table(evaluations: list[Evaluation]) -> None:
    """Print the two-way table, where there is something in it."""
    headings, rows = policy_by_estimator_table(evaluations)
    if rows:
        title = "what other estimators make of the same inputs and outputs"
        print_texts_and_tables(format_table(headings, rows, title=title, n_labels=2), AUDITOR_EXPLANATION)


def sort_by_log_posterior_gain(evaluations: list[Evaluation]) -> list[Evaluation]:
    """The best log posterior gain first."""
    return sorted(evaluations, key=lambda evaluation: -float(evaluation.metrics["log_posterior_gain"].mean()))


def table_caption(evaluations: list[Evaluation]) -> str:
    """What the figures of a table are, and what its less known metrics mean, a line each."""
    several = any(evaluation.seeds > 1 for evaluation in evaluations)
    seed_note = "of several seeds interquartile means, shares as means, and the median seed; " if several else ""
    found = {name for evaluation in evaluations for name in evaluation.metrics}
    explanations = [meaning for name, meaning in METRIC_EXPLANATIONS.items() if name in found]
    return "\n".join([f"means, errors as medians; {seed_note}[95 % bootstrap intervals over systems]", *explanations])
