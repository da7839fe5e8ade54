"""Models in seconds and stated units: the scaled model is the hand-scaled one, and the posterior is in the units."""

import re
from dataclasses import replace

import numpy as np
import pytest
from reference.filters import Plant
from tables import table

from duffing_env import ModelEnv
from estimator import Channel, OnlineEstimator, Rig
from estimator.inference.free_run import free_run
from estimator.models.model import Model
from estimator.models.scaling import power_of_two, scale_model, state_sizes
from estimator.priors import gaussian_moments, weak_prior
from estimator.rigs.stated_units import prior_in_units
from estimator.rigs.units import Scales

#: A mass on a spring with a bend, in SI units.
SHAKER = Model(
    "shaker", {"x": "m", "v": "m/s"}, {"m": "kg", "c": "N s/m", "k": "N/m"}, inputs={"u": "N"}, noise=("0", "1/m"),
    outputs={"y": "x"}, rates=("v", "(u - c*v - k*x)/m"), time="s", substeps=4,
)  # fmt: skip

#: Mass [kg], sampling step [s].
RIGS = [(1e-3, 1 / 50_000), (1e3, 1 / 10)]


def shaker_on(mass, step):
    """A rig, the true parameters, and a record: a resonance at a twentieth of the sampling frequency."""
    natural = 2 * np.pi / (20 * step)
    truth = {"m": mass, "c": 0.05 * mass * natural, "k": mass * natural**2}
    force = 10 * mass
    span = force / truth["k"]
    rig = Rig(step, "zero_order", input=Channel("N", limit=force), output=Channel("m", range=8 * span))
    u = force * np.repeat(np.random.default_rng(0).choice([-1.0, 1.0], 60), 5)
    plant, state, y = Plant.of(SHAKER), np.zeros(2), []
    coefficients, h = list(truth.values()), step / 4
    for level in u:
        y.append(state[0])
        for _ in range(4):
            k1 = np.array(plant.move(state, coefficients, level))
            k2 = np.array(plant.move(state + h / 2 * k1, coefficients, level))
            k3 = np.array(plant.move(state + h / 2 * k2, coefficients, level))
            k4 = np.array(plant.move(state + h * k3, coefficients, level))
            state = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    noise = 1e-2 * span
    return rig, truth, u, np.array(y) + noise * np.random.default_rng(1).standard_normal(len(u)), noise


def scaled_by_hand(rig, truth):
    """`SHAKER` with x in parts of the range X, v in X per sample, and coefficients in parts of the true ones.

    And the factor from the strength of its process noise to the strength in `SHAKER`.
    """
    m, c, k = truth.values()
    step, limit, span = rig.step, rig.scales.input, rig.scales.output
    by_force, by_speed, by_shift = step**2 * limit / (span * m), step * c / m, step**2 * k / m
    model = Model(
        "shaker_by_hand", {"x": "1", "v": "1"}, dict.fromkeys(truth, "1"), ("0", "1/m"), {"y": "x"}, substeps=4,
        rates=("v", f"({by_force}*u - {by_speed}*c*v - {by_shift}*k*x)/m"), dimensions=SHAKER.coefficients,
        physical={name: f"{value}*{name}" for name, value in truth.items()},
        inverse={name: f"{name}/{value}" for name, value in truth.items()},
    )  # fmt: skip
    return model, step**1.5 / (span * m)


@pytest.mark.parametrize(("mass", "step"), RIGS)
def test_the_posterior_in_units_is_the_hand_scaled_one(mass, step):
    rig, truth, u, y, noise = shaker_on(mass, step)
    mean, std = ({name: factor * value for name, value in truth.items()} for factor in (1.1, 0.2))
    strength = 1e-3 * noise * mass / step**1.5
    prior = prior_in_units(
        SHAKER, rig, mean, std, process_noise=strength, measurement_noise=noise,
        state_std={"x": noise, "v": noise / step},
    )  # fmt: skip
    for name, (value, deviation, unit) in prior.parameters().items():
        assert value == pytest.approx(mean[name], rel=1e-12)
        assert deviation == pytest.approx(std[name], rel=1e-12)
        assert unit == SHAKER.coefficients[name]
    assert np.abs(np.log2(prior.coefficients_mean)).max() <= 0.5 + 1e-9
    estimator = OnlineEstimator(prior=prior, rig=rig)
    free_energy = estimator.run(u, y)
    found = estimator.belief.parameters()
    for name, value in truth.items():
        assert abs(found[name][0] - value) < 5 * found[name][1] < 0.5 * value

    model, factor = scaled_by_hand(rig, truth)
    in_parts = weak_prior(
        model, *gaussian_moments(model, mean, std, rig.scales), strength * factor, noise / rig.scales.output,
        state_std=noise / rig.scales.output, scales=rig.scales,
    )  # fmt: skip
    by_hand = OnlineEstimator(model, in_parts, rig)
    np.testing.assert_allclose(by_hand.run(u, y), free_energy, rtol=1e-6, atol=1e-6)
    for name, (value, deviation, unit) in by_hand.belief.parameters().items():
        assert found[name] == (pytest.approx(value, rel=1e-9), pytest.approx(deviation, rel=1e-6), unit)
    np.testing.assert_allclose(estimator.forecasts, by_hand.forecasts, rtol=1e-6, atol=1e-6 * noise)


