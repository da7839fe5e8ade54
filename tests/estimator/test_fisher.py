"""Fisher information: against a plain twin, the curvature of the likelihood, the estimator's posterior, and bounds."""

import numpy as np
import pytest

from estimator import (
    SAMPLING_STEP,
    SILVERBOX_TWIN,
    Coefficients,
    OnlineEstimator,
    PhysicalParameters,
    Prior,
    to_coefficients,
)
from estimator.fisher import as_rows, cramer_rao, fisher_information, ode_information, relative_covariance
from estimator.models.ode import N_MOTION, DuffingODE, flow

Q, R = 5e-4, 3e-4
TWIN = to_coefficients(SILVERBOX_TWIN)


def draw_systems(rng, n, spread=0.3):
    factors = np.exp(rng.uniform(np.log(1 - spread), np.log(1 + spread), (4, n)))
    centre = np.array([getattr(SILVERBOX_TWIN, name) for name in "mcab"])
    return to_coefficients(PhysicalParameters(*(centre[:, None] * factors)))


def simulate(theta, u, rng=None):
    """Outputs (T,) of Eq. (2) from rest; without noise where there is no generator."""
    x, last, y = 0.0, 0.0, np.empty(len(u))
    for t in range(len(u)):
        x, last = theta @ np.array([x, x**3, last, u[t]]), x
        if rng is not None:
            x += Q * rng.standard_normal()
        y[t] = x + (R * rng.standard_normal() if rng is not None else 0.0)
    return y


def filtered(theta, u, y, state_std=0.0):
    """Innovations (T,) and their variances (T,) of the extended Kalman filter, with matrices."""
    m, P, H = np.zeros(2), state_std**2 * np.eye(2), np.array([[1.0, 0.0]])
    innovations, variances = np.empty(len(u)), np.empty(len(u))
    for t in range(len(u)):
        A = np.array([[theta[0] + 3 * theta[1] * m[0] ** 2, theta[2]], [1.0, 0.0]])
        m = np.array([theta @ np.array([m[0], m[0] ** 3, m[1], u[t]]), m[0]])
        P = A @ P @ A.T + np.diag([Q**2, 0.0])
        S = H @ P @ H.T + R**2
        K = P @ H.T / S
        innovations[t], variances[t] = y[t] - m[0], S[0, 0]
        m = m + K[:, 0] * innovations[t]
        P = (np.eye(2) - K @ H) @ P
    return innovations, variances


def differentiated(theta, u, y, state_std=0.0):
    """Slopes (T, 4) of the innovations by central differences, and their variances (T,)."""
    slopes = np.empty((len(u), 4))
    for j, h in enumerate(1e-6 * np.array([1.0, 10.0, 1.0, 1.0])):
        up, down = theta.copy(), theta.copy()
        up[j] += h
        down[j] -= h
        slopes[:, j] = (filtered(up, u, y, state_std)[0] - filtered(down, u, y, state_std)[0]) / (2 * h)
    return slopes, filtered(theta, u, y, state_std)[1]


def log_likelihood(theta, u, y):
    innovations, variances = filtered(theta, u, y)
    return -0.5 * np.sum(np.log(variances) + innovations**2 / variances)


@pytest.mark.parametrize("state_std", [0.0, 1e-3])
def test_without_noise_it_is_what_differences_of_the_filters_innovations_give(state_std):
    # Without noise the innovations are zero, so the gain's own sensitivity has no effect, and F is exact.
    rng = np.random.default_rng(0)
    systems = draw_systems(rng, 5)
    u = rng.choice([-0.12, 0.12], (5, 60))
    information = fisher_information(systems, u, Q, R, state_std=state_std)
    for theta, inputs, F in zip(as_rows(systems), u, information, strict=True):
        slopes, variances = differentiated(theta, inputs, simulate(theta, inputs), state_std)
        expected = slopes.T @ (slopes / variances[:, None])
        scale = np.sqrt(np.diag(expected))
        np.testing.assert_allclose(F / np.outer(scale, scale), expected / np.outer(scale, scale), rtol=0, atol=1e-6)


