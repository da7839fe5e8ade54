"""How probable it is that an input takes the output out of its range, under the whole posterior."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from estimator.belief import covariance_places
from estimator.free_run import free_run
from estimator.online import OnlineEstimator
from estimator.parameters import FloatArray

if TYPE_CHECKING:
    from agents.running.follower import Follower

#: Systems that are drawn from the belief.
DRAWS = 300

#: An input that is too large is tried again at this share, so often: down to a thousandth.
_LESS, _TRIALS = 0.8, 31

#: From the standard deviation of the process noise to that of a force that is held over a sample.
_HELD = np.sqrt(3.0)


def drawn_from(estimator: OnlineEstimator, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """States and coefficients (draws, d) and noises (draws, 2) from a posterior, hypotheses as often as probable."""
    arrays = estimator.arrays()
    weights = np.where(np.isfinite(arrays["records"]).all(axis=1), arrays["weights"], 0.0)
    counts = rng.multinomial(DRAWS, weights / weights.sum())
    d, places = len(estimator.model.names), covariance_places(estimator.model)
    drawn, noises = [], []
    for record, count in zip(arrays["records"], counts.tolist(), strict=True):
        if count:
            drawn.append(rng.multivariate_normal(record[:d], record[places], count, method="eigh"))
            shapes, rates = record[-4::2], record[-3::2]
            noises.append(1.0 / np.sqrt(rng.gamma(shapes, 1.0 / rates, (count, 2))))
    return np.concatenate(drawn), np.concatenate(noises)


class Futures:
    """What systems drawn from a posterior do with inputs: coefficients, state and noises are all drawn.

    Args:
        follower: of the run.
        limit: of the output, in the belief's scale.
        rng: of the draws; the noises of a drawn system stay the same from input to input.
    """

    def __init__(self, follower: Follower, limit: float, rng: np.random.Generator) -> None:
        self.model, self.delay, self.limit = follower.estimator.model, follower.delay, limit
        self._drawn, noises = follower.drawn(rng)
        self._process, self._sensor = noises.T
        self._seeds = rng.integers(2**63, size=DRAWS)

    def probability(self, u: FloatArray) -> float:
        """That inputs (N,), in the belief's scale, take the output out of its limit at any of the samples.

        The mean of what the draws tell of it, (k + 1) / (n + 2): it is never 0.
        """
        n, gain = self.model.n_states, list(self.model.coefficients).index("gain")
        acting = np.concatenate([np.zeros(self.delay), u])[: len(u)]
        left = 0
        for k in range(DRAWS):
            state, coefficients = self._drawn[k, :n], self._drawn[k, n:]
            noise = np.random.default_rng(self._seeds[k]).standard_normal((2, len(u)))
            force = _HELD * self._process[k] / max(abs(coefficients[gain]), 1e-12)
            with np.errstate(over="ignore", invalid="ignore"):
                y = free_run(self.model, coefficients, acting + force * noise[0], state) + self._sensor[k] * noise[1]
            left += not bool((np.abs(y) <= self.limit).all())
        return (left + 1) / (DRAWS + 2)

    def share(self, u: FloatArray, bound: float) -> tuple[float, float]:
        """The largest share of inputs whose probability of leaving the limit is below a bound, and that probability.

        Returns:
            The share, in (0, 1], or 0 where even no input is too much; and the probability at it.
        """
        share = 1.0
        for _ in range(_TRIALS):
            probability = self.probability(share * u)
            if probability < bound:
                return share, probability
            share *= _LESS
        return 0.0, self.probability(0.0 * u)