def test_other_sizes_of_states_change_nothing():
    rig, truth, u, y, noise = shaker_on(*RIGS[0])
    std = {name: 0.2 * value for name, value in truth.items()}
    found = []
    for sizes in ({}, {"x": 3.0, "v": 40.0}):
        prior = prior_in_units(
            SHAKER, rig, truth, std, process_noise=1e-9, measurement_noise=noise, sizes=sizes,
            state_std={"x": noise, "v": noise / rig.step},
        )  # fmt: skip
        estimator = OnlineEstimator(prior=prior, rig=rig)
        estimator.run(u, y)
        found.append(np.array([moments[:2] for moments in estimator.belief.parameters().values()]))
    np.testing.assert_allclose(found[0], found[1], rtol=1e-9)


def test_an_environment_takes_a_model_in_seconds():
    rig, truth, _, _, noise = shaker_on(*RIGS[0])
    env = ModelEnv(
        system=SHAKER, mean=truth, spread=0.2, sampling_step=rig.step, process_noise=1e-6 * noise / rig.step**1.5,
        measurement_noise=noise, max_input=rig.input.limit, max_output=10 * rig.output.range, horizon=64,
    )  # fmt: skip
    env.reset(seed=0)
    rng, truncated = np.random.default_rng(0), False
    while not truncated:
        *_, terminated, truncated, _ = env.step(rng.choice([-1.0, 1.0], 1).astype(np.float32))
        assert not terminated
    for name, (mean, std, unit) in env.belief.parameters().items():
        assert abs(mean - env.truth[name]) < 5 * std < 0.5 * env.truth[name]
        assert unit == SHAKER.coefficients[name]


def test_sizes_come_from_the_units():
    lengths = {"y": 3e-4, "u": 20.0}
    assert state_sizes(SHAKER, 1e-3, lengths) == {"x": 2.0**-12, "v": power_of_two(3e-4 / 8e-3)}
    hysteresis = replace(
        SHAKER, states={"x": "m", "v": "m/s", "z": "N", "w": "K"}, rates=(*SHAKER.rates, "v", "x"),
        noise=("0", "1/m", "0", "0"),
    )  # fmt: skip
    assert list(state_sizes(hysteresis, 1e-3, lengths).values())[2:] == [16.0, 1.0]
    assert state_sizes(hysteresis, 1e-3, lengths, {"w": 300.0})["w"] == 256.0


def test_scaling_keeps_older_inputs_derivatives_constants_and_parameters():
    model = Model(
        "chain", {"x": "m"}, {"k": "1"}, ("k",), {"y": "x"}, next_state=("k*x + u[-1] + g",), constants={"g": 2.0}
    )
    scaled = scale_model(model, 0.5, {"x": 4.0, "k": 2.0, "u": 8.0, "y": 16.0})
    np.testing.assert_allclose(
        free_run(scaled, [0.3], np.ones(5)) * 16.0, free_run(model, [0.6], 8.0 * np.ones(5)), rtol=1e-14
    )
    lag = Model("lag", {"x": "m"}, {"k": "1/s"}, ("1",), {"y": "x"}, rates=("derivative(u) - k*x",), time="s",
                physical={"corner": "k/(2*pi)"}, dimensions={"corner": "Hz"}, inverse={"k": "2*pi*corner"})  # fmt: skip
    scaled = scale_model(lag, 0.5, {"x": 4.0, "k": 2.0, "u": 8.0})
    assert scaled.rates == ("0.125*(16.0 * derivative(u) - 2.0 * k * (4.0 * x))",)
    assert (scaled.physical, scaled.inverse) == ({"corner": "2.0 * k / (2 * pi)"}, {"k": "0.5*(2*pi*corner)"})
    assert Scales().unit(scaled.dimensions["corner"]) == "Hz"


@table(
    ("make", "words"),
    [
        (lambda: free_run(SHAKER, [1.0, 1.0, 1.0], [0.0]), "in samples here, but 'shaker' counts seconds"),
        (lambda: replace(SHAKER, time="ms"), "time must be one of"),
        (
            lambda: replace(SHAKER, rates=(), next_state=SHAKER.rates),
            "time must be 'sample' for a difference equation, but is 's'",
        ),
        (
            lambda: replace(SHAKER, physical={"mass": "m", "c": "c", "k": "k"},
                            dimensions=dict.fromkeys(("mass", "c", "k"), (1, -1, 2)),
                            inverse={"m": "mass", "c": "c", "k": "k"}),
            "dimensions of mass must be a unit such as 'kg' where time is in seconds",
        ),
        (lambda: state_sizes(SHAKER, 1.0, {}, {"z": 1.0}), "sizes must be of ['x', 'v'], but one is of 'z'"),
        (lambda: state_sizes(SHAKER, 1.0, {}, {"x": 0.0}), "sizes['x'] must be"),
        (lambda: scale_model(SHAKER, -1.0, {}), "step must be"),
        (
            lambda: prior_in_units(SHAKER, Rig(1e-3), {"m": 1.0, "c": 1.0}, {}, process_noise=1.0,
                                   measurement_noise=1.0),
            "parameters must have ['m', 'c', 'k'], but ['k'] are missing",
        ),
        (
            lambda: prior_in_units(SHAKER, Rig(1e-3), {"m": 1.0, "c": 1.0, "k": 1.0}, {}, process_noise=1.0,
                                   measurement_noise=1.0, state_std={"z": 1.0}),
            "state_std must be of ['x', 'v'], but has ['z']",
        ),
    ],
)  # fmt: skip
def test_refusals(make, words):
    with pytest.raises(ValueError, match=re.escape(words)):
        make()
