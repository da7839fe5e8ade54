"""Prior and belief: densities against SciPy, the record and back, errors."""

import dataclasses
import re

import numpy as np
import pytest
from scipy import stats
from twins import Moments, random_prior

from estimator import SILVERBOX_TWIN, Belief, Coefficients, Prior, to_coefficients
from estimator.parameters import log_uniform_moments, propagate_to_physical
from estimator.record import COVARIANCES, NOISES, QUANTITIES, RECORD, RECORD_SIZE

ALL, LINEAR = [0, 1, 2, 3], [0, 2, 3]


@pytest.fixture
def moments():
    return random_prior(np.random.default_rng(0))


@pytest.fixture
def belief(moments):
    return Belief(moments.to_record())


def prior(**changes):
    """A valid prior with round numbers; ``changes`` replace fields."""
    fields = {
        "theta_mean": [1.4, -2.0, -0.9],
        "theta_cov": np.diag([0.1, 4.0, 0.2]),
        "eta_mean": 0.4,
        "eta_var": 0.01,
        "gamma_shape": 2.0,
        "gamma_rate": 1e-6,
        "xi_shape": 3.0,
        "xi_rate": 1e-5,
        "state_mean": [0.02, 0.01],
        "state_cov": [[2e-6, 1e-6], [1e-6, 3e-6]],
    }
    return Prior(**(fields | changes))


def test_the_record_holds_means_covariances_and_noises():
    assert (len(QUANTITIES), len(COVARIANCES), len(NOISES)) == (7, 28, 4)
    assert len(set(RECORD)) == len(RECORD) == RECORD_SIZE == 39


def test_properties_read_the_record(belief, moments):
    np.testing.assert_array_equal(belief.state_mean, moments.mean[:3])
    np.testing.assert_array_equal(belief.state_cov, moments.cov[:3, :3])
    np.testing.assert_array_equal(belief.theta_mean, moments.mean[3:6])
    np.testing.assert_array_equal(belief.theta_cov, moments.cov[3:6, 3:6])
    np.testing.assert_array_equal(belief.coefficients_mean, moments.mean[3:])
    np.testing.assert_array_equal(belief.coefficients_cov, moments.cov[3:, 3:])
    assert (belief.eta_mean, belief.eta_var) == (moments.mean[6], moments.cov[6, 6])
    assert (belief.gamma_shape, belief.gamma_rate, belief.xi_shape, belief.xi_rate) == moments.gamma + moments.xi
    assert belief.gamma_mean == moments.gamma[0] / moments.gamma[1]
    assert belief.xi_mean == moments.xi[0] / moments.xi[1]
    assert belief.coefficients() == Coefficients(*moments.mean[3:], gamma=belief.gamma_mean, xi=belief.xi_mean)


def test_mean_field_knows_two_lags(moments):
    belief = Belief(moments.to_record(), factorisation="mean_field")
    np.testing.assert_array_equal(belief.state_mean, moments.mean[:2])
    np.testing.assert_array_equal(belief.state_cov, moments.cov[:2, :2])


def test_a_belief_is_a_copy_that_nobody_can_change(moments):
    record = moments.to_record()
    belief = Belief(record)
    record[:] = np.nan
    np.testing.assert_array_equal(belief.record, moments.to_record())
    with pytest.raises(ValueError, match="read-only"):
        belief.record[0] = 1.0
    with pytest.raises(dataclasses.FrozenInstanceError):
        belief.record = record
    for name in ("state_mean", "state_cov", "theta_mean", "theta_cov", "coefficients_mean", "coefficients_cov"):
        getattr(belief, name)[...] = 7.0  # a copy, too
    np.testing.assert_array_equal(belief.record, moments.to_record())


@pytest.mark.parametrize(("nonlinear", "active"), [(True, ALL), (False, LINEAR)])
def test_entropy_and_log_prob_equal_scipy(nonlinear, active):
    moments = random_prior(np.random.default_rng(1), nonlinear=nonlinear)
    belief = Belief(moments.to_record(), nonlinear=nonlinear)
    mean, cov = moments.mean[3:], moments.cov[3:, 3:]
    normal = stats.multivariate_normal(mean[active], cov[np.ix_(active, active)])
    assert belief.entropy() == pytest.approx(normal.entropy(), rel=1e-12)

    points = mean + 0.1 * np.random.default_rng(2).standard_normal((2, 3, 4))
    np.testing.assert_allclose(belief.log_prob(points), normal.logpdf(points[..., active]), rtol=1e-10)
    one = belief.log_prob(Coefficients(*points[1, 2]))
    assert type(one) is float
    assert one == pytest.approx(normal.logpdf(points[1, 2, active]), rel=1e-10)
    batch = belief.log_prob(Coefficients(*np.moveaxis(points, -1, 0)))
    np.testing.assert_array_equal(batch, belief.log_prob(points))


