"""Renders an episode: input and output over time on the left, the posterior of the parameters on the right.

The parameters are m, c, a and b of a Duffing oscillator, and the first four of another model.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt

from duffing_env.rendering.plot_panels import GREY, INK, RULE, ParameterPanel, SignalPanel
from estimator.belief import Belief
from estimator.models.model import Model
from estimator.models.named_parameters import Parameters
from estimator.rigs.physical_parameters import propagate_to_physical
from estimator.rigs.rig_prior import STDS_PER_90_PERCENT
from estimator.rigs.units import SUPERSCRIPTS, VOLT_SCALES, Scales
from estimator.support.array_types import FloatArray
from estimator.support.optional_dependencies import require_packages

Frame = npt.NDArray[np.uint8]

WIDTH, HEIGHT = 960, 540
"""Size of a frame in pixels."""

#: Largest width of the heading, in parts of the frame: the status of a long episode begins behind it.
_MAX_HEADING_WIDTH = 0.13

MAX_SAMPLES_SHOWN = 256
"""Samples on the time axes. Longer episodes scroll: more samples would hide the single periods."""

#: Labels of the Duffing oscillator's parameters.
_PARAMETER_LABELS = {"m": "mass m", "c": "damping c", "a": "stiffness a", "b": "cubic b"}

#: Largest number of parameters of another model that are shown.
_MAX_PARAMETERS = 4

#: Length of the time axis from which it is in seconds rather than milliseconds [s].
_SECONDS_AXIS_FROM = 10.0

#: Height that the parameters' panels share, in parts of the frame.
_PARAMETER_PANELS_HEIGHT = 0.82


class EpisodeRenderer:
    """Draws one episode after another: as RGB arrays and, in mode ``human``, in a window.

    Copies and pickles continue to draw, but have no window: a planner that tries inputs on a copy shows nothing.

    Args:
        render_mode: ``rgb_array``, or ``human``: then `start` and `add_sample` show the frame in a window.
        max_inputs: name of each input to its limit, in internal units.
        max_output: limit of the output, in internal units.
        fps: largest number of frames per second in the window.
        scales: factors from internal to physical units, which the picture shows.

    Raises:
        gymnasium.error.DependencyNotInstalled: in mode ``human`` without pygame.
    """

    def __init__(
        self,
        render_mode: str | None,
        max_inputs: Mapping[str, float],
        max_output: float,
        fps: float,
        scales: Scales = VOLT_SCALES,
    ) -> None:
        self._limits, self._scales = (max_inputs, max_output), scales
        self._figure_cache: _EpisodeFigure | None = None
        self._window = _PygameWindow(fps) if render_mode == "human" else None

    def start(self, truth: Parameters, belief: Belief, horizon: int) -> None:
        """Begin an episode of at most ``horizon`` samples; ``belief`` is the prior."""
        names = shown_parameters(belief.model)
        self._truth = np.array([getattr(truth, name, np.nan) for name in names])
        self._labels = _axis_labels(belief)
        units = dict(zip(belief.model.inputs, self._scales.input_units(belief.model.n_inputs), strict=True))
        # Channels by name have units of their own, in which the inputs are shown.
        stated = {} if self._scales.more_inputs else belief.model.inputs
        self._input_units = {name: stated.get(name) or unit for name, unit in units.items()}
        self._model = (
            "Duffing oscillator" if tuple(names) == tuple(_PARAMETER_LABELS) else belief.model.name.replace("_", " ")
        )
        self._horizon = horizon
        self._samples = 0
        self._prior_entropy = belief.entropy()
        # Inputs, output and the belief after them; the prior has no input and output before it.
        no_inputs = np.full(belief.model.n_inputs, np.nan)
        self._history: deque[tuple[FloatArray, float, Belief]] = deque(
            [(no_inputs, np.nan, belief)], maxlen=MAX_SAMPLES_SHOWN + 1
        )
        self._show()

    def add_sample(self, u: float | FloatArray, y: float, belief: Belief) -> None:
        """Add a sample: applied inputs (inputs,), the output after them, in internal units, and the belief after it."""
        self._samples += 1
        inputs = np.atleast_1d(u) * self._scales.input_scales(belief.model.n_inputs)
        self._history.append((inputs, self._scales.output * y, belief))
        self._show()

    def frame(self) -> Frame:
        """The episode so far, at most its last `MAX_SAMPLES_SHOWN` samples, as a new RGB array (HEIGHT, WIDTH, 3)."""
        if self._figure_cache is None:
            self._figure_cache = _EpisodeFigure(
                *self._limits, self._scales, self._input_units, self._model, self._labels
            )
        inputs, outputs, beliefs = zip(*self._history, strict=True)
        means, stds = _physical_moments(beliefs)
        gained = self._prior_entropy - beliefs[-1].entropy()
        first = self._samples + 1 - len(beliefs)
        return self._figure_cache.draw(
            status=f"sample {self._samples} of {self._horizon}, {gained:.1f} nats gained",
            extent=(first, max(self._samples, min(self._horizon, MAX_SAMPLES_SHOWN))),
            inputs=np.stack(inputs, axis=1),
            outputs=np.array([outputs]),
            means=means,
            stds=stds,
            truth=self._truth,
        )

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.close()
            self._window = None

    def _show(self) -> None:
        if self._window is not None:
            self._window.show(self.frame())

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_figure_cache": None, "_window": None}


def shown_parameters(model: Model) -> list[str]:
    """Names of the shown parameters: m, c, a and b of a model that has them, else the first ones.

    Example:
        >>> from estimator.models import MODELS
        >>> [shown_parameters(MODELS[name]()) for name in ("duffing", "pendulum", "wiener_hammerstein")]
        [['m', 'c', 'a', 'b'], ['p1', 'p2', 'p3'], ['stiffness', 'damping', 'cubic', 'decay']]
    """
    names = list(model.physical or model.coefficients)
    return list(_PARAMETER_LABELS) if set(_PARAMETER_LABELS) <= set(names) else names[:_MAX_PARAMETERS]


def _physical_moments(beliefs: Sequence[Belief]) -> tuple[FloatArray, FloatArray]:
    """(parameters, n) means and standard deviations of the shown parameters, to first order.

    NaN where a belief has none: the map may divide by the gain (η), whose mean is about 0.4 but may pass 0.
    """
    model, scales = beliefs[0].model, beliefs[0].scales
    names = list(model.coefficients)
    gain = names.index("gain") if "gain" in names else -1
    mean = np.array([belief.coefficients_mean for belief in beliefs])
    cov = np.array([belief.coefficients_cov for belief in beliefs])
    is_finite = np.isfinite(mean).all(axis=-1) & np.isfinite(cov).all(axis=(-1, -2))
    if model.physical:  # a model without this map divides by nothing
        is_finite &= np.abs(mean[:, gain]) > 1e-12
    shown, parameters = shown_parameters(model), list(model.physical or model.coefficients)
    means, stds = np.full((2, len(shown), len(beliefs)), np.nan)
    with np.errstate(all="ignore"):
        physical, physical_cov = propagate_to_physical(model, mean[is_finite], cov[is_finite], scales)
        variances = np.diagonal(physical_cov, axis1=-2, axis2=-1)
    for row, index in enumerate(map(parameters.index, shown)):
        means[row, is_finite] = physical[:, index]
        stds[row, is_finite] = np.sqrt(variances[:, index])
    return means, stds


class _EpisodeFigure:
    """The figure, on an Agg canvas: pyplot would look for a display, and never release the figure.

    Axes and labels are drawn when the time axes change, and kept as a background; a frame adds curves and numbers.
    """

    def __init__(
        self,
        max_inputs: Mapping[str, float],
        max_output: float,
        scales: Scales,
        input_units: Mapping[str, str],
        title: str,
        labels: Mapping[str, float],
    ) -> None:
        require_packages("matplotlib")
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        self._figure = Figure((WIDTH / 100, HEIGHT / 100), dpi=100, facecolor="white")
        self._canvas = FigureCanvasAgg(self._figure)
        # Unit of the time axes: an episode takes a fraction of a second, or minutes.
        self._unit, factor = ("ms", 1e3) if MAX_SAMPLES_SHOWN * scales.step < _SECONDS_AXIS_FROM else ("s", 1.0)
        self._sample = factor * scales.step
        self._background: Any = None
        self._extent: tuple[int, int] | None = None

        left, right = (0.06, 0.41), (0.575, 0.405)
        if len(max_inputs) == 1:
            input_title = _with_unit(f"input {next(iter(max_inputs))}", next(iter(input_units.values())))
        else:
            input_title = "inputs in parts of their limits"
        sizes = scales.input_scales(len(max_inputs)).tolist()
        input_limits = {name: size * u for (name, u), size in zip(max_inputs.items(), sizes, strict=True)}
        input_limits = {f"{name} (±{u:.4g} {input_units[name]})": u for name, u in input_limits.items()}
        y = _with_unit("output y", scales.output_unit)
        height = _PARAMETER_PANELS_HEIGHT / len(labels)
        self._signals = (
            SignalPanel(self._add_axes(*left, 0.52, 0.34), input_title, input_limits, "steps-pre"),
            SignalPanel(self._add_axes(*left, 0.10, 0.34), y, {y: scales.output * max_output}, "default"),
        )
        self._parameters = [
            ParameterPanel(self._add_axes(*right, 0.10 + height * row, height - 0.06), name, unit)
            for row, (name, unit) in zip(reversed(range(len(labels))), labels.items(), strict=True)
        ]
        self._panels: tuple[SignalPanel | ParameterPanel, ...] = (*self._signals, *self._parameters)
        style: dict[str, Any] = {"color": INK, "verticalalignment": "center_baseline"}
        heading = self._figure.text(0.06, 0.945, title, fontsize=12, weight="bold", **style)
        # The name of a model shrinks until it ends before the status begins.
        wide = heading.get_window_extent(self._canvas.get_renderer()).width / WIDTH
        heading.set_fontsize(min(12.0, 12.0 * _MAX_HEADING_WIDTH / wide))
        self._status = self._figure.text(0.47, 0.945, "", fontsize=9, ha="right", animated=True, **style)
        self._figure.text(0.505, 0.48, "deviation from the truth [%]", color=INK, fontsize=9, rotation=90, va="center")
        self._add_legend()

    def draw(
        self, status: str, extent: tuple[int, int], inputs: FloatArray, outputs: FloatArray, means: FloatArray,
        stds: FloatArray, truth: FloatArray,
    ) -> Frame:  # fmt: skip
        """Draw a frame.

        Args:
            status: the line beside the title.
            extent: first and last sample of the time axes. The arrays begin with the first.
            inputs: (inputs, n) inputs in their units.
            outputs: (1, n) outputs in their unit.
            means: (parameters, n) means of the shown parameters.
            stds: (parameters, n) their standard deviations.
            truth: (parameters,) their true values.
        """
        if extent != self._extent:
            self._draw_background(extent)
        times = self._sample * np.arange(extent[0], extent[0] + inputs.shape[1])
        self._status.set_text(status)
        for signal_panel, values in zip(self._signals, (inputs, outputs), strict=True):
            signal_panel.update(times, values)
        for parameter_panel, mean, std, true in zip(self._parameters, means, stds, truth, strict=True):
            parameter_panel.update(times, mean, STDS_PER_90_PERCENT * std, true)

        self._canvas.restore_region(self._background)
        for panel in self._panels:
            for artist in panel.animated_artists:
                self._figure.draw_artist(artist)
        self._figure.draw_artist(self._status)
        return np.asarray(self._canvas.buffer_rgba())[..., :3].copy()

    def _draw_background(self, extent: tuple[int, int]) -> None:
        margin = 0.01 * (extent[1] - extent[0])  # for the dots
        for panel in self._panels:
            panel.axes.set_xlim(self._sample * (extent[0] - margin), self._sample * (extent[1] + margin))
        self._canvas.draw()
        self._background = self._canvas.copy_from_bbox(self._figure.bbox)
        self._extent = extent

    def _add_axes(self, left: float, width: float, bottom: float, height: float) -> Any:
        axes = self._figure.add_axes((left, bottom, width, height))
        axes.spines[["top", "right"]].set_visible(False)
        axes.spines[["bottom", "left"]].set_color(GREY)
        axes.tick_params(labelsize=8, colors=GREY, length=3)
        axes.grid(axis="y", color=RULE, linewidth=0.6)
        axes.set_axisbelow(True)
        if bottom == 0.10:
            axes.set_xlabel(f"time [{self._unit}]", fontsize=9, color=INK)
        else:
            axes.tick_params(labelbottom=False)
        return axes

    def _add_legend(self) -> None:
        parameter = self._parameters[0]
        entries = {
            "limit": self._signals[0].limit,
            "truth": parameter.truth,
            "posterior mean": parameter.mean,
            "90 % band": parameter.band,
        }
        self._figure.legend(
            entries.values(),
            entries.keys(),
            loc="center right",
            bbox_to_anchor=(0.99, 0.947),
            ncols=len(entries),
            fontsize=8.5,
            labelcolor=INK,
            frameon=False,
            handlelength=1.6,
            columnspacing=1.4,
        )


def _axis_labels(belief: Belief) -> dict[str, float]:
    """Label of each shown parameter to the power of ten of its axis, by a prior."""
    model, labels = belief.model, {}
    units = {name: belief.scales.unit(d) for name, d in model.dimensions.items()} or model.coefficients
    means, stds = _physical_moments([belief])
    for name, size in zip(shown_parameters(model), np.maximum(np.abs(means), stds)[:, 0], strict=True):
        power = int(np.floor(np.log10(size))) if np.isfinite(size) and size != 0 else 0
        power = 0 if -1 <= power <= 1 else power
        parts = [f"10{str(power).translate(SUPERSCRIPTS)}"] * (power != 0) + [units[name]] * (units[name] != "1")
        labels[_with_unit(_PARAMETER_LABELS.get(name, name), " ".join(parts) or "1")] = 10.0**power
    return labels


def _with_unit(name: str, unit: str) -> str:
    return name if unit == "1" else f"{name} [{unit}]"


class _PygameWindow:
    """A pygame window that shows frames."""

    def __init__(self, fps: float) -> None:
        try:
            import pygame
        except ImportError as error:
            raise gym.error.DependencyNotInstalled(
                "render_mode='human' needs pygame: pip install \"duffing-env[human]\", or use render_mode='rgb_array'"
            ) from error
        self._pygame = pygame
        self._fps = fps
        pygame.display.init()
        pygame.display.set_caption("duffing-env")
        self._surface = pygame.display.set_mode((WIDTH, HEIGHT))
        self._clock = pygame.time.Clock()

    def show(self, frame: Frame) -> None:
        """Show a frame, once the last one has been shown for 1 / fps seconds."""
        self._pygame.event.pump()
        self._surface.blit(self._pygame.image.frombuffer(frame.tobytes(), (WIDTH, HEIGHT), "RGB"), (0, 0))
        self._clock.tick(self._fps)
        self._pygame.display.flip()

    def close(self) -> None:
        self._pygame.display.quit()
