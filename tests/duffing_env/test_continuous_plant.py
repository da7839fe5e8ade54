"""The plant ``sde`` on a block of its own: against an exact integration, and its noise against theory."""

from functools import cache

import numpy as np
import pytest
from reference.filters import continuous_step
from scipy.integrate import solve_ivp
from twin import to_rates

from duffing_env.kernel_stages.generated_environment_functions import generated_functions
from duffing_env.kernel_stages.plant_stages import compile_noise_draw
from duffing_env.kernel_stages.sample_stages import compile_simulation
from duffing_env.storage.kernel_spec import block_layout
from duffing_env.tracks.differential_equation_tracks import ContinuousExperiment
from estimator import SILVERBOX_ODE_TWIN, SILVERBOX_SAMPLING_STEP
from estimator.compilation.simd import LANES
from estimator.models.duffing import duffing

EXPERIMENT = ContinuousExperiment()
KIND = EXPERIMENT.kernel_spec._replace(degree=1)  # which holds an input that does not rise
HELD = KIND._replace(plant_model=duffing(noise="held"))
PLACE = block_layout(KIND)
STREAM = ("SFC64_a", "SFC64_b", "SFC64_c", "SFC64_d")
RATES = ("TRUE_stiffness", "TRUE_cubic", "TRUE_damping", "TRUE_gain")


def lanes(seed=0, **rows):
    """A block of twins with the given rows; by row."""
    by_row = np.zeros((max(PLACE.values()) + 1, LANES))
    words = np.random.default_rng(seed).integers(1, 2**63, (4, LANES), dtype=np.uint64)
    rows = dict(zip(STREAM, words.view(np.float64), strict=True)) | rows
    rows = dict(zip(RATES, to_rates(SILVERBOX_ODE_TWIN), strict=True)) | rows
    for name, values in rows.items():
        by_row[PLACE[name]] = values
    return by_row


@cache
def compiled(kind):
    """The two functions that a sample of the plant takes."""
    assert block_layout(kind) == PLACE
    draw_noise = compile_noise_draw(PLACE)
    return draw_noise, compile_simulation(kind, generated_functions(kind), draw_noise)


def step(by_row, process_noise=0.0, measurement_noise=0.0, kind=KIND):
    draw_noise, move = compiled(kind)
    by_row[PLACE["PROCESS_STD"]], by_row[PLACE["SENSOR_STD_y"]] = process_noise, measurement_noise
    draw_noise(by_row.reshape(-1))
    move(by_row.reshape(-1))


def test_the_drift_is_eq_1_to_far_below_the_noise():
    # In seconds, by SciPy: over a sample, at amplitudes that random inputs of 0.15 V reach.
    rng = np.random.default_rng(0)
    x, v = rng.uniform(-0.3, 0.3, (2, LANES))
    last_u, u = rng.uniform(-0.15, 0.15, (2, LANES))
    by_row = lanes(X_x=x, X_v=v, LAST_INPUT_u=last_u, RISE_u=u - last_u)
    step(by_row)
    twin = SILVERBOX_ODE_TWIN
    for j in range(LANES):

        def slope(t, state, j=j):
            force = last_u[j] + (u[j] - last_u[j]) * t / SILVERBOX_SAMPLING_STEP
            return [state[1], (force - twin.c * state[1] - twin.a * state[0] - twin.b * state[0] ** 3) / twin.m]

        start = [x[j], v[j] / SILVERBOX_SAMPLING_STEP]
        exact = solve_ivp(slope, (0, SILVERBOX_SAMPLING_STEP), start, rtol=1e-12, atol=1e-12).y[:, -1]
        # The smallest noise of docs/evidence/continuous.md moves x by 1e-4 V and x' by 1.7e-4 V per sample.
        assert by_row[PLACE["X_x"], j] == pytest.approx(exact[0], abs=1e-6)
        assert by_row[PLACE["X_v"], j] == pytest.approx(exact[1] * SILVERBOX_SAMPLING_STEP, abs=4e-6)
    np.testing.assert_array_equal(by_row[PLACE["Y_y"]], by_row[PLACE["X_x"]])


