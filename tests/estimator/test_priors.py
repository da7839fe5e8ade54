"""Priors: moments against Monte Carlo, closed forms and finer quadrature, the published numbers, errors."""

import os
import re
import subprocess
import sys

import numpy as np
import pytest
from tables import table

from estimator import (
    SILVERBOX_ODE_TWIN,
    SILVERBOX_SAMPLING_STEP,
    SILVERBOX_TWIN,
    Parameters,
    coefficients_of,
    difference,
    duffing,
    paper_text_prior,
    published_run_prior,
    silverbox_prior,
)
from estimator import priors as module
from estimator.models.pendulum import PENDULUM
from estimator.priors import log_uniform_moments, weak_prior

PAPER = difference()
OSCILLATOR = Parameters(m=5e-6, c=2e-4, a=1.0, b=4.0)
MODELS = {"paper": PAPER, "linear": difference("linear"), "duffing": duffing()}


@pytest.mark.parametrize("name", MODELS)
def test_log_uniform_moments_equal_monte_carlo(name):
    rng, spread, model = np.random.default_rng(4), 0.4, MODELS[name]
    mean, cov = log_uniform_moments(model, OSCILLATOR, spread)
    factors = np.exp(rng.uniform(np.log(1 - spread), np.log(1 + spread), (4, 200_000)))
    drawn = {key: value * row for (key, value), row in zip(OSCILLATOR.items(), factors, strict=True)}
    samples = coefficients_of(model, drawn)
    deviations, root = samples - mean, np.sqrt(len(samples))
    products = deviations[:, :, None] * deviations[:, None, :]
    assert np.abs(deviations.mean(axis=0) / (samples.std(axis=0) / root)).max() < 4.5
    assert np.abs((products.mean(axis=0) - cov) / (products.std(axis=0) / root)).max() < 4.5


def test_log_uniform_moments_obey_closed_forms():
    spread = 0.6
    mean, cov = log_uniform_moments(PAPER, OSCILLATOR, spread)
    width = np.log((1 + spread) / (1 - spread))
    b_mean = OSCILLATOR.b * 2 * spread / width
    b_square = OSCILLATOR.b**2 * 2 * spread / width  # ((1 + s)² - (1 - s)²) / 2 = 2 s
    eta_square = cov[3, 3] + mean[3] ** 2
    # θ2 = -b η, where b and η are independent.
    assert mean[1] == pytest.approx(-b_mean * mean[3], rel=1e-12)
    assert cov[1, 3] == pytest.approx(-b_mean * cov[3, 3], rel=1e-11)
    assert cov[1, 1] == pytest.approx(b_square * eta_square - mean[1] ** 2, rel=1e-11)


@pytest.mark.parametrize("spread", [0.5, 0.999])
def test_log_uniform_moments_have_converged(spread, monkeypatch):
    # A c δ as large as m makes the coefficients as nonlinear as they get.
    center = Parameters({**OSCILLATOR, "c": OSCILLATOR.m / SILVERBOX_SAMPLING_STEP})
    mean, cov = log_uniform_moments(PAPER, center, spread)
    monkeypatch.setattr(module, "_MAX_NODES_PER_AXIS", 25)
    monkeypatch.setattr(module, "_MAX_NODES", 25**4)
    finer_mean, finer_cov = log_uniform_moments(PAPER, center, spread)
    deviations = np.sqrt(np.diag(finer_cov))
    assert np.abs((mean - finer_mean) / deviations).max() < 1e-10
    assert np.abs((cov - finer_cov) / np.outer(deviations, deviations)).max() < 1e-10


@table("name", MODELS)
def test_no_spread_is_the_map_itself(name):
    mean, cov = log_uniform_moments(MODELS[name], OSCILLATOR, 0.0)
    np.testing.assert_allclose(mean, coefficients_of(MODELS[name], OSCILLATOR), rtol=1e-13)
    np.testing.assert_allclose(cov, 0, atol=1e-25)


def test_a_narrow_prior_has_the_relative_variances_of_quotients():
    # Of a factor it is spread² / 3, of the quotient of two twice that.
    prior = silverbox_prior(duffing(), spread=1e-5)
    ratios = np.diag(prior.coefficients_cov) / prior.coefficients_mean**2 / 1e-5**2
    np.testing.assert_allclose(ratios, [2 / 3, 2 / 3, 2 / 3, 1 / 3], rtol=1e-2)


