"""Sigma points: the moments against a plain twin with whole matrices and against Gaussian integrals known exactly."""

import re

import numpy as np
import pytest

from estimator import NLARX, DuffingODE, JointBelief, OnlineEstimator
from estimator.inference import sigma_points
from estimator.models.ode import N_MOTION, N_STATES, flow, flow_points
from estimator.models.regressors import PRESETS, Term

STATES, SIZE, MOVERS = 2, 7, 6

MODELS = [NLARX(regressors="three-tap"), DuffingODE(cubic_damping=True), DuffingODE("look_ahead")]


def some_moments(rng, known=()):
    """Mean and covariance (SIZE) at random, standard deviations over three decades; some dimensions are known."""
    std = np.exp(rng.uniform(np.log(1e-3), np.log(1.0), SIZE))
    factor = rng.standard_normal((SIZE, SIZE + 2))
    cov = factor @ factor.T
    cov *= np.outer(std, std) / np.sqrt(np.outer(np.diag(cov), np.diag(cov)))
    cov[list(known), :] = cov[:, list(known)] = 0.0
    return rng.standard_normal(SIZE), cov


def predicted(mean, cov, motion, movers=MOVERS, walk=None):
    """What the module makes of a motion (movers,) -> (k,) of the state: mean, covariance, number of pairs."""
    mean, cov = mean.copy(), cov.copy()
    columns, points = sigma_points.memory(len(mean), movers)
    points[:] = np.nan
    pairs = sigma_points.spread(mean, cov, columns, points)
    assert np.isnan(points[:, 2 * pairs :]).all()
    moved = np.array([motion(point) for point in points[:, : 2 * pairs].T]).T
    walk = np.zeros(len(mean) - len(moved)) if walk is None else walk
    sigma_points.predict(mean, cov, np.ascontiguousarray(moved), columns, pairs, walk)
    return mean, cov, pairs


def twin(mean, cov, motion, movers=MOVERS, states=STATES):
    """The same: points of the unknown movers, and the conditional Gaussian of the other dimensions at each of them."""
    unknown = [i for i in range(movers) if cov[i, i] > 0]
    P = cov[np.ix_(unknown, unknown)]
    deviations = np.sqrt(len(unknown)) * np.linalg.cholesky(P)
    deviations = np.hstack([deviations, -deviations])
    onto = np.zeros((len(mean), len(unknown)))
    onto[unknown] = np.eye(len(unknown))
    others = [i for i in range(len(mean)) if i not in unknown]
    onto[others] = np.linalg.solve(P, cov[np.ix_(unknown, others)]).T
    joint = mean[:, None] + onto @ deviations
    rest = cov - onto @ P @ onto.T  # of the others, given the movers
    joint[:states] = np.column_stack([motion(point[:movers]) for point in joint.T])
    weight = 1 / joint.shape[1]
    center = joint @ np.full(joint.shape[1], weight)
    result = weight * (joint - center[:, None]) @ (joint - center[:, None]).T
    result[np.ix_(others, others)] += rest[np.ix_(others, others)]
    return center, result


def assert_same(actual, expected, tolerance):
    """Means and covariances agree in standard deviations."""
    std = np.sqrt(np.diag(expected[1]))
    std[std < 1e-12] = 1.0  # known, but for the twin's rounding
    np.testing.assert_allclose(actual[0] / std, expected[0] / std, rtol=tolerance, atol=tolerance)
    np.testing.assert_allclose(actual[1] / np.outer(std, std), expected[1] / np.outer(std, std), atol=tolerance)


def bent(point):
    """A motion of the state that is far from linear."""
    return np.array([np.sin(3 * point[0]) + point[1] * point[2] ** 2, np.exp(point[3] / 2) * point[4] - point[5]])


@pytest.mark.parametrize("known", [(), (3,), (6,), (1, 2, 5), (0, 1)])
def test_a_prediction_equals_its_twin(known):
    rng = np.random.default_rng(len(known))
    for _ in range(50):
        mean, cov = some_moments(rng, known)
        walk = 0.1 * np.diag(cov)[STATES:]
        actual, still = predicted(mean, cov, bent, walk=walk), predicted(mean, cov, bent)
        expected = twin(mean, cov, bent)
        assert actual[2] == MOVERS - len([i for i in known if i < MOVERS])
        assert_same(still[:2], expected, 1e-9)
        np.testing.assert_array_equal(still[1][STATES:, STATES:], cov[STATES:, STATES:])  # parameters do not move
        np.testing.assert_array_equal(actual[1], still[1] + np.diag([0.0, 0.0, *walk]))
        np.testing.assert_array_equal(still[0][STATES:], mean[STATES:])
        np.testing.assert_array_equal(still[1], still[1].T)


