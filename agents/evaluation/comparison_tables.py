"""The leaderboard: policies side by side, every figure with its interval; as a table, JSON and figures."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from agents.console_output import format_table, print_texts_and_tables, split_to_width, write_json
from agents.evaluation.policy_evaluation import Evaluation
from estimator.rigs.units import axis_label
from estimator.support.array_types import FloatArray

_N_RESAMPLES = 2000

NamedStatistic = tuple[str, Callable[..., Any]]

MEAN: NamedStatistic = ("mean", np.mean)
MEDIAN: NamedStatistic = ("median", np.median)
IQM: NamedStatistic = ("iqm", partial(stats.trim_mean, proportiontocut=0.25))


@dataclass(frozen=True)
class MetricColumn:
    """A column of the table.

    Attributes:
        title: with its unit.
        decimals: decimals that are printed; of what may have any size, less than 0 the significant ones.
        scale: from the stored to the printed unit.
        center: the statistic over systems, and its name.
        center_of_seeds: the same over systems and training seeds, by default the interquartile mean. Of shares it is
            the mean: the middle half of an event that is rare never sees it.
    """

    title: str
    decimals: int
    scale: float = 1.0
    center: NamedStatistic = MEAN
    center_of_seeds: NamedStatistic = IQM

    def format_value(self, value: float) -> str:
        """A value as it is printed."""
        form = f".{self.decimals}f" if self.decimals >= 0 else f".{-self.decimals}g"
        return format(self.scale * value, form)


_proportion = partial(MetricColumn, center_of_seeds=MEAN)

METRIC_COLUMNS = {
    "information_gain": MetricColumn("information gained / nat", 2),
    "log_posterior_gain": MetricColumn("log posterior gain / nat", 2),
    "error_m": MetricColumn("error of m / %", 3, 100, MEDIAN),
    "error_c": MetricColumn("error of c / %", 2, 100, MEDIAN),
    "error_a": MetricColumn("error of a / %", 3, 100, MEDIAN),
    "error_b": MetricColumn("error of b / %", 2, 100, MEDIAN),
    "coverage_50": _proportion("50 % intervals that cover / %", 1, 100),
    "coverage": _proportion("90 % intervals that cover / %", 1, 100),
    "coverage_95": _proportion("95 % intervals that cover / %", 1, 100),
    "nees": _proportion("NEES per coefficient", 2),
    "ended_early": _proportion("episodes ended early / %", 1, 100),
    "input_power": MetricColumn("input power / mV²", 0, 1e6),
    "input_peak": MetricColumn("input peak / mV", 1, 1e3),
    "crest_factor": MetricColumn("crest factor", 2),
    "decision_time": MetricColumn("time per decision / µs", 2, 1e6),
    "fisher_gain": MetricColumn("Fisher information / nat", 2),
    "efficiency": MetricColumn("D-efficiency, of the best known / %", 1, 100),
    "certified": MetricColumn("at least, of what is possible / %", 1, 100),
    # Infinite where the whole regime tells less, so only a median says something of many.
    "silverbox_equivalent": MetricColumn("Silverbox equivalent / samples", 0, 1.0, MEDIAN, MEDIAN),
    "full_peak_equivalent": MetricColumn("the same at full peak / samples", 0, 1.0, MEDIAN, MEDIAN),
    "simulation_rmse": MetricColumn("RMSE on the twin's arrow / mV", 3, 1e3, MEDIAN),
    "arrow_rmse": MetricColumn("RMSE on the real arrow / mV", 2, 1e3, MEDIAN),
}


#: The chief ones, with titles for a table of 80 characters; and those whose spread it has.
HEADLINE_TITLES = {
    "information_gain": "information / nat",
    "efficiency": "D-efficiency / %",
    "coverage": "cover / %",
    "ended_early": "early / %",
    "decision_time": "µs",
}
_HEADLINE_WITH_INTERVAL = ("information_gain", "efficiency")


#: What the less known of them are, where they are in a table.
METRIC_EXPLANATIONS = {
    "nees": "NEES: squared error in units of the believed covariance; 1 where beliefs are right",
    "efficiency": "D-efficiency: information per coefficient, in parts of the best input that a search found which "
    "knows the system",
    "certified": "at least: the same, in parts of an upper bound of what any input tells",
    "silverbox_equivalent": "Silverbox equivalent: samples of the benchmark's multisine that tell as much",
}

#: What the auditor of the second table is.
AUDITOR_EXPLANATION = "the auditor: an offline maximum a posteriori fit that knows the noises"


def metric_columns(names: Iterable[str], input_unit: str = "V") -> dict[str, MetricColumn]:
    """The columns of the metrics that were found, in their order; errors of other parameters than m, c, a, b first.

    Args:
        names: names.
        input_unit: of the input; of a rig its own.
    """
    others = {name for name in names if name not in METRIC_COLUMNS}
    errors = {
        name: MetricColumn(f"error of {name.removeprefix('error_')} / %", 2, 100, MEDIAN) for name in sorted(others)
    }
    columns = METRIC_COLUMNS
    if input_unit != "V":
        power = axis_label("input power", input_unit)
        powers = {
            "input_power": power if input_unit == "1" else f"{power}²",
            "input_peak": axis_label("input peak", input_unit),
        }
        columns = METRIC_COLUMNS | {name: MetricColumn(title, -4) for name, title in powers.items()}
    return errors | {name: metric for name, metric in columns.items() if name in names}


def summarise_metrics(evaluation: Evaluation, seed: int = 0) -> dict[str, dict[str, Any]]:
    """The centre of each metric over systems, with its 95 % interval: `center_and_interval` by name."""
    columns = metric_columns(evaluation.metrics)
    return {
        name: center_and_interval(values.reshape(evaluation.seeds, -1), columns[name], seed)
        for name, values in evaluation.metrics.items()
    }


def center_and_interval(values: FloatArray, metric: MetricColumn, seed: int = 0) -> dict[str, Any]:
    """The centre of values (seeds, systems), with a 95 % bootstrap interval (percentile, 2000 resamples).

    Over several training seeds the bootstrap is stratified: in every resample each seed has as many systems as it was
    evaluated on. They are the same for all seeds, as the seeds were evaluated on the same ones, which are not
    independent of each other. So the interval is that of these policies over systems; what another training would
    give is in the spread of ``seeds``.

    Returns:
        The centre by its name, ``low`` and ``high``; of several seeds also ``seeds``, the metric's centre for each, and
        ``median_of_seeds``.
    """
    statistic_name, statistic = metric.center if len(values) == 1 else metric.center_of_seeds

    def resampled(rows: Any, axis: int = -1) -> Any:
        drawn = values[:, np.asarray(rows, dtype=np.intp)]  # (seeds, ..., systems)
        return statistic(np.concatenate(drawn, axis=axis), axis=axis)

    entry: dict[str, Any] = {statistic_name: float(resampled(np.arange(values.shape[1])))}
    if (values == values.flat[0]).all():  # SciPy warns of samples without spread
        entry |= dict.fromkeys(("low", "high"), entry[statistic_name])
    else:
        with np.errstate(invalid="ignore"):  # values may be infinite, and SciPy takes their standard deviation
            interval = stats.bootstrap(
                (np.arange(values.shape[1]),), resampled, n_resamples=_N_RESAMPLES, method="percentile", vectorized=True,
                rng=np.random.default_rng(seed),
            ).confidence_interval  # fmt: skip
        entry |= {"low": float(interval.low), "high": float(interval.high)}
    if len(values) > 1:
        per_seed = [float(metric.center[1](row)) for row in values]
        entry |= {"median_of_seeds": float(np.median(per_seed)), "seeds": per_seed}
    return entry


def center_and_interval_text(metric: MetricColumn, values: FloatArray) -> str:
    """The centre of values (systems,), with its interval, on one line."""
    return metric_cell(metric, center_and_interval(values[None], metric)).replace("\n", " ")


def center_value(entry: dict[str, Any]) -> Any:
    """The centre in what `center_and_interval` made, whatever it is called."""
    return next(value for key, value in entry.items() if key in ("mean", "median", "iqm"))


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


def metric_cell(metric: MetricColumn, entry: dict[str, Any] | None) -> str:
    """What a table says of a metric: its centre, its interval on the next line, then the median of seeds, of several.

    A dash where there is none.
    """
    if entry is None:
        return "-"
    text = metric.format_value
    cell = f"{text(center_value(entry))}\n[{text(entry['low'])}, {text(entry['high'])}]"
    return f"{cell}\nmedian seed {text(entry['median_of_seeds'])}" if "seeds" in entry else cell
