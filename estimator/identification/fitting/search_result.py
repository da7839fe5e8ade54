"""`SearchResult`: fits at several noise ratios, their probabilities, and the moments of their mixture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimator.identification.fitting.ridge_posterior import RidgePosterior
from estimator.identification.fitting.weak_form import input_effect_rms
from estimator.identification.likelihood.fit_hypothesis import FitHypothesis, LaplaceFits
from estimator.identification.likelihood.laplace_fit import LaplaceFitter
from estimator.support.array_types import FloatArray


@dataclass(frozen=True, eq=False)
class SearchResult:
    """The result of a search.

    Attributes:
        fits: fits at H noise ratios, with the same records, interpolation, delay and terms.
        weights: (H,) their probabilities.
        fitter: the fitter that made them.
        has_failed: whether the fit is poor and no other start leads to it.
        ridges: ridges of a posterior that is no Gaussian, along which the fits then lie; None of a Gaussian.
    """

    fits: LaplaceFits
    weights: FloatArray
    fitter: LaplaceFitter
    has_failed: bool = False
    ridges: RidgePosterior | None = None

    @property
    def mean(self) -> FloatArray:
        """(K,) mean of the mixture; along a ridge its median, because the mean may lie off the ridge."""
        return np.asarray(self.weights @ self.fits.mean) if self.ridges is None else self.fits.mean[self._best_index]

    @property
    def cov(self) -> FloatArray:
        """(K, K) covariance of the mixture, about `mean`."""
        away = self.fits.mean - self.mean
        return np.asarray(np.tensordot(self.weights, self.fits.cov, 1) + (away.T * self.weights) @ away)

    @property
    def best(self) -> FitHypothesis:
        """The most probable hypothesis; along a ridge the median one."""
        return self.fits.hypotheses[self._best_index]

    @property
    def initial_states(self) -> FloatArray:
        """(records, 2) displacement and velocity one sample before each record."""
        assert self.best.initial_states is not None
        return self.best.initial_states

    @property
    def sensor_std(self) -> float:
        """σ_v of `best`."""
        return float(self.fits.sensor_std[self._best_index])

    @property
    def _best_index(self) -> int:
        return int(np.argmax(self.weights)) if self.ridges is None else self.ridges.median_index

    @property
    def relative_disturbance(self) -> float:
        """σ_w of `best`, relative to the effect of the inputs."""
        return self.best.noise_ratio * self.sensor_std / max(input_effect_rms(self.fitter.problem, self.mean), 1e-300)

    @property
    def noises(self) -> tuple[FloatArray, FloatArray]:
        """(H,) σ_w and σ_v of the hypotheses."""
        ratios = np.array([h.noise_ratio for h in self.fits.hypotheses])
        return ratios * self.fits.sensor_std, self.fits.sensor_std