def test_a_motion_without_bends_is_carried_exactly():
    rng = np.random.default_rng(10)
    for known in ((), (2, 4)):
        mean, cov = some_moments(rng, known)
        slope, offset = rng.standard_normal((STATES, MOVERS)), rng.standard_normal(STATES)
        F = np.eye(SIZE)
        F[:STATES] = np.pad(slope, ((0, 0), (0, SIZE - MOVERS)))
        expected = F @ mean + np.pad(offset, (0, SIZE - STATES)), F @ cov @ F.T
        assert_same(predicted(mean, cov, lambda point, A=slope, b=offset: A @ point + b), expected, 1e-10)


def test_means_of_products_of_two_and_of_a_cube_are_the_integrals():
    """E[x y] = m_x m_y + P_xy and E[x² y] = m_x² m_y + m_y P_xx + 2 m_x P_xy (Isserlis), which first order misses."""
    mean, cov = some_moments(np.random.default_rng(11))
    moved, _, _ = predicted(mean, cov, lambda point: np.array([point[0] * point[3], point[1] ** 2 * point[4]]))
    expected = [
        mean[0] * mean[3] + cov[0, 3],
        mean[1] ** 2 * mean[4] + mean[4] * cov[1, 1] + 2 * mean[1] * cov[1, 4],
    ]
    np.testing.assert_allclose(moved[:2], expected, rtol=1e-12, atol=1e-13)


def test_dimensions_that_depend_on_others_get_no_points():
    rng = np.random.default_rng(12)
    mean, cov = some_moments(rng)
    onto = np.eye(SIZE)
    onto[2], onto[4] = onto[0] - 2 * onto[1], 3 * onto[3]
    cov = onto @ cov @ onto.T
    moved, joint, pairs = predicted(mean, cov, lambda point: point[[0, 1]])
    assert pairs == MOVERS - 2
    assert_same((moved, joint), (mean, cov), 1e-10)


def test_a_state_that_is_known_moves():
    mean = np.arange(1.0, 8.0)
    moved, cov, pairs = predicted(mean, np.zeros((SIZE, SIZE)), bent)
    assert pairs == 1
    np.testing.assert_array_equal(moved[:STATES], bent(mean))
    np.testing.assert_array_equal(cov, 0.0)


@pytest.mark.parametrize("count", [2, 5, 18])
def test_points_flow_as_one_does(count):
    rng = np.random.default_rng(13)
    points = np.full((N_MOTION, 2 * N_MOTION), np.nan)
    points[:, :count] = rng.uniform(0.1, 0.5, (N_MOTION, count))
    piece, before = rng.standard_normal(4), points.copy()
    flow_points(points, count, piece, 3)
    sensitivities, work = np.empty((2, N_MOTION)), np.empty((3, 2, N_MOTION))
    expected = [flow(p[0], p[1], p[2:].copy(), piece, 3, sensitivities, work) for p in before[:, :count].T]
    np.testing.assert_allclose(points[:2, :count].T, expected, rtol=1e-13, atol=1e-15)
    np.testing.assert_array_equal(points[2:], before[2:])
    assert np.isnan(points[:, count:]).all()


# --- Estimators ----------------------------------------------------------------------------------------------------


def some_record(samples=300):
    rng = np.random.default_rng(3)
    u, y = rng.uniform(-0.1, 0.1, samples), np.zeros(samples)
    for t in range(2, samples):
        y[t] = 1.48 * y[t - 1] - 1.5 * y[t - 1] ** 3 - 0.94 * y[t - 2] + 0.2 * (u[t - 1] + u[t])
    return u, y + 5e-4 * rng.standard_normal(samples)


def estimate(model, prior=None, expectations="sigma_points", drift=0.0):
    return OnlineEstimator(model, prior, expectations=expectations, drift=drift)


