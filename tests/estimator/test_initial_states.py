"""First states that are unknown, as coefficients: in the likelihood, the Fisher information and the online update."""

import re
from dataclasses import replace

import numpy as np
import pytest
from reference.filters import Plant, acting, path
from tables import table

from estimator import OnlineEstimator
from estimator.inference.fisher_information import fisher_information
from estimator.inference.free_run import free_run
from estimator.inference.maximum_a_posteriori import maximum_a_posteriori
from estimator.inference.record_filter import inputs_by_sample, noise_variances, record_likelihoods
from estimator.models.model import Model
from estimator.priors import weak_prior

#: A spring that begins at an unknown position.
SWING = Model(
    "swing",
    {"x": "m", "v": "m/s"},
    {"k": "1", "c": "1", "x0": "m"},
    noise=("0", "1"),
    outputs={"y": "x"},
    rates=("v", "u - k*x - c*v"),
    substeps=2,
    initial_states={"x": "x0"},
)
VALUES = np.array([0.3, 0.1, 0.7])
Q, R = 0.01, 0.02


def along(c, u, y, state_cov):
    plant, slopes = Plant.of(SWING), np.zeros((2, 3))
    slopes[0, 2] = 1.0
    inputs = [acting(plant, u, t, "zero_order") for t in range(len(u))]
    return path(plant, np.array([c[2], 0.0]), state_cov, c, inputs, Q**2, [R**2], y, slopes)


def some_record(samples=30):
    rng = np.random.default_rng(1)
    u = 0.2 * rng.uniform(-1, 1, samples)
    y = along(VALUES, u, None, np.zeros((2, 2))).shown + R * rng.standard_normal((samples, 1))
    return u, y


def test_likelihood_and_information_are_those_of_a_filter_with_matrices():
    u, y = some_record()
    inputs, noises = inputs_by_sample(SWING, u[None]), noise_variances(SWING, Q, R)
    filtered = record_likelihoods(SWING, VALUES[None], inputs, y[None], noises, 1e-2 * np.eye(2))
    expected = along(VALUES, u, y, np.diag([0.0, 1e-2]))
    assert filtered.loss[0] == pytest.approx(expected.loss, rel=1e-10)
    np.testing.assert_allclose(filtered.gradient[0], expected.gradient, rtol=1e-7)
    np.testing.assert_allclose(filtered.information[0], expected.information, rtol=1e-9)
    expected = along(VALUES, u, None, np.zeros((2, 2))).information
    np.testing.assert_allclose(fisher_information(SWING, VALUES, u, Q, R), expected, rtol=1e-9)


def test_slopes_may_be_given():
    """Of a model that does not name the coefficient, the same numbers; spare lanes and finished series change none."""
    u, y = some_record()
    plain = replace(SWING, initial_states={}, outputs={"y": "x + 0*x0"})
    points = VALUES * np.linspace(0.9, 1.1, 9)[:, None]
    inputs, noises = inputs_by_sample(SWING, np.tile(u, (9, 1))), noise_variances(SWING, Q, R)
    inputs[3, 12:] = np.nan
    outputs, cov = np.tile(y, (9, 1, 1)), np.diag([0.0, 1e-2])
    expected = record_likelihoods(SWING, points, inputs, outputs, noises, cov)
    begin, slopes = np.zeros((9, 2)), np.zeros((9, 2, 3))
    begin[:, 0], slopes[:, 0, 2] = points[:, 2], 1.0
    found = record_likelihoods(plain, points, inputs, outputs, noises, cov, begin, initial_state_slopes=slopes)
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12)


def test_a_fit_finds_the_first_state():
    u, y = some_record(60)
    prior = weak_prior(SWING, [0.25, 0.1, 0.0], np.diag([0.01, 0.01, 1.0]), state_std=1e-6)
    fitted = maximum_a_posteriori(SWING, u[None], y[None, :, 0], prior, Q, R)
    assert fitted.converged.all()
    assert np.all(np.abs(fitted.mean[0] - VALUES) < 4 * np.sqrt(np.diag(fitted.cov[0])))
    assert np.sqrt(fitted.cov[0, 2, 2]) < 0.05
    np.testing.assert_allclose(
        free_run(SWING, VALUES, u), free_run(SWING, VALUES, u, state=[VALUES[2], 0.0]), rtol=1e-15
    )


def test_online_the_first_state_is_learned_as_from_the_whole_record():
    """At known k and c the problem is linear, and both are the exact posterior."""
    u, y = some_record()
    prior = weak_prior(SWING, VALUES * [1, 1, 0], np.diag([0, 0, 0.25]), Q, R, noise_shape=1e12, state_std=1e-6)
    assert prior.cov[0, 4] == prior.cov[0, 0] == prior.cov[4, 4] == 0.25
    estimator = OnlineEstimator(SWING, prior)
    estimator.run(u, y[:, 0])
    fitted = maximum_a_posteriori(SWING, u[None], y[None, :, 0], prior, Q, R, "linear")
    mean, std = estimator.belief.coefficients()["x0"]
    assert mean == pytest.approx(fitted.mean[0, 2], rel=1e-6)
    assert std == pytest.approx(np.sqrt(fitted.cov[0, 2, 2]), rel=1e-6)
    assert std < 0.02
    estimator.rewind()
    belief = estimator.belief
    assert belief.state_mean[0] == mean
    assert belief.cov[0, 0] == belief.cov[0, 4] == belief.coefficients_cov[2, 2]
    expected = free_run(SWING, belief.coefficients_mean, u, interpolation="linear")
    np.testing.assert_allclose(estimator.simulate(u, y[:2, 0])[10:], expected[10:], atol=0.05)


@table(
    ("initial_states", "words"),
    [
        ({"z": "x0"}, "initial_states must give a state of ['x', 'v'] a coefficient of ['k', 'c', 'x0'], but"),
        ({"x": "start"}, "'x': 'start'"),
        ({}, "coefficients must stand in an expression, but ['x0'] do not"),
        ("x0", "initial_states must be"),
    ],
)
def test_what_does_not_fit_is_refused(initial_states, words):
    with pytest.raises(ValueError, match=re.escape(words)):
        replace(SWING, initial_states=initial_states)
