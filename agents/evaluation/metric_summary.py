"""Metrics of an evaluation summarised over systems and training seeds: centres with 95 % bootstrap intervals."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from scipy import stats

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


#: What the less known of them are, where they are in a table.
METRIC_EXPLANATIONS = {
    "nees": "NEES: squared error in units of the believed covariance; 1 where beliefs are right",
    "efficiency": "D-efficiency: information per coefficient, in parts of the best input that a search found which "
    "knows the system",
    "certified": "at least: the same, in parts of an upper bound of what any input tells",
    "silverbox_equivalent": "Silverbox equivalent: samples of the benchmark's multisine that tell as much",
}


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


def metric_cell(metric: MetricColumn, entry: dict[str, Any] | None) -> str:
    """What a table says of a metric: its centre, its interval on the next line, then the median of seeds, of several.

    A dash where there is none.
    """
    if entry is None:
        return "-"
    text = metric.format_value
    cell = f"{text(center_value(entry))}\n[{text(entry['low'])}, {text(entry['high'])}]"
    return f"{cell}\nmedian seed {text(entry['median_of_seeds'])}" if "seeds" in entry else cell
