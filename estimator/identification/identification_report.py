"""The report of an identification: one page of HTML that opens without a network."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from estimator.identification.data.record_reader import Record, standardised_innovations
from estimator.rigs.rig_prior import STDS_PER_90_PERCENT
from estimator.rigs.units import digits_to_distinguish
from estimator.support.array_types import FloatArray
from estimator.support.file_io import write_atomically
from estimator.support.html_page import figure_label, figure_to_svg, html_document, html_table
from estimator.support.optional_dependencies import require_packages

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from estimator.identification.identification_result import Result

#: Samples of a record in a figure, at most.
_MAX_SHOWN_SAMPLES = 1500

#: Outputs that start a free run.
_FREE_RUN_OUTPUTS = 20

_PARAMETER_MEANINGS = {
    "m": "mass",
    "c/m": "damping by mass",
    "a/m": "linear stiffness by mass",
    "b/m": "cubic stiffness by mass",
    "c": "damping",
    "a": "linear stiffness",
    "b": "cubic stiffness",
    "u0": "offset of the input",
    "y0": "offset of the output",
}

_CONTRACTION_CAPTION = (
    "What the first outputs of the records leave open. An interval narrows with the square root of their number, and "
    "faster at first; where it stays as it is, choose an input that tells about that parameter."
)
_FIT_CAPTION = (
    "The free run gets 20 outputs and then the input alone: it errs where parameters are wrong, and where the force is "
    "disturbed. The forecast gets every output before its own: 90 % of its errors lie in the band if the intervals are "
    "to be trusted."
)
_RESIDUALS_CAPTION = (
    "What the forecasts leave, in their standard deviations. It looks normal and white where equation, input and noise "
    "are as assumed."
)


def _parameter_colors(result: Result) -> dict[str, str]:
    """The parameters that figures show, and their colors."""
    names = (name for name in result.parameters if name.endswith("/m") or name in "mcab")
    return dict(zip(names, ("#222", "#06c", "#c40", "#084"), strict=False))


def write_report(result: Result, path: Path, commands: Sequence[str] = ()) -> Path:
    """Write the page; see `Result.report`."""
    parts = ["<h1>Identification</h1>", _checks_html(result), _parameters_html(result)]
    parts.append(
        f"<h2>What each sample told</h2><figure>{figure_to_svg(_draw_contraction(result))}<figcaption>{_CONTRACTION_CAPTION}"
    )
    parts.append("</figcaption></figure>")
    for record, forecast, run in zip(
        result.records, result.forecasts, result.compute_forecasts(_FREE_RUN_OUTPUTS), strict=True
    ):
        parts.append(f"<h2>{escape(record.name)}</h2>{_record_summary(result, record)}")
        drawn = (
            (_draw_fit(result, record, forecast, run), _FIT_CAPTION),
            (_draw_residuals(record, forecast), _RESIDUALS_CAPTION),
        )
        for figure, caption in drawn:
            parts.append(f"<figure>{figure_to_svg(figure)}<figcaption>{caption}</figcaption></figure>")
    if commands:
        parts.append(f"<h2>How this page was made</h2><pre>{escape(chr(10).join(commands))}</pre>")
    write_atomically(path, html_document("Identification", parts))
    return path


def _checks_html(result: Result) -> str:
    if not result.warnings:
        return "<p class='fine'>No check speaks against this result.</p>"
    return "".join(
        f"<p class='warning'><b>{escape(warning.name)}</b>: {escape(warning.message)}</p>"
        for warning in result.warnings
    )


def _parameters_html(result: Result) -> str:
    intervals, rows = result.interval(0.9), []
    for name, (mean, std) in result.parameters.items():
        low, high = intervals[name]
        digits = digits_to_distinguish(low, high, 6)
        label, interval = f"{name}, {_PARAMETER_MEANINGS[name]}", f"{low:.{digits}g} to {high:.{digits}g}"
        rows.append(
            [
                label,
                "open" if name in result.unidentified else f"{mean:.{digits}g}",
                f"{std:.2g}",
                interval,
                escape(result.units[name]),
            ]
        )
    for name, what in (("input", "disturbance of the force"), ("output", "noise of the sensor")):
        mean, std = result.noises[name]
        half = STDS_PER_90_PERCENT * std
        interval = f"{max(mean - half, 0):.3g} to {mean + half:.3g}"
        rows.append([what, f"{mean:.3g}", f"{std:.1g}", interval, escape(getattr(result.rig, name).unit)])
    equation = "<p>m x'' + c x' + a x + b x³ = u - u0 + w, seen with the offset y0 and noise.</p>"
    heads = ["", "mean", "standard deviation", "90 % interval", "unit"]
    return f"<h2>Parameters</h2>{equation}{html_table(heads, rows)}"


def _record_summary(result: Result, record: Record) -> str:
    seconds = len(record.u) * result.rig.step
    facts = [f"{len(record.u)} samples in {seconds:.4g} s"]
    facts += [
        f"{count} outputs {what}"
        for count, what in ((record.n_missing, "missing"), (record.n_clipped, "clipped"))
        if count
    ]
    shown = f"; the first {_MAX_SHOWN_SAMPLES} are shown" if len(record.u) > _MAX_SHOWN_SAMPLES else ""
    return f"<p>{', '.join(facts)}{shown}.</p>"


def _new_figure(rows: int, columns: int, height: float, **settings: Any) -> tuple[Figure, Any]:
    require_packages("matplotlib")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, squeeze=False, **settings)


def _draw_contraction(result: Result) -> Figure:
    """Half widths of the intervals of m, c, a and b against the number of outputs."""
    figure, ((axis,),) = _new_figure(1, 1, 3.2)
    counts = [count for count, _ in result.history]
    for name, color in _parameter_colors(result).items():
        stds = np.array([told[name.partition("/")[0]][1] for _, told in result.history])
        axis.plot(counts, 164.5 * stds / abs(result.parameters[name][0]), color=color, marker=".", label=name)
    axis.set_xscale("log", base=2)
    axis.set_yscale("log")
    axis.xaxis.set_major_formatter(lambda value, _: f"{value:.0f}")
    axis.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axis.set_xlabel("outputs that were used")
    axis.set_ylabel("half of the 90 % interval\n[% of the last mean]")
    axis.grid(alpha=0.3)
    axis.legend(ncols=4, fontsize=8)
    return figure


def _draw_fit(result: Result, record: Record, forecast: FloatArray, free_run: FloatArray) -> Figure:
    """Input; measured, forecast and free run; and the errors of both, over the first samples."""
    figure, axes = _new_figure(4, 1, 8.5, sharex=True)
    count = min(len(record.u), _MAX_SHOWN_SAMPLES)
    seconds, measured, free_run = (
        record.times_in_steps(result.rig.step)[:count] * result.rig.step,
        record.y[:count],
        free_run[:count, 0],
    )
    output = result.rig.output
    input_axis, output_axis, free_run_error_axis, forecast_error_axis = axes[:, 0]
    input_axis.step(seconds, record.u[:count], where="post", color="#555", linewidth=0.8)
    input_axis.set_ylabel(figure_label(f"input [{result.rig.input.unit}]"))
    output_axis.plot(seconds, measured, color="#bbb", linewidth=4, label="measured")
    output_axis.plot(seconds, forecast[:count, 0], color="#06c", linewidth=1.2, label="forecast, one sample ahead")
    output_axis.plot(
        seconds,
        free_run,
        color="#c40",
        linewidth=0.9,
        linestyle="--",
        label=f"free run after {_FREE_RUN_OUTPUTS} samples",
    )
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


def _draw_residuals(record: Record, forecast: FloatArray) -> Figure:
    """Histogram and autocorrelation of the standardised innovations."""
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
    right.set_xlabel("lag [samples]; between the dashed lines 95 % if white")
    right.set_ylabel("autocorrelation")
    return figure
