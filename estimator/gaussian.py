"""Gaussian beliefs in coefficients: what every belief can be asked, whatever its model."""

from __future__ import annotations

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
