"""Hypotheses about input path and noise ratio, priors of the coefficients, and the Laplace fits of hypotheses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from estimator.support.array_types import FloatArray


@dataclass(frozen=True)
class FitHypothesis:
    """A hypothesis about the records, fixed while the coefficients are fitted.

    Attributes:
        interpolation: of the input.
        delay: of the input [samples].
        noise_ratio: ratio σ_w/σ_v of process noise to sensor noise, scaled.
        initial_states: (records, 2) displacement and velocity one sample before each record, about which the filter is
            linear at first; None: at rest.
        lag: time constant of a first-order lag of the input [samples].
    """

    interpolation: str
    delay: float
    noise_ratio: float = 1.0
    initial_states: FloatArray | None = field(default=None, compare=False)
    lag: float = 0.0

    @property
    def input_path(self) -> tuple[str, float, float]:
        """Interpolation, delay and lag of the input."""
        return self.interpolation, self.delay, self.lag


@dataclass(frozen=True, eq=False)
class CoefficientPrior:
    """A Gaussian prior over the coefficients of a model.

    Attributes:
        mean: (K,) prior mean.
        precision: (K, K) inverse covariance.
    """

    mean: FloatArray
    precision: FloatArray

    @classmethod
    def of(cls, mean: FloatArray, cov: FloatArray) -> CoefficientPrior:
        """The prior with a mean (K,) and a covariance (K, K)."""
        scale = np.sqrt(np.diag(cov))
        return cls(mean, np.linalg.inv(cov / np.outer(scale, scale)) / np.outer(scale, scale))

    def extended(self, moments: Sequence[tuple[float, float]]) -> CoefficientPrior:
        """The prior with further coefficients, independent, of given means and standard deviations."""
        n, means, stds = len(self.mean), [mean for mean, _ in moments], np.array([std for _, std in moments])
        precision = np.zeros((n + len(stds),) * 2)
        precision[:n, :n], precision[n:, n:] = self.precision, np.diag(stds**-2)
        return CoefficientPrior(np.append(self.mean, means), precision)


@dataclass(frozen=True, eq=False)
class LaplaceFits:
    """The fits of H hypotheses.

    Attributes:
        hypotheses: the hypotheses.
        mean: (H, K) most probable coefficients.
        cov: (H, K, K) their covariances.
        sensor_std: (H,) sensor noise σ_v.
        free_energy: (H,) free energies in nats, up to a shared constant; inf where the fit diverged, or where records
            and prior leave a coefficient open.
        loss: (H,) the loss L in the free energy.
    """

    hypotheses: tuple[FitHypothesis, ...]
    mean: FloatArray
    cov: FloatArray
    sensor_std: FloatArray
    free_energy: FloatArray
    loss: FloatArray

    def lowest_free_energy(self, count: int) -> LaplaceFits:
        """The ``count`` fits of the lowest free energies, in ascending order."""
        return self.select(np.argsort(self.free_energy, kind="stable")[:count])

    def select(self, chosen: npt.NDArray[Any]) -> LaplaceFits:
        """The chosen fits, by indices or by flags."""
        kept = tuple(self.hypotheses[i] for i in np.arange(len(self.hypotheses))[chosen])
        parts = (self.mean, self.cov, self.sensor_std, self.free_energy, self.loss)
        return LaplaceFits(kept, *(part[chosen] for part in parts))

    @classmethod
    def concatenated(cls, batches: Sequence[LaplaceFits]) -> LaplaceFits:
        """The fits of several batches, in order."""
        parts = zip(*((f.mean, f.cov, f.sensor_std, f.free_energy, f.loss) for f in batches), strict=True)
        return cls(tuple(h for f in batches for h in f.hypotheses), *(np.concatenate(part) for part in parts))


def with_noise_ratios(hypothesis: FitHypothesis, ratios: FloatArray) -> list[FitHypothesis]:
    """The same hypothesis at several noise ratios."""
    return [replace(hypothesis, noise_ratio=float(ratio)) for ratio in ratios]