def test_along_outputs_it_is_that_of_the_filter_on_them():
    rng = np.random.default_rng(1)
    theta, u = as_rows(TWIN), rng.choice([-0.12, 0.12], 100)
    y = simulate(theta, u, rng)
    slopes, variances = differentiated(theta, u, y)
    expected = slopes.T @ (slopes / variances[:, None])
    scale = np.sqrt(np.diag(expected))
    F = fisher_information(TWIN, u, Q, R, y=y)
    # The gain's sensitivity is left out: it is of the order of the innovation beside the displacement.
    np.testing.assert_allclose(F / np.outer(scale, scale), expected / np.outer(scale, scale), rtol=0, atol=0.01)


def test_it_is_the_mean_curvature_of_the_log_likelihood():
    rng = np.random.default_rng(2)
    theta, u, runs = as_rows(TWIN), rng.choice([-0.12, 0.12], 60), 100
    F = fisher_information(TWIN, u, Q, R)
    scale = 1 / np.sqrt(np.diag(F))
    steps = 0.1 * scale
    curvatures = np.empty((runs, 4))
    for i in range(runs):
        y = simulate(theta, u, rng)
        middle = log_likelihood(theta, u, y)
        for j in range(4):
            h = np.eye(4)[j] * steps
            sides = log_likelihood(theta + h, u, y) + log_likelihood(theta - h, u, y)
            curvatures[i, j] = (2 * middle - sides) / steps[j] ** 2
    standardised = curvatures * scale**2
    error = standardised.std(axis=0) / np.sqrt(runs)
    assert np.all(np.abs(standardised.mean(axis=0) - 1) < 4 * error + 0.01)
    assert error.max() < 0.05


def test_the_structured_posterior_has_the_information_of_prior_and_data():
    # With known noises it is an extended Kalman filter of state and coefficients, so its precision is near Λ0 + F.
    rng = np.random.default_rng(3)
    u = rng.choice([-0.12, 0.12], 250)
    y = simulate(as_rows(TWIN), u, rng)
    prior = Prior.silverbox_twin(0.1, Q, R, noise_shape=1e9)
    estimator = OnlineEstimator(prior=prior)
    acting = np.concatenate([u, [0.0]])
    estimator.run(acting, np.concatenate([[0.0], y]))
    precision = np.linalg.inv(prior.coefficients_cov)
    F = fisher_information(TWIN, u, Q, R, y=y, state_std=1e-3)
    gained = 0.5 * np.linalg.slogdet((precision + F) @ prior.coefficients_cov)[1]
    posterior = estimator.belief.coefficients_cov
    believed = -0.5 * np.linalg.slogdet(posterior @ precision)[1]
    assert believed == pytest.approx(gained, abs=0.1)


def test_a_series_ends_before_its_first_nan():
    rng = np.random.default_rng(4)
    u = rng.choice([-0.1, 0.1], (2, 50))
    short = u.copy()
    short[0, 30:] = np.nan
    information = fisher_information(TWIN, short, Q, R)
    np.testing.assert_array_equal(information[0], fisher_information(TWIN, u[0, :30], Q, R))
    np.testing.assert_array_equal(information[1], fisher_information(TWIN, u[1], Q, R))


