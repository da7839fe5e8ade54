"""The physical equation: its flow against SciPy's solver, its sensitivities, and the input between the samples."""

import re
from math import comb

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import make_interp_spline

from estimator import SAMPLING_STEP, SILVERBOX_TWIN, DuffingODE, OnlineEstimator
from estimator.gaussian import JointBelief
from estimator.models.ode import N_JOINT, N_MOTION, flow, from_coordinates, to_coordinates

#: The Silverbox per sample, with every effect made large enough to be seen: k, c, g, b, f, e, y0.
P = np.array([0.49, 0.07, 0.5, 2.0, 0.02, 0.3, 0.03])


def moved(z, v, p, piece, substeps):
    """Where `flow` moves to (2,), and its sensitivities (2, N_MOTION)."""
    sensitivities = np.empty((2, N_MOTION))
    state = flow(z, v, p, piece, substeps, sensitivities, np.empty((3, 2, N_MOTION)))
    return np.array(state), sensitivities


def draw(rng):
    """A state, parameters and an input polynomial at random."""
    z, v = 0.3 * rng.standard_normal(2)
    degree = rng.choice([1, 3, 5])
    return z, v, P * rng.uniform(0.7, 1.3, 7), 0.2 * rng.standard_normal(degree + 1)


def solved(z, v, p, piece):
    """The same motion by an eighth-order solver with step control, in the coordinates of the docstring's first line."""
    k, c, g, b, f, e, y0 = p
    u0 = (k * y0 - f) / g

    def rates(tau, state):
        x, v = state
        u = np.polyval(piece[::-1], tau)
        return [v, g * (u - u0) - c * v - k * x - b * x**3 - e * v**3]

    x, v = solve_ivp(rates, (0.0, 1.0), [z - y0, v], method="DOP853", rtol=1e-13, atol=1e-15).y[:, -1]
    return np.array([x + y0, v])


def test_flow_is_the_motion_of_the_equation():
    rng = np.random.default_rng(0)
    for _ in range(20):
        z, v, p, piece = draw(rng)
        np.testing.assert_allclose(moved(z, v, p, piece, 256)[0], solved(z, v, p, piece), rtol=0, atol=1e-10)


def test_flow_converges_with_order_four():
    rng = np.random.default_rng(1)
    errors = np.zeros(4)
    for _ in range(20):
        z, v, p, piece = draw(rng)
        exact = solved(z, v, p, piece)
        errors += [np.linalg.norm(moved(z, v, p, piece, substeps)[0] - exact) for substeps in (2, 4, 8, 16)]
    np.testing.assert_allclose(np.log2(errors[:-1] / errors[1:]), 4.0, atol=0.25)


@pytest.mark.parametrize("substeps", [1, 3])
def test_sensitivities_are_the_derivative_of_the_arithmetic(substeps):
    """Of the very steps that are taken, however coarse: so they are compared with differences of `flow` itself."""
    rng = np.random.default_rng(2)
    for _ in range(20):
        z, v, p, piece = draw(rng)
        _, sensitivities = moved(z, v, p, piece, substeps)
        point = np.concatenate([[z, v], p])
        for j, step in enumerate(1e-5 * np.eye(N_MOTION)):
            ahead, behind = (moved(at[0], at[1], at[2:], piece, substeps)[0] for at in (point + step, point - step))
            np.testing.assert_allclose(sensitivities[:, j], (ahead - behind) / 2e-5, rtol=1e-7, atol=1e-8)


# --- The input between the samples ---------------------------------------------------------------------------------


def values(pieces, tau):
    """The polynomials (T - 1, degree + 1) at a point between the samples."""
    return np.polyval(pieces.T[::-1], tau)


def test_linear_input_is_a_line_between_two_samples():
    pieces = DuffingODE("linear").pieces(np.array([1.0, 3.0, -1.0]))
    np.testing.assert_array_equal(pieces, [[1.0, 2.0], [3.0, -4.0]])
    assert DuffingODE("linear").pieces(np.array([1.0])).shape == (0, 2)


