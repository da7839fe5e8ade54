"""The offline baseline: against finite differences, plain loops, known networks and the published row."""

import math
import re

import numpy as np
import pytest
from tables import table

from estimator.inference import pem_narx as module
from estimator.inference.pem_narx import PEMNARX, evaluate_network, network_jacobian

# L (3), d, a (2), c (2), b (3 x 2), and r0. The units bend over the amplitudes that the simulations below reach.
TRUTH = np.array([1.4, -0.8, 0.2, 0.01, 0.05, -0.03, 0.5, -1.0, 8.0, -5.0, 2.0, 4.0, -3.0, 6.0])
MEAN = np.array([0.02, 0.02, 0.005])


def plain_network(parameters, mean, r):
    """f(r) of one regressor vector, term by term."""
    K = (len(parameters) - 4) // 5
    z = [r[i] - mean[i] for i in range(3)]
    f = sum(parameters[i] * z[i] for i in range(3)) + parameters[3]
    for k in range(K):
        s = parameters[4 + K + k] + sum(parameters[4 + 2 * K + i * K + k] * z[i] for i in range(3))
        f += parameters[4 + k] / (1 + math.exp(-s))
    return f


def plain_simulate(parameters, mean, u, y_init, delay, noise=None):
    y = list(y_init)
    for t in range(len(y), len(u)):
        f = plain_network(parameters, mean, (y[t - 1], y[t - 2], u[t - delay]))
        y.append(f + (0.0 if noise is None else noise[t]))
    return np.array(y)


def system(seed, T=1500, delay=0, sigma=0.0):
    rng = np.random.default_rng(seed)
    u = 0.2 * rng.standard_normal(T)
    return u, plain_simulate(TRUTH, MEAN, u, [0.0, 0.0], delay, sigma * rng.standard_normal(T))


