"""Figures of trainings and evaluations, as PNG files. No display is needed."""

from __future__ import annotations

import io
from itertools import cycle, product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from estimator import SAMPLING_STEP
from estimator.files import write_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from agents.evaluation.leaderboard import Metric
    from agents.evaluation.rollout import Evaluation

_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#666666", "#000000")
_STROKES = ("-", "--", ":")
_RESONANCES = (49.5, 94.7)
"""Least and largest linear resonance of oscillators within ±30 % of the twin [Hz]."""

_MILLISECONDS = 1e3 * SAMPLING_STEP


def draw_learning_curve(path: Path, curve: list[tuple[int, float, float]], reward: str) -> None:
    """Mean return of the last episodes over the samples that were trained on, with wall time above."""
    figure = _figure(7, 4)
    axes = figure.add_subplot()
    steps, seconds, returns = np.array(curve, dtype=float).reshape(-1, 3).T
    axes.plot(steps / 1e6, returns, color=_COLOURS[0])
    axes.set_xlabel("samples / 10⁶")
    axes.set_ylabel(f"mean return: {reward.replace('_', ' ')}")
    axes.grid(alpha=0.3)
    if len(steps) > 1:
        axes.set_xlim(steps[0] / 1e6, steps[-1] / 1e6)
        above = axes.secondary_xaxis(
            "top",
            functions=(
                lambda samples: np.interp(np.asarray(samples), steps / 1e6, seconds),
                lambda time: np.interp(np.asarray(time), seconds, steps / 1e6),
            ),
        )
        above.set_xlabel("wall time / s")
    _save(figure, path)


def draw_contraction(path: Path, evaluations: list[Evaluation], title: str) -> None:
    """Write `figure_of_contraction` to a PNG file."""
    _save(figure_of_contraction(evaluations, title), path)


def figure_of_contraction(evaluations: list[Evaluation], title: str = "") -> Figure:
    """Gain of log posterior of the truth over the samples: median over systems, band from 25 to 75 %."""
    figure = _figure(7.5, 4.5)
    axes = figure.add_subplot()
    lowest = 0.0  # an over-confident posterior may lose
    looks = product(_STROKES, _COLOURS)
    for evaluation, (stroke, colour) in zip(evaluations, cycle(looks), strict=False):
        low, median, high = np.percentile(evaluation.curve, [25, 50, 75], axis=1)
        lowest = min(lowest, low.min())
        samples = np.arange(len(median))
        axes.fill_between(samples, low, high, color=colour, alpha=0.15, linewidth=0)
        axes.plot(samples, median, stroke, color=colour, label=evaluation.title)
    axes.set_xlabel("samples")
    axes.set_ylabel("log posterior gain of the truth / nat")
    axes.set_title(title)
    axes.set_xlim(0, None)
    axes.set_ylim(lowest, None)
    axes.grid(alpha=0.3)
    if len(evaluations) > len(_COLOURS):  # so many names would cover the curves
        figure.set_figwidth(10)
        axes.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), borderaxespad=0.0)
    else:
        axes.legend(loc="lower right")
    return figure


def draw_excitations(path: Path, evaluations: list[Evaluation], system: int = 0) -> None:
    """Input and output of one system under each policy."""
    figure = _figure(9, 1.6 * len(evaluations) + 0.8)
    grid = figure.subplots(len(evaluations), 2, sharex=True, sharey="col", squeeze=False)
    for row, evaluation, colour in zip(grid, evaluations, cycle(_COLOURS), strict=False):
        for axes, signal in zip(row, (evaluation.inputs, evaluation.outputs), strict=True):
            time = _MILLISECONDS * np.arange(len(signal))
            axes.plot(time, signal[:, system], color=colour, linewidth=0.8)
            axes.grid(alpha=0.3)
        row[0].set_ylabel("u / V")
        row[1].set_ylabel("y / V")
        row[0].set_title(evaluation.title, loc="left", fontsize=9)
    for axes in grid[-1]:
        axes.set_xlabel("time / ms")
    _save(figure, path)


