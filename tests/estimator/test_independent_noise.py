"""Process noise of its own for each state: declaration, likelihood, Fisher information and online update."""

import re
from dataclasses import replace

import numpy as np
import pytest
from reference.filters import Plant, acting, path
from tables import table

from estimator import OnlineEstimator, difference, duffing
from estimator.inference.fisher_information import fisher_information
from estimator.inference.maximum_a_posteriori import maximum_a_posteriori
from estimator.inference.record_filter import inputs_by_sample, noise_variances, record_likelihoods
from estimator.models.model import Model
from estimator.models.noise_ratios import scale_noise_sources
from estimator.priors import weak_prior

#: Two coupled states, each with noise of its own.
CHAIN = Model(
    "chain",
    {"x": "V", "w": "V"},
    {"loss": "1", "gain": "1"},
    noise=("1", "1"),
    outputs={"y": "x"},
    next_state=("0.5*x + 0.4*w + gain*u", "loss*w + 0.2*x"),
    independent_noise=True,
)

#: A spring with noise in position and velocity.
SPRING = Model(
    "spring",
    {"x": "m", "v": "m/s"},
    {"k": "1", "c": "1"},
    noise=("0.5", "1.5"),
    outputs={"y": "x", "z": "v"},
    rates=("v", "u - k*x - c*v"),
    substeps=2,
    independent_noise=True,
)
MODELS = {"added": (CHAIN, (0.6, 0.8)), "white": (SPRING, (0.5, 0.2)), "held": (replace(SPRING, held=True), (0.5, 0.2))}
RATIOS = {"x": 3.0, list(CHAIN.states)[1]: 0.2}


def along(model, c, u, y, q, r, ratios, slopes=None, state=None):
    plant = Plant.of(model, ratios)
    inputs = [acting(plant, u, t, "zero_order") for t in range(len(u))]
    n = model.n_states
    z = np.zeros(n) if state is None else state
    return path(plant, z, 1e-4 * np.eye(n), np.array(c), inputs, q**2, [r**2] * model.n_outputs, y, slopes)


@pytest.mark.parametrize("name", MODELS)
def test_likelihood_and_information_are_those_of_a_filter_with_matrices(name):
    model, c = MODELS[name]
    rng, q, r = np.random.default_rng(3), 0.02, 0.01
    u = rng.uniform(-1, 1, 25)
    first, second = model.states
    given = {first: 3.0, second: np.array([0.2, 1.0])}
    noises = noise_variances(model, q, r, given)
    assert noises.shape == (2, 1 + model.n_outputs + 2)
    y = along(model, c, u, None, q, r, (1, 1)).shown + r * rng.standard_normal((25, model.n_outputs))
    filtered = record_likelihoods(
        model,
        np.array([c, c]),
        inputs_by_sample(model, np.array([u, u])),
        np.array([y, y]),
        noises,
        1e-4 * np.eye(2),
    )
    information = fisher_information(model, c, u, q, r, y=y, state_std=1e-2, process_ratios=given)
    for row, ratios in enumerate([(3.0, 0.2), (3.0, 1.0)]):
        expected = along(model, c, u, y, q, r, ratios)
        assert filtered.loss[row] == pytest.approx(expected.loss, rel=1e-10)
        np.testing.assert_allclose(filtered.gradient[row], expected.gradient, rtol=1e-7)
        np.testing.assert_allclose(filtered.information[row], expected.information, rtol=1e-9)
        np.testing.assert_array_equal(information[row], filtered.information[row])
    assert abs(filtered.loss[0] - filtered.loss[1]) > 0.1


@pytest.mark.parametrize("name", MODELS)
def test_ratios_declared_and_given_are_the_same(name):
    model, c = MODELS[name]
    u = np.random.default_rng(4).uniform(-1, 1, 25)
    first, second = model.states
    ratios = {first: 2.0, second: 0.3}
    declared = fisher_information(scale_noise_sources(model, ratios), c, u, 0.02, 0.01)
    np.testing.assert_allclose(fisher_information(model, c, u, 0.02, 0.01, process_ratios=ratios), declared, rtol=1e-12)
    assert np.abs(fisher_information(model, c, u, 0.02, 0.01) / declared - 1).max() > 0.05


