"""`Result`: what records tell of an oscillator, in the units of its rig."""

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
from estimator.rigs.units import digits_to_distinguish
from estimator.support.array_types import FloatArray

_Value = TypeVar("_Value")

#: What a free decay tells: its name, the parameter that it is where m is 1, and powers of displacement and second.
FREE_DECAY_RATIOS = {
    "c/m": ("c", (0, 0, -1)),
    "a/m": ("a", (0, 0, -2)),
    "b/m": ("b", (0, -2, -2)),
    "y0": ("y0", (0, 1, 0)),
}


def parameter_moments(belief: Belief, ridges: RidgePosterior | None) -> dict[str, tuple[float, float]]:
    """Parameter to mean and standard deviation of a belief, with the spreads along ridges where there are any."""
    ridge_stds = {} if ridges is None else ridges.half_widths()
    return {name: (mean, ridge_stds.get(name, std)) for name, (mean, std, _) in belief.parameters().items()}


@dataclass(frozen=True, eq=False)
class Result:
    """What `identify` found.

    Attributes:
        rig: as it was given.
        belief: the posterior, before a further record: its coefficients and noises, with the state at any place.
        warnings: what the checks found; empty where nothing speaks against the result.
        records: the records, with clipped samples taken out.
        forecasts: per record, (T, 2) mean and variance of each output before it was seen.
        noises: name to mean and standard deviation: of ``input``, the disturbance of the force as a standard deviation
            per sample, and of ``output``, the sensor's.
        compute_history: makes `history`, which takes some fits.
        compute_forecasts: makes forecasts in which the filter is shown so many outputs of each record alone.
        ridges: along which the posterior lies where it is no Gaussian; intervals are then taken along them.
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
        """What the records tell of what is given for all parameters."""
        return {name: values[own] for name, (own, _) in FREE_DECAY_RATIOS.items()} if self.is_free_decay else values

    @property
    def unidentified(self) -> tuple[str, ...]:
        """Parameters that the records do not identify: the check ``not_identified`` names them."""
        return tuple(name for one in self.warnings if one.name == "not_identified" for name in one.parameters)

    @property
    def units(self) -> dict[str, str]:
        """Parameter to its unit."""
        if self.is_free_decay:
            return {name: self.belief.scales.unit(dimension) for name, (_, dimension) in FREE_DECAY_RATIOS.items()}
        return {name: unit for name, (_, _, unit) in self.belief.parameters().items()}

    def interval(self, probability: float = 0.9) -> dict[str, tuple[float, float]]:
        """Parameter to the central interval that holds it with a probability.

        Raises:
            ValueError: for a probability that is not between 0 and 1.
        """
        gaussian = self.belief.interval(probability)
        return self._of_identifiable(gaussian if self.ridges is None else gaussian | self.ridges.interval(probability))

    @cached_property
    def history(self) -> ContractionHistory:
        """What the first samples left: how many outputs, and the mean and standard deviation of each parameter.

        From few samples to all, for the same oscillator in the same noise (`estimator.identification.fitting.posterior_belief`).
        """
        return self.compute_history()

    @property
    def estimator(self) -> OnlineEstimator:
        """A new estimator that begins with what is believed now, for further records.

        Raises:
            ValueError: after a free decay, which does not tell m.
        """
        if self.is_free_decay:
            raise ValueError("records must have an input for an estimator to go on, but are of a free decay; drive it")
        return OnlineEstimator(self.belief.model, self.belief, self.rig)

    def simulate(self, u: npt.ArrayLike, y_init: npt.ArrayLike) -> FloatArray:
        """Free run of the mean parameters over inputs (T,) in the rig's units, started by the first outputs.

        Raises:
            ValueError: as `OnlineEstimator.simulate`.
        """
        return self.estimator.simulate(u, y_init)

    def report(self, path: str | Path, commands: Sequence[str] = ()) -> Path:
        """Write one page of HTML that opens without a network: parameters, fits, residuals, and the checks.

        Args:
            path: of the page; its folder is made.
            commands: that made it, to be shown.
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
            f"{name:>3} = {mean:.{digits}g} {units[name]}, 90 % in [{low:.{digits}g}, {high:.{digits}g}]"
            f"{', open' if name in self.unidentified else ''}"
            for (name, (mean, _)), (low, high) in zip(self.parameters.items(), intervals.values(), strict=True)
            for digits in [digits_to_distinguish(low, high, 6)]
        ]
        warnings = [f"WARNING {warning}" for warning in self.warnings] or ["no check speaks against it"]
        return "\n".join([*rows, *warnings])
