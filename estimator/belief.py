"""The belief: the readable face of the flat record that the kernels update."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from estimator.gaussian import GaussianCoefficients
from estimator.parameters import (
    Coefficients,
    FloatArray,
    PhysicalParameters,
    propagate_to_physical,
    to_coefficients,
)
from estimator.record import RECORD, RECORD_SIZE

_INDEX = {name: i for i, name in enumerate(RECORD)}
_MEANS = slice(0, 7)
_STATES = 3


def _covariance_index() -> npt.NDArray[np.intp]:
    """(7, 7) positions of the covariance's entries in a record."""
    index = np.empty((7, 7), dtype=np.intp)
    upper = np.triu_indices(7)
    index[upper] = index.T[upper] = np.arange(_INDEX["P_x0_x0"], _INDEX["P_e_e"] + 1)
    return index


_COVARIANCE = _covariance_index()
_NOISES = slice(_INDEX["g_shape"], RECORD_SIZE)


def to_moments(record: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Mean (7,), covariance (7, 7), and shapes and rates of γ and ξ (4,) of a flat record; copies."""
    return record[_MEANS].copy(), record[_COVARIANCE], record[_NOISES].copy()


def from_moments(mean: FloatArray, cov: FloatArray, noises: FloatArray) -> FloatArray:
    """The flat record (RECORD_SIZE,) with these moments."""
    record = np.empty(RECORD_SIZE)
    record[_MEANS] = mean
    record[_COVARIANCE] = cov
    record[_NOISES] = noises
    return record


Self = TypeVar("Self", bound="RecordBelief")


@dataclass(frozen=True, eq=False)
class RecordBelief(GaussianCoefficients):
    """A posterior as the kernels hold it: state and coefficients Gaussian, q(γ) and q(ξ) Gamma.

    A copy; later updates do not change it.

    Attributes:
        record: (RECORD_SIZE,) the flat record.
    """

    record: FloatArray

    def __post_init__(self) -> None:
        record = np.array(self.record, dtype=np.float64)
        record.flags.writeable = False
        object.__setattr__(self, "record", record)

    def __eq__(self, other: object) -> bool:
        """Whether all numbers are the same, as Gymnasium's checker asks of two episodes of one seed."""
        if not isinstance(other, RecordBelief):
            return NotImplemented
        return self._kind == other._kind and np.array_equal(self.record, other.record)

    def __hash__(self) -> int:
        return hash((self._kind, self.record.tobytes()))

    def with_records(self: Self, records: FloatArray) -> list[Self]:
        """Beliefs of the same kind with other records (n, RECORD_SIZE), which must not be written to any more."""
        beliefs = []
        for record in records:
            # Past the copy that a belief makes, which takes as long as 20 steps of one of a thousand environments.
            belief = object.__new__(type(self))
            belief.__dict__.update(self.__dict__, record=record)
            beliefs.append(belief)
        return beliefs

    @property
    def _kind(self) -> tuple[Any, ...]:
        """What tells beliefs of the same numbers apart."""
        return (type(self),)

    @property
    def _lags(self) -> int:
        """Numbers of the record that are the state's."""
        return 2

    @staticmethod
    def propagate(coefficients_mean: FloatArray, coefficients_cov: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Moments (..., 4) and (..., 4, 4) of (m, c, a, b) from those of the coefficients, to first order."""
        raise NotImplementedError

    @staticmethod
    def coefficients_of(parameters: PhysicalParameters) -> FloatArray:
        """(..., 4) the coefficients of one oscillator or a batch of shape (...)."""
        raise NotImplementedError

    @property
    def state_mean(self) -> FloatArray:
        """(k,) means of the state."""
        return self.record[: self._lags].copy()

    @property
    def state_cov(self) -> FloatArray:
        """(k, k) covariance of the state."""
        return self.record[_COVARIANCE[: self._lags, : self._lags]]

    @property
    def coefficients_mean(self) -> FloatArray:
        """(4,) means of the coefficients."""
        return self.record[_STATES:7].copy()

    @property
    def coefficients_cov(self) -> FloatArray:
        """(4, 4) covariance of the coefficients."""
        return self.record[_COVARIANCE[_STATES:, _STATES:]]

    @property
    def gamma_shape(self) -> float:
        """Shape of q(γ)."""
        return float(self.record[_INDEX["g_shape"]])

    @property
    def gamma_rate(self) -> float:
        """Rate of q(γ) [V²]."""
        return float(self.record[_INDEX["g_rate"]])

    @property
    def xi_shape(self) -> float:
        """Shape of q(ξ)."""
        return float(self.record[_INDEX["n_shape"]])

    @property
    def xi_rate(self) -> float:
        """Rate of q(ξ) [V²]."""
        return float(self.record[_INDEX["n_rate"]])

    @property
    def gamma_mean(self) -> float:
        """E[γ] [1/V²]."""
        return self.gamma_shape / self.gamma_rate

    @property
    def xi_mean(self) -> float:
        """E[ξ] [1/V²]."""
        return self.xi_shape / self.xi_rate

    def physical(self) -> tuple[FloatArray, FloatArray]:
        """Mean (4,) and covariance (4, 4) of (m, c, a, b), first order."""
        return self.propagate(self.coefficients_mean, self.coefficients_cov)


@dataclass(frozen=True, eq=False)
class Belief(RecordBelief):
    """A posterior: q(x, θ, η) Gaussian, q(γ) and q(ξ) Gamma. A copy; later updates do not change it.

    The coefficients are θ1 [1], θ2 [1/V²], θ3 [1] and η [1], the state is x_t, x_{t-1}, (x_{t-2})  [V].

    Attributes:
        record: (RECORD_SIZE,) the flat record.
        factorisation: ``structured`` (three lags of the state, jointly with θ and η) or ``mean_field`` (two lags,
            θ and η independent of them and of each other).
        nonlinear: False where θ2 is fixed at 0; densities are then over (θ1, θ3, η).
    """

    factorisation: str = "structured"
    nonlinear: bool = True

    @property
    def _kind(self) -> tuple[Any, ...]:
        return (Belief, self.factorisation, self.nonlinear)

    @property
    def _lags(self) -> int:
        return 3 if self.factorisation == "structured" else 2

    @staticmethod
    def propagate(coefficients_mean: FloatArray, coefficients_cov: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Moments (..., 4) and (..., 4, 4) of (m, c, a, b) from those of θ and η, Eq. (4), to first order."""
        return propagate_to_physical(coefficients_mean, coefficients_cov)

    @staticmethod
    def coefficients_of(parameters: PhysicalParameters) -> FloatArray:
        """(..., 4) θ1, θ2, θ3, η of one oscillator or a batch, Eq. (3)."""
        psi = to_coefficients(parameters)
        return np.stack([psi.theta1, psi.theta2, psi.theta3, psi.eta], axis=-1)

    @property
    def theta_mean(self) -> FloatArray:
        """(3,) means of θ1 [1], θ2 [1/V²], θ3 [1]."""
        return self.coefficients_mean[:3]

    @property
    def theta_cov(self) -> FloatArray:
        """(3, 3) covariance of θ."""
        return self.coefficients_cov[:3, :3]

    @property
    def eta_mean(self) -> float:
        """Mean of η [1]."""
        return float(self.record[_INDEX["e"]])

    @property
    def eta_var(self) -> float:
        """Variance of η."""
        return float(self.record[_INDEX["P_e_e"]])

    def coefficients(self) -> Coefficients:
        """The posterior means as coefficients."""
        theta1, theta2, theta3, eta = self.coefficients_mean.tolist()
        return Coefficients(theta1, theta2, theta3, eta, self.gamma_mean, self.xi_mean)

    def log_prob(self, coefficients: Coefficients | npt.ArrayLike) -> float | FloatArray:
        """Log density of q(θ, η) at given coefficients.

        Args:
            coefficients: `Coefficients`, or values (..., 4) of θ1, θ2, θ3, η.

        Returns:
            Log density in nats, of shape (...): a float for one point.

        Raises:
            ValueError: for a wrong shape, or values that are not finite.
        """
        if isinstance(coefficients, Coefficients):
            c = coefficients
            coefficients = np.stack([c.theta1, c.theta2, c.theta3, c.eta], axis=-1)
        return super().log_prob(coefficients)
