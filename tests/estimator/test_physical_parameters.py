"""Maps between physical parameters and coefficients: hand calculations, differences, Monte Carlo, there and back."""

import copy
import pickle
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tables import table

from estimator.models.difference_equation import difference
from estimator.models.duffing import duffing
from estimator.models.model import Model
from estimator.models.named_parameters import Parameters
from estimator.models.pendulum import PENDULUM
from estimator.rigs.physical_parameters import coefficients_of, physical_jacobian, propagate_to_physical, to_physical
from estimator.rigs.silverbox_constants import SILVERBOX_ODE_TWIN, SILVERBOX_SAMPLING_STEP
from estimator.rigs.units import Scales

EPS = np.finfo(float).eps
PAPER = difference()
FULL = duffing(offsets=True, cubic_damping=True, feedthrough=True)
# About the size of the Silverbox circuit at its sampling step.
OSCILLATOR = Parameters(m=5e-6, c=2e-4, a=1.0, b=4.0)
PLANTS = {
    "paper": (PAPER, OSCILLATOR),
    "linear": (difference("linear"), OSCILLATOR),
    "duffing": (duffing(), OSCILLATOR),
    "all terms": (FULL, Parameters(OSCILLATOR, u0=0.01, y0=-0.02, e=1e-9, d=0.1)),
}

scale = st.floats(1e-2, 1e2)
# Below 1e-200 products may leave the normal floats, where rounding is no longer relative.
signed = st.floats(-1e2, 1e2).map(lambda value: value if abs(value) > 1e-200 else 0.0)
steps = st.floats(1e-3, 10.0)
repeatable = settings(derandomize=True, deadline=None)


def batch(parameters, rng, shape):
    return Parameters({name: value * rng.uniform(0.5, 1.5, shape) for name, value in parameters.items()})


def vector(model, parameters):
    return np.stack([parameters[name] for name in model.physical], axis=-1)


def test_sampling_step_is_that_of_the_record():
    assert pytest.approx(610.3515625, rel=1e-15) == 1 / SILVERBOX_SAMPLING_STEP


def test_hand_computed_example():
    # m + cδ = 2 and δ² = 1/4, so every number is exact in binary.
    found = coefficients_of(PAPER, {"m": 1.0, "c": 2.0, "a": 4.0, "b": 8.0}, Scales(0.5))
    assert found.tolist() == [1.0, -1.0, -0.5, 0.125]
    assert to_physical(PAPER, found, Scales(0.5)).tolist() == [1.0, 2.0, 4.0, 8.0]


def test_coefficients_solve_the_difference_equation():
    x_before, x, u, p = 0.03, 0.05, 0.2, OSCILLATOR
    theta1, theta2, theta3, eta = coefficients_of(PAPER, p)
    x_after = theta1 * x + theta2 * x**3 + theta3 * x_before + eta * u
    acceleration = (x_after - 2 * x + x_before) / SILVERBOX_SAMPLING_STEP**2
    velocity = (x_after - x) / SILVERBOX_SAMPLING_STEP
    assert p.m * acceleration + p.c * velocity + p.a * x + p.b * x**3 == pytest.approx(u, rel=1e-12)


def test_the_continuous_twin_is_what_it_was_identified_as():
    found = coefficients_of(duffing(), SILVERBOX_ODE_TWIN) / SILVERBOX_SAMPLING_STEP ** np.array([2, 2, 1, 2])
    np.testing.assert_allclose(found, [184255, 730155, 41.8992, 186015], rtol=1e-14)


@repeatable
@given(m=scale, c=scale, a=signed, b=signed, step=steps)
def test_physical_round_trip(m, c, a, b, step):
    scales = Scales(step)
    back = to_physical(PAPER, coefficients_of(PAPER, {"m": m, "c": c, "a": a, "b": b}, scales), scales)
    # Each error is some roundings of the largest term in the sum that forms the parameter.
    divisor = m + c * step
    assert abs(back[0] - m) <= 20 * EPS * m
    assert abs(back[1] - c) <= 20 * EPS * divisor / step
    assert abs(back[2] - a) <= 20 * EPS * (divisor / step**2 + abs(a))
    assert abs(back[3] - b) <= 20 * EPS * abs(b)


