"""Figures of trainings, evaluations and designed experiments, with matplotlib and without a display."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from itertools import cycle, product
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from estimator.rigs.units import axis_label
from estimator.support.file_io import write_atomically
from estimator.support.html_page import figure_label
from estimator.support.optional_dependencies import require_packages

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from agents.evaluation.policy_rollout import Evaluation
    from agents.hardware.experiment_design import ExperimentDesign
    from agents.training.checkpoints import LearningPoint

_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#666666", "#000000")
_LINE_STYLES = ("-", "--", ":")

#: A limit is drawn if a signal reaches this fraction of it; a more distant one would shrink the signal.
_SHOW_LIMIT_FROM = 0.5

#: Points are marked where there are fewer of them than this.
_MARK_POINTS_BELOW = 20


def save_png(figure: Figure, path: Path) -> None:
    """Write a figure as PNG, in one piece."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    write_atomically(path, buffer.getvalue())


def new_figure(width: float, height: float) -> Figure:
    """An empty figure of this size [inch], for any backend."""
    require_packages("matplotlib")
    from matplotlib.figure import Figure

    return Figure((width, height), layout="constrained", dpi=120)


def plot_learning_curve(
    curve: Sequence[LearningPoint], reward: str, held_out: Sequence[tuple[int, float]] = ()
) -> Figure:
    """Mean return of the last episodes over the training samples, with the wall time above.

    Args:
        curve: points of the learning curve.
        reward: its name.
        held_out: samples, and the information gain [nats] of the policy on held-out systems, drawn in a panel below;
            the first point is the untrained network.
    """
    figure = new_figure(7, 6.5 if held_out else 4)
    axes, *below = figure.subplots(2 if held_out else 1, squeeze=False)[:, 0]
    for panel in below:
        samples, gains = np.array(held_out, dtype=float).T
        panel.plot(samples / 1e6, gains, color=_COLOURS[1], marker=".")
        panel.set(xlabel="samples / 10⁶", ylabel="information / nat, held-out systems")
        panel.grid(alpha=0.3)
        panel.set_xlim(0, max(samples[-1] / 1e6, 1e-6))
    steps, seconds, returns = np.array(curve, dtype=float).reshape(-1, 3).T
    axes.plot(steps / 1e6, returns, color=_COLOURS[0], marker="." if len(steps) < _MARK_POINTS_BELOW else None)
    axes.set(xlabel="samples / 10⁶", ylabel=f"mean return: {reward.replace('_', ' ')}")
    axes.grid(alpha=0.3)
    if len(steps) > 1:
        axes.set_xlim(0, steps[-1] / 1e6)
        samples_at, seconds_at = np.append(0.0, steps / 1e6), np.append(0.0, seconds)
        above = axes.secondary_xaxis(
            "top",
            functions=(
                lambda samples: np.interp(np.asarray(samples), samples_at, seconds_at),
                lambda time: np.interp(np.asarray(time), seconds_at, samples_at),
            ),
        )
        above.set_xlabel("wall time / s")
    return figure


def plot_log_posterior_gain(evaluations: list[Evaluation], title: str = "") -> Figure:
    """Gain of the log posterior at the truth over the samples: median over systems, band from 25 to 75 %."""
    figure = new_figure(7.5, 4.5 + 0.22 * math.ceil(len(evaluations) / 3))
    axes = figure.add_subplot()
    lowest = 0.0  # the gain of an over-confident posterior may be negative
    line_looks = product(_LINE_STYLES, _COLOURS)
    for evaluation, (line_style, colour) in zip(evaluations, cycle(line_looks), strict=False):
        low, median, high = np.percentile(evaluation.gain_curve, [25, 50, 75], axis=1)
        lowest = min(lowest, low.min())
        samples = np.arange(len(median))
        axes.fill_between(samples, low, high, color=colour, alpha=0.15, linewidth=0)
        axes.plot(samples, median, line_style, color=colour, label=figure_label(evaluation.title))
    axes.set(xlabel="samples", ylabel="log posterior gain of the truth / nat", title=title)
    axes.set(xlim=(0, None), ylim=(lowest, None))
    axes.grid(alpha=0.3)
    # Within the axes the legend would cover curves.
    legend_title = "medians, and bands from 25 to 75 % of the systems"
    figure.legend(loc="outside lower center", ncols=min(3, len(evaluations)), title=legend_title, title_fontsize=9)
    return figure


