"""Parameter maps: against hand calculations, differences, Monte Carlo and closed forms."""

import dataclasses
import os
import re
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimator import parameters as module
from estimator.parameters import (
    SAMPLING_STEP,
    Coefficients,
    PhysicalParameters,
    coefficients_jacobian,
    log_uniform_moments,
    physical_jacobian,
    propagate_to_physical,
    to_coefficients,
    to_physical,
)

EPS = np.finfo(float).eps
# About the size of the Silverbox circuit at its sampling step.
OSCILLATOR = PhysicalParameters(m=5e-6, c=2e-4, a=1.0, b=4.0, tau=1e3, xi=1e6)
PHYSICAL = ("m", "c", "a", "b")
COEFFICIENTS = ("theta1", "theta2", "theta3", "eta")

scale = st.floats(1e-2, 1e2)
# Below 1e-200 products may leave the normal floats, where rounding is no longer relative.
signed = st.floats(-1e2, 1e2).map(lambda value: value if abs(value) > 1e-200 else 0.0)
steps = st.floats(1e-3, 10.0)
repeatable = settings(derandomize=True, deadline=None)


def batch_of_oscillators(rng, shape):
    return PhysicalParameters(*(value * rng.uniform(0.5, 1.5, shape) for value in dataclasses.astuple(OSCILLATOR)))


def vector(record, names):
    return np.stack([getattr(record, name) for name in names], axis=-1)


def entry(record, index):
    return type(record)(**{f.name: getattr(record, f.name)[index] for f in dataclasses.fields(record)})


def test_sampling_step_is_that_of_the_record():
    rate = 1 / SAMPLING_STEP
    assert rate == pytest.approx(610.3515625, rel=1e-15)


# m + cδ = 2 and δ² = 1/4, so every number below is exact in binary.
HAND_PHYSICAL = PhysicalParameters(m=1.0, c=2.0, a=4.0, b=8.0, tau=3.0, xi=7.0)
HAND_COEFFICIENTS = Coefficients(theta1=1.0, theta2=-1.0, theta3=-0.5, eta=0.125, gamma=192.0, xi=7.0)


def test_hand_computed_example():
    assert to_coefficients(HAND_PHYSICAL, step=0.5) == HAND_COEFFICIENTS
    assert to_physical(HAND_COEFFICIENTS, step=0.5) == HAND_PHYSICAL


def test_coefficients_solve_the_difference_equation():
    x_before, x, u = 0.03, 0.05, 0.2
    p, psi = OSCILLATOR, to_coefficients(OSCILLATOR)
    x_after = psi.theta1 * x + psi.theta2 * x**3 + psi.theta3 * x_before + psi.eta * u
    acceleration = (x_after - 2 * x + x_before) / SAMPLING_STEP**2
    velocity = (x_after - x) / SAMPLING_STEP
    force = p.m * acceleration + p.c * velocity + p.a * x + p.b * x**3
    assert force == pytest.approx(u, rel=1e-12)


@repeatable
@given(m=scale, c=scale, a=signed, b=signed, tau=scale, xi=scale, step=steps)
def test_physical_round_trip(m, c, a, b, tau, xi, step):
    back = to_physical(to_coefficients(PhysicalParameters(m, c, a, b, tau, xi), step), step)
    # Each error is some roundings of the largest term in the sum that forms the parameter.
    divisor = m + c * step
    assert abs(back.m - m) <= 20 * EPS * m
    assert abs(back.c - c) <= 20 * EPS * divisor / step
    assert abs(back.a - a) <= 20 * EPS * (divisor / step**2 + abs(a))
    assert abs(back.b - b) <= 20 * EPS * abs(b)
    assert abs(back.tau - tau) <= 20 * EPS * tau
    assert back.xi == xi


@repeatable
@given(
    theta1=st.floats(-3, 3),
    theta2=signed,
    theta3=st.floats(-2, 2),
    eta=scale,
    sign=st.sampled_from([-1, 1]),
    gamma=scale,
    xi=scale,
    step=steps,
)
def test_coefficients_round_trip(theta1, theta2, theta3, eta, sign, gamma, xi, step):
    psi = Coefficients(theta1, theta2, theta3, sign * eta, gamma, xi)
    back = to_coefficients(to_physical(psi, step), step)
    # (m + c δ) η / δ² is 1, formed as -θ3 + (1 + θ3): hence the factor 1 + |θ3| throughout.
    rounding = 40 * EPS * (1 + abs(theta3))
    assert abs(back.theta1 - theta1) <= rounding * (1 + abs(theta1) + abs(theta3))
    assert abs(back.theta2 - theta2) <= rounding * abs(theta2)
    assert abs(back.theta3 - theta3) <= rounding * (1 + abs(theta3))
    assert abs(back.eta - sign * eta) <= rounding * eta
    assert abs(back.gamma - gamma) <= rounding * gamma
    assert back.xi == xi