def test_look_ahead_input_is_the_spline_through_a_window():
    u = np.random.default_rng(3).standard_normal(30)
    pieces = DuffingODE("look_ahead").pieces(u)
    np.testing.assert_allclose(values(pieces, 0.0), u[:-1], atol=1e-12)
    np.testing.assert_allclose(values(pieces, 1.0), u[1:], atol=1e-12)
    # At the ends an input that is not there is its neighbour.
    padded = np.concatenate([np.full(7, u[0]), u, u[-1:]])
    for t in range(len(u) - 1):
        spline = make_interp_spline(np.arange(10.0), padded[t : t + 10], k=5)
        np.testing.assert_allclose(values(pieces[t : t + 1], 0.3), spline(7.3), atol=1e-12)


def test_look_ahead_input_is_the_same_piece_by_piece():
    u = np.random.default_rng(3).standard_normal(30)
    model = DuffingODE("look_ahead")
    whole = model.pieces(u)
    for t in range(model.reach, len(u) - 2):
        # To sample t + 1 from those that reach it, and the next one.
        np.testing.assert_array_equal(model.pieces(u[t + 1 - model.reach : t + 3])[-2], whole[t])


@pytest.mark.parametrize(
    ("interpolation", "degree", "inner"), [("look_ahead", 5, slice(7, -1)), ("spline", 5, slice(None))]
)
def test_polynomials_are_reproduced(interpolation, degree, inner):
    """Every polynomial up to the degree, between the samples too: by its binomial expansion about each sample."""
    rng = np.random.default_rng(4)
    time, coefficients = np.arange(-7.0, 8.0), rng.standard_normal(degree + 1)
    pieces = DuffingODE(interpolation).pieces(np.polyval(coefficients[::-1], time))
    expected = [
        [sum(coefficients[m] * comb(m, n) * start ** (m - n) for m in range(n, degree + 1)) for n in range(degree + 1)]
        for start in time[:-1]
    ]
    np.testing.assert_allclose(pieces[inner], expected[inner], rtol=1e-8, atol=1e-8 * np.abs(expected).max())


def test_spline_passes_through_the_samples_and_bends_smoothly():
    u = np.random.default_rng(5).standard_normal(40)
    pieces = DuffingODE("spline").pieces(u)
    np.testing.assert_allclose(values(pieces, 0.0), u[:-1], atol=1e-12)
    np.testing.assert_allclose(values(pieces, 1.0), u[1:], atol=1e-12)
    for derivative in range(5):  # continuous up to the fourth
        ends = sum(
            pieces[:, n] * np.prod(np.arange(n, n - derivative, -1)) for n in range(derivative, pieces.shape[1])
        )  # fmt: skip
        starts = pieces[:, derivative] * np.prod(np.arange(derivative, 0, -1))
        np.testing.assert_allclose(ends[:-1], starts[1:], atol=1e-9 * np.abs(starts).max())


def test_between_samples_a_band_limited_input_is_followed_ever_better():
    # A tone of 150 Hz, and what it is halfway between the samples.
    phase = 2 * np.pi * 150 * SAMPLING_STEP * np.arange(200.0)
    between = np.sin(phase[:-1] + phase[1] / 2)
    errors = [
        np.abs(values(DuffingODE(name).pieces(np.sin(phase)), 0.5) - between)[20:-20].max()
        for name in ("linear", "look_ahead", "spline")
    ]
    assert errors[1] < 0.5 * errors[0]
    assert errors[2] < 0.1 * errors[1]


# --- Parameters and coordinates ------------------------------------------------------------------------------------


def test_prior_is_about_the_twin_in_physical_units():
    belief = DuffingODE().prior(spread=0.2, process_noise=1e-5, measurement_noise=1e-3, noise_shape=3.0)
    rows = belief.parameters()
    twin = SILVERBOX_TWIN
    for name, value in (
        ("stiffness", twin.a / twin.m),
        ("damping", twin.c / twin.m),
        ("gain", 1 / twin.m),
        ("cubic", twin.b / twin.m),
    ):
        assert rows[name][:2] == pytest.approx((value, 0.2 * value))
    assert rows["input_offset"] == (0.0, pytest.approx(0.02), "V")
    assert rows["cubic_damping"] == (0.0, pytest.approx(0.1 * SAMPLING_STEP), "V⁻² s")
    assert belief.state_cov[1, 1] == pytest.approx((0.1 / SAMPLING_STEP) ** 2)
    assert (belief.gamma_mean, belief.xi_mean) == pytest.approx((1e10, 1e6))
    assert belief.gamma_shape == belief.xi_shape == 3.0


