"""Matplotlib panels of an environment's picture: a signal over time, and a parameter's posterior over time."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import cycle
from typing import Any

import numpy as np

from estimator.support.array_types import FloatArray

INK, GREY, RULE = "#26323b", "#6f7b84", "#e3e7ea"
SIGNAL, POSTERIOR, TRUTH = "#3d4f5c", "#1f6f9f", "#c4532d"

#: Colours of several inputs, which repeat.
_SEVERAL_SIGNALS = (SIGNAL, "#b8860b", "#4b8b3b", "#8e5ea2")
_TITLE: dict[str, Any] = {"fontsize": 9, "pad": 4}

#: A curve ends in a dot. Matplotlib leaves "animated" artists out of the background.
_CURVE: dict[str, Any] = {"marker": "o", "markersize": 3.5, "markevery": [-1], "animated": True}


class SignalPanel:
    """Inputs or an output over time, between limits. A frame draws ``animated_artists`` over the background.

    Several signals are drawn in parts of their limits, with a legend of their names.

    Args:
        axes: to draw in.
        title: of the panel.
        limits: name of each signal to its limit.
        drawstyle: Matplotlib's, of the curves.
    """

    def __init__(self, axes: Any, title: str, limits: Mapping[str, float], drawstyle: str) -> None:
        self.axes = axes
        axes.set_title(title, loc="left", color=INK, **_TITLE)
        is_single = len(limits) == 1
        limit = next(iter(limits.values())) if is_single else 1.0
        self._scales = [1.0 if is_single else 1.0 / each for each in limits.values()]
        self._edge = 1.15 * limit
        axes.set_ylim(-self._edge, self._edge)
        axes.set_yticks(limit * np.array([-1, -0.5, 0, 0.5, 1]))
        axes.yaxis.set_major_formatter("{x:.4g}")
        for edge in (-limit, limit):
            self.limit = axes.axhline(edge, color=GREY, linewidth=1, linestyle=(0, (1, 2)))
        self.animated_artists = tuple(
            axes.plot([], color=color, linewidth=1, drawstyle=drawstyle, label=name, **_CURVE)[0]
            for name, color in zip(limits, cycle(_SEVERAL_SIGNALS))
        )
        if not is_single:
            axes.legend(
                handles=self.animated_artists, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=len(limits),
                fontsize=8, labelcolor=INK, frameon=False, handlelength=1.2, columnspacing=1.2, borderpad=0.0,
            )  # fmt: skip

    def update(self, times: FloatArray, signals: FloatArray) -> None:
        """Show signals (signals, n) over times (n,), each in the unit of its limit."""
        for curve, scale, values in zip(self.animated_artists, self._scales, signals, strict=True):
            curve.set_data(times, np.clip(scale * values, -self._edge, self._edge))


class ParameterPanel:
    """Mean and credible band of one parameter as deviations from the truth, and as numbers above."""

    #: Largest deviation from the truth that is drawn [%]; larger ones are drawn there.
    _EDGE = 150.0

    def __init__(self, axes: Any, name: str, unit: float) -> None:
        self.axes = axes
        self._unit = unit
        axes.set_title(name, loc="left", color=INK, **_TITLE)
        # Linear near the truth and logarithmic away from it: a posterior contracts by a factor of a hundred and more.
        axes.set_yscale("asinh", linear_width=0.3)
        axes.set_ylim(-1.2 * self._EDGE, 1.2 * self._EDGE)
        axes.set_yticks([-100, -10, -1, 0, 1, 10, 100], ["−100", "−10", "−1", "", "1", "10", "100"])
        axes.yaxis.minorticks_off()
        self.truth = axes.axhline(0, color=TRUTH, linewidth=1, linestyle=(0, (4, 2)))
        self.band = axes.fill_between([], [], color=POSTERIOR, alpha=0.22, linewidth=0, animated=True)
        (self.mean,) = axes.plot([], color=POSTERIOR, linewidth=1.3, **_CURVE)
        self._true_value = axes.annotate(
            "", (0.6, 1.0), (0, _TITLE["pad"]), "axes fraction", "offset points", ha="center", color=TRUTH,
            fontsize=_TITLE["fontsize"], animated=True, annotation_clip=False,
        )  # fmt: skip
        self._estimate = axes.set_title("", loc="right", color=POSTERIOR, animated=True, **_TITLE)
        self.animated_artists = (self.band, self.mean, self._true_value, self._estimate)

    def update(self, times: FloatArray, mean: FloatArray, half: FloatArray, true: float) -> None:
        """Show means (n,) with half widths of their bands (n,), beside the true value."""
        percent = 100 * np.array([mean - half - true, mean - true, mean + half - true]) / abs(true)
        low, middle, high = np.clip(percent, -self._EDGE, self._EDGE)
        self.mean.set_data(times, middle)
        known = np.isfinite(low) & np.isfinite(high)
        there, back = (times[known], low[known]), (times[known][::-1], high[known][::-1])
        self.band.set_verts([np.hstack([there, back]).T])
        self._true_value.set_text(f"true {true / self._unit:.3f}".replace("-", "−"))
        in_sight = half[-1] < 10 * abs(true)
        numbers = f"{mean[-1] / self._unit:z.3f} ± {half[-1] / self._unit:.3f}".replace("-", "−")
        self._estimate.set_text(numbers if in_sight else "not known yet")