def test_precisions_left_out_mean_no_noise_on_both_sides():
    psi = to_coefficients(PhysicalParameters(1.0, 2.0, 4.0, 8.0), step=0.5)
    assert (psi.gamma, psi.xi) == (np.inf, np.inf)
    phi = to_physical(psi, step=0.5)
    assert (phi.tau, phi.xi) == (np.inf, np.inf)


def test_scalars_stay_floats():
    for record in (to_coefficients(OSCILLATOR), to_physical(to_coefficients(OSCILLATOR))):
        assert {type(value) for value in dataclasses.astuple(record)} == {float}


def test_fields_broadcast_to_one_shape_and_are_copied():
    m = np.array([[1.0], [2.0]])
    record = PhysicalParameters(m=m, c=[1, 2, 3], a=1, b=4.0)
    assert {np.shape(value) for value in dataclasses.astuple(record)} == {(2, 3)}
    m[:] = np.nan
    np.testing.assert_array_equal(record.m, [[1.0] * 3, [2.0] * 3])
    np.testing.assert_array_equal(record.c, [[1.0, 2.0, 3.0]] * 2)


def test_batch_equals_loop():
    parameters = batch_of_oscillators(np.random.default_rng(1), (2, 3))
    coefficients = to_coefficients(parameters)
    mean = vector(coefficients, COEFFICIENTS)
    cov = 1e-6 * (np.eye(4) + mean[..., :, None] * mean[..., None, :])
    batch = {
        "coefficients": vector(coefficients, (*COEFFICIENTS, "gamma", "xi")),
        "physical": vector(to_physical(coefficients), (*PHYSICAL, "tau", "xi")),
        "coefficients_jacobian": coefficients_jacobian(parameters),
        "physical_jacobian": physical_jacobian(coefficients),
        "mean": propagate_to_physical(mean, cov)[0],
        "cov": propagate_to_physical(mean, cov)[1],
    }
    for index in np.ndindex(2, 3):
        phi, psi = entry(parameters, index), entry(coefficients, index)
        single = {
            "coefficients": vector(to_coefficients(phi), (*COEFFICIENTS, "gamma", "xi")),
            "physical": vector(to_physical(psi), (*PHYSICAL, "tau", "xi")),
            "coefficients_jacobian": coefficients_jacobian(phi),
            "physical_jacobian": physical_jacobian(psi),
            "mean": propagate_to_physical(mean[index], cov[index])[0],
            "cov": propagate_to_physical(mean[index], cov[index])[1],
        }
        for name, value in single.items():
            # The last places differ: a float and an array take different routes to a power.
            np.testing.assert_allclose(batch[name][index], value, rtol=1e-12, atol=0, err_msg=name)


def central_differences(function, record, names):
    """Columns are slopes along `names`, each from a step of 1e-6 of that field."""
    columns = []
    for name in names:
        width = 1e-6 * abs(getattr(record, name))
        upper = function(dataclasses.replace(record, **{name: getattr(record, name) + width}))
        lower = function(dataclasses.replace(record, **{name: getattr(record, name) - width}))
        columns.append((upper - lower) / (2 * width))
    return np.stack(columns, axis=-1)


@pytest.mark.parametrize(("parameters", "step"), [(OSCILLATOR, SAMPLING_STEP), (HAND_PHYSICAL, 0.5)])
def test_jacobians_equal_central_differences(parameters, step):
    coefficients = to_coefficients(parameters, step)
    forward = central_differences(lambda phi: vector(to_coefficients(phi, step), COEFFICIENTS), parameters, PHYSICAL)
    backward = central_differences(lambda psi: vector(to_physical(psi, step), PHYSICAL), coefficients, COEFFICIENTS)
    # Sizes differ by many orders: an entry is judged as a change for a change of 100 %.
    for exact, differences, row, column in (
        (
            coefficients_jacobian(parameters, step),
            forward,
            vector(coefficients, COEFFICIENTS),
            vector(parameters, PHYSICAL),
        ),
        (
            physical_jacobian(coefficients, step),
            backward,
            vector(parameters, PHYSICAL),
            vector(coefficients, COEFFICIENTS),
        ),
    ):
        relative = column / row[:, None]
        np.testing.assert_allclose(exact * relative, differences * relative, atol=1e-7, rtol=1e-7)


