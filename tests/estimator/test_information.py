"""Fisher information: against a plain twin, the curvature of the likelihood, the estimator's posterior, and bounds."""

import filtering
import numpy as np
import pytest
from filtering import CASES, of_paper

from estimator import SILVERBOX_TWIN, OnlineEstimator, difference, silverbox_prior
from estimator.information import cramer_rao, fisher_information, follow, relative_covariance, sampled
from estimator.physical import coefficients_of

Q, R = 5e-4, 3e-4
PAPER = difference()
CIRCUIT = {name: getattr(SILVERBOX_TWIN, name) for name in "mcab"}
TWIN = coefficients_of(PAPER, CIRCUIT)


def draw_systems(rng, n, spread=0.3):
    factors = np.exp(rng.uniform(np.log(1 - spread), np.log(1 + spread), (4, n)))
    return coefficients_of(PAPER, {name: CIRCUIT[name] * row for name, row in zip("mcab", factors, strict=True)})


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
    """Innovations (T,) and their variances (T,)."""
    return of_paper(theta, u, y, Q**2, R**2, state_std**2 * np.eye(2))


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
    information = fisher_information(PAPER, systems, u, Q, R, state_std=state_std)
    for theta, inputs, F in zip(systems, u, information, strict=True):
        slopes, variances = differentiated(theta, inputs, simulate(theta, inputs), state_std)
        expected = slopes.T @ (slopes / variances[:, None])
        scale = np.sqrt(np.diag(expected))
        np.testing.assert_allclose(F / np.outer(scale, scale), expected / np.outer(scale, scale), rtol=0, atol=1e-6)


def test_along_outputs_it_is_that_of_the_filter_on_them():
    rng = np.random.default_rng(1)
    theta, u = TWIN, rng.choice([-0.12, 0.12], 100)
    y = simulate(theta, u, rng)
    slopes, variances = differentiated(theta, u, y)
    expected = slopes.T @ (slopes / variances[:, None])
    scale = np.sqrt(np.diag(expected))
    F = fisher_information(PAPER, TWIN, u, Q, R, y=y)
    # The gain's sensitivity is left out: it is of the order of the innovation beside the displacement.
    np.testing.assert_allclose(F / np.outer(scale, scale), expected / np.outer(scale, scale), rtol=0, atol=0.01)


def test_it_is_the_mean_curvature_of_the_log_likelihood():
    rng = np.random.default_rng(2)
    theta, u, runs = TWIN, rng.choice([-0.12, 0.12], 60), 100
    F = fisher_information(PAPER, TWIN, u, Q, R)
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
    y = simulate(TWIN, u, rng)
    prior = silverbox_prior(PAPER, 0.1, Q, R, noise_shape=1e9)
    estimator = OnlineEstimator(prior=prior)
    acting = np.concatenate([u, [0.0]])
    estimator.run(acting, np.concatenate([[0.0], y]))
    precision = np.linalg.inv(prior.coefficients_cov)
    F = fisher_information(PAPER, TWIN, u, Q, R, y=y, state_std=1e-3)
    gained = 0.5 * np.linalg.slogdet((precision + F) @ prior.coefficients_cov)[1]
    posterior = estimator.belief.coefficients_cov
    believed = -0.5 * np.linalg.slogdet(posterior @ precision)[1]
    assert believed == pytest.approx(gained, abs=0.1)


def test_a_series_ends_before_its_first_nan():
    rng = np.random.default_rng(4)
    u = rng.choice([-0.1, 0.1], (2, 50))
    short = u.copy()
    short[0, 30:] = np.nan
    information = fisher_information(PAPER, TWIN, short, Q, R)
    np.testing.assert_array_equal(information[0], fisher_information(PAPER, TWIN, u[0, :30], Q, R))
    np.testing.assert_array_equal(information[1], fisher_information(PAPER, TWIN, u[1], Q, R))
    assert not fisher_information(PAPER, TWIN, u[:, :0], Q, R).any()


def test_bounds():
    rng = np.random.default_rng(5)
    F = fisher_information(PAPER, TWIN, rng.choice([-0.12, 0.12], 200), Q, R)
    precision = np.linalg.inv(silverbox_prior(PAPER).coefficients_cov)
    for bound, total in ((cramer_rao(F), F), (cramer_rao(F, precision), F + precision)):
        np.testing.assert_allclose(bound @ total, np.eye(4), atol=1e-8)
    # Relative errors are those of a simulated change of m, c, a and b.
    bound = cramer_rao(F)
    relative = relative_covariance(PAPER, TWIN, bound)
    draws = rng.multivariate_normal(TWIN, bound, size=20_000)
    eta = draws[:, 3]
    a = (1 - draws[:, 0] - draws[:, 2]) / eta / SILVERBOX_TWIN.a - 1
    b = -draws[:, 1] / eta / SILVERBOX_TWIN.b - 1
    np.testing.assert_allclose(np.sqrt(np.diag(relative))[2:], [a.std(), b.std()], rtol=0.03)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"process_noise": -1.0}, "process_noise must be 0 or more"),
        ({"measurement_noise": -1.0}, "measurement_noise must be positive"),
        ({"state_std": -1.0}, "state_std must be a number from 0"),
        ({"measurement_noise": [1.0, 2.0]}, "measurement_noise must be one number, or one for each"),
        ({"y": np.zeros(3)}, "u and y must have one shape"),
        ({"interpolation": "linear"}, "interpolation must be 'zero_order' for the difference equation"),
        ({"interpolation": "spline"}, "interpolation must be one of"),
    ],
)
def test_errors_name_the_argument(arguments, words):
    with pytest.raises(ValueError, match=words):
        fisher_information(PAPER, TWIN, np.zeros(5), **{"process_noise": Q, "measurement_noise": R, **arguments})