def with_prior(model, scale=1.0, **fixed):
    """The model's prior with standard deviations scaled, and parameters fixed at given values."""
    prior = model.prior()
    mean, cov = prior.mean.copy(), scale**2 * prior.cov
    for name, value in fixed.items():
        i = STATES + prior.names.index(name)
        mean[i], cov[i, :], cov[:, i] = value, 0.0, 0.0
    noises = (prior.gamma_shape, prior.gamma_rate, prior.xi_shape, prior.xi_rate)
    return JointBelief(prior.names, prior.units, mean, cov, *noises)


def ode_motion(last, now, substeps):
    """The motion of `DuffingODE` over a sample between two inputs."""

    def motion(point):
        sensitivities, work = np.empty((2, N_MOTION)), np.empty((3, 2, N_MOTION))
        piece = np.array([last, now - last])
        return np.array(flow(point[0], point[1], point[2:].copy(), piece, substeps, sensitivities, work))

    return motion


def regressor_motion(terms, inputs):
    """The motion of declared regressors, given the inputs by tap."""

    def motion(point):
        x1, x2 = point[:2]
        taps = {None: 1.0, **dict(enumerate(inputs))}
        return np.array([sum(c * x1**t.lag1 * x2**t.lag2 * taps[t.tap] for c, t in zip(point[2:], terms)), x1])  # noqa: B905

    return motion


@pytest.mark.parametrize("learned", [1, 40])
@pytest.mark.parametrize("kind", ["ode", "regressors"])
def test_a_step_of_an_estimator_equals_its_twin(kind, learned):
    """From a wide belief and from a learned one, over a sample whose output is missing, with drift."""
    u, y = some_record()
    model = DuffingODE(cubic_damping=True) if kind == "ode" else NLARX(regressors="cubic")
    estimator = estimate(model, drift=0.01)
    estimator.run(u[:learned], y[:learned])
    before = {name: array.copy() for name, array in estimator.arrays().items()}
    estimator.run(u[learned : learned + 1], [np.nan], missing=True)
    after = estimator.arrays()
    taps = [u[learned - i] if learned >= i else 0.0 for i in range(3)]
    motion = ode_motion(taps[1], taps[0], model.substeps) if kind == "ode" else regressor_motion(model.terms, taps)
    movers = N_MOTION if kind == "ode" else len(before["mean"])
    mean, cov = twin(before["mean"], before["cov"], motion, movers)
    direction = np.zeros(len(mean))
    direction[:2] = (1.0, 2.0) if kind == "ode" else (1.0, 0.0)
    cov += before["noises"][1] / before["noises"][0] * np.outer(direction, direction)
    cov[N_STATES:, N_STATES:] += np.diag(before["walk"])
    assert_same((after["mean"], after["cov"]), (mean, cov), 1e-7)


LINEAR = [
    (NLARX(regressors=(Term(1), Term(0, 1), Term(tap=0), Term(tap=2), Term())), {"x1": 1.48, "x2": -0.94}),
    (DuffingODE(), {"stiffness": 180e3, "damping": 45.0, "gain": 190e3, "cubic": 0.0, "output_offset": 0.01}),
]


