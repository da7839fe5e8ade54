"""The model that an environment's plant obeys, and what is believed of it before the first sample."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from duffing_env.storage.kernel_spec import noise_std_rows
from estimator.belief import Belief
from estimator.models.model import Model
from estimator.models.named_parameters import Parameters
from estimator.rigs.physical_parameters import coefficients_of
from estimator.support.array_types import FloatArray


class PlantModel(NamedTuple):
    """A plant.

    Attributes:
        model: its equation.
        interpolation: of the input between samples.
        prior: of its coefficients.
        process_noise: standard deviation, of all systems or of each (n,).
        sensor_noises: standard deviations, one for each sensor (p,), or for each system and sensor (n, p).
    """

    model: Model
    interpolation: str
    prior: Belief
    process_noise: float | FloatArray
    sensor_noises: FloatArray

    def coefficients_of(self, truth: Parameters) -> FloatArray:
        """(..., K) the coefficients of one plant or a batch."""
        return coefficients_of(self.model, truth, self.prior.scales)


def plant_model_of(experiment: Any, truth: Parameters | None = None) -> PlantModel:
    """The plant of an experiment that simulates one; with its systems' own noises, where these are drawn."""
    model = experiment.plant
    interpolation = "linear" if experiment.degree and model.is_continuous else "zero_order"
    prior, setup, names = experiment.prior_for_model(model), experiment.kernel_params, list(noise_std_rows(model))
    process, sensors = setup.process_noise, setup.measurement_noise
    if truth is not None and names[0] in truth:
        process, *others = (np.asarray(truth[name]) / prior.scales.output for name in names)
        sensors = np.stack(others, axis=-1)
    return PlantModel(model, interpolation, prior, process, sensors)