def test_estimates_of_ratios_given_and_declared_agree():
    rng, n, samples = np.random.default_rng(5), 3, 60
    u, y = rng.uniform(-1, 1, (n, samples)), np.empty((n, samples))
    x = w = np.zeros(n)
    for t in range(samples):
        x, w = 0.5 * x + 0.4 * w + 0.8 * u[:, t], 0.6 * w + 0.2 * x + 0.3 * rng.standard_normal(n)
        y[:, t] = x + 0.05 * rng.standard_normal(n)
    prior = weak_prior(CHAIN, [0.5, 1.0], 0.1 * np.eye(2))
    ratios = {"x": 0.01, "w": 30.0}
    given = maximum_a_posteriori(CHAIN, u, y, prior, 0.01, 0.05, process_ratios=ratios)
    declared = scale_noise_sources(CHAIN, ratios)
    fitted = maximum_a_posteriori(declared, u, y, replace(prior, model=declared), 0.01, 0.05)
    np.testing.assert_allclose(given.mean, fitted.mean, rtol=1e-6)
    assert given.converged.all()


def test_the_online_update_of_a_linear_model_is_a_kalman_filter():
    """With coefficients and noises known, against the matrices of the declared noise."""
    model, q, r = scale_noise_sources(CHAIN, {"w": 4.0}), 0.05, 0.1
    prior = weak_prior(model, [0.6, 0.8], np.zeros((2, 2)), q, r, noise_shape=1e12, state_std=0.3)
    rng = np.random.default_rng(6)
    u, y = rng.uniform(-1, 1, 20), rng.standard_normal(20)
    estimator = OnlineEstimator(model, prior)
    estimator.run(np.append(u[1:], 0.0), y)  # the newest input is one sample late in a difference equation's rig
    F, Q = np.array([[0.5, 0.4], [0.2, 0.6]]), np.diag([q**2, (4 * q) ** 2])
    z, P = np.zeros(2), 0.09 * np.eye(2)
    acting_inputs = np.concatenate([[0.0], np.append(u[1:], 0.0)[:-1]])
    for t in range(20):
        z, P = F @ z + [0.8 * acting_inputs[t], 0.0], F @ P @ F.T + Q
        gain = P[:, 0] / (P[0, 0] + r**2)
        z, P = z + gain * (y[t] - z[0]), P - np.outer(gain, P[0])
    np.testing.assert_allclose(estimator.belief.state_mean, z, rtol=1e-8)
    np.testing.assert_allclose(estimator.belief.state_cov, P, rtol=1e-8)


def test_digests_and_files_of_other_models_do_not_change():
    """The digests are in the names of stored oracles."""
    assert (duffing().digest, difference().digest) == ("051e5b60588f", "c41def760f93")
    assert "independent_noise" not in duffing().to_dict()
    assert Model(**CHAIN.to_dict()) == CHAIN
    assert CHAIN.digest != replace(CHAIN, independent_noise=False).digest


@table(
    ("call", "words"),
    [
        (lambda: replace(CHAIN, independent_noise=1), "independent_noise must be"),
        (lambda: scale_noise_sources(CHAIN, {"y": 1.0}), "ratios must be of states with independent noise, ['x', 'w']"),
        (lambda: scale_noise_sources(CHAIN, {"w": 0.0}), "ratios of w must be"),
        (lambda: scale_noise_sources(duffing(), {"x": 2.0}), "independent_noise=True"),
        (lambda: noise_variances(CHAIN, 1.0, 1.0, {"z": 1.0}), "process_ratios must be of states"),
        (lambda: noise_variances(CHAIN, 1.0, 1.0, {"w": -1.0}), "process_ratios['w'] must be 0 or more"),
        (lambda: noise_variances(CHAIN, np.ones(3), 1.0, {"w": np.ones(2)}), "must be batches of one size"),
    ],
)
def test_what_does_not_fit_is_refused(call, words):
    with pytest.raises(ValueError, match=re.escape(words)):
        call()