def test_log_prob_integrates_to_one(belief):
    # Importance sampling from a wider Gaussian: the mean of the density ratio is 1.
    wide = stats.multivariate_normal(belief.coefficients_mean, 2 * belief.coefficients_cov)
    points = wide.rvs(100_000, random_state=np.random.default_rng(3))
    ratio = np.exp(belief.log_prob(points) - wide.logpdf(points))
    assert ratio.mean() == pytest.approx(1.0, abs=5 * ratio.std() / np.sqrt(len(points)))


@pytest.mark.parametrize(
    ("coefficients", "message"),
    [
        ([1.0, 2.0, 3.0], "coefficients must have shape (..., 4), but has (3,)"),
        (1.0, "coefficients must have shape (..., 4), but has ()"),
        ([1.0, 2.0, np.nan, 4.0], "coefficients must be finite, but has entries that are not; remove them"),
    ],
)
def test_log_prob_refuses(belief, coefficients, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        belief.log_prob(coefficients)


def test_physical_equals_the_parameter_map(belief):
    mean, cov = belief.physical()
    expected_mean, expected_cov = propagate_to_physical(belief.coefficients_mean, belief.coefficients_cov)
    np.testing.assert_array_equal(mean, expected_mean)
    np.testing.assert_array_equal(cov, expected_cov)
    truth = to_coefficients(SILVERBOX_TWIN)
    record = prior(theta_mean=[truth.theta1, truth.theta2, truth.theta3], eta_mean=truth.eta).to_record()
    twin = [SILVERBOX_TWIN.m, SILVERBOX_TWIN.c, SILVERBOX_TWIN.a, SILVERBOX_TWIN.b]
    np.testing.assert_allclose(Belief(record).physical()[0], twin, rtol=1e-10)


def test_a_linear_belief_knows_that_there_is_no_cubic_stiffness():
    belief = Belief(prior().to_record(nonlinear=False), nonlinear=False)
    mean, cov = belief.physical()
    assert (belief.theta_mean[1], mean[3]) == (0.0, 0.0)
    np.testing.assert_array_equal(belief.theta_cov[1], 0.0)
    np.testing.assert_array_equal(cov[3], 0.0)


def test_to_record_and_back():
    joint = np.diag([0.1, 4.0, 0.2, 0.01])
    joint[0, 3] = joint[3, 0] = 0.02
    correlated = prior(coefficients_cov=joint)
    record = Moments.of_record(correlated.to_record())
    np.testing.assert_array_equal(record.mean, [0.02, 0.01, 0.0, 1.4, -2.0, -0.9, 0.4])
    np.testing.assert_array_equal(record.cov[3:, 3:], joint)
    np.testing.assert_array_equal(record.cov[:2, :2], [[2e-6, 1e-6], [1e-6, 3e-6]])
    # Of x_{t-2} nothing is known but that it is as uncertain as x_{t-1}; states and coefficients are independent.
    np.testing.assert_array_equal(record.cov[2], [0, 0, 3e-6, 0, 0, 0, 0])
    np.testing.assert_array_equal(record.cov[:3, 3:], 0.0)
    assert record.gamma + record.xi == (2.0, 1e-6, 3.0, 1e-5)

    mean_field = Moments.of_record(correlated.to_record(factorisation="mean_field"))
    np.testing.assert_array_equal(mean_field.cov[3:, 3:], np.diag([0.1, 4.0, 0.2, 0.01]))
    np.testing.assert_array_equal(mean_field.cov[2], 0.0)  # there is no third lag
    linear = Moments.of_record(correlated.to_record(nonlinear=False))
    assert linear.mean[4] == 0.0
    np.testing.assert_array_equal(linear.cov[4], 0.0)
    np.testing.assert_array_equal(np.delete(linear.cov, 4, 0)[:, 0], np.delete(record.cov, 4, 0)[:, 0])


def test_without_a_joint_covariance_theta_and_eta_are_independent():
    np.testing.assert_array_equal(prior().coefficients_cov, np.diag([0.1, 4.0, 0.2, 0.01]))


def test_published_priors():
    run, text = Prior.published_run(), Prior.paper_text()
    for published in (run, text):
        np.testing.assert_array_equal(published.theta_mean, [1.0, 1.0, 1.0])
        np.testing.assert_allclose(np.linalg.inv(published.theta_cov), 0.1 * np.eye(3), rtol=1e-15)
        np.testing.assert_array_equal(published.state_mean, [0.0, 0.0])
        np.testing.assert_allclose(np.linalg.inv(published.state_cov), 0.1 * np.eye(2), rtol=1e-15)
    assert (run.eta_mean, 1 / run.eta_var) == (2.0, 1e2)
    assert (run.gamma_shape, run.gamma_rate, run.xi_shape, run.xi_rate) == (1e8, 1e3, 1e8, 1e1)
    assert (text.eta_mean, 1 / text.eta_var) == (1.0, 0.1)
    assert (text.gamma_shape, text.gamma_rate, text.xi_shape, text.xi_rate) == (1e3, 1e1, 1e8, 1e3)


def test_silverbox_twin_matches_the_oscillators_it_is_drawn_from():
    twin = Prior.silverbox_twin(spread=0.2, process_noise=1e-3, measurement_noise=2e-4, noise_shape=3.0, state_std=0.01)
    mean, cov = log_uniform_moments(SILVERBOX_TWIN, 0.2)
    np.testing.assert_array_equal([*twin.theta_mean, twin.eta_mean], mean)
    np.testing.assert_array_equal(twin.coefficients_cov, cov)
    np.testing.assert_array_equal(twin.theta_cov, cov[:3, :3])
    assert twin.eta_var == cov[3, 3]
    np.testing.assert_allclose(twin.state_cov, 1e-4 * np.eye(2), rtol=1e-12)
    assert (twin.gamma_shape, twin.xi_shape) == (3.0, 3.0)
    assert (twin.gamma_rate / twin.gamma_shape) ** 0.5 == pytest.approx(1e-3, rel=1e-12)
    assert (twin.xi_rate / twin.xi_shape) ** 0.5 == pytest.approx(2e-4, rel=1e-12)


def test_a_prior_is_a_copy_that_nobody_can_change():
    mean = np.array([1.4, -2.0, -0.9])
    settled = prior(theta_mean=mean)
    mean[:] = np.nan
    np.testing.assert_array_equal(settled.theta_mean, [1.4, -2.0, -0.9])
    with pytest.raises(ValueError, match="read-only"):
        settled.theta_mean[0] = 1.0
    with pytest.raises(dataclasses.FrozenInstanceError):
        settled.eta_mean = 1.0


def test_priors_and_beliefs_can_be_compared_and_kept_in_sets(belief):
    # Priors by identity, beliefs by their numbers; a comparison of arrays as fields would raise.
    assert len({prior(), prior(), belief}) == 3
    assert prior() != prior()
    same = dataclasses.replace(belief)
    assert same == belief
    assert hash(same) == hash(belief)
    assert dataclasses.replace(belief, record=belief.record + 1e-9) != belief
    assert belief != "belief"


LOPSIDED = np.array([[2e-10, 1e-10], [0.0, 3e-10]])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"theta_mean": [1.0, 2.0]}, "theta_mean must have shape (3,), but has (2,); reshape"),
        ({"eta_mean": [1.0]}, "eta_mean must have shape (), but has (1,); reshape"),
        ({"theta_cov": np.eye(2)}, "theta_cov must have shape (3, 3), but has (2, 2)"),
        ({"state_mean": 0.0}, "state_mean must have shape (2,), but has ()"),
        ({"theta_mean": [1.0, np.nan, 0.0]}, "theta_mean must be finite, but is [ 1. nan  0.]; replace"),
        ({"eta_mean": np.inf}, "eta_mean must be finite, but is inf"),
        ({"state_cov": [[np.nan, 0], [0, 1]]}, "state_cov must be finite, but is [[nan  0.]"),
        ({"eta_var": 0.0}, "eta_var must be positive, but is 0.0; pass a value above 0"),
        ({"gamma_shape": -1.0}, "gamma_shape must be positive, but is -1.0"),
        ({"gamma_rate": 0.0}, "gamma_rate must be positive, but is 0.0"),
        ({"xi_shape": 0.0}, "xi_shape must be positive, but is 0.0"),
        ({"xi_rate": -1e-9}, "xi_rate must be positive, but is -1e-09"),
        # However small the covariance is: state variances are of the order of 1e-6.
        (
            {"state_cov": LOPSIDED},
            "state_cov must be symmetric, but is [[2e-10, 1e-10], [0.0, 3e-10]]; pass (C + C.T) / 2",
        ),
        ({"state_cov": [[1.0, 2.0], [2.0, 1.0]]}, "state_cov must be positive definite, but has eigenvalue -1.0"),
        ({"theta_cov": np.zeros((3, 3))}, "theta_cov must be positive definite, but has eigenvalue 0.0; add variance"),
        ({"coefficients_cov": np.eye(3)}, "coefficients_cov must have shape (4, 4), but has (3, 3)"),
        ({"coefficients_cov": np.eye(4)}, "coefficients_cov must contain theta_cov and eta_var as its blocks"),
        (
            {"eta_var": 1e-9, "coefficients_cov": np.diag([0.1, 4.0, 0.2, 2e-9])},
            "coefficients_cov must contain theta_cov and eta_var as its blocks, but has diagonal",
        ),
    ],
)
def test_prior_refuses(changes, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        prior(**changes)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"process_noise": 0.0}, "process_noise must be positive and finite, but is 0.0; pass a standard deviation"),
        ({"measurement_noise": np.nan}, "measurement_noise must be positive and finite, but is nan"),
        ({"spread": 1.0}, "spread must be above 0 and below 1, but is 1.0"),
        ({"spread": 0.0}, "spread must be above 0 and below 1, but is 0.0"),
        ({"noise_shape": 0.0}, "gamma_shape must be positive, but is 0.0"),
        ({"state_std": 0.0}, "state_cov must be positive definite, but has eigenvalue 0.0"),
    ],
)
def test_silverbox_twin_refuses(arguments, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        Prior.silverbox_twin(**arguments)
