"""The model that an environment's plant obeys, and what is believed of it before the first sample."""

from __future__ import annotations

from typing import Any, NamedTuple

from estimator.belief import Belief
from estimator.models.model import Model
from estimator.parameters import FloatArray, Parameters
from estimator.physical import coefficients_of


class Plant(NamedTuple):
    """A plant.

    Attributes:
        model: its equation.
        interpolation: of the input between samples.
        prior: of its coefficients.
        process_noise: standard deviation.
        sensor_noises: standard deviations, one for each sensor.
    """

    model: Model
    interpolation: str
    prior: Belief
    process_noise: float
    sensor_noises: list[float]

    def coefficients_of(self, truth: Parameters) -> FloatArray:
        """(..., K) the coefficients of one plant or a batch."""
        return coefficients_of(self.model, truth, self.prior.scales)


def plant_of(experiment: Any) -> Plant:
    """The plant of an experiment that simulates one."""
    model = experiment.plant
    interpolation = "linear" if experiment.degree and model.is_continuous else "zero_order"
    sensors = getattr(experiment, "noises", [experiment.measurement_noise])
    return Plant(model, interpolation, experiment.prior_of(model), experiment.process_noise, sensors)
