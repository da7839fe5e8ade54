"""Figures of the Silverbox protocol. No display is needed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from agents.evaluation.figures import new_figure
from estimator import duffing
from estimator.rigs.rig_prior import STDS_PER_90_PERCENT
from estimator.rigs.units import Scales
from research.studies.silverbox_protocol import WITHOUT_EXTRAPOLATION

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from research.studies.silverbox_protocol import ProtocolOutcome

_COLOURS = {
    "paper as published": "#000000",
    "paper, delay 1": "#666666",
    "NLARX three-tap": "#cc79a7",
    "ODE linear": "#d55e00",
    "ODE look-ahead": "#e69f00",
    "ODE spline": "#56b4e9",
    "ODE spline +e": "#0072b2",
}
_RMS_WINDOW = 400
"""Samples of the running root mean square."""

_SHOWN_FROM = 200
"""The parameters' axes are cut to hold their intervals from this many samples on."""


def protocol_figures(outcomes: Mapping[str, ProtocolOutcome]) -> dict[str, Figure]:
    """The three figures ``arrow``, ``learning`` and ``parameters`` of outcomes by setting name."""
    shown = {name: outcomes[name] for name in _COLOURS if name in outcomes}
    return {"arrow": _arrow(shown), "learning": _learning(shown), "parameters": _parameters(shown)}


def _arrow(outcomes: Mapping[str, ProtocolOutcome]) -> Figure:
    """Simulation error over the arrow: every sample, and its running root mean square."""
    figure = new_figure(9, 5)
    axes = figure.add_subplot()
    for name, outcome in outcomes.items():
        if name in ("ODE look-ahead", "ODE spline"):
            continue  # they would lie on "ODE linear"
        error = 1e3 * np.abs(outcome.arrow_error)
        axes.plot(error, ",", color=_COLOURS[name], alpha=0.4)
        mean_square = np.convolve(error**2, np.full(_RMS_WINDOW, 1 / _RMS_WINDOW), mode="valid")
        middle = np.arange(len(mean_square)) + _RMS_WINDOW / 2
        axes.plot(middle, np.sqrt(mean_square), color=_COLOURS[name], linewidth=1.2, label=name)
    axes.axvline(WITHOUT_EXTRAPOLATION, color="black", linestyle=":", linewidth=1)
    axes.set(yscale="log", ylim=(3e-3, 300), ylabel="simulation error / mV", xlim=(0, len(error)))
    axes.set_xlabel("sample of the arrow; right of the dotted line its amplitude exceeds the training's")
    axes.set_title(f"points: every sample; lines: root mean square of {_RMS_WINDOW}", fontsize=9, loc="left")
    axes.grid(alpha=0.3)
    axes.legend(loc="upper left", ncols=3, fontsize=9)
    return figure


def _learning(outcomes: Mapping[str, ProtocolOutcome]) -> Figure:
    """Simulation error on the arrow against the number of training samples."""
    figure = new_figure(7, 4.5)
    axes = figure.add_subplot()
    for name, outcome in outcomes.items():
        samples, errors = np.array(list(outcome.learning.items())).T
        axes.loglog(samples, 1e3 * errors, "o-", markersize=3, color=_COLOURS[name], label=name)
    axes.axhline(1.0, color="black", linestyle=":", linewidth=1)
    axes.set(xlabel="training samples", ylabel="simulation error on the arrow / mV")
    axes.grid(alpha=0.3)
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 0.27), fontsize=9)
    return figure


def _parameters(outcomes: Mapping[str, ProtocolOutcome]) -> Figure:
    """Posterior means and 90 % intervals of the physical parameters against the number of training samples."""
    figure = new_figure(11, 5.5)
    dimensions = duffing(offsets=True, cubic_damping=True, feedthrough=True).dimensions
    units = {name: Scales().unit(dimension) for name, dimension in dimensions.items()}
    panels = dict(zip(units, figure.subplots(2, 4, sharex=True).flat, strict=True))
    limits: dict[str, list[float]] = {parameter: [] for parameter in panels}
    for name, outcome in outcomes.items():
        posteriors = {n: belief.parameters() for n, belief in outcome.beliefs.items() if name.startswith("ODE")}
        for parameter in panels:
            if not all(parameter in parameters for parameters in posteriors.values()) or not posteriors:
                continue  # the parameter is known
            mean, std = np.array([parameters[parameter][:2] for parameters in posteriors.values()]).T
            low, high, samples = (
                mean - STDS_PER_90_PERCENT * std,
                mean + STDS_PER_90_PERCENT * std,
                np.array(list(posteriors)),
            )
            panels[parameter].fill_between(samples, low, high, color=_COLOURS[name], alpha=0.2, linewidth=0)
            panels[parameter].plot(samples, mean, color=_COLOURS[name], label=name, linewidth=1)
            limits[parameter] += [low[samples >= _SHOWN_FROM].min(), high[samples >= _SHOWN_FROM].max()]
    for place, ((parameter, axes), unit) in enumerate(zip(panels.items(), units.values(), strict=True)):
        low, high = min(limits[parameter], default=0.0), max(limits[parameter], default=1.0)
        axes.set(xscale="log", ylim=(low - 0.1 * (high - low), high + 0.1 * (high - low)))
        axes.set_title(f"{parameter} / {unit}", fontsize=9)
        axes.grid(alpha=0.3)
        if place >= 4:
            axes.set_xlabel("training samples")
    handles, labels = panels["m"].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), fontsize=9)
    return figure
