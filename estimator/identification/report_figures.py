"""Figures of the identification report: contraction, fit, forecast errors and residuals."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from estimator.identification.data.record import Record
from estimator.identification.diagnostics.residual_checks import standardised_innovations
from estimator.identification.fitting.posterior_belief import ContractionHistory
from estimator.rigs.rig import Rig
from estimator.rigs.rig_prior import STDS_PER_90_PERCENT
from estimator.support.array_types import FloatArray
from estimator.support.html_page import figure_label
from estimator.support.optional_dependencies import require_packages

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Samples of a record in a figure, at most.
MAX_SHOWN_SAMPLES = 1500

#: Outputs that start a free run.
FREE_RUN_OUTPUTS = 20


#: Colors of the parameters, in their order.
_PARAMETER_COLORS = ("#222", "#06c", "#c40", "#084")


def _new_figure(rows: int, columns: int, height: float, **settings: Any) -> tuple[Figure, Any]:
    """A figure without a window, and its axes (rows, columns)."""
    require_packages("matplotlib")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, squeeze=False, **settings)


def draw_contraction(history: ContractionHistory, parameters: Mapping[str, tuple[float, float]]) -> Figure:
    """Half widths of the 90 % intervals of m, c, a and b over the number of outputs."""
    figure, ((axis,),) = _new_figure(1, 1, 3.2)
    counts = [count for count, _ in history]
    names = (name for name in parameters if name.endswith("/m") or name in "mcab")
    for name, color in zip(names, _PARAMETER_COLORS, strict=False):
        stds = np.array([moments[name.partition("/")[0]][1] for _, moments in history])
        half_widths = 100 * STDS_PER_90_PERCENT * stds / abs(parameters[name][0])
        axis.plot(counts, half_widths, color=color, marker=".", label=name)
    axis.set_xscale("log", base=2)
    axis.set_yscale("log")
    axis.xaxis.set_major_formatter(lambda value, _: f"{value:.0f}")
    axis.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axis.set_xlabel("number of outputs")
    axis.set_ylabel("half of the 90 % interval\n[% of the final mean]")
    axis.grid(alpha=0.3)
    axis.legend(ncols=4, fontsize=8)
    return figure


def draw_fit(rig: Rig, record: Record, forecast: FloatArray, free_run: FloatArray) -> Figure:
    """Input, outputs with forecast and free run, and the errors of both, over the first samples of a record.

    Args:
        rig: the rig of the record.
        record: the measured inputs and outputs.
        forecast: (T, 2) mean and variance of each output, one sample ahead.
        free_run: (T, 2) the same after the first `FREE_RUN_OUTPUTS` outputs.
    """
    figure, axes = _new_figure(4, 1, 8.5, sharex=True)
    count = min(len(record.u), MAX_SHOWN_SAMPLES)
    seconds = record.times_in_steps(rig.step)[:count] * rig.step
    measured, free_run, output = record.y[:count], free_run[:count, 0], rig.output
    input_axis, output_axis, free_run_error_axis, forecast_error_axis = axes[:, 0]
    input_axis.step(seconds, record.u[:count], where="post", color="#555", linewidth=0.8)
    input_axis.set_ylabel(figure_label(f"input [{rig.only_input.unit}]"))
    output_axis.plot(seconds, measured, color="#bbb", linewidth=4, label="measured")
    output_axis.plot(seconds, forecast[:count, 0], color="#06c", linewidth=1.2, label="forecast, one sample ahead")
    label = f"free run after {FREE_RUN_OUTPUTS} samples"
    output_axis.plot(seconds, free_run, color="#c40", linewidth=0.9, linestyle="--", label=label)
    output_axis.set_ylabel(figure_label(f"{output.kind} [{output.unit}]"))
    output_axis.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, fontsize=8)
    free_run_error_axis.plot(seconds, measured - free_run, color="#c40", linewidth=0.8)
    free_run_error_axis.set_ylabel(figure_label(f"free run's error [{output.unit}]"))
    forecast_error_axis.plot(seconds, measured - forecast[:count, 0], color="#06c", linewidth=0.8)
    std = np.sqrt(forecast[:count, 1])
    half = STDS_PER_90_PERCENT * std
    forecast_error_axis.fill_between(seconds, -half, half, color="#06c", alpha=0.2, label="90 % of the forecast")
    forecast_error_axis.set_ylim(*(6 * float(np.nanmedian(std)) * np.array([-1, 1])))
    forecast_error_axis.set_ylabel(figure_label(f"forecast's error [{output.unit}]"))
    forecast_error_axis.set_xlabel("time [s]")
    forecast_error_axis.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), fontsize=8)
    for axis in (input_axis, output_axis, free_run_error_axis, forecast_error_axis):
        axis.ticklabel_format(axis="y", scilimits=(-2, 4), useMathText=True)
    figure.align_ylabels()
    return figure


def draw_residuals(record: Record, forecast: FloatArray) -> Figure:
    """Histogram and autocorrelation of the standardised innovations of a record."""
    figure, axes = _new_figure(1, 2, 3.0)
    values = standardised_innovations(record.y, forecast)[4:]
    left, right = axes[0]
    bins = np.linspace(-5, 5, 61)
    left.hist(np.clip(values, -5, 5), bins, density=True, color="#06c", alpha=0.5, label="residuals")
    left.plot(bins, np.exp(-(bins**2) / 2) / np.sqrt(2 * np.pi), color="#222", linewidth=1, label="normal")
    left.set_xlabel("residual [standard deviations]")
    left.set_ylabel("density")
    left.legend(fontsize=8)
    lags = np.arange(1, min(41, len(values)))
    power = float(values @ values)
    correlation = [float(values[k:] @ values[:-k]) / power for k in lags]
    right.bar(lags, correlation, color="#06c", alpha=0.6)
    bound = 1.96 / np.sqrt(max(len(values), 1))
    for level in (-bound, bound):
        right.axhline(level, color="#222", linewidth=0.8, linestyle="--")
    right.set_xlabel("lag [samples]; 95 % of white noise lies between the dashed lines")
    right.set_ylabel("autocorrelation")
    return figure
