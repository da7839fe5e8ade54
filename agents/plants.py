"""The model that an environment's plant obeys, and what is believed of it before the first sample."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from duffing_env.experiment import ContinuousExperiment
from estimator.maximum_a_posteriori import Moments
from estimator.models.difference import difference
from estimator.models.duffing import duffing
from estimator.models.model import Model
from estimator.parameters import FloatArray, PhysicalParameters
from estimator.physical import coefficients_of


class Plant(NamedTuple):
    """A plant.

    Attributes:
        model: its equation.
        interpolation: of the input between samples.
        prior: of its coefficients.
    """

    model: Model
    interpolation: str
    prior: Moments

    def coefficients_of(self, truth: PhysicalParameters) -> FloatArray:
        """(..., K) the coefficients of one oscillator or a batch."""
        return coefficients_of(self.model, {name: np.asarray(getattr(truth, name)) for name in self.model.physical})


def plant_of(experiment: Any) -> Plant:
    """The plant of an experiment."""
    if isinstance(experiment, ContinuousExperiment):
        return Plant(duffing(), "linear", experiment.physical_prior)
    return Plant(difference(), "zero_order", experiment.believed)


def believed_of(experiment: Any) -> tuple[Model, str]:
    """The model whose coefficients an experiment's estimator believes in, and the interpolation of the input."""
    return (duffing(), "linear") if experiment.estimator_kind == "ode" else (difference(), "zero_order")
