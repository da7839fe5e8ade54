"""Stiff equations: however wrong the coefficients are, an innovation varies at least as much as its sensor's noise."""

import numpy as np
import pytest

from estimator import Model
from estimator.inference.record_filter import record_likelihoods

#: Decades to each side of a coefficient's value from which points are drawn.
DECADES = 2.0
POINTS = 200

OVERFLOW_A, OVERFLOW_B = (f"1.5*max({tank} - 10, 0)" for tank in "ab")
ROOT_A, ROOT_B = (f"({tank}**2 + 1e-9)**(1/4)" for tank in "ab")


def in_samples(step, *rates):
    """Rates per second, as rates per sample."""
    return tuple(f"{step}*({rate})" for rate in rates)


#: Model, its coefficients' values, first state, input (T,), and sampling steps that the output is simulated with.
BIOREACTOR = Model(
    "bioreactor", {"x": "1", "s": "1"}, {"mu": "1", "k": "1", "yield_": "1"}, noise=("1", "1"), outputs={"y": "x"},
    rates=in_samples(0.5, "mu*s*x/(k + s) - u*x", "u*(5 - s) - mu*s*x/((k + s)*yield_)"),
)  # fmt: skip
MOTOR = Model(
    "motor", {"w": "rad/s", "i": "A"},
    {"kt": "1", "fv": "1", "fc": "1", "j": "1", "l": "1", "r": "1"}, noise=("1", "1"), outputs={"y": "w"},
    rates=in_samples(0.002, "(kt*i - fv*w - fc*tanh(w))/j", "(u - r*i - kt*w)/l"),
)  # fmt: skip
TANKS = Model(
    "tanks", {"a": "1", "b": "1"}, {"ku": "1", "ka": "1", "ea": "1", "kb": "1", "kc": "1", "ov": "1"},
    noise=("1", "1"), outputs={"y": "b"},
    rates=in_samples(
        4.0, f"ku*u - ka*{ROOT_A} + ea - ea*a - {OVERFLOW_A}",
        f"kb*{ROOT_A} - kc*{ROOT_B} + ov*{OVERFLOW_A} - {OVERFLOW_B}",
    ),
)  # fmt: skip


def held(rng, levels, hold, samples=400):
    return np.repeat(rng.uniform(*levels, samples // hold + 1), hold)[:samples]


CASES = {
    "bioreactor": (BIOREACTOR, (0.5, 0.3, 0.4), (1.5, 1.0), lambda rng: held(rng, (0.1, 0.4), 20)),
    "motor": (MOTOR, (0.1, 0.002, 0.05, 0.01, 0.005, 1.0), (0.0, 0.0), lambda rng: held(rng, (-6.0, 6.0), 150)),
    "tanks": (TANKS, (0.05, 0.06, 0.01, 0.06, 0.05, 0.5), (2.0, 2.0), lambda rng: held(rng, (0.5, 4.0), 50)),
}


@pytest.mark.parametrize("name", CASES)
def test_no_innovation_varies_less_than_its_sensor(name):
    model, values, first, draw_input = CASES[name]
    rng = np.random.default_rng(0)
    u = draw_input(rng)
    points = np.array(values) * 10.0 ** rng.uniform(-DECADES, DECADES, (POINTS, len(values)))
    y = np.tile(first[0] + rng.standard_normal((1, len(u), 1)), (POINTS, 1, 1))
    forecasts = np.full((POINTS, len(u), 1, 2), np.nan)
    sensor_variance = 1e-4
    record_likelihoods(
        model, points, np.tile(u[None, :, None], (POINTS, 1, 1)), y, np.array([1e-2, sensor_variance]),
        1e-4 * np.eye(2), np.tile(first, (POINTS, 1)), forecasts=forecasts,
    )  # fmt: skip
    variances = forecasts[..., 1][np.isfinite(forecasts[..., 1])]
    assert len(variances) > 0.2 * POINTS * len(u)
    assert variances.min() >= sensor_variance * (1 - 1e-6)
