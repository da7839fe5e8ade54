"""Interpolation of the input: taps, and polynomials through the inputs."""

import re

import numpy as np
import pytest
from scipy.interpolate import make_interp_spline
from tables import table

from estimator import Rig, difference, duffing
from estimator.inference.input_interpolation import input_stencil


def rows(model, rig, u):
    """(T, rows) taps or polynomial coefficients of each sample."""
    way = input_stencil(model, rig)
    if way.needs_whole_record:
        return way.spline_coefficients(u)
    before = np.full(way.n_past, u[0] if way.repeats_first else 0.0)
    padded, window = np.concatenate([before, u]), way.stencil.shape[1]
    return np.array([way.stencil @ padded[t : t + window] for t in range(len(u))])


U = np.random.default_rng(0).standard_normal(40)
BEFORE = np.concatenate([[0.0, 0.0, 0.0], U])


@table("delay", [0, 1])
def test_taps_are_the_inputs_before(delay):
    found = rows(difference("three-tap"), Rig.silverbox("zero_order", delay), U)
    expected = np.array([[BEFORE[3 + t - delay - i] for i in range(3)] for t in range(40)])
    np.testing.assert_array_equal(found, expected)


@table(("delay", "back"), [(-1, 0), (0, 1), (1, 2)])
def test_a_held_input_acts_from_its_sample_on(delay, back):
    found = rows(duffing(), Rig.silverbox("zero_order", delay), U)
    np.testing.assert_array_equal(found[:, 0], BEFORE[3 - back : 43 - back])


@table("delay", [0, 1])
def test_linear_goes_from_input_to_input(delay):
    found = rows(duffing(), Rig.silverbox("linear", delay), U)
    np.testing.assert_array_equal(found[:, 0], BEFORE[2 - delay : 42 - delay])
    np.testing.assert_allclose(found.sum(axis=1), BEFORE[3 - delay : 43 - delay], rtol=1e-14)


def at(pieces, tau):
    return sum(pieces[:, n] * tau**n for n in range(pieces.shape[1]))


def test_lookahead_is_the_quintic_through_its_window():
    way = input_stencil(duffing(), Rig.silverbox("look_ahead"))
    assert (way.lookahead, way.n_past, way.stencil.shape) == (True, 9, (6, 10))
    found = rows(duffing(), Rig.silverbox("look_ahead"), U)  # the t-th is on the way to sample t - 1
    for t in range(9, 40):
        spline = make_interp_spline(np.arange(10), U[t - 9 : t + 1], k=5)
        for tau in (0.0, 0.3, 1.0):
            assert at(found[t : t + 1], tau)[0] == pytest.approx(float(spline(7 + tau)), abs=1e-10)
    np.testing.assert_allclose(at(found[9:], 0.0), U[7:38], atol=1e-12)
    np.testing.assert_allclose(at(found[9:], 1.0), U[8:39], atol=1e-12)
    delayed = input_stencil(duffing(), Rig.silverbox("look_ahead", 1))
    assert not delayed.lookahead  # the next input but for the delay is known


@table("delay", [0, 1])
def test_the_spline_goes_through_all_inputs(delay):
    found = rows(duffing(), Rig.silverbox("spline", delay), U)
    spline = make_interp_spline(np.arange(40), U, k=5)
    for t in range(1 + delay, 40):
        assert at(found[t : t + 1], 0.4)[0] == pytest.approx(float(spline(t - 1 - delay + 0.4)), abs=1e-9)
    np.testing.assert_array_equal(found[: 1 + delay], [[U[0], 0, 0, 0, 0, 0]] * (1 + delay))
    with pytest.raises(ValueError, match=re.escape("u must have more than 5 samples for interpolation 'spline'")):
        rows(duffing(), Rig.silverbox("spline"), U[:5])


@table("interpolation", ["look_ahead", "spline"])
def test_a_band_limited_input_is_met_between_the_samples(interpolation):
    time = np.arange(400.0)
    wave = lambda t: np.sin(0.6 * np.pi * t) + np.cos(0.35 * np.pi * t)  # noqa: E731
    found = rows(duffing(), Rig.silverbox(interpolation), wave(time))
    shift = 2 if interpolation == "look_ahead" else 1
    middle = at(found, 0.5)[40:360]
    linear = at(rows(duffing(), Rig.silverbox("linear"), wave(time)), 0.5)[40:360]
    error = np.abs(middle - wave(time[40:360] - shift + 0.5)).max()
    assert error < 0.3 * np.abs(linear - wave(time[40:360] - 0.5)).max()
