"""`RidgePosterior`: mixtures of Gaussians along the ridges of a posterior, and their intervals."""

from __future__ import annotations

from dataclasses import dataclass

from estimator.support.array_types import FloatArray

#: Probability of a standard deviation either way.
ONE_STD_PROBABILITY = 0.6826894921370859


@dataclass(frozen=True, eq=False)
class MixtureMarginal:
    """What is left of a parameter: a mixture of Gaussians along a ridge.

    Attributes:
        mean: (n,) of each, in the rig's units.
        std: (n,)
        weights: (n,) their probabilities.
    """

    mean: FloatArray
    std: FloatArray
    weights: FloatArray

    def quantile(self, probability: float) -> float:
        """What the parameter is below with a probability."""
        from scipy.special import ndtr

        low, high = float((self.mean - 9 * self.std).min()), float((self.mean + 9 * self.std).max())
        for _ in range(200):
            middle = (low + high) / 2
            if self.weights @ ndtr((middle - self.mean) / self.std) < probability:
                low = middle
            else:
                high = middle
        return (low + high) / 2


@dataclass(frozen=True, eq=False)
class RidgePosterior:
    """A posterior that is no Gaussian, as several walks along it see it.

    Attributes:
        marginals: parameter to what each walk left of it.
        median_index: number of the hypothesis in the middle.
    """

    marginals: dict[str, list[MixtureMarginal]]
    median_index: int

    def interval(self, probability: float) -> dict[str, tuple[float, float]]:
        """Parameter to the widest of the central intervals: a walk misses what lies beside it, and none adds."""
        below = 0.5 - probability / 2
        return {
            name: (min(one.quantile(below) for one in several), max(one.quantile(1 - below) for one in several))
            for name, several in self.marginals.items()
        }

    def half_widths(self) -> dict[str, float]:
        """Parameter to half of the interval that would be a standard deviation either way of a Gaussian."""
        return {name: (high - low) / 2 for name, (low, high) in self.interval(ONE_STD_PROBABILITY).items()}