def figure_of_inputs(evaluations: list[Evaluation], system: int = 0) -> Figure:
    """Input of one system in time, and the spectrum of the inputs: root of the mean power over systems."""
    figure = _figure(9, 1.6 * len(evaluations) + 0.8)
    grid = figure.subplots(len(evaluations), 2, sharex="col", sharey="col", squeeze=False)
    for (left, right), evaluation, colour in zip(grid, evaluations, cycle(_COLOURS), strict=False):
        time = _MILLISECONDS * np.arange(len(evaluation.inputs))
        left.plot(time, evaluation.inputs[:, system], color=colour, linewidth=0.8)
        left.set_ylabel("u / V")
        left.set_title(evaluation.title, loc="left", fontsize=9)
        inputs = np.nan_to_num(evaluation.inputs)  # an episode that ended is silent
        spectrum = np.sqrt(np.mean(np.abs(np.fft.rfft(inputs, axis=0)) ** 2, axis=1)) / len(inputs)
        right.plot(np.fft.rfftfreq(len(inputs), SAMPLING_STEP), 1e3 * spectrum, color=colour, linewidth=0.8)
        right.set_ylabel("|U| / mV")
        for axes in (left, right):
            axes.grid(alpha=0.3)
    grid[-1][0].set_xlabel("time / ms")
    grid[-1][1].set_xlabel("frequency / Hz")
    return figure


def figure_of_information(evaluations: list[Evaluation]) -> Figure | None:
    """Mean relative error of m, c, a, b against the information in the outputs, system by system."""
    if not all("fisher_gain" in evaluation.metrics for evaluation in evaluations):
        return None
    figure = _figure(7.5, 4.5)
    axes = figure.add_subplot()
    for evaluation, colour in zip(evaluations, cycle(_COLOURS), strict=False):
        errors = np.mean([evaluation.metrics[f"error_{name}"] for name in "mcab"], axis=0)
        axes.semilogy(
            evaluation.metrics["fisher_gain"], 100 * errors, ".", color=colour, alpha=0.5, markersize=4,
            label=evaluation.title,
        )  # fmt: skip
    axes.set_xlabel("Fisher information / nat")
    axes.set_ylabel("mean error of m, c, a, b / %")
    axes.grid(alpha=0.3)
    axes.legend()
    return figure


def figure_of_calibration(evaluations: list[Evaluation]) -> Figure:
    """Share of intervals that hold the truth against their nominal level: a panel for each estimator."""
    from agents.evaluation.metrics import LEVELS

    found = [evaluation.estimators or {"": evaluation.metrics} for evaluation in evaluations]
    figure = _figure(9, 3.6)
    panels = figure.subplots(1, len(found[0]), sharex=True, sharey=True, squeeze=False)[0]
    nominal = [100 * level for level in LEVELS.values()]
    for axes, estimator in zip(panels, found[0], strict=True):
        axes.plot([0, 100], [0, 100], color="#888888", linewidth=1)
        for evaluation, values, colour in zip(evaluations, found, cycle(_COLOURS), strict=False):
            covered = [100 * float(np.mean(values[estimator][name])) for name in LEVELS]
            axes.plot(nominal, covered, "o-", color=colour, linewidth=0.8, markersize=4, label=evaluation.title)
        axes.set_title(estimator.replace("_", " "), fontsize=9)
        axes.set_xlabel("nominal level / %")
        axes.grid(alpha=0.3)
    panels[0].set_ylabel("intervals that hold the truth / %")
    panels[0].legend(fontsize=7)
    return figure


