"""Coverage of the physical equation: sigma points hold their intervals where the first order does not."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.stats import binom, chi2

from benchmarks import coverage_sigma
from benchmarks.coverage import LEVEL, QUANTILE
from benchmarks.coverage_sigma import MEASUREMENT_NOISE, MODEL, Config, draw, errors, simulate
from estimator import recorded_prior

SYSTEMS = 100
TAIL = 1e-4  # chance that a calibrated posterior misses one bound of one check


def identified(expectations, spread, samples):
    rng = np.random.default_rng(0)
    prior = recorded_prior(MODEL, spread, measurement_noise=MEASUREMENT_NOISE)
    truth = draw(spread, SYSTEMS, rng)
    return errors(prior, expectations, truth, *simulate(truth, samples, rng))


def assert_calibrated(normalised, nees):
    """Hits are binomial with p = 0.9: from 77 to 99 of 100. The sum of the NEES is chi-squared with 7 for each."""
    hits = (np.abs(normalised) <= QUANTILE).sum(axis=0)
    assert (binom.ppf(TAIL, SYSTEMS, LEVEL) <= hits).all()
    assert (hits <= binom.isf(TAIL, SYSTEMS, LEVEL)).all()
    freedoms = 7 * SYSTEMS
    assert chi2.ppf(TAIL, freedoms) <= 7 * nees.sum() <= chi2.isf(TAIL, freedoms)


@pytest.mark.slow  # seconds of compilation
def test_sigma_points_hold_the_truth():
    assert_calibrated(*identified("sigma_points", 0.1, 256))
    normalised, nees = identified("sigma_points", 0.3, 256)
    assert (np.abs(normalised) <= QUANTILE).mean() > 0.8
    assert np.median(nees) < 1.3


def test_the_first_order_does_not():
    with pytest.raises(AssertionError):
        assert_calibrated(*identified("first_order", 0.1, 256))
    normalised, nees = identified("first_order", 0.3, 256)
    assert (np.abs(normalised) <= QUANTILE).mean() < 0.75
    assert nees.mean() > 10


def test_simulated_oscillators_obey_the_equation(monkeypatch):
    monkeypatch.setattr(coverage_sigma, "MEASUREMENT_NOISE", 0.0)
    monkeypatch.setattr(coverage_sigma, "PROCESS_NOISE", 0.0)
    rng = np.random.default_rng(1)
    truth = draw(0.3, 3, rng)
    u, y = simulate(truth, 60, rng)
    u = np.column_stack([np.zeros(3), u])  # before the first
    time = np.arange(61.0)
    for (k, c, g, b, u0, y0, d), u_i, y_i in zip(truth, u, y, strict=True):

        def rates(t, state):
            force = np.interp(t, time, u_i) - u0  # noqa: B023
            return [state[1], g * force - c * state[1] - k * state[0] - b * state[0] ** 3]  # noqa: B023

        x = solve_ivp(rates, time[[0, -1]], [0.0, 0.0], t_eval=time, rtol=1e-9, atol=1e-12, max_step=1.0).y[0]
        np.testing.assert_allclose(y_i, (x + y0 + d * u_i)[1:], atol=1e-6)


def test_systems_are_drawn_from_the_prior():
    truth = draw(0.5, 2000, np.random.default_rng(2))
    mean = recorded_prior(MODEL).coefficients()
    assert (truth[:, :4] >= 0.1 * np.array([mean[n][0] for n in ("stiffness", "damping", "gain", "cubic")])).all()
    np.testing.assert_allclose(truth[:, 4:].std(axis=0), [0.02, 0.02, 0.1], rtol=0.1)


@pytest.mark.slow  # seconds of compilation
def test_the_command_prints_its_tables(capsys, monkeypatch):
    monkeypatch.setattr(coverage_sigma, "LENGTHS", (64,))
    coverage_sigma.main(Config(systems=2))
    printed = capsys.readouterr().out
    assert "noise prior centred at 0.3 mV" in printed
    assert printed.count("| sigma_points | 64 ") == 2