@repeatable
@given(
    theta1=st.floats(-3, 3), theta2=signed, theta3=st.floats(-2, 2), eta=scale, sign=st.sampled_from([-1, 1]),
    step=steps,
)  # fmt: skip
def test_coefficients_round_trip(theta1, theta2, theta3, eta, sign, step):
    physical = to_physical(PAPER, np.array([theta1, theta2, theta3, sign * eta]), Scales(step))
    back = coefficients_of(PAPER, dict(zip("mcab", physical, strict=True)), Scales(step))
    # (m + c δ) η / δ² is 1, formed as -θ3 + (1 + θ3): hence the factor 1 + |θ3| throughout.
    rounding = 40 * EPS * (1 + abs(theta3))
    assert abs(back[0] - theta1) <= rounding * (1 + abs(theta1) + abs(theta3))
    assert abs(back[1] - theta2) <= rounding * abs(theta2)
    assert abs(back[2] - theta3) <= rounding * (1 + abs(theta3))
    assert abs(back[3] - sign * eta) <= rounding * eta


@table("name", PLANTS)
def test_a_batch_goes_there_and_back_as_its_rows_do(name):
    model, parameters = PLANTS[name]
    many = batch(parameters, np.random.default_rng(1), (2, 3))
    points = coefficients_of(model, many)
    assert points.shape == (2, 3, model.n_coefficients)
    cov = 1e-6 * (np.eye(model.n_coefficients) + points[..., :, None] * points[..., None, :])
    means, covs = propagate_to_physical(model, points, cov)
    np.testing.assert_allclose(means, vector(model, many), rtol=1e-11)
    for index in np.ndindex(2, 3):
        # The last places differ: a float and an array take different routes to a power.
        one = coefficients_of(model, {key: value[index] for key, value in many.items()})
        np.testing.assert_allclose(points[index], one, rtol=1e-12, atol=0)
        for whole, single in zip((means, covs), propagate_to_physical(model, points[index], cov[index]), strict=True):
            np.testing.assert_allclose(whole[index], single, rtol=1e-12, atol=0)


@table("name", PLANTS)
def test_slopes_equal_central_differences(name):
    model, parameters = PLANTS[name]
    points, size = coefficients_of(model, parameters), vector(model, parameters)
    columns = []
    for j in range(model.n_coefficients):
        width = 1e-6 * abs(points[j]) * np.eye(model.n_coefficients)[j]
        columns.append((to_physical(model, points + width) - to_physical(model, points - width)) / (2 * width[j]))
    # Sizes differ by many orders: an entry is judged as a change for a change of 100 %.
    relative = points / size[:, None]
    np.testing.assert_allclose(
        physical_jacobian(model, points) * relative, np.stack(columns, axis=-1) * relative, atol=1e-7, rtol=1e-7
    )


def test_propagation_equals_monte_carlo():
    rng = np.random.default_rng(3)
    mean = coefficients_of(PAPER, OSCILLATOR)
    # Deviations of 1e-4 keep the second order far below the sampling error of the mean.
    factor = 1e-4 * mean[:, None] * rng.normal(size=(4, 4))
    physical = to_physical(PAPER, mean + rng.normal(size=(200_000, 4)) @ factor.T)
    found_mean, found_cov = propagate_to_physical(PAPER, mean, factor @ factor.T)
    np.testing.assert_allclose(found_mean, vector(PAPER, OSCILLATOR), rtol=1e-12)
    deviations, root = physical - found_mean, np.sqrt(len(physical))
    products = deviations[:, :, None] * deviations[:, None, :]
    assert np.abs(deviations.mean(axis=0) / (physical.std(axis=0) / root)).max() < 4.5
    assert np.abs((products.mean(axis=0) - found_cov) / (products.std(axis=0) / root)).max() < 4.5


def test_a_model_without_parameters_has_its_coefficients():
    model = difference("three-tap")
    points = np.arange(12.0).reshape(2, 6) @ np.ones((6, model.n_coefficients))
    named = dict(zip(model.coefficients, points.T, strict=True))
    np.testing.assert_array_equal(coefficients_of(model, named), points)
    np.testing.assert_array_equal(to_physical(model, points), points)
    np.testing.assert_array_equal(physical_jacobian(model, points)[1], np.eye(model.n_coefficients))


@table("step", [0.0, -1.0, np.inf, np.nan])
def test_an_invalid_sampling_step_is_named(step):
    message = f"step must be a number from 1e-30 to 1e+30, but is {step}; give the seconds"
    with pytest.raises(ValueError, match=re.escape(message)):
        Scales(step)