def test_jacobians_are_inverse_matrices():
    parameters = batch_of_oscillators(np.random.default_rng(2), (5,))
    product = coefficients_jacobian(parameters) @ physical_jacobian(to_coefficients(parameters))
    np.testing.assert_allclose(product, np.broadcast_to(np.eye(4), (5, 4, 4)), atol=1e-12)


def moment_scores(samples, mean, cov):
    """How many standard errors the samples' mean and covariance lie from those given."""
    deviations = samples - mean
    products = deviations[:, :, None] * deviations[:, None, :]
    root = np.sqrt(len(samples))
    return (
        deviations.mean(axis=0) / (samples.std(axis=0) / root),
        (products.mean(axis=0) - cov) / (products.std(axis=0) / root),
    )


def test_propagation_equals_monte_carlo():
    rng = np.random.default_rng(3)
    mean = vector(to_coefficients(OSCILLATOR), COEFFICIENTS)
    # Deviations of 1e-4 keep the second order far below the sampling error of the mean.
    factor = 1e-4 * mean[:, None] * rng.normal(size=(4, 4))
    cov = factor @ factor.T
    samples = mean + rng.normal(size=(200_000, 4)) @ factor.T
    physical = vector(to_physical(Coefficients(*samples.T)), PHYSICAL)
    propagated_mean, propagated_cov = propagate_to_physical(mean, cov)
    np.testing.assert_allclose(propagated_mean, vector(OSCILLATOR, PHYSICAL), rtol=1e-12)
    mean_scores, cov_scores = moment_scores(physical, propagated_mean, propagated_cov)
    assert np.abs(mean_scores).max() < 4.5
    assert np.abs(cov_scores).max() < 4.5


def test_log_uniform_moments_equal_monte_carlo():
    rng = np.random.default_rng(4)
    spread = 0.4
    mean, cov = log_uniform_moments(OSCILLATOR, spread)
    factors = np.exp(rng.uniform(np.log(1 - spread), np.log(1 + spread), (4, 200_000)))
    drawn = PhysicalParameters(*(factors * vector(OSCILLATOR, PHYSICAL)[:, None]))
    samples = vector(to_coefficients(drawn), COEFFICIENTS)
    mean_scores, cov_scores = moment_scores(samples, mean, cov)
    assert np.abs(mean_scores).max() < 4.5
    assert np.abs(cov_scores).max() < 4.5


def test_log_uniform_moments_obey_closed_forms():
    spread = 0.6
    mean, cov = log_uniform_moments(OSCILLATOR, spread)
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
    center = dataclasses.replace(OSCILLATOR, c=OSCILLATOR.m / SAMPLING_STEP)
    mean, cov = log_uniform_moments(center, spread)
    monkeypatch.setattr(module, "QUADRATURE_NODES", 25)
    finer_mean, finer_cov = log_uniform_moments(center, spread)
    deviations = np.sqrt(np.diag(finer_cov))
    mean_error = (mean - finer_mean) / deviations
    cov_error = (cov - finer_cov) / np.outer(deviations, deviations)
    assert np.abs(mean_error).max() < 1e-10
    assert np.abs(cov_error).max() < 1e-10


def test_no_spread_is_the_map_itself():
    mean, cov = log_uniform_moments(OSCILLATOR, 0.0)
    np.testing.assert_allclose(mean, vector(to_coefficients(OSCILLATOR), COEFFICIENTS), rtol=1e-13)
    np.testing.assert_allclose(cov, 0, atol=1e-25)


