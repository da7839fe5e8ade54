"""`SearchResult`: fits about the noises, their probabilities, and the moments of their mixture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimator.identification.fitting.ridge_posterior import RidgePosterior
from estimator.identification.fitting.weak_form import input_effect_rms
from estimator.identification.likelihood.fit_hypothesis import (
    FitHypothesis,
    LaplaceFits,
)
from estimator.identification.likelihood.laplace_fit import LaplaceFitter
from estimator.support.array_types import FloatArray


@dataclass(frozen=True, eq=False)
class SearchResult:
    """What a search left.

    Attributes:
        fits: hypotheses about the noises that share the records, interpolation, delay and terms.
        weights: (H,) their probabilities.
        fitter: that made them.
        has_failed: whether they explain the records badly, and no other start leads to them.
        ridges: along which the posterior lies where it is no Gaussian; the hypotheses are then also about the
            coefficients.
    """

    fits: LaplaceFits
    weights: FloatArray
    fitter: LaplaceFitter
    has_failed: bool = False
    ridges: RidgePosterior | None = None

    @property
    def mean(self) -> FloatArray:
        """(K,) of the mixture; along a ridge its middle, because a mean may be beside all that is possible."""
        return np.asarray(self.weights @ self.fits.mean) if self.ridges is None else self.fits.mean[self._best_index]

    @property
    def cov(self) -> FloatArray:
        """(K, K) of the mixture, about `mean`."""
        away = self.fits.mean - self.mean
        return np.asarray(np.tensordot(self.weights, self.fits.cov, 1) + (away.T * self.weights) @ away)

    @property
    def best(self) -> FitHypothesis:
        """The most probable hypothesis; along a ridge that in the middle."""
        return self.fits.hypotheses[self._best_index]

    @property
    def initial_states(self) -> FloatArray:
        """(records, 2) displacement and velocity a sample before each record."""
        assert self.best.initial_states is not None
        return self.best.initial_states

    @property
    def sensor_std(self) -> float:
        """σ_v of that hypothesis."""
        return float(self.fits.sensor_std[self._best_index])

    @property
    def _best_index(self) -> int:
        return int(np.argmax(self.weights)) if self.ridges is None else self.ridges.median_index

    @property
    def relative_disturbance(self) -> float:
        """σ_w of the most probable hypothesis, in parts of what the inputs do."""
        return self.best.noise_ratio * self.sensor_std / max(input_effect_rms(self.fitter.problem, self.mean), 1e-300)

    @property
    def noises(self) -> tuple[FloatArray, FloatArray]:
        """(H,) σ_w and σ_v of the hypotheses."""
        ratios = np.array([h.noise_ratio for h in self.fits.hypotheses])
        return ratios * self.fits.sensor_std, self.fits.sensor_std
