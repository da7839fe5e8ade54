"""The search for the noises and its fits, where hypotheses go wrong."""

from types import SimpleNamespace

import numpy as np

from estimator.identification.fit import Fits, Hypothesis
from estimator.identification.search import settle


class Flat:
    """A fitter to which all ratios of the noises are alike."""

    problem = SimpleNamespace(frequency=1.0, scales=SimpleNamespace(order=0))

    def fit(self, hypotheses, start, level):
        count = len(hypotheses)
        return Fits(tuple(hypotheses), np.zeros((count, 1)), np.ones((count, 1, 1)), np.ones(count), np.zeros(count))


def test_a_grid_that_is_widened_to_the_last_has_the_weights_of_its_last_fits():
    found = settle(Flat(), Hypothesis("linear", 0), np.zeros(1), 1.0, reach=1.001)
    assert len(found.weights) == len(found.fits.hypotheses)
    ratios = np.array([h.ratio for h in found.fits.hypotheses])
    np.testing.assert_allclose(found.weights, (1 / (1 + ratios**2) * ratios) / (1 / (1 + ratios**2) * ratios).sum())
