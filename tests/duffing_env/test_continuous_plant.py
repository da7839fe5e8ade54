"""The plant ``sde`` on a block of its own: against an exact integration, and its noise against theory."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from duffing_env.layout import LAYOUT, N_ROWS
from duffing_env.plant import integrate_plant
from estimator import CONTINUOUS_TWIN, SAMPLING_STEP, continuous_prior
from estimator.inference import continuous
from estimator.lanes import LANES

STREAM = ("stream_a", "stream_b", "stream_c", "stream_d")


def lanes(seed=0, **rows):
    """A block of twins with the given rows; by row."""
    by_row = np.zeros((N_ROWS, LANES))
    words = np.random.default_rng(seed).integers(1, 2**63, (4, LANES), dtype=np.uint64)
    rows = dict(zip(STREAM, words.view(np.float64), strict=True)) | rows
    for name in ("m", "c", "a", "b"):
        by_row[LAYOUT[name]] = getattr(CONTINUOUS_TWIN, name)
    for name, values in rows.items():
        by_row[LAYOUT[name]] = values
    return by_row


def step(by_row, process_noise=0.0, measurement_noise=0.0):
    integrate_plant(by_row.reshape(-1), process_noise, measurement_noise, SAMPLING_STEP)


def test_the_drift_is_eq_1_to_far_below_the_noise():
    # In seconds, by SciPy: over a sample, at amplitudes that random inputs of 0.15 V reach.
    rng = np.random.default_rng(0)
    x, v = rng.uniform(-0.3, 0.3, (2, LANES))
    last_u, u = rng.uniform(-0.15, 0.15, (2, LANES))
    by_row = lanes(x=x, velocity=v, last_u=last_u, u=u)
    step(by_row)
    twin = CONTINUOUS_TWIN
    for j in range(LANES):

        def slope(t, state, j=j):
            force = last_u[j] + (u[j] - last_u[j]) * t / SAMPLING_STEP
            return [state[1], (force - twin.c * state[1] - twin.a * state[0] - twin.b * state[0] ** 3) / twin.m]

        start = [x[j], v[j] / SAMPLING_STEP]
        exact = solve_ivp(slope, (0, SAMPLING_STEP), start, rtol=1e-12, atol=1e-12).y[:, -1]
        # The smallest noise of docs/continuous.md moves x by 1e-4 V and x' by 1.7e-4 V per sample.
        assert by_row[LAYOUT["x"], j] == pytest.approx(exact[0], abs=1e-6)
        assert by_row[LAYOUT["velocity"], j] == pytest.approx(exact[1] * SAMPLING_STEP, abs=4e-6)
    np.testing.assert_array_equal(by_row[LAYOUT["y"]], by_row[LAYOUT["x"]])


def test_a_constant_input_ends_where_the_spring_holds_it():
    u = np.linspace(-0.15, 0.15, LANES)
    by_row = lanes(last_u=u, u=u)
    for _ in range(1000):
        step(by_row)
    x = by_row[LAYOUT["x"]]
    np.testing.assert_allclose(CONTINUOUS_TWIN.a * x + CONTINUOUS_TWIN.b * x**3, u, rtol=0, atol=1e-12)


def test_it_does_not_blow_up():
    x = np.linspace(-2.0, 2.0, LANES)
    by_row = lanes(x=x)
    for _ in range(500):
        step(by_row)
    assert np.abs(by_row[LAYOUT["x"]]).max() < 1e-3


def noise_of_a_sample(draws, **rows):
    """(2, draws * LANES) what noise of 1 mV does to (x, x') in a sample [mV]."""
    still = lanes(**rows)
    step(still)
    still = still[[LAYOUT["x"], LAYOUT["velocity"]]].copy()
    by_row, told = lanes(**rows), []
    start = {name: by_row[LAYOUT[name]].copy() for name in ("x", "velocity")}
    for _ in range(draws):
        for name, values in start.items():
            by_row[LAYOUT[name]] = values
        step(by_row, process_noise=1e-3)
        told.append(1e3 * (by_row[[LAYOUT["x"], LAYOUT["velocity"]]] - still))
    return np.concatenate(told, axis=1)


@pytest.mark.parametrize("x", [0.0, 0.3])
def test_the_noise_is_what_the_estimator_takes_it_for(x):
    # 64,000 draws: variances to 0.6 % (one standard deviation).
    measured = np.cov(noise_of_a_sample(2000, x=x))
    belief = lanes()
    belief[: len(continuous_prior().record)] = continuous_prior(spread=1e-6).record[:, None]
    belief[LAYOUT["x0"]] = x
    continuous.update(belief.reshape(-1), 1, continuous.SUBSTEPS)
    xx, xv, vv = (belief[LAYOUT[name], 0] for name in ("N_xx", "N_xv", "N_vv"))
    np.testing.assert_allclose(measured, [[xx, xv], [xv, vv]], rtol=0.03)
    # Weaker than of a free mass, which would have 1, 3/2, 3.
    assert xx < 0.92
    assert vv < 2.5


def test_noise_alone_moves_a_free_mass_by_its_standard_deviation():
    free = {"c": 0.0, "a": 0.0, "b": 0.0}
    moments = np.cov(noise_of_a_sample(2000, **free))
    np.testing.assert_allclose(moments, [[1.0, 1.5], [1.5, 3.0]], rtol=0.03)


def test_the_sensor_adds_its_noise():
    deviations = []
    by_row = lanes()
    for _ in range(500):
        step(by_row, measurement_noise=2e-3)
        deviations.append(by_row[LAYOUT["y"]] - by_row[LAYOUT["x"]])
    assert np.std(deviations) == pytest.approx(2e-3, rel=0.03)
    assert abs(np.corrcoef(np.ravel(deviations[:-1]), np.ravel(deviations[1:]))[0, 1]) < 0.03


def test_the_streams_of_waiting_lanes_stand_still():
    waiting = np.arange(LANES) % 2
    by_row = lanes(waiting=waiting)
    places = [LAYOUT[name] for name in STREAM]
    before = by_row[places].view(np.uint64).copy()
    step(by_row, 1e-3, 1e-3)
    still = (by_row[places].view(np.uint64) == before).all(axis=0)
    np.testing.assert_array_equal(still, waiting == 1)