def test_log_uniform_moments_do_not_depend_on_threads():
    """Environments start from these moments: a last digit that moves would make every episode another one."""
    program = "from estimator import silverbox_prior; print(silverbox_prior().coefficients_cov.tobytes().hex())"
    printed = set()
    for threads in ("1", "2"):
        environment = os.environ | {"OPENBLAS_NUM_THREADS": threads, "OMP_NUM_THREADS": threads}
        done = subprocess.run(
            [sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True
        )
        printed.add(done.stdout)
    assert len(printed) == 1


@pytest.mark.parametrize(
    ("model", "twin"), [(PAPER, SILVERBOX_TWIN), (duffing(), SILVERBOX_ODE_TWIN)], ids=["paper", "duffing"]
)
def test_silverbox_prior_matches_the_oscillators_it_is_drawn_from(model, twin):
    prior = silverbox_prior(
        model, spread=0.2, process_noise=1e-3, measurement_noise=2e-4, noise_shape=3.0, state_std=0.01
    )
    mean, cov = log_uniform_moments(model, twin, 0.2)
    np.testing.assert_array_equal(prior.coefficients_mean, mean)
    np.testing.assert_array_equal(prior.coefficients_cov, cov)
    np.testing.assert_array_equal(prior.state_mean, [0.0, 0.0])
    np.testing.assert_allclose(prior.state_cov, 1e-4 * np.eye(2), rtol=1e-12)
    assert prior.noises[[0, 2]].tolist() == [3.0, 3.0]
    assert prior.gamma_mean**-0.5 == pytest.approx(1e-3, rel=1e-12)
    assert prior.xi_mean**-0.5 == pytest.approx(2e-4, rel=1e-12)


@pytest.mark.parametrize(
    ("prior", "eta", "precision", "noises"),
    [(published_run_prior, 2.0, 1e2, [1e8, 1e3, 1e8, 1e1]), (paper_text_prior, 1.0, 0.1, [1e3, 1e1, 1e8, 1e3])],
    ids=["published run", "paper's text"],
)
def test_the_papers_priors(prior, eta, precision, noises):
    one = prior()
    assert one.coefficients_mean.tolist() == [1.0, 1.0, 1.0, eta]
    np.testing.assert_allclose(np.linalg.inv(one.coefficients_cov), np.diag([0.1, 0.1, 0.1, precision]), rtol=1e-14)
    assert one.state_mean.tolist() == [0.0, 0.0]
    np.testing.assert_allclose(np.linalg.inv(one.state_cov), 0.1 * np.eye(2), rtol=1e-14)
    assert one.noises.tolist() == noises
    # Without the cubic term θ2 is known to be 0, or is not there.
    known, linear, rest = prior(False), prior(model=difference("linear")), [0, 2, 3]
    assert known.coefficients_mean.tolist() == [1.0, 0.0, 1.0, eta]
    np.testing.assert_array_equal(known.coefficients_cov[1], 0.0)
    np.testing.assert_array_equal(linear.coefficients_mean, known.coefficients_mean[rest])
    np.testing.assert_array_equal(linear.coefficients_cov, known.coefficients_cov[np.ix_(rest, rest)])
    np.testing.assert_array_equal(linear.noises, one.noises)
    mean, cov = known.physical()
    assert mean[3] == 0.0
    np.testing.assert_array_equal(cov[3], 0.0)


def test_mean_field_begins_without_correlations_of_states_theta_and_eta():
    cov = np.full((6, 6), 0.01) + np.eye(6)
    prior = published_run_prior()
    joint = type(prior).of(PAPER, prior.mean, cov, (2.0, 1.0), (2.0, 1.0))
    apart = joint.with_factorisation("mean_field")
    assert apart.factorisation == "mean_field"
    parts = np.zeros((6, 6))
    for part in (slice(0, 2), slice(2, 5), slice(5, 6)):
        parts[part, part] = cov[part, part]
    np.testing.assert_array_equal(apart.cov, parts)
    np.testing.assert_array_equal(apart.mean, joint.mean)
    assert joint.with_factorisation("structured") == joint


@table(
    ("call", "message"),
    [
        (lambda: silverbox_prior(process_noise=0.0), "process_noise must be a number from 1e-60 to 1e+60, but is 0.0"),
        (
            lambda: silverbox_prior(measurement_noise=np.nan),
            "measurement_noise must be a number from 1e-60 to 1e+60, but is nan",
        ),
        (lambda: silverbox_prior(noise_shape=0.0), "noise_shape must be a number from 1e-60 to 1e+60, but is 0.0"),
        (lambda: silverbox_prior(state_std=0.0), "state_std must be a number from 1e-60 to 1e+60, but is 0.0"),
        (lambda: silverbox_prior(spread=1.0), "spread must be a number from 1e-09 to 0.999999999, but is 1.0"),
        (lambda: silverbox_prior(spread=0.0), "spread must be a number from 1e-09 to 0.999999999, but is 0.0"),
        (lambda: silverbox_prior(PENDULUM), "model must have the parameters m, c, a and b, but pendulum has"),
        (lambda: silverbox_prior(duffing(offsets=True)), "model must have the parameters m, c, a and b, but duffing"),
        (lambda: log_uniform_moments(PAPER, OSCILLATOR, 1.0), "from 0 to 0.999999999, but is 1.0"),
        (lambda: log_uniform_moments(PAPER, OSCILLATOR, np.nan), "but is nan; log-uniform intervals do not reach 0"),
        (lambda: silverbox_prior(process_noise=1e300), "process_noise must be a number from 1e-60"),
        (lambda: silverbox_prior(process_noise=1e-300), "process_noise must be a number from 1e-60"),
        (lambda: weak_prior(PAPER, "abc", np.eye(4)), "mean must be numbers, but is 'abc'"),
        (lambda: weak_prior(PAPER, np.ones(3), np.eye(4)), "mean and cov must have shapes (4,) and (4, 4)"),
        (lambda: weak_prior(PAPER, np.ones(4), np.eye(4), state_std=[1.0, 2.0, 3.0]), "state_std must be one number"),
        (lambda: log_uniform_moments(PAPER, {**OSCILLATOR, "b": 0.0}, 0.1), "center must have a finite b other than 0"),
        (lambda: log_uniform_moments(PAPER, {"m": 1.0}, 0.1), "center must have a finite c other than 0"),
    ],
)
def test_bad_input_is_named(call, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        call()
