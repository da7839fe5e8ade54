"""Tables of a comparison of policies, printed or for a page, and evaluation.json."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
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
from agents.evaluation.policy_rollout import Evaluation
from agents.result_files import write_json


@dataclass(frozen=True)
class ComparisonSettings:
    """Settings of a comparison: the track, its number of systems, their seed, and the options of the environment."""

    env: str
    systems: int
    seed: int
    options: dict[str, Any]


#: Metrics of the headline table, with titles for a width of 80 characters.
HEADLINE_TITLES = {
    "information_gain": "information / nat",
    "efficiency": "D-efficiency / %",
    "coverage": "cover / %",
    "ended_early": "early / %",
    "decision_time": "µs",
}

#: Metrics of this table with half of their interval.
_HEADLINE_WITH_INTERVAL = ("information_gain", "efficiency")


#: Explanation of the auditor, below the table of estimators.
AUDITOR_EXPLANATION = "the auditor: an offline maximum a posteriori fit that knows the noises"


def write_evaluations(path: Path, evaluations: list[Evaluation], settings: ComparisonSettings) -> None:
    """Write evaluation.json: the settings of a comparison, and the summaries of all metrics."""
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
    write_json(path, {"settings": asdict(settings), "policies": results})


#: Headings and rows of a table.
HeadingsAndRows = tuple[list[str], list[list[str]]]

#: Largest width of a column [characters].
_MAX_COLUMN_WIDTH = 36


def comparison_table(evaluations: list[Evaluation]) -> HeadingsAndRows:
    """A row for each metric, and a column for each policy, the best log posterior gain first."""
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
    """A row for each policy and estimator: metrics of the estimator on the policy's inputs and outputs."""
    found = [name for e in evaluations for values in e.estimator_metrics.values() for name in values]
    columns = {name: m for name, m in metric_columns(found).items() if name not in ("coverage_50", "coverage_95")}
    rows = []
    for evaluation in sort_by_log_posterior_gain(evaluations):
        for estimator, values in evaluation.estimator_metrics.items():
            centers = {name: float(metric.center.function(values[name])) for name, metric in columns.items()}
            cells = [metric.format_value(centers[name]) for name, metric in columns.items()]
            rows.append([evaluation.title, estimator.replace("_", " "), *cells])
    return ["policy", "estimator", *(metric.title for metric in columns.values())], rows


def print_comparison_table(evaluations: list[Evaluation], title: str) -> None:
    """Print the table of all metrics, with their intervals."""
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
    """A row for each policy, with the metrics of `HEADLINE_TITLES`."""
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
    """Print the headline table, in 80 columns."""
    headings, rows = headline_table(evaluations)
    caption = "means over systems ± half of the 95 % bootstrap interval; 90 % intervals that cover; "
    caption += "episodes that a limit ended early; time of a decision"
    if "efficiency" in evaluations[0].metrics:
        caption += f"\n{METRIC_EXPLANATIONS['efficiency']}"
    print_texts_and_tables(format_table(headings, rows, title=title), caption)


def print_estimator_table(evaluations: list[Evaluation]) -> None:
    """Print the table of policies by estimators, unless it is empty."""
    headings, rows = policy_by_estimator_table(evaluations)
    if rows:
        title = "other estimators on the same inputs and outputs"
        print_texts_and_tables(format_table(headings, rows, title=title, n_labels=2), AUDITOR_EXPLANATION)


def sort_by_log_posterior_gain(evaluations: list[Evaluation]) -> list[Evaluation]:
    """The evaluations, the best log posterior gain first."""
    return sorted(evaluations, key=lambda evaluation: -float(evaluation.metrics["log_posterior_gain"].mean()))


def table_caption(evaluations: list[Evaluation]) -> str:
    """The statistics in a table, and explanations of its less known metrics, a line each."""
    several = any(evaluation.seeds > 1 for evaluation in evaluations)
    seed_note = "of several seeds interquartile means, shares as means, and the median seed; " if several else ""
    found = {name for evaluation in evaluations for name in evaluation.metrics}
    explanations = [meaning for name, meaning in METRIC_EXPLANATIONS.items() if name in found]
    return "\n".join([f"means, errors as medians; {seed_note}[95 % bootstrap intervals over systems]", *explanations])