def test_errors_of_batches_and_of_nothing_learned():
    with pytest.raises(ValueError, match="batches of one size"):
        fisher_information(PAPER, np.ones((3, 4)), np.zeros((2, 5)), Q, R)
    with pytest.raises(ValueError, match="process_noise and measurement_noise must be of as many records"):
        fisher_information(PAPER, TWIN, np.zeros(5), np.full(3, Q), np.full((2, 1), R))
    with pytest.raises(ValueError, match="coefficients must be of"):
        fisher_information(PAPER, np.ones(3), np.zeros(5), Q, R)
    with pytest.raises(ValueError, match="positive definite"):
        cramer_rao(fisher_information(PAPER, TWIN, np.zeros(5), Q, R))


@pytest.mark.parametrize("case", CASES)
def test_of_any_model_it_is_that_of_a_filter_with_matrices(case):
    model, interpolation, c, size = CASES[case]
    u = size * np.random.default_rng(6).uniform(-1, 1, 30)
    q, r = 2e-3, 1e-3
    expected = filtering.information(model, interpolation, c, u, q**2, r**2, 1e-6)
    F = fisher_information(model, c, u, q, r, interpolation=interpolation, state_std=1e-3)
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(F / np.outer(scale, scale), expected / np.outer(scale, scale), rtol=0, atol=1e-5)


@pytest.mark.parametrize("case", CASES)
def test_the_likelihood_of_any_model_is_that_of_a_filter_with_matrices(case):
    model, interpolation, c, size = CASES[case]
    rng = np.random.default_rng(7)
    u, q, r = size * rng.uniform(-1, 1, (2, 20)), 2e-5, 1e-5
    y = np.array([filtering.filtered(model, interpolation, c, row, None, q**2, r**2)[2] for row in u])
    y += r * rng.standard_normal(y.shape)
    degree = int(interpolation == "linear")
    points, rest = np.array([c, c], dtype=np.float64), np.zeros((model.n_states, model.n_states))
    found = follow(model, points, sampled(model, u, degree), y, np.array([q**2, *[r**2] * model.n_outputs]), rest)
    for row in range(2):
        value = filtering.log_likelihood(model, interpolation, c, u[row], y[row], q**2, r**2)
        assert -found.loss[row] == pytest.approx(value, rel=1e-6)
        std = 1 / np.sqrt(np.diag(found.information[row]))
        for j in range(len(c)):
            h = 1e-3 * std * (np.arange(len(c)) == j)
            up, down = (
                filtering.log_likelihood(model, interpolation, c + s * h, u[row], y[row], q**2, r**2) for s in (1, -1)
            )
            # In standard deviations. Left out is what S and the gain tell, which is as small as the noise beside u.
            assert -found.slope[row, j] * std[j] == pytest.approx((up - down) / 2e-3, abs=0.02)
    np.testing.assert_array_equal(found.information, np.swapaxes(found.information, 1, 2))


@pytest.mark.parametrize("case", CASES)
def test_a_series_may_begin_in_any_motion(case):
    model, interpolation, c, size = CASES[case]
    rng = np.random.default_rng(9)
    u, q, r, spread = size * rng.uniform(-1, 1, (2, 20)), 2e-5, 1e-5, 1e-4
    begin = 0.3 * size * rng.standard_normal((2, model.n_states))
    noise = q**2, r**2, 0.0
    y = np.array([filtering.filtered(model, interpolation, c, u[i], None, *noise, begin[i])[2] for i in range(2)])
    y += r * rng.standard_normal(y.shape)
    points, cov = np.array([c, c], dtype=np.float64), spread**2 * np.eye(model.n_states)
    noises = np.array([q**2, *[r**2] * model.n_outputs])
    found = follow(model, points, sampled(model, u, int(interpolation == "linear")), y, noises, cov, begin)
    for row in range(2):
        value = filtering.log_likelihood(model, interpolation, c, u[row], y[row], q**2, r**2, spread**2, begin[row])
        assert -found.loss[row] == pytest.approx(value, rel=1e-6)


def test_spare_lanes_and_other_series_change_nothing():
    rng = np.random.default_rng(8)
    systems, u = draw_systems(rng, 40), rng.choice([-0.1, 0.1], (40, 30))
    u[7] = np.nan
    u[11, 4:] = np.nan
    many = fisher_information(PAPER, systems, u, Q, R)
    for row in (0, 7, 11, 39):
        np.testing.assert_array_equal(many[row], fisher_information(PAPER, systems[row], u[row], Q, R))
    np.testing.assert_array_equal(many[7], np.zeros((4, 4)))
