"""Maximum a posteriori: against a general optimiser on a plain likelihood, and calibration on simulated truth."""

import numpy as np
import pytest
from reference.filters import central, filter_paper
from scipy.optimize import minimize

from estimator import SILVERBOX_TWIN, difference, silverbox_prior, weak_prior
from estimator.inference.maximum_a_posteriori import maximum_a_posteriori
from estimator.models.pendulum import PENDULUM
from estimator.rigs.physical_parameters import coefficients_of

PAPER = difference()
NOISES = (5e-4, 5e-4)
PRIOR = silverbox_prior(PAPER, 0.3, *NOISES)


def simulate(systems, samples, rng, process=NOISES[0]):
    """Systems from rest under uniform inputs: true coefficients (n, 4), u and y (n, T)."""
    center = np.array([SILVERBOX_TWIN.m, SILVERBOX_TWIN.c, SILVERBOX_TWIN.a, SILVERBOX_TWIN.b])
    drawn = center * np.exp(rng.uniform(np.log(0.7), np.log(1.3), (systems, 4)))
    psi = coefficients_of(PAPER, dict(zip("mcab", drawn.T, strict=True)))
    u, y = rng.uniform(-0.15, 0.15, (systems, samples)), np.empty((systems, samples))
    x = last = np.zeros(systems)
    for t in range(samples):
        w, v = rng.standard_normal((2, systems))
        x, last = psi[:, 0] * x + psi[:, 1] * x**3 + psi[:, 2] * last + psi[:, 3] * u[:, t] + process * w, x
        y[:, t] = x + NOISES[1] * v
    return psi, u, y


def objective(psi, u, y):
    """L(ψ) of the module's docstring, with matrices."""
    innovations, variances = filter_paper(psi, u, y, NOISES[0] ** 2, NOISES[1] ** 2, PRIOR.state_cov)
    pull = psi - PRIOR.coefficients_mean
    loss = 0.5 * (innovations**2 / variances + np.log(variances)).sum()
    return loss + 0.5 * pull @ np.linalg.solve(PRIOR.coefficients_cov, pull)


def test_the_mode_is_that_of_the_posterior():
    _, u, y = simulate(3, 150, np.random.default_rng(0))
    fit = maximum_a_posteriori(PAPER, u, y, PRIOR, *NOISES)
    assert fit.converged.all()
    for row in range(3):
        std = np.sqrt(np.diag(fit.cov[row]))
        found = minimize(lambda z: objective(fit.mean[row] + std * z, u[row], y[row]), np.zeros(4), method="Powell")  # noqa: B023
        assert np.abs(found.x).max() < 1e-3
        assert found.fun > objective(fit.mean[row], u[row], y[row]) - 1e-6
        slope = central(lambda z: objective(fit.mean[row] + std * z, u[row], y[row]), np.zeros(4), 0.01)  # noqa: B023
        assert np.abs(slope).max() < 1e-6


def test_it_is_calibrated():
    psi, u, y = simulate(200, 256, np.random.default_rng(1))
    fit = maximum_a_posteriori(PAPER, u, y, PRIOR, *NOISES)
    std = np.sqrt(np.diagonal(fit.cov, axis1=1, axis2=2))
    covered = (np.abs(fit.mean - psi) < 1.645 * std).mean(axis=0)
    assert fit.converged.all()
    assert (covered > 0.84).all()
    assert (covered < 0.96).all()


def test_of_several_starts_the_deepest_minimum_is_kept():
    rng = np.random.default_rng(4)
    psi, u, y = simulate(20, 256, rng, process=1e-5)
    wide = np.array([0.3, 0.4, 0.3, 0.1])
    prior = weak_prior(PAPER, psi.mean(axis=0) - wide, np.diag(wide**2))
    alone = maximum_a_posteriori(PAPER, u, y, prior, 1e-5, NOISES[1])
    fit = maximum_a_posteriori(PAPER, u, y, prior, 1e-5, NOISES[1], starts=[psi])
    worst = [
        (np.abs(found.mean - psi) / np.sqrt(np.diagonal(found.cov, axis1=1, axis2=2))).max() for found in (alone, fit)
    ]
    assert worst[0] > 1000, "the prior's mean leads astray"
    assert worst[1] < 4
    assert fit.converged.all()
    # A start that leads nowhere, or to the same minimum, changes nothing.
    again = maximum_a_posteriori(PAPER, u, y, prior, 1e-5, NOISES[1], starts=[psi, fit.mean, psi + 100.0])
    np.testing.assert_array_equal(again.mean, fit.mean)


