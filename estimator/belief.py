"""Prior and belief: the readable faces of the flat record that the kernels update."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from estimator.gaussian import GaussianCoefficients
from estimator.parameters import (
    SILVERBOX_TWIN,
    Coefficients,
    FloatArray,
    PhysicalParameters,
    log_uniform_moments,
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


@dataclass(frozen=True, eq=False)
class Prior:
    """What is believed before the first sample.

    θ = (θ1, θ2, θ3) and η are Gaussian, γ and ξ are Gamma(shape, rate), the state (x_0, x_{-1}) is Gaussian.

    Attributes:
        theta_mean: (3,) means of θ1 [1], θ2 [1/V²], θ3 [1].
        theta_cov: (3, 3) their covariance, positive definite.
        eta_mean: mean of η [1].
        eta_var: variance of η, positive.
        gamma_shape, gamma_rate: of the process precision γ [1/V²]; rate in V², both positive.
        xi_shape, xi_rate: of the measurement precision ξ [1/V²].
        state_mean: (2,) means of x_0 and x_{-1} [V].
        state_cov: (2, 2) their covariance [V²], positive definite.
        coefficients_cov: (4, 4) joint covariance of (θ, η), whose blocks are ``theta_cov`` and ``eta_var``; without
            it θ and η are independent. The mean-field factorisation uses the blocks only.

    Raises:
        ValueError: naming the field, for a wrong shape, a value that is not finite, a covariance that is not
            symmetric positive definite, or a shape, rate or variance that is not positive.
    """

    theta_mean: FloatArray
    theta_cov: FloatArray
    eta_mean: float
    eta_var: float
    gamma_shape: float
    gamma_rate: float
    xi_shape: float
    xi_rate: float
    state_mean: FloatArray
    state_cov: FloatArray
    coefficients_cov: FloatArray | None = None

    def __post_init__(self) -> None:
        for name, shape in (("theta_mean", (3,)), ("eta_mean", ()), ("state_mean", (2,))):
            self._settle(name, shape)
        for name in ("eta_var", "gamma_shape", "gamma_rate", "xi_shape", "xi_rate"):
            value = self._settle(name, ())
            if value <= 0:
                raise ValueError(f"{name} must be positive, but is {value}; pass a value above 0")
        for name, size in (("theta_cov", 3), ("state_cov", 2)):
            _check_covariance(name, self._settle(name, (size, size)))
        if self.coefficients_cov is None:
            joint = np.zeros((4, 4))
            joint[:3, :3] = self.theta_cov
            joint[3, 3] = self.eta_var
            object.__setattr__(self, "coefficients_cov", joint)
        else:
            joint = self._settle("coefficients_cov", (4, 4))
            _check_covariance("coefficients_cov", joint)
            blocks = joint.copy()
            blocks[:3, :3] = self.theta_cov
            blocks[3, 3] = self.eta_var
            if not _agree(joint, blocks):
                raise ValueError(
                    f"coefficients_cov must contain theta_cov and eta_var as its blocks, but has diagonal "
                    f"{np.diag(joint)}; pass theta_cov=coefficients_cov[:3, :3] and eta_var=coefficients_cov[3, 3]"
                )

    def _settle(self, name: str, shape: tuple[int, ...]) -> FloatArray:
        """Copy a field to float64, check its shape and that it is finite."""
        value = np.array(getattr(self, name), dtype=np.float64)
        if value.shape != shape:
            raise ValueError(f"{name} must have shape {shape}, but has {value.shape}; reshape it")
        if not np.isfinite(value).all():
            raise ValueError(f"{name} must be finite, but is {value}; replace the entries that are not")
        value.flags.writeable = False
        object.__setattr__(self, name, value if shape else float(value))
        return value

    @classmethod
    def published_run(cls) -> Prior:
        """The prior that the paper's published numbers were computed with (it differs from the paper's text)."""
        return cls(np.ones(3), 10 * np.eye(3), 2.0, 1e-2, 1e8, 1e3, 1e8, 1e1, np.zeros(2), 10 * np.eye(2))

    @classmethod
    def paper_text(cls) -> Prior:
        """The prior as the paper's section 4 states it; the state's, not given there, is that of the published run."""
        return cls(np.ones(3), 10 * np.eye(3), 1.0, 10.0, 1e3, 1e1, 1e8, 1e3, np.zeros(2), 10 * np.eye(2))

    @classmethod
    def silverbox_twin(
        cls,
        spread: float = 0.3,
        process_noise: float = 5e-4,
        measurement_noise: float = 5e-4,
        noise_shape: float = 2.0,
        state_std: float = 1e-3,
        center: PhysicalParameters = SILVERBOX_TWIN,
    ) -> Prior:
        """The prior of the environments: moment-matched to oscillators near the Silverbox circuit.

        Args:
            spread: m, c, a and b are log-uniform on center * [1 - spread, 1 + spread]; in (0, 1).
            process_noise: standard deviation of w̃ [V] at which the prior of γ is centred.
            measurement_noise: standard deviation of v [V] at which the prior of ξ is centred.
            noise_shape: shape of both Gamma priors: 2 is worth four noises seen one by one. They never are, so that
                even such a prior binds for thousands of samples (docs/coverage.md): centre it with care.
            state_std: standard deviation of x_0 and x_{-1} [V].
            center: the oscillator in the middle of the range.
        """
        if not 0 < spread < 1:
            raise ValueError(
                f"spread must be above 0 and below 1, but is {spread}; pass the range's relative half width"
            )
        for name, value in (("process_noise", process_noise), ("measurement_noise", measurement_noise)):
            if not 0 < value < np.inf:
                raise ValueError(f"{name} must be positive and finite, but is {value}; pass a standard deviation in V")
        mean, cov = log_uniform_moments(center, spread)
        return cls(
            theta_mean=mean[:3],
            theta_cov=cov[:3, :3],
            eta_mean=float(mean[3]),
            eta_var=float(cov[3, 3]),
            gamma_shape=noise_shape,
            gamma_rate=noise_shape * process_noise**2,
            xi_shape=noise_shape,
            xi_rate=noise_shape * measurement_noise**2,
            state_mean=np.zeros(2),
            state_cov=state_std**2 * np.eye(2),
            coefficients_cov=cov,
        )

    def to_record(self, *, factorisation: str = "structured", nonlinear: bool = True) -> FloatArray:
        """The prior as a flat record (RECORD_SIZE,) that the kernels start from.

        Without the nonlinearity θ2 is known to be 0: mean, variance and covariances are 0, and stay so.
        """
        mean = np.zeros(7)
        mean[:2] = self.state_mean
        mean[_STATES:] = [*self.theta_mean, self.eta_mean]
        cov = np.zeros((7, 7))
        cov[:2, :2] = self.state_cov
        assert self.coefficients_cov is not None
        cov[_STATES:, _STATES:] = self.coefficients_cov
        if factorisation == "structured":
            cov[2, 2] = self.state_cov[1, 1]
        else:
            cov[_STATES:-1, -1] = cov[-1, _STATES:-1] = 0.0
        if not nonlinear:
            mean[4] = 0.0
            cov[4, :] = cov[:, 4] = 0.0
        return from_moments(mean, cov, np.array([self.gamma_shape, self.gamma_rate, self.xi_shape, self.xi_rate]))


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


def _agree(first: FloatArray, second: FloatArray) -> bool:
    """Whether two covariances are the same up to rounding, each entry beside the standard deviations it belongs to."""
    std = np.sqrt(np.abs(np.diag(first)))
    return bool((np.abs(first - second) <= 1e-9 * np.outer(std, std)).all())


def _check_covariance(name: str, value: FloatArray) -> None:
    if not _agree(value, value.T):
        raise ValueError(f"{name} must be symmetric, but is {value.tolist()}; pass (C + C.T) / 2")
    smallest = np.linalg.eigvalsh(value)[0]
    if smallest <= 0:
        raise ValueError(f"{name} must be positive definite, but has eigenvalue {smallest}; add variance to it")