def test_a_constant_input_ends_where_the_spring_holds_it():
    u = np.linspace(-0.15, 0.15, LANES)
    by_row = lanes(LAST_INPUT_u=u)
    for _ in range(1000):
        step(by_row)
    x = by_row[PLACE["X_x"]]
    np.testing.assert_allclose(SILVERBOX_ODE_TWIN.a * x + SILVERBOX_ODE_TWIN.b * x**3, u, rtol=0, atol=1e-12)


def test_it_does_not_blow_up():
    x = np.linspace(-2.0, 2.0, LANES)
    by_row = lanes(X_x=x)
    for _ in range(500):
        step(by_row)
    assert np.abs(by_row[PLACE["X_x"]]).max() < 1e-3


FREE = dict.fromkeys(RATES[:3], 0.0)


def noise_of_a_sample(draws, kind=KIND, **rows):
    """Displacement of (x, x') by 1 mV of noise in a sample (2, draws * LANES) [mV]."""
    still = lanes(**rows)
    step(still, kind=kind)
    still = still[[PLACE["X_x"], PLACE["X_v"]]].copy()
    by_row, noise_kicks = lanes(**rows), []
    start = {name: by_row[PLACE[name]].copy() for name in ("X_x", "X_v")}
    for _ in range(draws):
        for name, values in start.items():
            by_row[PLACE[name]] = values
        step(by_row, process_noise=1e-3, kind=kind)
        noise_kicks.append(1e3 * (by_row[[PLACE["X_x"], PLACE["X_v"]]] - still))
    return np.concatenate(noise_kicks, axis=1)


@pytest.mark.parametrize("x", [0.0, 0.3])
def test_the_noise_is_what_the_estimator_takes_it_for(x):
    # 64,000 draws: variances to 0.6 % (one standard deviation).
    measured = np.cov(noise_of_a_sample(2000, X_x=x))
    _, _, expected = continuous_step(np.array([x, 0.0, *to_rates(SILVERBOX_ODE_TWIN)]), 0.0, 0.0)
    np.testing.assert_allclose(measured, expected, rtol=0.03)
    # Weaker than of a free mass, which would have 1, 3/2, 3.
    assert measured[0, 0] < 0.95
    assert measured[1, 1] < 2.6


def test_noise_alone_moves_a_free_mass_by_its_standard_deviation():
    moments = np.cov(noise_of_a_sample(2000, **FREE))
    np.testing.assert_allclose(moments, [[1.0, 1.5], [1.5, 3.0]], rtol=0.03)


def test_a_held_force_moves_a_free_mass_by_its_standard_deviation():
    moved = noise_of_a_sample(2000, HELD, **FREE)
    np.testing.assert_allclose(moved[1], 2 * moved[0], rtol=1e-9)  # one and the same force throughout the sample
    assert np.std(moved[0]) == pytest.approx(1.0, rel=0.03)


def test_the_sensor_adds_its_noise():
    deviations = []
    by_row = lanes()
    for _ in range(500):
        step(by_row, measurement_noise=2e-3)
        deviations.append(by_row[PLACE["Y_y"]] - by_row[PLACE["X_x"]])
    assert np.std(deviations) == pytest.approx(2e-3, rel=0.03)
    assert abs(np.corrcoef(np.ravel(deviations[:-1]), np.ravel(deviations[1:]))[0, 1]) < 0.03


def test_the_streams_of_waiting_lanes_stand_still():
    waiting = np.arange(LANES) % 2
    by_row = lanes(NEEDS_RESET=waiting)
    places = [PLACE[name] for name in STREAM]
    before = by_row[places].view(np.uint64).copy()
    step(by_row, 1e-3, 1e-3)
    still = (by_row[places].view(np.uint64) == before).all(axis=0)
    np.testing.assert_array_equal(still, waiting == 1)
