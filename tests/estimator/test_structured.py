"""The structured update against its plain twin, and against what its free energy must be."""

import numpy as np
import pytest
from scipy.stats import norm
from twins import Moments, assert_same_moments, block_of, draw_variances, random_prior, records_of, structured_step

from estimator.inference import free_energy, update
from estimator.lanes import LANES

NO_TRACE = np.empty(0)
DRAWS = 20_000


def samples(rng):
    return rng.normal(0.0, 0.1, LANES), rng.normal(0.0, 0.2, LANES)


def linearised(prior, u):
    """Mean and variance of g + η u, to first order."""
    x, x_last, _, t1, t2, t3, eta = prior.mean
    slope = np.array([t1 + 3 * t2 * x**2, t3, 0.0, x, x**3, x_last, u])
    return t1 * x + t2 * x**3 + t3 * x_last + eta * u, slope @ prior.cov @ slope


@pytest.mark.parametrize("nonlinear", [True, False])
def test_update_equals_its_twin(nonlinear):
    rng = np.random.default_rng(0)
    for iterations in range(1, 11):
        priors = [random_prior(rng, nonlinear=nonlinear) for _ in range(LANES)]
        for _ in range(2):
            u, y = samples(rng)
            block, trace = block_of([prior.to_record() for prior in priors], u, y), np.empty(iterations)
            update(block, True, iterations, False, trace)
            posteriors = [Moments.of_record(record) for record in records_of(block)]
            for j in range(LANES):
                twin, free_energies = structured_step(priors[j], u[j], y[j], iterations, nonlinear)
                assert_same_moments(posteriors[j], twin)
                # The twin's lnΓ of shapes up to 1e3 and its 7×7 solves round at 1e-11 nats.
                assert free_energy(block, j, True) == pytest.approx(free_energies[-1], rel=1e-9, abs=1e-9)
                if j == 0:
                    np.testing.assert_allclose(trace, free_energies, rtol=1e-9, atol=1e-9)
            priors = posteriors


def test_lanes_are_independent():
    rng = np.random.default_rng(1)
    priors = np.array([random_prior(rng).to_record() for _ in range(LANES)])
    u, y = samples(rng)
    mixed = block_of(priors, u, y)
    update(mixed, True, 3, False, NO_TRACE)
    for j in range(LANES):
        uniform = block_of([priors[j]] * LANES, u[j], y[j])
        update(uniform, True, 3, False, NO_TRACE)
        np.testing.assert_array_equal(
            records_of(uniform), np.broadcast_to(records_of(mixed)[j], (LANES, len(priors[j])))
        )


def test_known_noises_make_it_a_kalman_filter_and_the_free_energy_the_surprise():
    # With shapes of 1e12 the noises stay where they are; then F is -log N(y | prediction, S), which is exact.
    rng = np.random.default_rng(2)
    prior = random_prior(rng)
    q, r, shape = 0.01**2, 0.02**2, 1e12
    known = Moments(prior.mean, prior.cov, (shape, shape * q), (shape, shape * r))
    u, y = samples(rng)
    block = block_of([known.to_record()] * LANES, u, y)
    update(block, True, 3, False, NO_TRACE)
    for j in range(LANES):
        prediction, variance = linearised(prior, u[j])
        # Both KL[q(γ)] and KL[q(ξ)] are below (ν²/r)² / shape, which is 1e-8 nats here.
        surprise = -norm.logpdf(y[j], prediction, np.sqrt(variance + q + r))
        assert free_energy(block, j, True) == pytest.approx(surprise, abs=1e-7)


def test_free_energy_never_rises_and_bounds_the_surprise():
    # The iterations are coordinate descent on F of the linearised model, and F >= -log p(y) for any noise prior.
    rng = np.random.default_rng(3)
    for _ in range(20):
        prior, u = random_prior(rng), rng.normal(0.0, 0.1)
        prediction, variance = linearised(prior, u)
        std = np.sqrt(variance + draw_variances(rng, prior.gamma, DRAWS) + draw_variances(rng, prior.xi, DRAWS))
        y = rng.normal(prediction, std[0])
        block, trace = block_of([prior.to_record()] * LANES, u, y), np.empty(10)
        update(block, True, 10, False, trace)
        assert np.diff(trace).max() <= 1e-12  # some twenty terms, each of them to 5e-14 as `test_elementary` has it
        density = norm.pdf(y, prediction, std)
        evidence, error = density.mean(), density.std() / np.sqrt(DRAWS)
        assert trace[-1] >= -np.log(evidence) - 5 * error / evidence


def test_one_output_at_a_time_cannot_tell_two_equal_noises_apart():
    # With equal priors, E[w²] = E[v²] for every sample, so that E[γ] = E[ξ] for ever: docs/coverage.md.
    rng = np.random.default_rng(4)
    prior = random_prior(rng)
    u, y = samples(rng)
    block = block_of([Moments(prior.mean, prior.cov, prior.gamma, prior.gamma).to_record()] * LANES, u, y)
    update(block, True, 10, False, NO_TRACE)
    for record in records_of(block):
        posterior = Moments.of_record(record)
        assert posterior.gamma == posterior.xi
        assert posterior.gamma[1] != prior.gamma[1]


def test_free_energy_is_finite_far_from_the_prior():
    # The rate of γ moves from 1e-6 to 1e33 with this sample: the prior rate is then lost in the new one.
    prior = random_prior(np.random.default_rng(5))
    block, trace = block_of([prior.to_record()] * LANES, 0.0, 1e20), np.empty(3)
    update(block, True, 3, False, trace)
    _, free_energies = structured_step(prior, 0.0, 1e20, 3)
    np.testing.assert_allclose(trace, free_energies, rtol=1e-9)
