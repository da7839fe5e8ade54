"""Elementary functions against the standard library, SciPy and 50-digit arithmetic."""

import math

import mpmath
import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import special
from tables import table

from estimator.compilation import elementary_functions
from estimator.compilation.elementary_functions import (
    digamma,
    expected_log_gamma,
    gamma_update_divergence,
    log,
    log_gamma_half_ratio,
)

EPS = np.finfo(float).eps
SMALLEST_NORMAL = np.finfo(float).tiny
LARGEST = np.finfo(float).max
SHAPES = [1e-3, 0.1, 0.5, 1.0, 2.0, 3.3, 9.99, 10.0, 19.99, 20.0, 123.0, 1e3, 1e5, 1e8, 1e9, 1e12]


repeatable = settings(derandomize=True, deadline=None, max_examples=500)


@repeatable
@given(st.floats(SMALLEST_NORMAL, LARGEST))
def test_log_over_the_whole_range(x):
    # Three units in the last place of the specification, and half a unit of math.log.
    assert abs(log(x) - math.log(x)) <= 3.5 * math.ulp(math.log(x))


@repeatable
@given(st.floats(-1.0, 1.0), st.integers(0, 15))
def test_log_near_one_keeps_its_relative_accuracy(offset, digits):
    x = 1.0 + offset * 10.0**-digits
    if x > 0:
        assert abs(log(x) - math.log(x)) <= 3.5 * math.ulp(math.log(x))


def test_log_on_a_dense_sample():
    # Hypothesis favours simple numbers; a million draws find the worst mantissas.
    x = np.exp(np.random.default_rng(0).uniform(-708.0, 709.0, 1_000_000))
    x[::2] = np.random.default_rng(1).uniform(0.5, 2.0, len(x[::2]))
    assert (np.abs(_each(4, x) - np.log(x)) <= 4 * np.spacing(np.abs(np.log(x)))).all()


@table("shape", SHAPES)
def test_digamma_equals_scipy(shape):
    # Beside 1 where digamma passes through 0 at 1.46.
    assert digamma(shape) == pytest.approx(special.digamma(shape), rel=4 * EPS, abs=5e-14)


@table("shape", SHAPES)
def test_log_gamma_half_step_in_fifty_digits(shape):
    with mpmath.workdps(50):
        exact = float(mpmath.loggamma(mpmath.mpf(shape) + 0.5) - mpmath.loggamma(mpmath.mpf(shape)))
    assert log_gamma_half_ratio(shape) == pytest.approx(exact, rel=4 * EPS, abs=2e-14)


@table("shape", SHAPES)
@table("ratio", [1e-14, 1e-8, 1e-3, 1.0, 1e3])
def test_gamma_step_divergence_in_fifty_digits(shape, ratio):
    rate = 1.3
    with mpmath.workdps(50):
        a0, b0 = mpmath.mpf(shape), mpmath.mpf(rate)
        a, b = a0 + 0.5, b0 + mpmath.mpf(ratio * rate)
        exact = (a - a0) * mpmath.digamma(a) - mpmath.loggamma(a) + mpmath.loggamma(a0)
        exact = float(exact + a0 * mpmath.log(b / b0) + a * (b0 - b) / b)
    # The terms that nearly cancel are as large as log shape, and shape * ratio where that is large.
    largest = max(1.0, shape * ratio)
    assert gamma_update_divergence(shape, rate, ratio * rate) == pytest.approx(exact, abs=3e-14 * largest)


def test_expected_log_gamma_equals_monte_carlo_and_scipy():
    shape, rate = 2.5, 0.3
    draws = np.log(np.random.default_rng(0).gamma(shape, 1 / rate, 200_000))
    assert expected_log_gamma(shape, rate) == pytest.approx(draws.mean(), abs=5 * draws.std() / np.sqrt(len(draws)))
    assert expected_log_gamma(shape, rate) == pytest.approx(special.digamma(shape) - np.log(rate), rel=1e-14)


@numba.njit
def _each(kind, x):
    out = np.empty_like(x)
    for i in range(len(x)):
        if kind == 0:
            out[i] = elementary_functions.sin(x[i])
        elif kind == 1:
            out[i] = elementary_functions.cos(x[i])
        elif kind == 2:
            out[i] = elementary_functions.exp(x[i])
        elif kind == 3:
            out[i] = elementary_functions.tanh(x[i])
        else:
            out[i] = elementary_functions.log(x[i])
    return out


def _wide(limit):
    """Two hundred thousand numbers over all sizes up to a limit, both signs, and what is special."""
    rng = np.random.default_rng(0)
    sizes = np.exp(rng.uniform(np.log(1e-300), np.log(limit), 100_000))
    numbers = np.concatenate([sizes, rng.uniform(-limit, limit, 100_000), [0.0, limit, 1.0, 0.5]])
    return np.concatenate([numbers, -numbers])


@pytest.mark.parametrize("kind", [0, 1], ids=["sin", "cos"])
def test_sine_and_cosine_over_a_hundred_thousand_radians(kind):
    x = _wide(1e5)
    quarters = np.arange(-60_000, 60_000) * (np.pi / 2)
    x = np.concatenate([x, quarters[np.abs(quarters) < 1e5], quarters[:1000] / 2])
    # Two units in the last place of 1, and half a unit of NumPy's.
    assert np.abs(_each(kind, x) - (np.sin, np.cos)[kind](x)).max() <= 2.5 * EPS


def test_a_small_sine_keeps_its_relative_accuracy():
    x = _wide(0.7)
    assert (np.abs(_each(0, x) - np.sin(x)) <= 2.5 * np.spacing(np.abs(np.sin(x)))).all()


def test_exponential_over_its_range():
    x = _wide(700.0)
    exact = np.exp(x)
    assert (np.abs(_each(2, x) - exact) <= 2.5 * np.spacing(exact)).all()
    outside = np.array([-1e300, -701.0, 701.0, 1e300])
    np.testing.assert_array_equal(_each(2, outside) > np.exp(699.0), [False, False, True, True])
    assert (_each(2, outside)[:2] < 1e-303).all()


def test_hyperbolic_tangent_over_its_range():
    x = _wide(1e5)
    assert np.abs(_each(3, x) - np.tanh(x)).max() <= 4.5 * EPS
    np.testing.assert_array_equal(_each(3, np.array([800.0, -1e300, 0.0])), [1.0, -1.0, 0.0])


def test_nan_stays_nan():
    for kind in range(4):
        assert np.isnan(_each(kind, np.array([np.nan]))).all()
