"""The lane-wise update of the physical equation against its plain twin, and against the model for records."""

import numpy as np
import pytest
from twins import Moments, assert_same_moments, block_of, continuous_step, records_of, runge_kutta

from estimator import CONTINUOUS_TWIN, ContinuousBelief, OnlineEstimator, continuous_prior, duffing
from estimator.inference import continuous, free_energy
from estimator.lanes import LANES
from estimator.posterior import Belief
from estimator.record import LAYOUT, N_ROWS

TWIN = ContinuousBelief.coefficients_of(CONTINUOUS_TWIN)


def random_prior(rng):
    """A belief at random about the twin, with state and coefficients correlated at will."""
    std = np.exp(rng.uniform(np.log(1e-3), np.log(0.1), 6)) * [1, 1, *TWIN]
    factor = rng.standard_normal((6, 8))
    cov = factor @ factor.T
    cov *= np.outer(std, std) / np.sqrt(np.outer(np.diag(cov), np.diag(cov)))
    mean = np.concatenate([rng.normal(0.0, 0.2, 2), TWIN * rng.uniform(0.7, 1.3, 4)])
    known = [0, 1, 3, 4, 5, 6]
    whole_mean, whole_cov = np.zeros(7), np.zeros((7, 7))
    whole_mean[known], whole_cov[np.ix_(known, known)] = mean, cov
    shapes, stds = np.exp(rng.uniform(0.0, 7.0, 2)), np.exp(rng.uniform(np.log(1e-4), np.log(1e-2), 2))
    return Moments(whole_mean, whole_cov, (shapes[0], shapes[0] * stds[0] ** 2), (shapes[1], shapes[1] * stds[1] ** 2))


def assert_same(actual, expected, rtol=1e-9):
    known = [0, 1, 3, 4, 5, 6]
    for moments in (actual, expected):
        assert moments.mean[2] == 0
        assert not moments.cov[2].any()
    chosen = np.ix_(known, known)
    assert_same_moments(
        Moments(actual.mean[known], actual.cov[chosen], actual.gamma, actual.xi),
        Moments(expected.mean[known], expected.cov[chosen], expected.gamma, expected.xi),
        rtol,
    )


@pytest.mark.parametrize("iterations", [1, 3, 10])
@pytest.mark.parametrize("substeps", [1, continuous.SUBSTEPS])
def test_update_equals_its_twin(iterations, substeps):
    rng = np.random.default_rng(0)
    priors = [random_prior(rng) for _ in range(LANES)]
    for _ in range(2):
        last_u, u, y = rng.normal(0.0, [[0.1], [0.1], [0.2]], (3, LANES))
        block = block_of([prior.to_record() for prior in priors], u, y, last_u)
        continuous.update(block, iterations, substeps)
        posteriors = [Moments.of_record(record) for record in records_of(block)]
        for j in range(LANES):
            twin, free_energies = continuous_step(priors[j], last_u[j], u[j], y[j], iterations, substeps)
            assert_same(posteriors[j], twin)
            assert free_energy(block, j, True) == pytest.approx(free_energies[-1], rel=1e-9, abs=1e-8)
        priors = posteriors


def test_it_is_the_update_that_the_engine_generates():
    rng = np.random.default_rng(1)
    prior = continuous_prior(state_std=0.05)
    moments, known = Moments.of_record(prior.record), [0, 1, 3, 4, 5, 6]
    belief = Belief.of(duffing(), moments.mean[known], moments.cov[np.ix_(known, known)], moments.gamma, moments.xi)
    estimator = OnlineEstimator(duffing(), belief)
    rows = block_of([prior.record] * LANES, 0.0, 0.0).reshape(N_ROWS, LANES)
    last_u = 0.0
    for u, y in zip(rng.uniform(-0.15, 0.15, 50).tolist(), (0.1 * rng.standard_normal(50)).tolist(), strict=True):
        for name, value in (("last_u", last_u), ("u", u), ("y", y)):
            rows[LAYOUT[name]] = value
        continuous.update(rows.reshape(-1), 3, continuous.SUBSTEPS)
        last_u = u
        estimator.update(u, y)
        assert rows[LAYOUT["predicted"], 0] == pytest.approx(estimator.forecasts[0, 0], abs=1e-12)
        assert free_energy(rows.reshape(-1), 0, True) == pytest.approx(estimator.free_energy, rel=1e-9, abs=1e-8)
    found, after = estimator.belief, Moments.of_record(records_of(rows.reshape(-1))[0])
    std = np.sqrt(np.diag(found.cov))
    np.testing.assert_allclose((after.mean[known] - found.mean) / std, 0, atol=1e-8)
    np.testing.assert_allclose(after.cov[np.ix_(known, known)], found.cov, rtol=1e-7, atol=1e-15)


def test_lanes_are_independent():
    rng = np.random.default_rng(2)
    priors = np.array([random_prior(rng).to_record() for _ in range(LANES)])
    last_u, u, y = rng.normal(0.0, 0.1, (3, LANES))
    mixed = block_of(priors, u, y, last_u)
    continuous.update(mixed, 3, continuous.SUBSTEPS)
    for j in range(LANES):
        uniform = block_of([priors[j]] * LANES, u[j], y[j], last_u[j])
        continuous.update(uniform, 3, continuous.SUBSTEPS)
        expected = np.broadcast_to(records_of(mixed)[j], (LANES, len(priors[j])))
        np.testing.assert_array_equal(records_of(uniform), expected)


def test_the_substeps_are_enough():
    # At amplitudes that random inputs of 0.15 V reach. The smallest noise of docs/continuous.md is 1e-4 V on x, and
    # sqrt(3) of that on x'.
    rng = np.random.default_rng(4)
    errors = {4: [], continuous.SUBSTEPS: []}
    for _ in range(100):
        state, (last_u, u) = rng.uniform(-0.3, 0.3, 2), rng.uniform(-0.15, 0.15, 2)
        exact, _ = runge_kutta(state, TWIN, last_u, u, 100)
        for substeps, told in errors.items():
            told.append(np.abs(runge_kutta(state, TWIN, last_u, u, substeps)[0] - exact))
    worst = {substeps: np.max(told, axis=0) for substeps, told in errors.items()}
    assert (worst[continuous.SUBSTEPS] < [1e-6, 2e-6]).all()
    assert (worst[4] > 8 * worst[continuous.SUBSTEPS]).all()  # of order 4
