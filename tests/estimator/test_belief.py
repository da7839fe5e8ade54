"""`Belief`: checks, properties, and immutability."""

import dataclasses
import re

import numpy as np
import pytest
from scipy.stats import multivariate_normal
from tables import table

from estimator.belief import Belief
from estimator.models.model import Model

#: A model without physical parameters.
MODEL = Model(
    "oscillator",
    {"x": "V", "v": "V"},
    {"stiffness": "s⁻²", "damping": "s⁻¹", "cubic": "V⁻² s⁻²"},
    noise=("0", "1"),
    outputs={"y": "x"},
    rates=("v", "u - damping*v - stiffness*x - cubic*x**3"),
)
FIELDS = {"mean": np.array([0.1, -2.0, 1.8e5, 42.0, 7e5]), "gamma": (2.0, 2e-6), "xi": (3.0, 12e-8)}


def covariance(seed=0):
    """A covariance (5, 5) of quantities that differ in size as the oscillator's do."""
    std = np.array([1e-3, 0.3, 500.0, 4e-5, 2e3])
    factor = np.random.default_rng(seed).standard_normal((5, 9))
    return np.outer(std, std) * (factor @ factor.T) / 9


def belief(**changes):
    return Belief.of(MODEL, **{**FIELDS, "cov": covariance(), **changes})


def fixed(index):
    """A belief in which one of the five quantities is known."""
    cov = covariance()
    cov[index, :] = cov[:, index] = 0.0
    return belief(cov=cov)


def test_the_repr_is_one_line():
    damping, cubic = np.sqrt(np.diag(covariance())[3:])
    text = f"stiffness = 1.8e+05 ± 0, damping = 42 ± {damping:.2g}, cubic = 7e+05 ± {cubic:.2g}"
    assert repr(fixed(2)) == f"Belief(oscillator: {text})"


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
    """A known parameter is left out, for any given value."""
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


def test_a_singular_covariance_has_neither_entropy_nor_density():
    cov = covariance()
    std = np.sqrt(np.diag(cov))
    cov[3:, :] = cov[:, 3:] = 0.0
    cov[3:, 3:] = np.outer(std[3:], std[3:])  # two coefficients that are as one
    one = belief(cov=cov)
    assert np.isnan(one.entropy())
    assert np.isnan(one.log_prob(one.coefficients_mean))


def test_nothing_can_be_written_into_it():
    mean, cov = FIELDS["mean"].copy(), covariance()
    one = belief(mean=mean, cov=cov)
    mean[:] = cov[:] = np.nan
    assert np.isfinite(one.mean).all()
    assert np.isfinite(one.cov).all()
    for array in (one.mean, one.cov, one.state_mean, one.state_cov, one.coefficients_mean, one.coefficients_cov):
        array[:] = 0.0
    np.testing.assert_array_equal(one.mean, FIELDS["mean"])
    np.testing.assert_array_equal(one.cov, covariance())
    with pytest.raises(ValueError, match="read-only"):
        one.record[0] = 1.0
    with pytest.raises(dataclasses.FrozenInstanceError):
        one.step = 1.0


def test_rounding_leaves_a_covariance_symmetric():
    """As of a record whose fit leaves two parameters nearly uncorrelated."""
    cov = covariance()
    cov[3, 4], cov[4, 3] = 1e-17, -2e-17  # where the standard deviations are of 4e-5 and 2e3
    np.testing.assert_allclose(belief(cov=cov).cov, cov, rtol=1e-14, atol=1e-16)
    cov[4, 3] = 1e-6 * np.sqrt(cov[3, 3] * cov[4, 4])
    with pytest.raises(ValueError, match="cov must be symmetric"):
        belief(cov=cov)


@table(
    ("changes", "message"),
    [
        (
            {"mean": np.zeros(2)},
            "mean and cov must have shapes (5,) and (5, 5) for the model 'oscillator', but have (2,)",
        ),
        ({"cov": np.eye(3)}, "mean and cov must have shapes (5,) and (5, 5)"),
        ({"cov": np.triu(np.ones((5, 5)))}, "cov must be symmetric; pass (C + C.T) / 2"),
        ({"cov": np.diag([1.0, 1.0, -1.0, 1.0, 1.0])}, "record must have a positive semi-definite covariance"),
        ({"cov": 2 * np.ones((5, 5)) - np.eye(5)}, "record must have a positive semi-definite covariance"),
        ({"cov": -np.eye(5)}, "record must have a positive semi-definite covariance, but has [[-1.0, "),
        ({"cov": 1e-7 * (np.ones((5, 5)) - np.eye(5))}, "record must have a positive semi-definite covariance"),
        ({"cov": np.where(np.eye(5) == 1, 1e-300, 1e300)}, "record must be within ±1e+60, but P_x_v is 1e+300"),
        ({"mean": "abc"}, "mean must be numbers, but is 'abc'"),
        ({"cov": [[10**400] * 5] * 5}, "cov must be numbers"),
        ({"gamma": None}, "gamma must be a pair"),
        ({"xi": "abc"}, "xi must be numbers, but is 'abc'"),
        ({"mean": np.array([0, 0, np.nan, 0, 0])}, "record must be finite, but stiffness is not; replace it"),
        ({"gamma": (0.0, 1.0)}, "record must have positive shapes and rates of the noises, but has [0.0, 1.0"),
        ({"xi": (1.0, -1.0)}, "record must have positive shapes and rates of the noises"),
        ({"xi": [(1.0, 1.0), (1.0, 1.0)]}, "xi one for each of ['y'], but are"),
    ],
)
def test_errors_name_the_field(changes, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        belief(**changes)


@table(
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