def test_episodes_of_different_lengths_fit_into_one_array():
    _, u, y = simulate(2, 100, np.random.default_rng(2))
    short = maximum_a_posteriori(PAPER, u[:, :40], y[:, :40], PRIOR, *NOISES)
    u[:, 40:] = y[:, 40:] = np.nan
    padded = maximum_a_posteriori(PAPER, u, y, PRIOR, *NOISES)
    np.testing.assert_array_equal(padded.mean, short.mean)
    np.testing.assert_array_equal(padded.cov, short.cov)


def test_without_samples_it_is_the_prior():
    fit = maximum_a_posteriori(PAPER, np.full((1, 3), np.nan), np.full((1, 3), np.nan), PRIOR, *NOISES)
    np.testing.assert_allclose(fit.mean[0], PRIOR.coefficients_mean, rtol=1e-14)
    np.testing.assert_allclose(fit.cov[0], PRIOR.coefficients_cov, rtol=1e-9)


def test_what_does_not_fit_is_refused():
    with pytest.raises(ValueError, match="u and y must have one shape"):
        maximum_a_posteriori(PAPER, np.zeros((2, 3)), np.zeros((2, 4)), PRIOR, *NOISES)
    with pytest.raises(ValueError, match="process_noise must be 0 or more"):
        maximum_a_posteriori(PAPER, np.zeros((2, 3)), np.zeros((2, 3)), PRIOR, -1.0, 1e-4)
    with pytest.raises(ValueError, match="prior must have the coefficients"):
        maximum_a_posteriori(PENDULUM, np.zeros((2, 3)), np.zeros((2, 3, 2)), PRIOR, 1e-3, 1e-3)
    zeros = np.zeros((2, 3))
    with pytest.raises(
        ValueError, match=r"starts\[1\] must be coefficients of every record, of shape \(2, 4\), but has"
    ):
        maximum_a_posteriori(PAPER, zeros, zeros, PRIOR, *NOISES, starts=[np.zeros((2, 4)), np.zeros(4)])
    with pytest.raises(ValueError, match="u must not be a masked array"):
        maximum_a_posteriori(PAPER, np.ma.masked_array(zeros), zeros, PRIOR, *NOISES)


def test_it_fits_other_models_and_leaves_alone_what_is_known():
    rng = np.random.default_rng(3)
    truth, std = np.array([0.0365, 0.01, 0.0074]), np.array([5e-3, 0.0, 1e-3])
    u, y, q, r = rng.choice([-3.0, 3.0], (30, 120)), np.zeros((30, 120, 2)), 1e-3, 5e-3
    for row in range(30):
        x, v = 0.0, 0.0
        for t in range(120):
            for _ in range(50):  # Euler's steps in the small
                w = np.sqrt(3 / 50) * q * rng.standard_normal()
                x, v = x + v / 50, v + (truth[2] * u[row, t] - truth[1] * v - truth[0] * np.sin(x)) / 50 + w
            y[row, t] = x, v
    y += r * rng.standard_normal(y.shape)
    prior = weak_prior(PENDULUM, truth + std, np.diag(std**2))
    fit = maximum_a_posteriori(PENDULUM, u, y, prior, q, [r, r])
    assert fit.converged.all()
    assert (fit.mean[:, 1] == truth[1]).all()
    assert (fit.cov[:, 1] == 0).all()
    spread = np.sqrt(np.diagonal(fit.cov, axis1=1, axis2=2))[:, [0, 2]]
    assert (spread < 0.2 * std[[0, 2]]).all()
    # The mean over records is off by no more than Euler's steps are.
    assert (np.abs((fit.mean - truth)[:, [0, 2]] / spread).mean(axis=0) < 1.5).all()
