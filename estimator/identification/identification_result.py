"""`Result`: identified parameters with intervals, warnings, forecasts and noises, in the units of the rig."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TypeVar

import numpy.typing as npt

from estimator.belief import Belief
from estimator.identification.data.record import Record
from estimator.identification.diagnostics.check_finding import CheckFinding
from estimator.identification.fitting.posterior_belief import ContractionHistory
from estimator.identification.fitting.ridge_posterior import RidgePosterior
from estimator.identification.identification_report import ReportContent, write_report
from estimator.identification.report_figures import FREE_RUN_OUTPUTS
from estimator.online import OnlineEstimator
from estimator.rigs.rig import Rig
from estimator.rigs.units import format_interval
from estimator.support.array_types import FloatArray

_Value = TypeVar("_Value")

#: Ratio that a free decay identifies, to the parameter that equals it at m = 1 and its powers of the input's unit, the
#: displacement's unit and the second.
FREE_DECAY_RATIOS = {
    "c/m": ("c", (0, 0, -1)),
    "a/m": ("a", (0, 0, -2)),
    "b/m": ("b", (0, -2, -2)),
    "y0": ("y0", (0, 1, 0)),
}


def parameter_moments(belief: Belief, ridges: RidgePosterior | None) -> dict[str, tuple[float, float]]:
    """Parameter to mean and standard deviation of a belief, with half widths along ridges where there are any."""
    ridge_stds = {} if ridges is None else ridges.half_widths()
    return {name: (mean, ridge_stds.get(name, std)) for name, (mean, std, _) in belief.parameters().items()}


@dataclass(frozen=True, eq=False)
class Result:
    """The result of `identify`.

    Attributes:
        rig: the rig of the records.
        belief: the posterior of coefficients and noises, with an unknown state, as before a further record.
        warnings: findings of the checks; empty where no check speaks against the result.
        records: the records, without clipped samples.
        forecasts: per record, (T, 2) mean and variance of each output, one sample ahead.
        noises: ``input`` and ``output`` to mean and standard deviation of the noise's own standard deviation per
            sample: the disturbance of the force, and the sensor's noise.
        compute_history: computes `history`, by several fits.
        compute_forecasts: computes forecasts from the first n outputs of each record alone.
        ridges: ridges of a posterior that is no Gaussian, from which the intervals are then taken; None of a Gaussian.
    """

    rig: Rig
    belief: Belief
    warnings: tuple[CheckFinding, ...]
    records: tuple[Record, ...]
    forecasts: tuple[FloatArray, ...]
    noises: Mapping[str, tuple[float, float]]
    compute_history: Callable[[], ContractionHistory]
    compute_forecasts: Callable[[int], tuple[FloatArray, ...]]
    ridges: RidgePosterior | None = None

    @property
    def parameters(self) -> dict[str, tuple[float, float]]:
        """Parameter to mean and standard deviation, in the rig's units: m, c, a, b and the offsets u0 and y0.

        Of a free decay (`is_free_decay`): c/m, a/m, b/m and y0.
        """
        return self._of_identifiable(parameter_moments(self.belief, self.ridges))

    @property
    def is_free_decay(self) -> bool:
        """Whether the records are of a free decay, without an input."""
        return not any(one.u.any() for one in self.records)

    def _of_identifiable(self, values: dict[str, _Value]) -> dict[str, _Value]:
        """The values of all parameters, or after a free decay of the ratios that it identifies."""
        if not self.is_free_decay:
            return values
        return {name: values[parameter] for name, (parameter, _) in FREE_DECAY_RATIOS.items()}

    @property
    def unidentified(self) -> tuple[str, ...]:
        """Parameters that the check ``not_identified`` names."""
        return tuple(name for one in self.warnings if one.name == "not_identified" for name in one.parameters)

    @property
    def units(self) -> dict[str, str]:
        """Parameter to its unit."""
        if self.is_free_decay:
            return {name: self.belief.scales.unit(dimension) for name, (_, dimension) in FREE_DECAY_RATIOS.items()}
        return {name: unit for name, (_, _, unit) in self.belief.parameters().items()}

    def interval(self, probability: float = 0.9) -> dict[str, tuple[float, float]]:
        """Parameter to its central credible interval.

        Args:
            probability: of the interval.

        Raises:
            ValueError: for a probability outside of 0 to 1.
        """
        gaussian = self.belief.interval(probability)
        return self._of_identifiable(gaussian if self.ridges is None else gaussian | self.ridges.interval(probability))

    @cached_property
    def history(self) -> ContractionHistory:
        """Number of outputs, and mean and standard deviation of each parameter that the first outputs leave.

        From few samples to all, for the same oscillator and noise
        (`estimator.identification.fitting.posterior_belief.contraction_history`).
        """
        return self.compute_history()

    @property
    def estimator(self) -> OnlineEstimator:
        """A new online estimator with this posterior as its prior, for further records.

        Raises:
            ValueError: after a free decay, which does not identify m.
        """
        if self.is_free_decay:
            raise ValueError(
                "records must have an input for an estimator, but are of a free decay; add a driven record"
            )
        return OnlineEstimator(self.belief.model, self.belief, self.rig)

    def simulate(self, u: npt.ArrayLike, y_init: npt.ArrayLike) -> FloatArray:
        """Free run at the mean parameters.

        Args:
            u: (T,) inputs in the rig's unit.
            y_init: the first outputs, which start the run.

        Raises:
            ValueError: as `OnlineEstimator.simulate`.
        """
        return self.estimator.simulate(u, y_init)

    def report(self, path: str | Path, commands: Sequence[str] = ()) -> Path:
        """Write one HTML page, readable offline, with parameters, fits, residuals and checks.

        Args:
            path: the page; its folder is created.
            commands: the commands that made it, which the page shows.
        """
        content = ReportContent(
            self.rig,
            self.parameters,
            self.interval(0.9),
            self.units,
            self.unidentified,
            self.noises,
            self.warnings,
            self.records,
            self.forecasts,
            self.compute_forecasts(FREE_RUN_OUTPUTS),
            self.history,
        )
        return write_report(content, Path(path), commands)

    def __str__(self) -> str:
        intervals, units = self.interval(0.9), self.units
        rows = [
            f"{name:>3} = {mean_text} {units[name]}, 90 % in [{low_text}, {high_text}]"
            f"{', open' if name in self.unidentified else ''}"
            for (name, (mean, _)), (low, high) in zip(self.parameters.items(), intervals.values(), strict=True)
            for mean_text, low_text, high_text in [format_interval(mean, low, high, 6)]
        ]
        warnings = [f"WARNING {warning}" for warning in self.warnings] or ["no check speaks against this result"]
        return "\n".join([*rows, *warnings])
