"""Metrics of an evaluation summarised over systems and training seeds: centres with 95 % bootstrap intervals."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, Required, TypedDict, cast

import numpy as np
from scipy import stats

from agents.evaluation.policy_rollout import Evaluation
from estimator.rigs.units import axis_label
from estimator.support.array_types import FloatArray

#: Bootstrap resamples of an interval.
_N_RESAMPLES = 2000


class NamedStatistic(NamedTuple):
    """A statistic over systems, and its name in files."""

    name: str
    function: Callable[..., Any]


class MetricSummary(TypedDict, total=False):
    """A metric over systems, as files hold it: its centre under the name of the statistic, and a 95 % interval.

    ``seeds``, the centre of each training seed, and ``median_of_seeds`` are there for several seeds only.
    """

    mean: float
    median: float
    iqm: float
    low: Required[float]
    high: Required[float]
    median_of_seeds: float
    seeds: list[float]


MEAN = NamedStatistic("mean", np.mean)


MEDIAN = NamedStatistic("median", np.median)


#: Interquartile mean.
IQM = NamedStatistic("iqm", partial(stats.trim_mean, proportiontocut=0.25))


@dataclass(frozen=True)
class MetricColumn:
    """A metric as a column of tables.

    Attributes:
        title: with the unit.
        decimals: number of decimals; if negative, number of significant digits.
        scale: factor from the stored to the printed unit.
        center: statistic over systems.
        center_of_seeds: statistic over systems and training seeds: the interquartile mean, but the mean of proportions,
            because the middle half of the values contains no rare event.
    """

    title: str
    decimals: int
    scale: float = 1.0
    center: NamedStatistic = MEAN
    center_of_seeds: NamedStatistic = IQM

    def format_value(self, value: float) -> str:
        """A value as a text, in the printed unit."""
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
    # Infinite where the whole regime has less information, so that only a median is finite.
    "silverbox_equivalent": MetricColumn("Silverbox equivalent / samples", 0, 1.0, MEDIAN, MEDIAN),
    "full_peak_equivalent": MetricColumn("the same at full peak / samples", 0, 1.0, MEDIAN, MEDIAN),
    "simulation_rmse": MetricColumn("RMSE on the twin's arrow / mV", 3, 1e3, MEDIAN),
    "arrow_rmse": MetricColumn("RMSE on the real arrow / mV", 2, 1e3, MEDIAN),
}


#: Explanations of less known metrics, below a table.
METRIC_EXPLANATIONS = {
    "nees": "NEES: squared error in units of the believed covariance; 1 where beliefs are right",
    "efficiency": "D-efficiency: information per coefficient, relative to the best known input for the true system",
    "certified": "at least: the same, relative to an upper bound over all inputs",
    "silverbox_equivalent": "Silverbox equivalent: samples of the benchmark's multisine with as much information",
}


def metric_columns(names: Iterable[str], input_unit: str = "V") -> dict[str, MetricColumn]:
    """The columns of metrics, in the order of tables; errors of parameters other than m, c, a, b come first.

    Args:
        names: of metrics.
        input_unit: unit of the input.
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


def summarise_metrics(evaluation: Evaluation, seed: int = 0) -> dict[str, MetricSummary]:
    """Name of each metric to its `center_and_interval` over systems."""
    columns = metric_columns(evaluation.metrics)
    return {
        name: center_and_interval(values.reshape(evaluation.seeds, -1), columns[name], seed)
        for name, values in evaluation.metrics.items()
    }


def center_and_interval(values: FloatArray, metric: MetricColumn, seed: int = 0) -> MetricSummary:
    """The centre of values (seeds, systems), with a 95 % bootstrap interval (percentile, 2000 resamples).

    Over several training seeds the same systems are resampled for all seeds, because the seeds were evaluated on the
    same systems and are not independent. So the interval holds for these policies over systems; the variation between
    trainings is in ``seeds``.
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
                (np.arange(values.shape[1]),),
                resampled,
                n_resamples=_N_RESAMPLES,
                method="percentile",
                vectorized=True,
                rng=np.random.default_rng(seed),
            ).confidence_interval
        entry |= {"low": float(interval.low), "high": float(interval.high)}
    if len(values) > 1:
        per_seed = [float(metric.center.function(row)) for row in values]
        entry |= {"median_of_seeds": float(np.median(per_seed)), "seeds": per_seed}
    return cast(MetricSummary, entry)


def center_and_interval_text(metric: MetricColumn, values: FloatArray) -> str:
    """The centre of values (systems,), with its interval, on one line."""
    return metric_cell(metric, center_and_interval(values[None], metric)).replace("\n", " ")


def center_value(entry: MetricSummary) -> float:
    """The centre in a summary, by whichever statistic.

    Raises:
        StopIteration: for a summary without one.
    """
    return next(float(entry[name]) for name in ("mean", "median", "iqm") if name in entry)


def metric_cell(metric: MetricColumn, entry: MetricSummary | None) -> str:
    """A cell of a table: centre, interval on the next line, then the median of several seeds; a dash for None."""
    if entry is None:
        return "-"
    text = metric.format_value
    cell = f"{text(center_value(entry))}\n[{text(entry['low'])}, {text(entry['high'])}]"
    return f"{cell}\nmedian seed {text(entry['median_of_seeds'])}" if "seeds" in entry else cell
