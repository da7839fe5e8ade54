"""Gaussian beliefs in coefficients: what every belief can be asked, whatever its model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from estimator.parameters import FloatArray


class GaussianCoefficients:
    """q(coefficients) = N(coefficients_mean, coefficients_cov).

    A coefficient of variance 0 is known; densities are then over the others.
    """

    @property
    def coefficients_mean(self) -> FloatArray:
        """(K,) means."""
        raise NotImplementedError

    @property
    def coefficients_cov(self) -> FloatArray:
        """(K, K) covariance."""
        raise NotImplementedError

    def entropy(self) -> float:
        """Entropy of the coefficients in nats."""
        active, cov = self._unknown()
        sign, log_det = np.linalg.slogdet(cov)
        return float(0.5 * (len(active) * np.log(2 * np.pi * np.e) + log_det)) if sign > 0 else float("nan")

    def log_prob(self, coefficients: npt.ArrayLike) -> float | FloatArray:
        """Log density at given coefficients.

        Args:
            coefficients: values (..., K), in the order of ``coefficients_mean``.

        Returns:
            Log density in nats, of shape (...): a float for one point.

        Raises:
            ValueError: for a wrong shape, or values that are not finite.
        """
        points = np.asarray(coefficients, dtype=np.float64)
        size = len(self.coefficients_mean)
        if points.ndim == 0 or points.shape[-1] != size:
            raise ValueError(f"coefficients must have shape (..., {size}), but has {points.shape}; pass one per name")
        if not np.isfinite(points).all():
            raise ValueError("coefficients must be finite, but has entries that are not; remove them")
        active, cov = self._unknown()
        factor = np.linalg.cholesky(cov)
        deviation = (points - self.coefficients_mean)[..., active]
        whitened = np.linalg.solve(factor, deviation[..., None])[..., 0]
        log_det = 2 * np.log(np.diag(factor)).sum()
        value = -0.5 * ((whitened**2).sum(-1) + log_det + len(active) * np.log(2 * np.pi))
        return float(value) if np.ndim(value) == 0 else value

    def _unknown(self) -> tuple[npt.NDArray[np.intp], FloatArray]:
        """The coefficients that are not known, and their covariance."""
        cov = self.coefficients_cov
        active = np.flatnonzero(np.diag(cov) != 0)
        return active, cov[np.ix_(active, active)]


@dataclass(frozen=True, eq=False)
class JointBelief(GaussianCoefficients):
    """A prior or posterior of a model with named parameters: q(state, parameters) Gaussian, q(γ) and q(ξ) Gamma.

    Attributes:
        names: (K,) of the parameters.
        units: (K,) of the parameters.
        mean: (k + K,) of the state, then the parameters, in their units.
        cov: (k + K, k + K) their covariance. A variance of 0 fixes a parameter at its mean.
        gamma_shape: of γ, the precision of what the process noise of a sample does to the output.
        gamma_rate: of γ [V²].
        xi_shape: of ξ, the measurement precision.
        xi_rate: of ξ [V²].

    Raises:
        ValueError: naming the field, for a wrong shape, a value that is not finite, or a rate that is not positive.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    mean: FloatArray
    cov: FloatArray
    gamma_shape: float
    gamma_rate: float
    xi_shape: float
    xi_rate: float

    def __post_init__(self) -> None:
        mean, cov = np.array(self.mean, dtype=np.float64), np.array(self.cov, dtype=np.float64)
        if mean.ndim != 1 or len(mean) < len(self.names):
            raise ValueError(f"mean must hold the state and {len(self.names)} parameters, but has shape {mean.shape}")
        if cov.shape != (len(mean), len(mean)):
            raise ValueError(f"cov must have shape {(len(mean), len(mean))}, but has {cov.shape}; it goes with mean")
        if not (np.isfinite(mean).all() and np.isfinite(cov).all()):
            raise ValueError("mean and cov must be finite, but have entries that are not; replace them")
        for name in ("gamma_shape", "gamma_rate", "xi_shape", "xi_rate"):
            value = float(getattr(self, name))
            if not 0 < value < np.inf:
                raise ValueError(f"{name} must be positive and finite, but is {value}; pass a value above 0")
            object.__setattr__(self, name, value)
        for name, array in (("mean", mean), ("cov", cov)):
            array.flags.writeable = False
            object.__setattr__(self, name, array)

    @property
    def _states(self) -> int:
        return len(self.mean) - len(self.names)

    @property
    def state_mean(self) -> FloatArray:
        """(k,) means of the state."""
        return self.mean[: self._states]

    @property
    def state_cov(self) -> FloatArray:
        """(k, k) covariance of the state."""
        return self.cov[: self._states, : self._states]

    @property
    def coefficients_mean(self) -> FloatArray:
        """(K,) means of the parameters."""
        return self.mean[self._states :]

    @property
    def coefficients_cov(self) -> FloatArray:
        """(K, K) covariance of the parameters."""
        return self.cov[self._states :, self._states :]

    @property
    def gamma_mean(self) -> float:
        """E[γ] [1/V²]."""
        return self.gamma_shape / self.gamma_rate

    @property
    def xi_mean(self) -> float:
        """E[ξ] [1/V²]."""
        return self.xi_shape / self.xi_rate

    def parameters(self) -> dict[str, tuple[float, float, str]]:
        """Mean, standard deviation and unit of each parameter, by name."""
        stds = np.sqrt(np.diag(self.coefficients_cov))
        rows = zip(self.names, self.coefficients_mean, stds, self.units, strict=True)
        return {name: (float(mean), float(std), unit) for name, mean, std, unit in rows}
