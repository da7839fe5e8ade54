"""Fisher information: against a plain twin, the curvature of the likelihood, the estimator's posterior, and bounds."""

import numpy as np
import pytest
from reference.filters import Plant, acting, central, filter_paper, path
from reference.plants import CASES
from tables import table

from estimator import SILVERBOX_TWIN, OnlineEstimator, difference, silverbox_prior
from estimator.inference.fisher_information import cramer_rao, fisher_information, relative_covariance
from estimator.inference.record_filter import inputs_by_sample, record_likelihoods
from estimator.rigs.physical_parameters import coefficients_of

Q, R = 5e-4, 3e-4
PAPER = difference()
CIRCUIT = {name: getattr(SILVERBOX_TWIN, name) for name in "mcab"}
TWIN = coefficients_of(PAPER, CIRCUIT)


def draw_systems(rng, n, spread=0.3):
    factors = np.exp(rng.uniform(np.log(1 - spread), np.log(1 + spread), (4, n)))
    return coefficients_of(PAPER, {name: CIRCUIT[name] * row for name, row in zip("mcab", factors, strict=True)})


def simulate(theta, u, rng=None, runs=()):
    """Outputs (T, *runs) of Eq. (2) from rest; without noise where there is no generator."""
    x, last, y = np.zeros(runs), np.zeros(runs), np.empty((len(u), *runs))
    for t in range(len(u)):
        x, last = theta[0] * x + theta[1] * x**3 + theta[2] * last + theta[3] * u[t], x
        if rng is not None:
            x = x + Q * rng.standard_normal(runs)
        y[t] = x if rng is None else x + R * rng.standard_normal(runs)
    return y


def differentiated(theta, u, y, state_std=0.0):
    """Fisher's information from slopes of the filter's innovations by differences."""
    cov = state_std**2 * np.eye(2)
    slopes = central(lambda c: filter_paper(c, u, y, Q**2, R**2, cov)[0], theta, 1e-5 * np.array([1, 10, 1, 1]))
    return slopes.T @ (slopes / filter_paper(theta, u, y, Q**2, R**2, cov)[1][:, None])


def log_likelihood(theta, u, y):
    """Of one record (T,), or of each of outputs (T, runs), without the constant."""
    innovations, variances = filter_paper(theta, u, y, Q**2, R**2)
    return -0.5 * np.sum(np.log(variances) + innovations**2 / variances, axis=0)


def assert_informations_agree(found, expected, atol):
    scale = np.outer(*[np.sqrt(np.diag(expected))] * 2)
    np.testing.assert_allclose(found / scale, expected / scale, rtol=0, atol=atol)


@table("state_std", [0.0, 1e-3])
def test_without_noise_it_is_what_differences_of_the_filters_innovations_give(state_std):
    # Without noise the innovations are zero, so the gain's own sensitivity has no effect, and F is exact.
    rng = np.random.default_rng(0)
    systems = draw_systems(rng, 5)
    u = rng.choice([-0.12, 0.12], (5, 60))
    information = fisher_information(PAPER, systems, u, Q, R, state_std=state_std)
    for theta, inputs, F in zip(systems, u, information, strict=True):
        assert_informations_agree(F, differentiated(theta, inputs, simulate(theta, inputs), state_std), 1e-6)


def test_along_outputs_it_is_that_of_the_filter_on_them():
    rng = np.random.default_rng(1)
    theta, u = TWIN, rng.choice([-0.12, 0.12], 100)
    y = simulate(theta, u, rng)
    # The gain's sensitivity is left out: it is of the order of the innovation beside the displacement.
    assert_informations_agree(fisher_information(PAPER, TWIN, u, Q, R, y=y), differentiated(theta, u, y), 0.01)


def test_it_is_the_mean_curvature_of_the_log_likelihood():
    rng = np.random.default_rng(2)
    theta, u, runs = TWIN, rng.choice([-0.12, 0.12], 60), 100
    F = fisher_information(PAPER, TWIN, u, Q, R)
    scale = 1 / np.sqrt(np.diag(F))
    steps = 0.1 * scale
    y = simulate(theta, u, rng, (runs,))
    middle, curvatures = log_likelihood(theta, u, y), np.empty((runs, 4))
    for j, h in enumerate(steps * np.eye(4)):
        sides = log_likelihood(theta + h, u, y) + log_likelihood(theta - h, u, y)
        curvatures[:, j] = (2 * middle - sides) / steps[j] ** 2
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