def test_scales_multiply_the_parameters_by_their_dimensions():
    """A force in units of 20 N and a displacement in units of 3 cm: m, c and a go with 20/0.03, b with 20/0.03³."""
    scales = Scales(1e-3, input=20.0, output=0.03, input_unit="N", output_unit="m")
    inside = coefficients_of(PAPER, {"m": 0.4, "c": 0.6, "a": 2500.0, "b": 4e7}, scales)
    plain = to_physical(PAPER, inside, Scales(1e-3))
    np.testing.assert_allclose(plain * 20.0 / 0.03 ** np.array([1, 1, 1, 3]), [0.4, 0.6, 2500.0, 4e7], rtol=1e-12)
    np.testing.assert_allclose(to_physical(PAPER, inside, scales), [0.4, 0.6, 2500.0, 4e7], rtol=1e-12)
    slopes = physical_jacobian(PAPER, inside, Scales(1e-3))[0] * 20.0 / 0.03
    np.testing.assert_allclose(physical_jacobian(PAPER, inside, scales)[0], slopes, rtol=1e-12)


def test_a_parameter_that_is_missing_is_named():
    message = "parameters must have ['m', 'c', 'a', 'b'], but ['c', 'b'] are missing from ['m', 'a']; add them"
    with pytest.raises(ValueError, match=re.escape(message)):
        coefficients_of(PAPER, Parameters(m=1.0, a=1.0))
    with pytest.raises(ValueError, match="are missing"):
        coefficients_of(PENDULUM, OSCILLATOR)


def test_parameters_are_a_mapping_with_attributes():
    twin = Parameters({"m": 5e-6}, c=2e-4)
    assert (twin.m, twin["c"], list(twin), len(twin)) == (5e-6, 2e-4, ["m", "c"], 2)
    assert twin == Parameters(m=5e-6, c=2e-4) == copy.deepcopy(twin) == pickle.loads(pickle.dumps(twin))
    assert twin != Parameters(m=5e-6, c=1e-4)
    assert twin != Parameters(c=2e-4, m=5e-6)
    with pytest.raises(AttributeError, match="there is no parameter 'a'"):
        _ = twin.a


HEAT = {
    "states": {"x": "K"}, "noise": ("1",), "outputs": {"y": "x"}, "rates": ("gain*u - loss*x",),
    "coefficients": {"loss": "1", "gain": "K/W"}, "physical": {"cap": "step/gain", "cond": "loss/gain"},
}  # fmt: skip
DIMENSIONS = {"cap": (1, -1, 1), "cond": (1, -1, 0)}


@table("order", [1, -1])
def test_maps_are_read_by_name_in_whatever_order_they_are_written(order):
    inverse = {"gain": "step/cap", "loss": "step*cond/cap"}
    written = {"inverse": inverse, "dimensions": DIMENSIONS}
    heat = Model("heat", **HEAT, **{key: dict(list(value.items())[::order]) for key, value in written.items()})
    scales = Scales(2.0, input=3.0, output=5.0, input_unit="W", output_unit="K")
    found = coefficients_of(heat, {"cap": 50.0, "cond": 0.25}, scales)
    # In units of 3 W and 5 K: cap = 50/(3/5) and cond = 0.25/(3/5).
    np.testing.assert_allclose(found, [2.0 * 0.25 / 50.0, 2.0 / 50.0 * 3.0 / 5.0], rtol=1e-14)
    np.testing.assert_allclose(to_physical(heat, found, scales), [50.0, 0.25], rtol=1e-14)
    assert heat == Model("heat", **HEAT, **written)


def test_no_parameters_have_no_coefficients():
    nothing = dict.fromkeys(PAPER.physical, np.zeros((0, 3)))
    assert coefficients_of(PAPER, nothing).shape == (0, 3, 4)


def test_an_inverse_map_that_does_not_invert_is_refused():
    # At a step of a second nobody would see it.
    heat = Model("heat", **HEAT, dimensions=DIMENSIONS, inverse={"gain": "step/cap", "loss": "cond/cap"})
    coefficients_of(heat, {"cap": 50.0, "cond": 2.0}, Scales(1.0))
    message = "the inverse of 'heat' turns cond=2 into loss=0.04, gain=0.04, and physical turns these into cond=1"
    with pytest.raises(ValueError, match=message):
        coefficients_of(heat, {"cap": 50.0, "cond": 2.0}, Scales(2.0))
