"""Beliefs of many environments as arrays, and the checks of observations, which are names or functions of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from estimator.belief import covariance_indices
from estimator.models.model import Model
from estimator.rigs.physical_parameters import propagate_to_physical
from estimator.rigs.units import VOLT_SCALES, Scales
from estimator.support.argument_checks import check_integer, short_repr
from estimator.support.array_types import FloatArray

#: Names of observations; `duffing_env.env.DuffingEnv` describes them.
OBSERVATIONS = ("posterior", "history", "privileged")

#: Largest number of steps that the observation ``history`` shows.
MAX_HISTORY = 10_000

#: Bound to which the entries of an observation that is a function of the belief are clipped.
OBSERVATION_BOUND = 10.0


@dataclass(frozen=True)
class Beliefs:
    """The beliefs of n environments as arrays, with the attributes of `estimator.Belief`.

    Attributes:
        model: the model with these states and coefficients.
        records: (n, size) flat records of the beliefs.
        scales: factors from internal to physical units, for physical parameters.
    """

    model: Model
    records: FloatArray
    scales: Scales = VOLT_SCALES

    @property
    def mean(self) -> FloatArray:
        """(n, d) means of states and coefficients."""
        return self.records[:, : len(self.model.names)]

    @property
    def cov(self) -> FloatArray:
        """(n, d, d) covariances of states and coefficients."""
        return self.records[:, covariance_indices(self.model)]

    @property
    def coefficients_mean(self) -> FloatArray:
        """(n, K) means of the coefficients."""
        return self.mean[:, self.model.n_states :]

    @property
    def coefficients_cov(self) -> FloatArray:
        """(n, K, K) covariances of the coefficients."""
        n = self.model.n_states
        return self.records[:, covariance_indices(self.model)[n:, n:]]

    @property
    def noises(self) -> FloatArray:
        """(n, 2 + 2 sensors) shape and rate of γ, then of each ξ."""
        return self.records[:, -2 - 2 * self.model.n_outputs :]

    def physical(self) -> tuple[FloatArray, FloatArray]:
        """Means (n, p) and covariances (n, p, p) of the physical parameters, as `estimator.Belief.physical` gives."""
        return propagate_to_physical(self.model, self.coefficients_mean, self.coefficients_cov, self.scales)


def check_observation(observation: Any, history: int) -> None:
    """Refuse an unknown observation, or a ``history`` that is no number of steps.

    Raises:
        ValueError: with the argument, its value and the valid ones.
    """
    if not callable(observation) and not (isinstance(observation, str) and observation in OBSERVATIONS):
        raise ValueError(
            f"observation must be one of {list(OBSERVATIONS)} or a function, but is {short_repr(observation)}"
        )
    check_integer("history", history, MAX_HISTORY)