def with_parameters(parameters, mean=MEAN, **arguments):
    model = PEMNARX(units=(len(parameters) - 4) // 5, **arguments)
    model.parameters, model.regressor_mean = np.asarray(parameters, dtype=float), mean
    return model


@pytest.fixture(scope="module")
def fitted():
    return PEMNARX(units=2, restarts=2).fit(*system(seed=0))


def test_network_term_by_term():
    z = np.random.default_rng(0).standard_normal((5, 3))
    expected = [plain_network(TRUTH, np.zeros(3), row) for row in z]
    np.testing.assert_allclose(evaluate_network(TRUTH, z), expected, rtol=1e-13)


@table("units", [0, 1, 4])
def test_jacobian_against_central_differences(units):
    rng = np.random.default_rng(units)
    parameters, z = rng.standard_normal(4 + 5 * units), rng.standard_normal((20, 3))
    steps = 1e-5 * np.eye(len(parameters))
    differences = [(evaluate_network(parameters + h, z) - evaluate_network(parameters - h, z)) / 2e-5 for h in steps]
    np.testing.assert_allclose(network_jacobian(parameters, z), np.transpose(differences), atol=1e-9)


@pytest.mark.parametrize("delay", [0, 1])
def test_recovers_a_simulated_network(delay):
    model = PEMNARX(units=2, input_delay=delay, restarts=2).fit(*system(seed=0, delay=delay))
    u, y = system(seed=1, delay=delay)
    linear = PEMNARX(units=0, input_delay=delay).fit(*system(seed=0, delay=delay))
    assert np.abs(linear.predict(u, y) - y).max() > 1e-3  # so a linear model cannot pass the next lines
    assert np.abs(model.predict(u, y) - y).max() < 1e-5
    assert np.abs(model.simulate(u, y[:2]) - y).max() < 1e-4


def test_training_error_is_the_noise_less_the_fitted_part():
    sigma, T = 0.01, 4000
    model = PEMNARX(units=2).fit(*system(seed=2, T=T, sigma=sigma))
    # N mse / sigma^2 has N - 14 degrees of freedom, so its standard deviation is 2.2 % of its mean.
    assert model.training_mse == pytest.approx(sigma**2 * (1 - 14 / T), rel=0.07)


def test_no_units_is_linear_least_squares():
    u, y = system(seed=3, T=200, sigma=0.01)
    columns = np.column_stack([y[1:-1], y[:-2], u[2:], np.ones(198)])
    coefficients = np.linalg.lstsq(columns, y[2:], rcond=None)[0]
    model = PEMNARX(units=0).fit(u, y)
    np.testing.assert_allclose(model.predict(u, y)[2:], columns @ coefficients, atol=1e-12)
    assert model.training_mse == pytest.approx(np.mean((columns @ coefficients - y[2:]) ** 2), rel=1e-9)


@table("delay", [0, 1])
@table("given", [2, 5])
def test_simulate_against_a_plain_loop(delay, given):
    u, y_init = np.random.default_rng(4).standard_normal(300), [0.1, -0.2, 0.3, 0.0, 0.05][:given]
    expected = plain_simulate(TRUTH, MEAN, u, y_init, delay)
    simulated = with_parameters(TRUTH, input_delay=delay).simulate(u, y_init)
    np.testing.assert_allclose(simulated, expected, atol=1e-11)
    np.testing.assert_array_equal(simulated[:given], y_init)


@table("delay", [0, 1])
def test_predict_against_a_plain_loop(delay):
    u, y = np.random.default_rng(5).standard_normal((2, 40))
    expected = [plain_network(TRUTH, MEAN, (y[t - 1], y[t - 2], u[t - delay])) for t in range(2, 40)]
    predicted = with_parameters(TRUTH, input_delay=delay).predict(u, y)
    np.testing.assert_allclose(predicted[2:], expected, rtol=1e-12, atol=1e-13)
    np.testing.assert_array_equal(predicted[:2], y[:2])


@table("delay", [0, 1])
def test_an_input_acts_input_delay_samples_later(delay):
    model = with_parameters(TRUTH, input_delay=delay)
    u, y = np.zeros(20), np.zeros(20)
    pulse = u.copy()
    pulse[10] = 0.1
    assert np.flatnonzero(model.predict(pulse, y) != model.predict(u, y)).tolist() == [10 + delay]
    assert np.flatnonzero(model.simulate(pulse, y[:2]) != model.simulate(u, y[:2]))[0] == 10 + delay


def test_units_of_measurement_do_not_matter(fitted):
    u, y = system(seed=0)
    scaled = PEMNARX(units=2, restarts=2).fit(1024 * u, 512 * y)  # powers of two, so that rounding is the same
    np.testing.assert_allclose(scaled.predict(1024 * u, 512 * y), 512 * fitted.predict(u, y), rtol=1e-12)
    assert scaled.training_mse == pytest.approx(512**2 * fitted.training_mse, rel=1e-6)


def test_same_seed_same_fit(fitted):
    again = PEMNARX(units=2, restarts=2).fit(*system(seed=0))
    other = PEMNARX(units=2, restarts=2, seed=1).fit(*system(seed=0))
    np.testing.assert_array_equal(again.parameters, fitted.parameters)
    assert not np.array_equal(other.parameters, fitted.parameters)


def test_keeps_the_best_restart(monkeypatch):
    monkeypatch.setattr(module, "MAX_EVALUATIONS", 8)  # far from convergence, so that restarts differ
    u, y = system(seed=6, T=300, sigma=0.01)
    errors = [PEMNARX(units=3, restarts=n).fit(u, y).training_mse for n in range(1, 9)]
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < errors[0]


def test_a_diverging_run_is_nan_from_there_on():
    unstable = np.array([3.0, -1.0, 0.0, 0.0, 0.1, 0.0, 1.0, 0.0, 0.0])
    simulated = with_parameters(unstable, mean=np.zeros(3)).simulate(np.zeros(3000), [1.0, 1.0])
    first = int(np.argmax(np.isnan(simulated)))
    assert 2 < first < 3000
    assert np.isnan(simulated[first:]).all()
    assert 1e5 < simulated[first - 1] <= module.DIVERGED_OUTPUT


def test_steep_units_saturate():
    steep = np.array([0.0, 0.0, 0.0, 0.0, 0.3, 1e6, 1e6, 1e6, 1e6])
    simulated = with_parameters(steep, mean=np.zeros(3)).simulate([0, 0, -1e6, 1e6], [0.0, 0.0])
    np.testing.assert_array_equal(simulated[2:], [0.0, 0.3])


@table(
    ("arguments", "message"),
    [
        ({"units": -1}, "units must be a whole number from 0"),
        ({"units": 2.5}, "units must be a whole number from 0"),
        ({"restarts": 0}, "restarts must be a whole number from 1"),
        ({"seed": None}, "seed must be a whole number from 0"),
        ({"input_delay": 2}, "must be a whole number from 0 to 1, but is 2"),
    ],
)
def test_bad_configuration(arguments, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        PEMNARX(**arguments)


@table(
    ("u", "y", "message"),
    [
        (np.arange(40.0), np.arange(39.0), "one length of at least 2, but have 40 and 39"),
        (np.ones((40, 1)), np.arange(40.0), "u must have shape (T,), but has (40, 1)"),
        (np.arange(40.0), np.r_[np.arange(39.0), np.nan], "y[39] is nan; remove or interpolate"),
        (np.arange(14.0), np.arange(14.0), "more than 16 samples to fit 14 parameters, but have 14"),
        (np.full(40, 0.1), np.arange(40.0), "u must vary"),
        (np.arange(40.0), np.full(40, 0.1), "y must vary"),
    ],
)
def test_bad_record(u, y, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        PEMNARX(units=2).fit(u, y)


@table(
    ("u", "y_init", "message"),
    [
        ([0.0, 0.0, np.inf], [0.0, 0.0], "u[2] is inf"),
        ([0.0, 0.0, 0.0], [0.0], "between 2 and len(u) = 3 outputs, but holds 1"),
        ([0.0, 0.0, 0.0], np.zeros(4), "between 2 and len(u) = 3 outputs, but holds 4"),
    ],
)
def test_bad_simulation(fitted, u, y_init, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        fitted.simulate(u, y_init)


def test_fit_comes_first():
    with pytest.raises(RuntimeError, match="call fit"):
        PEMNARX().predict([0.0, 0.0], [0.0, 0.0])
    with pytest.raises(RuntimeError, match="call fit"):
        PEMNARX().simulate([0.0, 0.0], [0.0, 0.0])


@pytest.mark.slow
def test_published_row(record):
    """MATLAB's row: reached to 1 % by the linear model, and beaten by the converged network."""
    prediction, simulation = 5.830793034083989e-05, 1.001367833873263e-03
    u, y = record.arrow.u, record.arrow.y

    def errors(model):
        predicted, simulated = model.predict(u, y), model.simulate(u, y[:2])
        terms = np.append(predicted[3:] - y[3:], -y[2])  # the published mean has one term 0 - y_2
        return np.mean(terms**2), np.mean((simulated[2:] - y[2:]) ** 2)

    linear = PEMNARX(units=0).fit(record.multisine.u, record.multisine.y)
    assert errors(linear) == pytest.approx((prediction, simulation), rel=0.01)
    sigmoid = PEMNARX().fit(record.multisine.u, record.multisine.y)
    assert linear.training_mse == pytest.approx(5.7393e-05, rel=1e-3)
    assert sigmoid.training_mse == pytest.approx(5.695e-05, rel=1e-3)
    assert errors(sigmoid)[0] == pytest.approx(5.714e-05, rel=0.002)
    assert errors(sigmoid)[1] == pytest.approx(8.90e-04, rel=0.02)