def draw_study(path: Path, results: dict[str, dict[str, Any]], measures: dict[str, Metric]) -> None:
    """Compare recipes: a panel for each measure, the centre with its interval, and every seed above as a tick.

    Args:
        path: of the PNG file.
        results: name of a recipe to `agents.evaluation.leaderboard.center_and_interval` of each measure; those that
            begin with the same words up to a comma have one colour.
        measures: how they are printed, by name.
    """
    figure = _figure(10, 5.2)
    panels = figure.subplots(2, -(-len(measures) // 2), sharey=True)
    kinds = list(dict.fromkeys(recipe.partition(",")[0] for recipe in results))
    for axes, (name, metric) in zip(panels.flat, measures.items(), strict=False):
        for row, (recipe, summary) in enumerate(results.items()):
            colour = _COLOURS[kinds.index(recipe.partition(",")[0])]
            entry = summary[name]
            each = metric.scale * np.array(entry.get("seeds", []))
            axes.plot(each, np.full(len(each), row - 0.25), "|", color=colour, markersize=7)
            axes.plot(metric.scale * np.array([entry["low"], entry["high"]]), [row, row], color=colour, linewidth=2.5)
            axes.plot(metric.scale * next(iter(entry.values())), row, "o", color=colour, markersize=5)
        axes.set_xlabel(metric.title)
        axes.grid(alpha=0.3, axis="x")
        if metric.center[0] == "median":  # errors, which span decades
            axes.set_xscale("log")
            axes.xaxis.set_major_formatter("{x:g}")
            axes.xaxis.set_minor_formatter("")
    for axes in panels[:, 0]:
        axes.set_yticks(range(len(results)), list(results))
    panels[0, 0].invert_yaxis()
    _save(figure, path)


def draw_policies(path: Path, systems: int = 64, samples: int = 256) -> None:
    """The inputs of all signals and of the policies with feedback: one in time, and the mean spectrum of many.

    Signals are drawn at a limit of 0.15 V. The policies with feedback act on Amplitude-v0, on systems of
    their own. Shaded are the linear resonances of oscillators within ±30 % of the twin.

    Args:
        path: The PNG file that is written.
        systems: Draws, or systems, that a spectrum is the mean of, at least 2.
        samples: Length of a signal, and of an episode.
    """
    from scipy.signal import periodogram

    from agents.evaluation.rollout import evaluate
    from agents.policies.excitations import EXCITATIONS
    from agents.policies.export import draw_signal
    from agents.policies.feedback import FEEDBACK

    inputs = {
        name: np.stack([draw_signal(name, samples=samples, seed=seed) for seed in range(systems)])
        for name in EXCITATIONS
    }
    for evaluation in evaluate(list(FEEDBACK), systems=systems, options={"horizon": samples}):
        inputs[evaluation.policy] = evaluation.inputs.T
    figure = _figure(9, 1.05 * len(inputs) + 0.5)
    grid = figure.subplots(len(inputs), 2, sharex="col", sharey="col")
    time = _MILLISECONDS * np.arange(samples)
    for row, (name, signals), colour in zip(grid, inputs.items(), cycle(_COLOURS), strict=False):
        row[0].step(time, signals[0], where="post", color=colour, linewidth=0.8)
        frequency, density = periodogram(signals, 1.0 / SAMPLING_STEP, detrend=False)
        with np.errstate(divide="ignore"):
            row[1].plot(frequency, 10 * np.log10(density.mean(axis=0)), color=colour, linewidth=0.9)
        row[1].axvspan(*_RESONANCES, color="black", alpha=0.08, linewidth=0)
        row[0].set_title(name, loc="left", fontsize=9)
        row[0].set_ylabel("u / V")
        row[1].set_ylabel("dB(V²/Hz)")
        for axes in row:
            axes.grid(alpha=0.3)
    grid[-1, 0].set_xlabel("time / ms")
    grid[-1, 1].set_xlabel("frequency / Hz")
    grid[0, 0].set_xlim(0, time[-1])
    grid[0, 1].set_xlim(0, 0.5 / SAMPLING_STEP)
    grid[0, 1].set_ylim(-85, -20)
    _save(figure, path)


def _figure(width: float, height: float) -> Figure:
    from matplotlib.figure import Figure

    return Figure((width, height), layout="constrained", dpi=120)


def _save(figure: Any, path: Path) -> None:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    write_atomically(path, buffer.getvalue())
