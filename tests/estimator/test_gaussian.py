"""`JointBelief`: what it refuses, what it answers, and that nobody can write into it."""

import dataclasses
import re

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from estimator import JointBelief

FIELDS = {
    "names": ("stiffness", "damping", "cubic"),
    "units": ("s⁻²", "s⁻¹", "V⁻² s⁻²"),
    "mean": np.array([0.1, -2.0, 1.8e5, 42.0, 7e5]),
    "gamma_shape": 2.0,
    "gamma_rate": 2e-6,
    "xi_shape": 3.0,
    "xi_rate": 12e-8,
}


def covariance(seed=0):
    """(5, 5), of quantities as different in size as those of the oscillator."""
    std = np.array([1e-3, 0.3, 500.0, 4e-5, 2e3])
    factor = np.random.default_rng(seed).standard_normal((5, 9))
    return np.outer(std, std) * (factor @ factor.T) / 9


def belief(**changes):
    return JointBelief(**{**FIELDS, "cov": covariance(), **changes})


def fixed(index):
    """A belief in which one of the five quantities is known."""
    cov = covariance()
    cov[index, :] = cov[:, index] = 0.0
    return belief(cov=cov)


def test_parts_and_moments():
    cov = covariance()
    one = belief()
    np.testing.assert_array_equal(one.state_mean, [0.1, -2.0])
    np.testing.assert_array_equal(one.state_cov, cov[:2, :2])
    np.testing.assert_array_equal(one.coefficients_mean, [1.8e5, 42.0, 7e5])
    np.testing.assert_array_equal(one.coefficients_cov, cov[2:, 2:])
    assert (one.gamma_mean, one.xi_mean) == pytest.approx((1e6, 2.5e7))
    assert one.parameters() == {
        "stiffness": (1.8e5, pytest.approx(np.sqrt(cov[2, 2])), "s⁻²"),
        "damping": (42.0, pytest.approx(np.sqrt(cov[3, 3])), "s⁻¹"),
        "cubic": (7e5, pytest.approx(np.sqrt(cov[4, 4])), "V⁻² s⁻²"),
    }


def standardised(one, which):
    """SciPy's normal of some coefficients in units of their standard deviations, and the logarithm of those units.

    SciPy works with eigenvalues, and would lose digits where the variances are as different as here.
    """
    cov = one.coefficients_cov[np.ix_(which, which)]
    std = np.sqrt(np.diag(cov))
    return multivariate_normal(np.zeros(len(which)), cov / np.outer(std, std)), std, np.log(std).sum()


@pytest.mark.parametrize(("known", "rest"), [(None, [0, 1, 2]), (1, [0, 2])], ids=["all free", "damping known"])
def test_entropy_and_density_equal_scipy(known, rest):
    """A parameter that is known is left out, whatever is given for it."""
    one = belief() if known is None else fixed(2 + known)
    normal, std, log_unit = standardised(one, rest)
    assert one.entropy() == pytest.approx(normal.entropy() + log_unit, rel=1e-12)
    deviations = normal.rvs(7, random_state=np.random.default_rng(1))
    points = np.full((7, 3), 1e6)
    points[:, rest] = one.coefficients_mean[rest] + std * deviations
    expected = normal.logpdf(deviations) - log_unit
    np.testing.assert_allclose(one.log_prob(points), expected, rtol=1e-8)
    assert one.log_prob(points[0]) == pytest.approx(expected[0], rel=1e-8)
    assert isinstance(one.log_prob(points[0]), float)
    assert one.log_prob(points.reshape(7, 1, 3)).shape == (7, 1)


def test_entropy_of_what_is_no_density_is_nan():
    cov = covariance()
    cov[2, 2] = -1.0
    assert np.isnan(belief(cov=cov).entropy())


def test_nothing_can_be_written_into_it():
    mean, cov = FIELDS["mean"].copy(), covariance()
    one = belief(mean=mean, cov=cov)
    mean[:] = cov[:] = np.nan
    assert np.isfinite(one.mean).all()
    assert np.isfinite(one.cov).all()
    for array in (one.mean, one.cov, one.state_mean, one.state_cov, one.coefficients_mean, one.coefficients_cov):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1.0
    with pytest.raises(dataclasses.FrozenInstanceError):
        one.gamma_rate = 1.0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mean": np.zeros(2)}, "mean must hold the state and 3 parameters, but has shape (2,)"),
        ({"mean": np.zeros((5, 1))}, "mean must hold the state and 3 parameters, but has shape (5, 1)"),
        ({"cov": np.eye(3)}, "cov must have shape (5, 5), but has (3, 3); it goes with mean"),
        ({"cov": np.ones(5)}, "cov must have shape (5, 5), but has (5,)"),
        ({"mean": np.array([0, 0, np.nan, 0, 0])}, "mean and cov must be finite"),
        ({"cov": np.full((5, 5), np.inf)}, "mean and cov must be finite"),
        ({"gamma_shape": 0.0}, "gamma_shape must be positive and finite, but is 0.0; pass a value above 0"),
        ({"gamma_rate": -1.0}, "gamma_rate must be positive and finite, but is -1.0"),
        ({"xi_shape": np.nan}, "xi_shape must be positive and finite, but is nan"),
        ({"xi_rate": np.inf}, "xi_rate must be positive and finite, but is inf"),
    ],
)
def test_errors_name_the_field(changes, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        belief(**changes)


@pytest.mark.parametrize(
    ("point", "message"),
    [
        (1.0, "coefficients must have shape (..., 3), but has ()"),
        (np.zeros((3, 5)), "coefficients must have shape (..., 3), but has (3, 5); pass one per name"),
        ([1.0, np.inf, 1.0], "coefficients must be finite"),
    ],
)
def test_a_density_asks_for_points(point, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        belief().log_prob(point)