def test_cramer_rao_bounds():
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


@table(
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
    with pytest.raises(ValueError, match="process_noise and measurement_noise must be batches"):
        fisher_information(PAPER, TWIN, np.zeros(5), np.full(3, Q), np.full((2, 1), R))
    with pytest.raises(ValueError, match=r"coefficients must be .* on the last axis"):
        fisher_information(PAPER, np.ones(3), np.zeros(5), Q, R)
    with pytest.raises(ValueError, match="positive definite"):
        cramer_rao(fisher_information(PAPER, TWIN, np.zeros(5), Q, R))


def along(case, u, q, r, y=None, state=0.0, cov=0.0, coefficients=None):
    """The filter of a case with matrices; ``cov``: variance of each state before the first sample."""
    model, interpolation, c, _ = CASES[case]
    plant, n = Plant.of(model), model.n_states
    inputs = [acting(plant, u, t, interpolation) for t in range(len(u))]
    c = c if coefficients is None else coefficients
    return path(plant, state + np.zeros(n), cov * np.eye(n), c, inputs, q**2, [r**2] * model.n_outputs, y)


@pytest.mark.parametrize("case", ["motion", "tanks"])
def test_of_any_model_it_is_that_of_a_filter_with_matrices(case):
    model, interpolation, c, size = CASES[case]
    u = size * np.random.default_rng(6).uniform(-1, 1, 30)
    F = fisher_information(model, c, u, 2e-3, 1e-3, interpolation=interpolation, state_std=1e-3)
    assert_informations_agree(F, along(case, u, 2e-3, 1e-3, cov=1e-6).information, 1e-9)


@pytest.mark.parametrize("case", CASES)
def test_the_likelihood_of_any_model_is_that_of_a_filter_with_matrices(case):
    """Of series that begin at rest, and of such that may begin in any motion."""
    model, interpolation, c, size = CASES[case]
    rng, q, r = np.random.default_rng(7), 2e-5, 1e-5
    points, noises = np.array([c, c], dtype=np.float64), np.array([q**2, *[r**2] * model.n_outputs])
    for begin, spread in (
        (np.zeros((2, model.n_states)), 0.0),
        (0.3 * size * rng.standard_normal((2, model.n_states)), 1e-4),
    ):
        u = size * rng.uniform(-1, 1, (2, 20))
        y = np.array(
            [along(case, row, q, r, state=state, cov=spread**2).shown for row, state in zip(u, begin, strict=True)]
        )
        y += r * rng.standard_normal(y.shape)
        laid, cov = inputs_by_sample(model, u, int(interpolation == "linear")), spread**2 * np.eye(model.n_states)
        found = record_likelihoods(model, points, laid, y, noises, cov, *((begin,) if spread else ()))
        for row in range(2):
            expected = along(case, u[row], q, r, y[row], begin[row], spread**2)
            assert found.loss[row] == pytest.approx(expected.loss, rel=1e-9)
            std = 1 / np.sqrt(np.diag(found.information[row]))
            np.testing.assert_allclose(found.gradient[row] * std, expected.gradient * std, atol=1e-6)
            assert_informations_agree(found.information[row], expected.information, 1e-9)
        np.testing.assert_array_equal(found.information, np.swapaxes(found.information, 1, 2))
    if model.is_continuous:
        return
    # In standard deviations. F omits the information in S and the gain, whose share is as small as the noise beside u.
    for j, h in enumerate(1e-3 * std * np.eye(len(c))):
        up, down = (along(case, u[1], q, r, y[1], begin[1], spread**2, c + s * h).loss for s in (1, -1))
        assert found.gradient[1, j] * std[j] == pytest.approx((up - down) / 2e-3, abs=0.02)


def test_spare_lanes_and_other_series_change_nothing():
    rng = np.random.default_rng(8)
    systems, u = draw_systems(rng, 40), rng.choice([-0.1, 0.1], (40, 30))
    u[7] = np.nan
    u[11, 4:] = np.nan
    many = fisher_information(PAPER, systems, u, Q, R)
    for row in (0, 7, 11, 39):
        np.testing.assert_array_equal(many[row], fisher_information(PAPER, systems[row], u[row], Q, R))
    np.testing.assert_array_equal(many[7], np.zeros((4, 4)))