def some_belief():
    """A belief with every correlation, about the Silverbox."""
    rng = np.random.default_rng(6)
    prior = DuffingODE(cubic_damping=True).prior()
    std = np.sqrt(np.diag(prior.cov))
    factor = rng.standard_normal((N_JOINT, 2 * N_JOINT))
    cov = np.outer(std, std) * (factor @ factor.T) / (2 * N_JOINT)
    return prior.mean + 0.1 * std * rng.standard_normal(N_JOINT), cov


def test_coordinates_and_back():
    mean, cov = some_belief()
    again, cov_again = from_coordinates(*to_coordinates(mean, cov))
    std = np.sqrt(np.diag(cov))
    np.testing.assert_allclose(again / std, mean / std, atol=1e-10)
    np.testing.assert_allclose(cov_again / np.outer(std, std), cov / np.outer(std, std), atol=1e-10)


def test_coordinates_carry_the_covariance_by_their_derivative():
    mean, cov = some_belief()
    zeros, slopes = np.zeros_like(cov), np.empty_like(cov)
    for j, step in enumerate(1e-4 * np.sqrt(np.diag(cov))):
        ahead, behind = (to_coordinates(mean + sign * step * np.eye(N_JOINT)[j], zeros)[0] for sign in (1, -1))
        slopes[:, j] = (ahead - behind) / (2 * step)
    expected = slopes @ cov @ slopes.T
    std = np.sqrt(np.diag(expected))
    actual = to_coordinates(mean, cov)[1]
    np.testing.assert_allclose(actual / np.outer(std, std), expected / np.outer(std, std), atol=1e-8)


def with_known(model, **fixed):
    """The model's prior with parameters fixed at given values."""
    prior = model.prior()
    mean, cov = prior.mean.copy(), prior.cov.copy()
    for name, value in fixed.items():
        i = 2 + model.names.index(name)
        mean[i], cov[i, :], cov[:, i] = value, 0.0, 0.0
    noises = (prior.gamma_shape, prior.gamma_rate, prior.xi_shape, prior.xi_rate)
    return JointBelief(prior.names, prior.units, mean, cov, *noises)


@pytest.mark.parametrize(
    "fixed",
    [
        {"input_offset": 0.0, "output_offset": 0.0},
        {"output_offset": 0.01},
        {"feedthrough": 0.02, "stiffness": 184_000.0},
        {"input_offset": 0.01, "output_offset": 0.0, "gain": 186_000.0},
    ],
    ids=lambda fixed: ", ".join(fixed),
)
def test_a_parameter_of_variance_zero_stays_where_it_is(fixed):
    model = DuffingODE()
    estimator = OnlineEstimator(model, with_known(model, **fixed))
    rng = np.random.default_rng(7)
    estimator.run(0.05 * rng.standard_normal(200), 0.05 * rng.standard_normal(200))
    rows = estimator.belief.parameters()
    for name in model.names:
        if name in fixed or name == "cubic_damping":
            assert rows[name][:2] == (pytest.approx(fixed.get(name, 0.0), rel=1e-12), 0.0)
        else:
            assert rows[name][1] > 0
    assert np.isfinite(estimator.belief.entropy())


def test_an_input_offset_that_is_known_is_refused_where_the_force_is_not():
    model = DuffingODE()
    for fixed in ({"input_offset": 0.01}, {"input_offset": 0.0}, {"input_offset": 0.01, "output_offset": 0.0}):
        message = f"prior must leave input_offset free, but fixes it at {fixed['input_offset']}"
        with pytest.raises(ValueError, match=re.escape(message)):
            OnlineEstimator(model, with_known(model, **fixed))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"interpolation": "cubic"}, "interpolation must be one of ['linear', 'look_ahead', 'spline'], but is 'cubic'"),
        ({"substeps": 0}, "substeps must be a whole number of at least 1, but is 0"),
        ({"substeps": 2.0}, "substeps must be a whole number of at least 1, but is 2.0"),
    ],
)
def test_errors_of_the_model(options, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        DuffingODE(**options)


def test_a_spline_needs_samples():
    with pytest.raises(ValueError, match=re.escape("u must have more than 5 samples for interpolation 'spline'")):
        DuffingODE("spline").pieces(np.zeros(5))
