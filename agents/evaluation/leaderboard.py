"""The leaderboard: policies side by side, every figure with its interval; as a table, JSON and figures."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from agents.evaluation.rollout import Evaluation
from agents.results import fitted, show, table, write_json
from estimator.parameters import FloatArray
from estimator.units import labelled

_RESAMPLES = 2000

Statistic = tuple[str, Callable[..., Any]]

MEAN: Statistic = ("mean", np.mean)
MEDIAN: Statistic = ("median", np.median)
IQM: Statistic = ("iqm", partial(stats.trim_mean, proportiontocut=0.25))


@dataclass(frozen=True)
class Metric:
    """A column of the table.

    Attributes:
        title: with its unit.
        digits: decimals that are printed; of what may have any size, less than 0 the significant ones.
        scale: from the stored to the printed unit.
        center: the statistic over systems, and its name.
        center_of_seeds: the same over systems and training seeds, by default the interquartile mean. Of shares it is
            the mean: the middle half of an event that is rare never sees it.
    """

    title: str
    digits: int
    scale: float = 1.0
    center: Statistic = MEAN
    center_of_seeds: Statistic = IQM

    def text(self, value: float) -> str:
        """A value as it is printed."""
        form = f".{self.digits}f" if self.digits >= 0 else f".{-self.digits}g"
        return format(self.scale * value, form)


_share = partial(Metric, center_of_seeds=MEAN)

METRICS = {
    "information_gain": Metric("information gained / nat", 2),
    "log_posterior_gain": Metric("log posterior gain / nat", 2),
    "error_m": Metric("error of m / %", 3, 100, MEDIAN),
    "error_c": Metric("error of c / %", 2, 100, MEDIAN),
    "error_a": Metric("error of a / %", 3, 100, MEDIAN),
    "error_b": Metric("error of b / %", 2, 100, MEDIAN),
    "coverage_50": _share("50 % intervals that cover / %", 1, 100),
    "coverage": _share("90 % intervals that cover / %", 1, 100),
    "coverage_95": _share("95 % intervals that cover / %", 1, 100),
    "nees": _share("NEES per coefficient", 2),
    "ended_early": _share("episodes ended early / %", 1, 100),
    "input_power": Metric("input power / mV²", 0, 1e6),
    "input_peak": Metric("input peak / mV", 1, 1e3),
    "crest_factor": Metric("crest factor", 2),
    "decision_time": Metric("time per decision / µs", 2, 1e6),
    "fisher_gain": Metric("Fisher information / nat", 2),
    "efficiency": Metric("D-efficiency, of the best known / %", 1, 100),
    "certified": Metric("at least, of what is possible / %", 1, 100),
    # Infinite where the whole regime tells less, so only a median says something of many.
    "silverbox_equivalent": Metric("Silverbox equivalent / samples", 0, 1.0, MEDIAN, MEDIAN),
    "full_peak_equivalent": Metric("the same at full peak / samples", 0, 1.0, MEDIAN, MEDIAN),
    "simulation_rmse": Metric("RMSE on the twin's arrow / mV", 3, 1e3, MEDIAN),
    "arrow_rmse": Metric("RMSE on the real arrow / mV", 2, 1e3, MEDIAN),
}


#: The chief ones, with titles for a table of 80 characters; and those whose spread it has.
HEADLINE = {
    "information_gain": "information / nat",
    "efficiency": "D-efficiency / %",
    "coverage": "cover / %",
    "ended_early": "early / %",
    "decision_time": "µs",
}
_WITH_SPREAD = ("information_gain", "efficiency")


#: What the less known of them are, where they are in a table.
TERMS = {
    "nees": "NEES: squared error in units of the believed covariance; 1 where beliefs are right",
    "efficiency": "D-efficiency: information per coefficient, in parts of the best input that a search found which "
    "knows the system",
    "certified": "at least: the same, in parts of an upper bound of what any input tells",
    "silverbox_equivalent": "Silverbox equivalent: samples of the benchmark's multisine that tell as much",
}

#: What the auditor of the second table is.
AUDITOR_IS = "the auditor: an offline maximum a posteriori fit that knows the noises"


def metrics_of(found: Iterable[str], unit: str = "V") -> dict[str, Metric]:
    """The columns of the metrics that were found, in their order; errors of other parameters than m, c, a, b first.

    Args:
        found: names.
        unit: of the input; of a rig its own.
    """
    others = {name for name in found if name not in METRICS}
    errors = {name: Metric(f"error of {name.removeprefix('error_')} / %", 2, 100, MEDIAN) for name in sorted(others)}
    known = METRICS
    if unit != "V":
        power = labelled("input power", unit)
        powers = {"input_power": power if unit == "1" else f"{power}²", "input_peak": labelled("input peak", unit)}
        known = METRICS | {name: Metric(title, -4) for name, title in powers.items()}
    return errors | {name: metric for name, metric in known.items() if name in found}


def summarise(evaluation: Evaluation, seed: int = 0) -> dict[str, dict[str, Any]]:
    """The centre of each metric over systems, with its 95 % interval: `center_and_interval` by name."""
    columns = metrics_of(evaluation.metrics)
    return {
        name: center_and_interval(values.reshape(evaluation.seeds, -1), columns[name], seed)
        for name, values in evaluation.metrics.items()
    }


def center_and_interval(values: FloatArray, metric: Metric, seed: int = 0) -> dict[str, Any]:
    """The centre of values (seeds, systems), with a 95 % bootstrap interval (percentile, 2000 resamples).

    Over several training seeds the bootstrap is stratified: in every resample each seed has as many systems as it was
    evaluated on. They are the same for all seeds, as the seeds were evaluated on the same ones, which are not
    independent of each other. So the interval is that of these policies over systems; what another training would
    give is in the spread of ``seeds``.

    Returns:
        The centre by its name, ``low`` and ``high``; of several seeds also ``seeds``, the metric's centre for each, and
        ``median_of_seeds``.
    """
    kind, statistic = metric.center if len(values) == 1 else metric.center_of_seeds

    def resampled(rows: Any, axis: int = -1) -> Any:
        drawn = values[:, np.asarray(rows, dtype=np.intp)]  # (seeds, ..., systems)
        return statistic(np.concatenate(drawn, axis=axis), axis=axis)

    entry: dict[str, Any] = {kind: float(resampled(np.arange(values.shape[1])))}
    if (values == values.flat[0]).all():  # SciPy warns of samples without spread
        entry |= dict.fromkeys(("low", "high"), entry[kind])
    else:
        with np.errstate(invalid="ignore"):  # values may be infinite, and SciPy takes their standard deviation
            interval = stats.bootstrap(
                (np.arange(values.shape[1]),), resampled, n_resamples=_RESAMPLES, method="percentile", vectorized=True,
                rng=np.random.default_rng(seed),
            ).confidence_interval  # fmt: skip
        entry |= {"low": float(interval.low), "high": float(interval.high)}
    if len(values) > 1:
        each = [float(metric.center[1](row)) for row in values]
        entry |= {"median_of_seeds": float(np.median(each)), "seeds": each}
    return entry


def in_line(metric: Metric, values: FloatArray) -> str:
    """The centre of values (systems,), with its interval, on one line."""
    return cell_of(metric, center_and_interval(values[None], metric)).replace("\n", " ")


def center_of(entry: dict[str, Any]) -> Any:
    """The centre in what `center_and_interval` made, whatever it is called."""
    return next(value for key, value in entry.items() if key in ("mean", "median", "iqm"))


def write_evaluations(path: Path, evaluations: list[Evaluation], settings: dict[str, Any]) -> None:
    """Write summaries and the settings that they were made with."""
    results = {
        evaluation.policy: {
            **summarise(evaluation),
            "estimators": {
                estimator: summarise(replace(evaluation, metrics=values))
                for estimator, values in evaluation.estimators.items()
            },
        }
        for evaluation in evaluations
    }
    write_json(path, {"settings": settings, "policies": results})


Table = tuple[list[str], list[list[str]]]

#: Of a column [characters].
_WIDEST = 36


def leaderboard(evaluations: list[Evaluation]) -> Table:
    """Heads and rows: a column for each policy, the best log posterior gain first; `cell_of` each metric."""
    ordered = in_order(evaluations)
    summaries = [summarise(evaluation) for evaluation in ordered]
    rows = [
        [metric.title, *(cell_of(metric, summary.get(name)) for summary in summaries)]
        for name, metric in metrics_of(
            [name for summary in summaries for name in summary], ordered[0].scales.input_unit
        ).items()
    ]
    return ["", *(evaluation.title for evaluation in ordered)], rows


def two_way_table(evaluations: list[Evaluation]) -> Table:
    """Heads and rows, policies by estimators: who identified what from the same inputs and outputs."""
    found = [name for e in evaluations for values in e.estimators.values() for name in values]
    columns = {name: m for name, m in metrics_of(found).items() if name not in ("coverage_50", "coverage_95")}
    rows = []
    for evaluation in in_order(evaluations):
        for estimator, values in evaluation.estimators.items():
            centers = {name: float(metric.center[1](values[name])) for name, metric in columns.items()}
            cells = [metric.text(centers[name]) for name, metric in columns.items()]
            rows.append([evaluation.title, estimator.replace("_", " "), *cells])
    return ["policy", "estimator", *(metric.title for metric in columns.values())], rows


def print_table(evaluations: list[Evaluation], title: str) -> None:
    """Print the leaderboard, with the intervals below."""
    from rich.table import Table as RichTable

    heads, rows = leaderboard(evaluations)

    def made(places: Sequence[int]) -> RichTable:
        found = RichTable(title=title)
        for place in places:
            found.add_column(heads[place], justify="right" if place else "left", overflow="fold", max_width=_WIDEST)
        for row in rows:
            found.add_row(*(row[place] for place in places))
        return found

    show(fitted(made, len(heads)), caption_of(evaluations))


def headline(evaluations: list[Evaluation]) -> Table:
    """Heads and rows: a line for each policy, with the chief figures, which are in ``HEADLINE``."""
    shown = {name: title for name, title in HEADLINE.items() if name in evaluations[0].metrics}
    rows = []
    for evaluation in evaluations:
        cells = [evaluation.title]
        for name in shown:
            metric, values = METRICS[name], evaluation.metrics[name].reshape(evaluation.seeds, -1)
            entry = center_and_interval(values, metric)
            spread = f" ± {metric.text((entry['high'] - entry['low']) / 2)}" if name in _WITH_SPREAD else ""
            cells.append(f"{metric.text(center_of(entry))}{spread}")
        rows.append(cells)
    return ["", *shown.values()], rows


def print_headline(evaluations: list[Evaluation], title: str) -> None:
    """Print the chief figures, in 80 columns."""
    heads, rows = headline(evaluations)
    caption = "means over systems ± half of the 95 % bootstrap interval; 90 % intervals that cover; "
    caption += "episodes that a limit ended early; time of a decision"
    if "efficiency" in evaluations[0].metrics:
        caption += f"\n{TERMS['efficiency']}"
    show(table(heads, rows, title=title), caption)


def print_estimators(evaluations: list[Evaluation]) -> None:
    """Print the two-way table, where there is something in it."""
    heads, rows = two_way_table(evaluations)
    if rows:
        title = "what other estimators make of the same inputs and outputs"
        show(table(heads, rows, title=title, labels=2), AUDITOR_IS)


def in_order(evaluations: list[Evaluation]) -> list[Evaluation]:
    """The best log posterior gain first."""
    return sorted(evaluations, key=lambda evaluation: -float(evaluation.metrics["log_posterior_gain"].mean()))


def caption_of(evaluations: list[Evaluation]) -> str:
    """What the figures of a table are, and what its less known metrics mean, a line each."""
    several = any(evaluation.seeds > 1 for evaluation in evaluations)
    over = "of several seeds interquartile means, shares as means, and the median seed; " if several else ""
    found = {name for evaluation in evaluations for name in evaluation.metrics}
    terms = [meaning for name, meaning in TERMS.items() if name in found]
    return "\n".join([f"means, errors as medians; {over}[95 % bootstrap intervals over systems]", *terms])


def cell_of(metric: Metric, entry: dict[str, Any] | None) -> str:
    """What a table says of a metric: its centre, its interval on the next line, then the median of seeds, of several.

    A dash where there is none.
    """
    if entry is None:
        return "-"
    text = metric.text
    cell = f"{text(center_of(entry))}\n[{text(entry['low'])}, {text(entry['high'])}]"
    return f"{cell}\nmedian seed {text(entry['median_of_seeds'])}" if "seeds" in entry else cell
