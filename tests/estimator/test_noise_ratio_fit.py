"""The posterior over noise ratios, and batches of linear equations, where hypotheses go wrong."""

from types import SimpleNamespace

import numpy as np

from estimator.identification.fitting.noise_ratio_fit import fit_noise_ratio
from estimator.identification.likelihood.batch_linear_algebra import invert_batch, solve_batch
from estimator.identification.likelihood.fit_hypothesis import FitHypothesis, LaplaceFits

REGULAR, SINGULAR = np.array([[2.0, 1.0], [1.0, 4.0]]), np.array([[1.0, 1.0], [1.0, 1.0]])


class Flat:
    """A fitter to which all ratios of the noises are alike."""

    problem = SimpleNamespace(mean_frequency=1.0, scales=SimpleNamespace(order=0))

    def fit(self, hypotheses, initial_coefficients, initial_sensor_std):
        count = len(hypotheses)
        return LaplaceFits(tuple(hypotheses), np.zeros((count, 1)), np.ones((count, 1, 1)), *np.zeros((3, count)))


def test_a_grid_that_is_widened_to_the_last_has_the_weights_of_its_last_fits():
    found = fit_noise_ratio(Flat(), FitHypothesis("linear", 0), np.zeros(1), 1.0, ratio_reach=1.001)
    assert len(found.weights) == len(found.fits.hypotheses)
    ratios = np.array([h.noise_ratio for h in found.fits.hypotheses])
    np.testing.assert_allclose(found.weights, (1 / (1 + ratios**2) * ratios) / (1 / (1 + ratios**2) * ratios).sum())


def test_a_singular_hypothesis_leaves_the_others_as_they_are():
    both, vectors = np.array([REGULAR, SINGULAR]), np.array([[1.0, 2.0], [1.0, 2.0]])
    np.testing.assert_allclose(invert_batch(both)[0], np.linalg.inv(REGULAR), rtol=1e-14)
    assert np.isnan(invert_batch(both)[1]).all(), "no covariance is none of 0, which were certainty"
    np.testing.assert_allclose(solve_batch(both, vectors)[0], np.linalg.solve(REGULAR, vectors[0]), rtol=1e-14)
    np.testing.assert_array_equal(solve_batch(both, vectors)[1], [0.0, 0.0])
