"""The worth of inputs and its gradient: against the Fisher information, differences, and the limits."""

import numpy as np
import pytest

from agents.ascent import improve
from agents.design import climb, half_log_det, invert, worth
from estimator import SILVERBOX_TWIN, Prior, to_coefficients
from estimator.fisher import as_rows, fisher_information

Q, R, LIMIT, AMPLITUDE = 5e-4, 3e-4, 0.3, 0.1
TWIN = to_coefficients(SILVERBOX_TWIN)
THETA = as_rows(TWIN)
PRECISION = np.linalg.inv(Prior.silverbox_twin().coefficients_cov)


def evaluated(u, start=None, penalty=0.0, gradient=None):
    start = np.zeros(13) if start is None else start
    tape, F = np.empty((len(u) + 1, 13)), np.empty((4, 4))
    told = (THETA, PRECISION, Q**2, R**2, LIMIT, penalty, start, u, tape, F)
    return worth(*told) if gradient is None else climb(*told, gradient)


def improved(inputs, energy=np.inf):
    inputs, values = inputs.copy(), np.empty(len(inputs))
    improve(THETA, PRECISION, Q**2, R**2, LIMIT, AMPLITUDE, energy, 0.3, 100, inputs, values)
    return inputs, values


def test_the_worth_is_half_the_log_determinant_of_the_precision():
    u = np.random.default_rng(0).choice([-0.03, 0.03], 60)
    value, _ = evaluated(u)
    expected = 0.5 * np.linalg.slogdet(PRECISION + fisher_information(TWIN, u, Q, R))[1]
    assert value == pytest.approx(expected, rel=1e-12)


def test_factor_and_inverse():
    rng = np.random.default_rng(1)
    A = rng.standard_normal((4, 6)) @ rng.standard_normal((6, 4))
    A = A @ A.T + np.eye(4)
    L, inverse = A.copy(), np.empty((4, 4))
    assert half_log_det(L) == pytest.approx(0.5 * np.linalg.slogdet(A)[1], rel=1e-12)
    invert(L, inverse)
    np.testing.assert_allclose(inverse @ A, np.eye(4), atol=1e-12)
    assert half_log_det(-np.eye(4)) == -np.inf


@pytest.mark.parametrize("moving", [False, True])
def test_the_gradient_is_that_of_differences(moving):
    rng = np.random.default_rng(2)
    u = 0.135 * rng.uniform(-1, 1, 40)
    start = np.zeros(13)
    if moving:
        start[:5] = 0.1, -0.05, 3e-7, 1e-7, 2e-7
        start[5:] = rng.normal(0, 0.2, 8)
    gradient = np.empty(40)
    value, peak = evaluated(u, start, 100.0, gradient)
    assert value == evaluated(u, start, 100.0)[0]
    assert LIMIT < peak < 1.2 * LIMIT  # so that the penalty has its part
    h = 1e-6
    for t in range(40):
        step = h * (np.arange(40) == t)
        slope = (evaluated(u + step, start, 100.0)[0] - evaluated(u - step, start, 100.0)[0]) / (2 * h)
        assert gradient[t] == pytest.approx(slope, rel=1e-5, abs=1e-4 * np.abs(gradient).max())


def test_a_trajectory_that_is_lost_counts_until_then():
    u = np.full(60, 0.3)
    gradient = np.empty(60)
    value, peak = evaluated(u, None, 0.0, gradient)
    assert LIMIT * 1.2 <= peak < 1.0
    used = np.flatnonzero(gradient)[-1] + 1
    assert 0 < used < 60
    assert value == evaluated(u[:used])[0]


def test_improvement_keeps_the_limits_and_gains():
    rng = np.random.default_rng(3)
    begun = AMPLITUDE * rng.uniform(-0.3, 0.3, (3, 48))
    inputs, values = improved(begun)
    assert np.abs(inputs).max() <= AMPLITUDE
    for u, start, value in zip(inputs, begun, values, strict=True):
        found, peak = evaluated(u)
        assert peak <= LIMIT
        assert value == pytest.approx(found, abs=1e-9)
        assert value > evaluated(start)[0] + 1.0


def test_improvement_keeps_an_energy():
    rng = np.random.default_rng(4)
    energy = 0.02**2 * 48
    inputs, values = improved(AMPLITUDE * rng.uniform(-1, 1, (2, 48)), energy)
    assert np.all((inputs**2).sum(axis=1) <= energy)
    assert np.all((inputs**2).sum(axis=1) > 0.99 * energy)
    assert np.isfinite(values).all()