@pytest.mark.parametrize(("model", "fixed"), LINEAR, ids=["regressors", "ode"])
def test_on_a_linear_model_it_is_first_order(model, fixed):
    u, y = some_record()
    prior = with_prior(model, **fixed)
    first, points = estimate(model, prior, "first_order"), estimate(model, prior)
    np.testing.assert_allclose(points.run(u, y), first.run(u, y), rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(points.forecasts, first.forecasts, rtol=1e-8, atol=1e-12)
    assert_same(
        (points.belief.mean, points.belief.cov), (first.belief.mean, first.belief.cov), 1e-7
    )  # fmt: skip


@pytest.mark.parametrize("model", [NLARX(regressors="cubic"), DuffingODE(cubic_damping=True)], ids=str)
def test_a_narrow_belief_moves_as_to_first_order(model):
    """The means differ by the second derivative times the variance: in standard deviations, as these."""
    u, y = some_record()
    trained = estimate(model)
    trained.run(u, y)
    differences = []
    for scale in (0.3, 0.1, 0.03):
        states = []
        for expectations in ("first_order", "sigma_points"):
            estimator = estimate(model, expectations=expectations)
            arrays = {name: array.copy() for name, array in trained.arrays().items()}
            estimator.restore(arrays | {"cov": scale**2 * arrays["cov"]})
            estimator.run([0.1], [np.nan], missing=True)
            states.append(estimator.arrays()["mean"][0])
        differences.append(abs(states[1] - states[0]) / scale**2)
    assert differences[2] > 1e-9
    np.testing.assert_allclose(differences, differences[2], rtol=0.02)


@pytest.mark.parametrize("model", MODELS, ids=str)
def test_run_is_repeated_update(model):
    u, y = some_record(120)
    at_once, one_by_one = estimate(model), estimate(model)
    at_once.run(u, y)
    for t in range(120):
        one_by_one.update(u[t], y[t])
    for name, array in at_once.arrays().items():
        np.testing.assert_array_equal(one_by_one.arrays()[name], array, err_msg=name)


@pytest.mark.parametrize("model", MODELS, ids=str)
def test_missing_outputs_teach_nothing(model):
    u, y = some_record()
    estimator = estimate(model)
    estimator.run(u[:200], y[:200])
    estimator.run(u[200:201], [np.nan], missing=True)  # takes the output that waits
    before = estimator.belief
    free_energies = estimator.run(u[201:], np.full(99, np.nan), missing=True)
    after = estimator.belief
    np.testing.assert_array_equal(after.coefficients_mean, before.coefficients_mean)
    np.testing.assert_array_equal(after.coefficients_cov, before.coefficients_cov)
    assert (after.gamma_rate, after.xi_shape) == (before.gamma_rate, before.xi_shape)
    assert (after.state_mean != before.state_mean).all()
    assert (free_energies == 0).all()


@pytest.mark.parametrize("model", MODELS, ids=str)
def test_rewind_and_free_runs(model):
    u, y = some_record()
    estimator = estimate(model)
    estimator.run(u, y)
    before = estimator.belief
    noise = np.sqrt(1 / before.xi_mean)
    predicted, simulated = estimator.predict(u, y), estimator.simulate(u, y[:50])
    assert np.std((predicted - y)[50:]) < 3 * noise
    np.testing.assert_array_equal(simulated[:50], y[:50])
    assert np.std((simulated - y)[50:]) < 5 * noise
    np.testing.assert_array_equal(estimator.belief.mean, before.mean)  # asking changed nothing
    estimator.rewind()
    after = estimator.belief
    np.testing.assert_array_equal(after.coefficients_mean, before.coefficients_mean)
    fresh = estimate(model, after)
    np.testing.assert_allclose(estimator.run(u[::-1], y), fresh.run(u[::-1], y), rtol=1e-5, atol=1e-5)


def test_drift_follows_a_change():
    u, y = some_record(1200)
    for t in range(602, 1200):
        y[t] = 1.40 * y[t - 1] - 1.5 * y[t - 1] ** 3 - 0.94 * y[t - 2] + 0.2 * (u[t - 1] + u[t])
    errors = []
    for drift in (0.0, 0.003):
        estimator = estimate(NLARX(regressors="three-tap"), drift=drift)
        estimator.run(u, y)
        errors.append(abs(estimator.belief.parameters()["x1"][0] - 1.40))
    assert errors[1] < 0.01 < errors[0]


@pytest.mark.parametrize("model", [NLARX(regressors="cubic"), DuffingODE()], ids=str)
def test_hard_records_leave_a_sound_belief(model):
    """A hundred thousand samples; saturated, quantised outputs; an input that is constant zero."""
    u, y = some_record(100_000)
    u[20_000:30_000] = 0.0
    y = np.round(np.clip(y, -0.1, 0.1) * 4096) / 4096
    estimator = estimate(model)
    assert np.isfinite(estimator.run(u, y)).all()
    cov = estimator.arrays()["cov"]
    unknown = np.diag(cov) > 0
    std = np.sqrt(np.diag(cov))[unknown]
    assert np.linalg.eigvalsh(cov[np.ix_(unknown, unknown)] / np.outer(std, std))[0] > 0


def test_what_does_not_go_with_sigma_points_is_refused():
    for options in ({}, {"factorisation": "mean_field"}):
        with pytest.raises(ValueError, match=re.escape("pass them as terms, regressors=PRESETS['paper']")):
            OnlineEstimator(expectations="sigma_points", **options)
    with pytest.raises(ValueError, match=re.escape("['first_order', 'sigma_points'], but is 'unscented'")):
        OnlineEstimator(expectations="unscented")
    estimate(NLARX(regressors=PRESETS["paper"])).update(0.0, 0.0)  # the remedy
