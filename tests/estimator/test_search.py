"""The search for the noises and its fits, where hypotheses go wrong."""

from types import SimpleNamespace

import numpy as np

from estimator.identification.fit import Fits, Hypothesis, inverted, solved
from estimator.identification.search import settle

REGULAR, SINGULAR = np.array([[2.0, 1.0], [1.0, 4.0]]), np.array([[1.0, 1.0], [1.0, 1.0]])


class Flat:
    """A fitter to which all ratios of the noises are alike."""

    problem = SimpleNamespace(frequency=1.0, scales=SimpleNamespace(order=0))

    def fit(self, hypotheses, start, level):
        count = len(hypotheses)
        return Fits(tuple(hypotheses), np.zeros((count, 1)), np.ones((count, 1, 1)), *np.zeros((3, count)))


def test_a_grid_that_is_widened_to_the_last_has_the_weights_of_its_last_fits():
    found = settle(Flat(), Hypothesis("linear", 0), np.zeros(1), 1.0, reach=1.001)
    assert len(found.weights) == len(found.fits.hypotheses)
    ratios = np.array([h.ratio for h in found.fits.hypotheses])
    np.testing.assert_allclose(found.weights, (1 / (1 + ratios**2) * ratios) / (1 / (1 + ratios**2) * ratios).sum())


def test_a_singular_hypothesis_leaves_the_others_as_they_are():
    both, vectors = np.array([REGULAR, SINGULAR]), np.array([[1.0, 2.0], [1.0, 2.0]])
    np.testing.assert_allclose(inverted(both)[0], np.linalg.inv(REGULAR), rtol=1e-14)
    assert np.isnan(inverted(both)[1]).all(), "no covariance is none of 0, which were certainty"
    np.testing.assert_allclose(solved(both, vectors)[0], np.linalg.solve(REGULAR, vectors[0]), rtol=1e-14)
    np.testing.assert_array_equal(solved(both, vectors)[1], [0.0, 0.0])