def test_bounds():
    rng = np.random.default_rng(5)
    F = fisher_information(TWIN, rng.choice([-0.12, 0.12], 200), Q, R)
    precision = np.linalg.inv(Prior.silverbox_twin().coefficients_cov)
    for bound, total in ((cramer_rao(F), F), (cramer_rao(F, precision), F + precision)):
        np.testing.assert_allclose(bound @ total, np.eye(4), atol=1e-8)
    # Relative errors are those of a simulated change of m, c, a and b.
    bound = cramer_rao(F)
    relative = relative_covariance(TWIN, bound)
    draws = rng.multivariate_normal(as_rows(TWIN), bound, size=20_000)
    eta = draws[:, 3]
    a = (1 - draws[:, 0] - draws[:, 2]) / eta / SILVERBOX_TWIN.a - 1
    b = -draws[:, 1] / eta / SILVERBOX_TWIN.b - 1
    np.testing.assert_allclose(np.sqrt(np.diag(relative))[2:], [a.std(), b.std()], rtol=0.03)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"process_noise": 0.0}, "process_noise must be positive"),
        ({"measurement_noise": -1.0}, "measurement_noise must be positive"),
        ({"state_std": -1.0}, "state_std must be 0 or more"),
        ({"y": np.zeros(3)}, "u and y must have one shape"),
    ],
)
def test_errors_name_the_argument(arguments, words):
    with pytest.raises(ValueError, match=words):
        fisher_information(TWIN, np.zeros(5), **arguments)


def test_errors_of_batches_and_of_nothing_learned():
    batch = Coefficients(*(np.ones(3) for _ in range(4)))
    with pytest.raises(ValueError, match="batches of one size"):
        fisher_information(batch, np.zeros((2, 5)))
    with pytest.raises(ValueError, match="positive definite"):
        cramer_rao(fisher_information(TWIN, np.zeros(5)))


def ode_innovations(parameters, u, y, q, r):
    """Innovations and their variances of the extended Kalman filter of Eq. (1) from rest, with matrices."""
    model, step = DuffingODE(), SAMPLING_STEP
    p = np.concatenate([parameters * [step**2, step, step**2, step**2], np.zeros(3)])
    J, work = np.empty((2, N_MOTION)), np.empty((3, 2, N_MOTION))
    m, P, d = np.zeros(2), np.zeros((2, 2)), np.array([1.0, 2.0])
    innovations, variances = np.empty(len(u) - 1), np.empty(len(u) - 1)
    for t, piece in enumerate(model.pieces(u)):
        m = np.array(flow(m[0], m[1], p, piece, model.substeps, J, work))
        A = J[:, :2]
        P = A @ P @ A.T + q**2 * np.outer(d, d)
        variances[t] = P[0, 0] + r**2
        K = P[:, 0] / variances[t]
        innovations[t] = y[t] - m[0]
        m, P = m + K * innovations[t], P - np.outer(K, P[0])
    return innovations, variances


def test_the_equation_of_motion_has_an_information_too():
    rng = np.random.default_rng(6)
    twin = SILVERBOX_TWIN
    parameters = np.array([twin.a, twin.c, 1.0, twin.b]) / twin.m
    u, q, r = 0.1 * rng.uniform(-1, 1, 80), 2e-4, 1e-3
    silent = -ode_innovations(parameters, u, np.zeros(79), 0.0, 1e6)[0]  # no output is believed: a free run
    slopes = np.empty((79, 4))
    for j in range(4):
        h = 1e-5 * parameters * (np.arange(4) == j)
        sides = [ode_innovations(parameters + s * h, u, silent, q, r)[0] for s in (1, -1)]
        slopes[:, j] = (sides[0] - sides[1]) / (2 * h[j])
    variances = ode_innovations(parameters, u, silent, q, r)[1]
    expected = slopes.T @ (slopes / variances[:, None])
    scale = np.sqrt(np.diag(expected))
    F = ode_information(parameters, u, q, r)
    np.testing.assert_allclose(F / np.outer(scale, scale), expected / np.outer(scale, scale), rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    ("parameters", "arguments", "words"),
    [
        (np.ones(3), {}, r"parameters must have shape \(4,\)"),
        (np.ones(4), {"process_noise": -1.0}, "process_noise must be 0 or more"),
        (np.ones(4), {"measurement_noise": 0.0}, "measurement_noise must be positive"),
    ],
)
def test_its_errors_name_the_argument(parameters, arguments, words):
    with pytest.raises(ValueError, match=words):
        ode_information(parameters, np.zeros(5), **arguments)
