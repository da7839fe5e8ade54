"""`RidgePosterior`: marginals and credible intervals along the ridges of a posterior, as mixtures of Gaussians."""

from __future__ import annotations

from dataclasses import dataclass

from estimator.support.array_types import FloatArray

#: Probability within one standard deviation of a Gaussian's mean.
ONE_STD_PROBABILITY = 0.6826894921370859


@dataclass(frozen=True, eq=False)
class MixtureMarginal:
    """The marginal of a parameter: a mixture of Gaussians along a ridge.

    Attributes:
        mean: (n,) means, in the rig's units.
        std: (n,) standard deviations.
        weights: (n,) probabilities.
    """

    mean: FloatArray
    std: FloatArray
    weights: FloatArray

    def quantile(self, probability: float) -> float:
        """The value below which the parameter lies with a probability."""
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
    """A posterior along several ridges.

    Attributes:
        marginals: parameter to its marginal along each ridge.
        median_index: index of the median fit.
    """

    marginals: dict[str, list[MixtureMarginal]]
    median_index: int

    def interval(self, probability: float) -> dict[str, tuple[float, float]]:
        """Parameter to its widest interval over the ridges: a ridge may miss values, but adds no impossible ones."""
        below = 0.5 - probability / 2
        return {
            name: (min(one.quantile(below) for one in several), max(one.quantile(1 - below) for one in several))
            for name, several in self.marginals.items()
        }

    def half_widths(self) -> dict[str, float]:
        """Parameter to half of its 68 % interval, which is the standard deviation of a Gaussian."""
        return {name: (high - low) / 2 for name, (low, high) in self.interval(ONE_STD_PROBABILITY).items()}
