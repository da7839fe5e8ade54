"""Hypotheses about input path and noises, priors of coefficients, and the results of their fits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from estimator.support.array_types import FloatArray


@dataclass(frozen=True)
class FitHypothesis:
    """What is held for true while the coefficients are fitted.

    Attributes:
        interpolation: of the input.
        delay: of the input, in samples.
        lag: time constant of a first-order lag of the input, in samples.
        noise_ratio: σ_w/σ_v inside.
        initial_states: (records, 2) displacement and velocity a sample before each record, about which the filter is linear at
            its first samples; at rest where it is None.
    """

    interpolation: str
    delay: float
    noise_ratio: float = 1.0
    initial_states: FloatArray | None = field(default=None, compare=False)
    lag: float = 0.0

    @property
    def input_path(self) -> tuple[str, float, float]:
        """How the input went: interpolation, delay and lag."""
        return self.interpolation, self.delay, self.lag


@dataclass(frozen=True, eq=False)
class CoefficientPrior:
    """A Gaussian over the coefficients of `Problem.model`: mean (K,) and precision (K, K)."""

    mean: FloatArray
    precision: FloatArray

    @classmethod
    def of(cls, mean: FloatArray, cov: FloatArray) -> CoefficientPrior:
        """That of given moments (K,) and (K, K)."""
        scale = np.sqrt(np.diag(cov))
        return cls(mean, np.linalg.inv(cov / np.outer(scale, scale)) / np.outer(scale, scale))

    def extended(self, moments: Sequence[tuple[float, float]]) -> CoefficientPrior:
        """With more coefficients, of means and standard deviations."""
        n, means, stds = len(self.mean), [mean for mean, _ in moments], np.array([std for _, std in moments])
        precision = np.zeros((n + len(stds),) * 2)
        precision[:n, :n], precision[n:, n:] = self.precision, np.diag(stds**-2)
        return CoefficientPrior(np.append(self.mean, means), precision)


@dataclass(frozen=True, eq=False)
class LaplaceFits:
    """What became of H hypotheses.

    Attributes:
        hypotheses: in order.
        mean: (H, K) most probable coefficients.
        cov: (H, K, K) their covariance.
        sensor_std: (H,) σ_v.
        free_energy: (H,) in nats, up to a constant that all share; inf where the numbers ran away, or the records and
            the prior leave a coefficient open.
        loss: (H,) the part of it that is L.
    """

    hypotheses: tuple[FitHypothesis, ...]
    mean: FloatArray
    cov: FloatArray
    sensor_std: FloatArray
    free_energy: FloatArray
    loss: FloatArray

    def lowest_free_energy(self, count: int) -> LaplaceFits:
        """Those of the lowest free energies, the lowest first."""
        return self.select(np.argsort(self.free_energy, kind="stable")[:count])

    def select(self, chosen: npt.NDArray[Any]) -> LaplaceFits:
        """Those of some hypotheses, told by their numbers or by flags."""
        kept = tuple(self.hypotheses[i] for i in np.arange(len(self.hypotheses))[chosen])
        parts = (self.mean, self.cov, self.sensor_std, self.free_energy, self.loss)
        return LaplaceFits(kept, *(part[chosen] for part in parts))

    @classmethod
    def concatenated(cls, batches: Sequence[LaplaceFits]) -> LaplaceFits:
        """All of several."""
        parts = zip(*((f.mean, f.cov, f.sensor_std, f.free_energy, f.loss) for f in batches), strict=True)
        return cls(tuple(h for f in batches for h in f.hypotheses), *(np.concatenate(part) for part in parts))


def with_noise_ratios(hypothesis: FitHypothesis, ratios: FloatArray) -> list[FitHypothesis]:
    """The same hypothesis at several ratios of the noises."""
    return [replace(hypothesis, noise_ratio=float(ratio)) for ratio in ratios]
