"""The plants, on a block of their own."""

import numpy as np
import pytest
from rounding import U64
from twin import to_coefficients

from duffing_env.experiment_config import SimulatedExperiment
from duffing_env.kernel_stages.generated_environment_functions import generated_functions
from duffing_env.kernel_stages.plant_stages import compile_noise_draw
from duffing_env.kernel_stages.sample_stages import compile_replay
from duffing_env.storage.kernel_spec import block_layout
from estimator import SILVERBOX_TWIN
from estimator.compilation.simd import LANES

KIND = SimulatedExperiment().kernel_spec
PLACE = block_layout(KIND)
STREAM = ("SFC64_a", "SFC64_b", "SFC64_c", "SFC64_d")
COEFFICIENTS = ("TRUE_theta1", "TRUE_theta2", "TRUE_theta3", "TRUE_eta")
TRUE = dict(zip(COEFFICIENTS, to_coefficients(SILVERBOX_TWIN), strict=True))


def move_plant(flat, process_noise, measurement_noise):
    """A sample of the plant, with the noise that stands in the block."""
    for name, std in (("PROCESS_STD", process_noise), ("SENSOR_STD_y", measurement_noise)):
        flat[PLACE[name] * LANES : (PLACE[name] + 1) * LANES] = std
    generated_functions(KIND).step_plant(flat)


def block(**rows):
    """A block with the given rows (numbers, or one for each lane); flat, as the kernel takes it, and by row."""
    by_row = np.zeros((max(PLACE.values()) + 1, LANES))
    for name, values in rows.items():
        by_row[PLACE[name]] = values
    return by_row.reshape(-1), lambda name: by_row[PLACE[name]]


def test_difference_plant_is_eq_2_with_a_noisy_sensor():
    rng = np.random.default_rng(0)
    x, last_x, u = rng.uniform(-0.5, 0.5, (3, LANES))
    w, v = rng.standard_normal((2, LANES))
    t1, t2, t3, e = rng.uniform(-2, 2, (4, LANES))
    flat, row = block(
        X_x1=x, X_x2=last_x, INPUT_u=u, NOISE_w=w, NOISE_v=v, **dict(zip(COEFFICIENTS, (t1, t2, t3, e), strict=True))
    )
    move_plant(flat, 3e-4, 2e-2)
    moved = t1 * x + t2 * x**3 + t3 * last_x + e * u + 3e-4 * w
    # Sums of five and six terms of up to three factors: no term is rounded more than eight times on a side.
    size = sum(map(np.abs, (t1 * x, t2 * x**3, t3 * last_x, e * u, 3e-4 * w)))
    assert (np.abs(row("X_x1") - moved) <= 16 * U64 * size).all()
    np.testing.assert_array_equal(row("X_x2"), x)
    assert (np.abs(row("Y_y") - moved - 2e-2 * v) <= 16 * U64 * (size + np.abs(2e-2 * v))).all()
    np.testing.assert_array_equal(row("INPUT_u"), u)


def test_a_constant_input_ends_where_the_spring_holds_it():
    # a x + b x³ = u knows nothing of the discretisation.
    u = np.linspace(-0.15, 0.15, LANES)
    flat, row = block(INPUT_u=u, **TRUE)
    for _ in range(4000):
        move_plant(flat, 0.0, 0.0)
    x = row("X_x1")
    np.testing.assert_allclose(SILVERBOX_TWIN.a * x + SILVERBOX_TWIN.b * x**3, u, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(row("Y_y"), x)


def test_it_blows_up_where_the_documentation_says():
    # Released at rest from x: below about 0.75 V it comes back, above it runs away.
    x = np.linspace(0.5, 1.0, LANES)
    flat, row = block(X_x1=x, X_x2=x, **TRUE)
    for _ in range(200):
        move_plant(flat, 0.0, 0.0)
    came_back = np.abs(row("X_x1")) < 1.0
    edge = x[came_back].max()
    assert not came_back[x > edge].any()
    assert 0.7 < edge < 0.8


def test_noise_is_scaled_once_and_the_stream_of_a_waiting_lane_stands_still():
    words = np.random.default_rng(0).integers(1, 2**60, (4, LANES), dtype=np.uint64)
    waiting = np.arange(LANES) % 2
    flat, row = block(NEEDS_RESET=waiting, **dict(zip(STREAM, words.view(np.float64), strict=True)))
    compile_noise_draw(PLACE)(flat)
    still = np.stack([row(name) for name in STREAM]).copy().view(np.uint64) == words
    np.testing.assert_array_equal(still.all(axis=0), waiting == 1)


@pytest.mark.parametrize(("deviation", "off_record"), [(0.0, 0.0), (2e-8, 0.0), (-2e-8, 0.0), (1e-7, 1.0), (-0.1, 1.0)])
def test_a_record_answers_the_recorded_input_only(deviation, off_record):
    # A float32 action in [-1, 1] is within 3e-8 of the number that it stands for; here it is scaled by 0.15.
    flat, row = block(INPUT_u=0.1 + deviation, OFF_RECORD=0.5)
    compile_replay(KIND).py_func(flat, np.array([[0.1], [-0.3]]), 0, np.array([0.15]))
    for name, expected in (("INPUT_u", 0.1), ("Y_y", -0.3), ("OFF_RECORD", off_record)):
        np.testing.assert_array_equal(row(name), expected)
