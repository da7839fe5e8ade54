"""The prior: what is believed before the first sample."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimator.belief import from_moments
from estimator.parameters import SILVERBOX_TWIN, FloatArray, PhysicalParameters, log_uniform_moments

_STATES = 3


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

    @property
    def coefficients_mean(self) -> FloatArray:
        """(4,) means of (θ, η)."""
        return np.append(self.theta_mean, self.eta_mean)

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