def plot_inputs_and_outputs(evaluations: list[Evaluation]) -> Figure:
    """Input and output of the first system in time, and the inputs' RMS spectrum over systems.

    Of several inputs and sensors the first ones are drawn. Dashed lines are limits, where a signal comes near to them.
    """
    figure = new_figure(12, 1.6 * len(evaluations) + 0.8)
    grid = figure.subplots(len(evaluations), 3, sharex="col", sharey="col", squeeze=False)
    scales = evaluations[0].scales
    unit, spectrum_unit, factor = scales.input_unit, scales.input_unit, scales.input
    if unit == "V":
        spectrum_unit, factor = "mV", 1e3 * factor
    for row, evaluation, colour in zip(grid, evaluations, cycle(_COLOURS), strict=False):
        time = 1e3 * scales.step * np.arange(len(evaluation.inputs))
        first_input = evaluation.inputs.reshape(*evaluation.inputs.shape[:2], -1)[..., 0]
        inputs = np.nan_to_num(first_input)  # zero after the end of an episode
        spectrum = factor * np.sqrt(np.mean(np.abs(np.fft.rfft(inputs, axis=0)) ** 2, axis=1)) / len(inputs)
        frequencies = np.fft.rfftfreq(len(inputs), scales.step)
        first_sensor = evaluation.outputs[:, 0].reshape(len(time), -1)[:, 0]
        lines = (
            (axis_label("u", unit), time, scales.input * first_input[:, 0]),
            (axis_label("y", scales.output_unit), time, scales.output * first_sensor),
            (axis_label("|U|", spectrum_unit), frequencies, spectrum),
        )
        for axes, (label, x, y) in zip(row, lines, strict=True):
            axes.plot(x, y, color=colour, linewidth=0.8, drawstyle="steps-post" if axes is row[0] else "default")
            axes.set_ylabel(label)
            axes.grid(alpha=0.3)
        row[0].set_title(figure_label(evaluation.title), loc="left", fontsize=9)
    for panels, scale, limit in zip(grid.T, (scales.input, scales.output), evaluations[0].limits, strict=False):
        values = np.concatenate([axes.lines[0].get_ydata() for axes in panels])
        if np.nanmax(np.abs(values), initial=0.0) > _SHOW_LIMIT_FROM * scale * limit:
            for axes in panels:
                time_ends = axes.lines[0].get_xdata()[[0, -1]]
                axes.hlines(scale * limit * np.array([-1, 1]), *time_ends, "black", "--", linewidth=0.8, zorder=1)
    for axes in grid[0, :2]:
        axes.set_title("system 0", loc="right", fontsize=9, color=_COLOURS[6])
    grid[0, 2].set_title("all systems", loc="right", fontsize=9, color=_COLOURS[6])
    for axes, label in zip(grid[-1], ("time / ms", "time / ms", "frequency / Hz"), strict=True):
        axes.set_xlabel(label)
    return figure


def plot_error_against_information(evaluations: list[Evaluation]) -> Figure | None:
    """Mean relative error of the parameters against the information in the outputs, system by system."""
    if not all("fisher_gain" in evaluation.metrics for evaluation in evaluations):
        return None
    figure = new_figure(7.5, 4.5)
    axes = figure.add_subplot()
    for evaluation, colour in zip(evaluations, cycle(_COLOURS), strict=False):
        errors = np.mean([v for name, v in evaluation.metrics.items() if name.startswith("error_")], axis=0)
        axes.semilogy(
            evaluation.metrics["fisher_gain"], 100 * errors, ".", color=colour, alpha=0.5, markersize=4,
            label=figure_label(evaluation.title),
        )  # fmt: skip
    axes.set(xlabel="Fisher information / nat", ylabel="mean error of the parameters / %")
    axes.grid(alpha=0.3)
    axes.legend()
    return figure


def plot_calibration(evaluations: list[Evaluation]) -> Figure:
    """Proportion of intervals that hold the truth against their nominal level: a panel for each estimator."""
    from agents.evaluation.metrics import CREDIBLE_LEVELS

    metrics_by_estimator = [evaluation.estimator_metrics or {"": evaluation.metrics} for evaluation in evaluations]
    figure = new_figure(9, 3.6)
    panels = figure.subplots(1, len(metrics_by_estimator[0]), sharex=True, sharey=True, squeeze=False)[0]
    nominal = [100 * level for level in CREDIBLE_LEVELS.values()]
    for axes, estimator in zip(panels, metrics_by_estimator[0], strict=True):
        axes.plot([0, 100], [0, 100], color="#888888", linewidth=1)
        for evaluation, values, colour in zip(evaluations, metrics_by_estimator, cycle(_COLOURS), strict=False):
            covered = [100 * float(np.mean(values[estimator][name])) for name in CREDIBLE_LEVELS]
            axes.plot(
                nominal, covered, "o-", color=colour, linewidth=0.8, markersize=4, label=figure_label(evaluation.title)
            )
        axes.set_title(estimator.replace("_", " "), fontsize=9)
        axes.set_xlabel("nominal level / %")
        axes.grid(alpha=0.3)
    panels[0].set_ylabel("intervals that hold the truth / %")
    panels[0].legend(fontsize=7)
    return figure


def plot_experiment_design(experiment_design: ExperimentDesign) -> Figure:
    """The signal of a designed experiment and the predicted output, both with their limits."""
    figure, rig = new_figure(9, 5), experiment_design.rig
    above, below = figure.subplots(2, 1, sharex=True)
    time = rig.step * np.arange(len(experiment_design.u))
    low, median, high = experiment_design.output_quantiles
    above.plot(time, experiment_design.u, color=_COLOURS[0], linewidth=1.0, zorder=3, drawstyle="steps-post")
    above.set(
        ylabel=f"input / {rig.only_input.unit}",
        title=f"{len(experiment_design.u)} samples by {experiment_design.policy}",
    )
    below.fill_between(time, low, high, color=_COLOURS[1], alpha=0.3, linewidth=0, label="expected, 90 %")
    below.plot(time, median, color=_COLOURS[1], linewidth=0.8, label="expected, median")
    below.set(xlabel="time / s", ylabel=f"output / {rig.output.unit}")
    for axes, limit in ((above, rig.only_input.limit), (below, rig.output.range)):
        lower_upper = limit * np.array([-1.0, 1.0])
        axes.hlines(lower_upper, *time[[0, -1]], color="black", linestyle="--", linewidth=0.8, zorder=1, label="limits")
        axes.grid(alpha=0.3)
    figure.legend(*below.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure
