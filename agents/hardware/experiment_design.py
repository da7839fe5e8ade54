"""The result of designing an experiment: the signal, the predicted output, and the intervals expected after it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from scipy.special import ndtri

from estimator.belief import Belief
from estimator.identification.data.column_units import name_with_unit, unit_in_name
from estimator.rigs.rig import Rig
from estimator.support.array_types import FloatArray
from estimator.support.file_io import write_atomically


class ParameterForecast(NamedTuple):
    """A parameter before and after an experiment.

    Attributes:
        name: of the parameter.
        mean: before.
        interval: credible interval before.
        expected_half_width: half width of the interval that is expected after.
        unit: of all of them.
    """

    name: str
    mean: float
    interval: tuple[float, float]
    expected_half_width: float
    unit: str


@dataclass(frozen=True, eq=False)
class ExperimentDesign:
    """The design of an experiment.

    Attributes:
        rig: of the experiment.
        policy: name of the policy that chose the inputs.
        u: (T,) inputs in the rig's unit.
        output_quantiles: (3, T) 5 %, 50 % and 95 % quantiles of the predicted output over the belief, in the sensor's
            unit, clipped to twice the range.
        prior: the belief before the experiment.
        expected_stds: parameter to its standard deviation expected after the experiment, the median over the belief.
        information_gain: expected information gain on the coefficients [nats].
        scale: the factor, from 0 to 1, by which the policy's inputs are multiplied to be safe.
        exit_probability: upper bound of the probability that the output leaves its range, under the belief
            (`MonteCarloSystems.violation_probability`).
        samples_per_period: samples in a period of small motions, under the belief.
    """

    rig: Rig
    policy: str
    u: FloatArray
    output_quantiles: FloatArray
    prior: Belief
    expected_stds: Mapping[str, float]
    information_gain: float
    scale: float
    exit_probability: float
    samples_per_period: float

    def parameter_rows(self, level: float = 0.9) -> list[ParameterForecast]:
        """Every parameter with its interval of this level now, and the half width expected after the experiment."""
        normal_quantile, intervals = float(ndtri(0.5 + level / 2)), self.prior.interval(level)
        return [
            ParameterForecast(name, mean, intervals[name], normal_quantile * self.expected_stds[name], unit)
            for name, (mean, _, unit) in self.prior.parameters().items()
        ]

    def write(self, path: Path) -> None:
        """Write a CSV file with time [s] and input, in the format that `identify` reads."""
        name = name_with_unit(self.rig.only_input.column or "u", self.rig.only_input.unit)
        lines = [f"time [s],{name if unit_in_name(name) else f'{name} [{self.rig.only_input.unit}]'}"]
        lines += [f"{k * self.rig.step:.9g},{value:.12g}" for k, value in enumerate((self.u + 0.0).tolist())]
        write_atomically(path, "\n".join(lines) + "\n")