MEAN = vector(HAND_COEFFICIENTS, COEFFICIENTS)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: PhysicalParameters(np.nan, 1, 1, 1),
            "m must be finite, but m is nan; replace",
        ),
        (
            lambda: PhysicalParameters(1, [1, 1, -np.inf, np.nan], 1, 1),
            "c must be finite, but c[2] is -inf; replace",
        ),
        (
            lambda: Coefficients(1, [[1, 1], [np.inf, 1]], 1, 1),
            "theta2 must be finite, but theta2[1, 0] is inf; replace",
        ),
        (
            lambda: PhysicalParameters(1, 1, 1, 1, tau=0.0),
            "tau must be positive, but tau is 0.0; it is 1 / variance",
        ),
        (
            lambda: PhysicalParameters(1, 1, 1, 1, xi=[1, -2]),
            "xi must be positive, but xi[1] is -2.0; it is 1 / variance",
        ),
        (
            lambda: Coefficients(1, 1, 1, 1, gamma=[1, np.nan]),
            "gamma must be positive, but gamma[1] is nan; it is 1 / variance",
        ),
        (
            lambda: PhysicalParameters([1, 1], [1, 1, 1], 1, 1),
            "fields must broadcast to one shape, but their shapes are m (2,), c (3,), a (), b ()",
        ),
        (
            lambda: to_coefficients(OSCILLATOR, step=0.0),
            "step must be positive and finite, but is 0.0; give the seconds",
        ),
        (
            lambda: to_physical(HAND_COEFFICIENTS, step=np.inf),
            "step must be positive and finite, but is inf; give the seconds",
        ),
        (
            lambda: to_coefficients(PhysicalParameters([2, 1], -2, 1, 1), step=0.5),
            "(m + c * step) must not be 0, but (m + c * step)[1] is 0.0; Eq. (3)",
        ),
        (
            lambda: coefficients_jacobian(PhysicalParameters(1, -2, 1, 1), step=0.5),
            "(m + c * step) must not be 0, but (m + c * step) is 0.0; Eq. (3)",
        ),
        (
            lambda: to_physical(Coefficients(1, 1, 1, [1, 0, 0])),
            "eta must not be 0, but eta[1] is 0.0; no oscillator",
        ),
        (
            lambda: physical_jacobian(Coefficients(1, 1, 1, 0)),
            "eta must not be 0, but eta is 0.0; no oscillator",
        ),
        (
            lambda: propagate_to_physical(MEAN, np.eye(3)),
            "coefficients_mean must have shape (..., 4) and coefficients_cov (..., 4, 4), but "
            "they have (4,) and (3, 3); give one",
        ),
        (
            lambda: propagate_to_physical(np.ones((2, 4)), np.ones((3, 4, 4))),
            "they have (2, 4) and (3, 4, 4); give one",
        ),
        (
            lambda: propagate_to_physical(np.float64(1), np.ones(4)),
            "they have () and (4,); give one",
        ),
        (
            lambda: propagate_to_physical([1, np.nan, 1, 1], np.eye(4)),
            "coefficients_mean must be finite, but coefficients_mean[1] is nan; replace",
        ),
        (
            lambda: propagate_to_physical(MEAN, np.diag([1, 1, np.inf, 1])),
            "coefficients_cov must be finite, but coefficients_cov[2, 2] is inf; replace",
        ),
        (
            lambda: propagate_to_physical([1, 1, 1, 0], np.eye(4)),
            "eta must not be 0, but eta is 0.0; no oscillator",
        ),
        (
            lambda: log_uniform_moments(OSCILLATOR, 1.0),
            "spread must be in [0, 1), but is 1.0; log-uniform",
        ),
        (
            lambda: log_uniform_moments(OSCILLATOR, np.nan),
            "spread must be in [0, 1), but is nan; log-uniform",
        ),
        (
            lambda: log_uniform_moments(PhysicalParameters(1, 1, [1, 2], 1), 0.1),
            "center must be one oscillator, but is a batch of shape (2,); call once",
        ),
        (
            lambda: log_uniform_moments(PhysicalParameters(1, 1, 1, -1), 0.1),
            "center.b must be positive, but is -1.0; a log-uniform",
        ),
        (
            lambda: log_uniform_moments(OSCILLATOR, 0.1, step=-1.0),
            "step must be positive and finite, but is -1.0; give the seconds",
        ),
    ],
)
def test_bad_input_is_named(call, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        call()


def test_log_uniform_moments_do_not_depend_on_threads():
    """Environments start from these moments: a last digit that moves would make every episode another one."""
    program = "from estimator import Prior; print(Prior.silverbox_twin().coefficients_cov.tobytes().hex())"
    printed = {
        subprocess.run(
            [sys.executable, "-c", program],
            env=os.environ | {"OPENBLAS_NUM_THREADS": threads, "OMP_NUM_THREADS": threads},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for threads in ("1", "2")
    }
    assert len(printed) == 1
