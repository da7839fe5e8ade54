"""The mean-field update against its plain twin, and against what its free energy must be."""

import numpy as np
import pytest
from scipy.stats import norm
from twins import (
    Moments,
    assert_same_moments,
    block_of,
    draw_variances,
    mean_field_step,
    random_prior,
    records_of,
)

from estimator.inference import free_energy, update
from estimator.lanes import LANES

NO_TRACE = np.empty(0)
DRAWS = 20_000


def samples(rng):
    return rng.normal(0.0, 0.1, LANES), rng.normal(0.0, 0.2, LANES)


@pytest.mark.parametrize("nonlinear", [True, False])
@pytest.mark.parametrize("as_published", [False, True])
def test_update_equals_its_twin(as_published, nonlinear):
    rng = np.random.default_rng(0)
    for iterations in range(1, 11):
        priors = [random_prior(rng, "mean_field", nonlinear) for _ in range(LANES)]
        for _ in range(2):
            u, y = samples(rng)
            block, trace = block_of([prior.to_record() for prior in priors], u, y), np.empty(iterations)
            update(block, False, iterations, as_published, trace)
            posteriors = [Moments.of_record(record) for record in records_of(block)]
            for j in range(LANES):
                twin, free_energies = mean_field_step(priors[j], u[j], y[j], iterations, as_published, nonlinear)
                assert_same_moments(posteriors[j], twin)
                # The twin's lnΓ of shapes up to 1e3, and its squares times 1e12, round at 1e-12 nats.
                assert free_energy(block, j, False) == pytest.approx(free_energies[-1], rel=1e-9, abs=1e-9)
                if j == 0:
                    np.testing.assert_allclose(trace, free_energies, rtol=1e-9, atol=1e-9)
            priors = posteriors


def test_free_energy_falls_and_bounds_the_surprise_where_the_first_order_is_exact():
    # With θ known and no cubic term nothing is linearised: the iterations are coordinate descent on F, and
    # F >= -log p(y), here by Monte Carlo over η and the noises.
    rng = np.random.default_rng(2)
    for _ in range(20):
        prior, u = random_prior(rng, "mean_field", nonlinear=False), rng.normal(0.0, 0.1)
        prior.cov[3:6, 3:6] *= 1e-18
        theta = prior.mean[[3, 5]]
        eta = prior.mean[6] + np.sqrt(prior.cov[6, 6]) * rng.standard_normal(DRAWS)
        std = np.sqrt(
            theta @ prior.cov[:2, :2] @ theta
            + draw_variances(rng, prior.gamma, DRAWS)
            + draw_variances(rng, prior.xi, DRAWS)
        )
        prediction = theta @ prior.mean[:2] + eta * u
        y = rng.normal(prediction[0], std[0])
        block, trace = block_of([prior.to_record()] * LANES, u, y), np.empty(10)
        update(block, False, 10, False, trace)
        assert np.diff(trace).max() <= 1e-12  # some twenty terms, each of them to 5e-14 as `test_elementary` has it
        density = norm.pdf(y, prediction, std)
        evidence, error = density.mean(), density.std() / np.sqrt(DRAWS)
        assert trace[-1] >= -np.log(evidence) - 5 * error / evidence


@pytest.mark.parametrize("as_published", [False, True])
def test_lanes_are_independent(as_published):
    rng = np.random.default_rng(3)
    priors = np.array([random_prior(rng, "mean_field").to_record() for _ in range(LANES)])
    u, y = samples(rng)
    mixed = block_of(priors, u, y)
    update(mixed, False, 10, as_published, NO_TRACE)
    for j in range(LANES):
        uniform = block_of([priors[j]] * LANES, u[j], y[j])
        update(uniform, False, 10, as_published, NO_TRACE)
        np.testing.assert_array_equal(
            records_of(uniform), np.broadcast_to(records_of(mixed)[j], (LANES, len(priors[j])))
        )
