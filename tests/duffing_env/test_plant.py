"""The plants, on a block of their own."""

import numpy as np
import pytest
from rounding import U64

from duffing_env.layout import LAYOUT, N_ROWS
from duffing_env.plant import draw_noise, move_plant, play_record
from estimator import SILVERBOX_TWIN, to_coefficients
from estimator.lanes import LANES

TWIN = to_coefficients(SILVERBOX_TWIN)
TRUE = dict(
    zip(("true_t1", "true_t2", "true_t3", "true_e"), (TWIN.theta1, TWIN.theta2, TWIN.theta3, TWIN.eta), strict=True)
)


def block(**rows):
    """A block with the given rows (numbers, or one for each lane); flat, as the kernel takes it, and by row."""
    by_row = np.zeros((N_ROWS, LANES))
    for name, values in rows.items():
        by_row[LAYOUT[name]] = values
    return by_row.reshape(-1), lambda name: by_row[LAYOUT[name]]


def test_difference_plant_is_eq_2_with_a_noisy_sensor():
    rng = np.random.default_rng(0)
    x, last_x, u = rng.uniform(-0.5, 0.5, (3, LANES))
    w, v = rng.standard_normal((2, LANES))
    t1, t2, t3, e = rng.uniform(-2, 2, (4, LANES))
    flat, row = block(x=x, last_x=last_x, u=u, noise_w=w, noise_v=v, true_t1=t1, true_t2=t2, true_t3=t3, true_e=e)
    move_plant(flat, 3e-4, 2e-2)
    moved = t1 * x + t2 * x**3 + t3 * last_x + e * u + 3e-4 * w
    # Sums of five and six terms of up to three factors: no term is rounded more than eight times on a side.
    size = sum(map(np.abs, (t1 * x, t2 * x**3, t3 * last_x, e * u, 3e-4 * w)))
    assert (np.abs(row("x") - moved) <= 16 * U64 * size).all()
    np.testing.assert_array_equal(row("last_x"), x)
    assert (np.abs(row("y") - moved - 2e-2 * v) <= 16 * U64 * (size + np.abs(2e-2 * v))).all()
    np.testing.assert_array_equal(row("u"), u)


def test_a_constant_input_ends_where_the_spring_holds_it():
    # a x + b x³ = u knows nothing of the discretisation.
    u = np.linspace(-0.15, 0.15, LANES)
    flat, row = block(u=u, **TRUE)
    for _ in range(4000):
        move_plant(flat, 0.0, 0.0)
    x = row("x")
    np.testing.assert_allclose(SILVERBOX_TWIN.a * x + SILVERBOX_TWIN.b * x**3, u, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(row("y"), x)


def test_it_blows_up_where_the_documentation_says():
    # Released at rest from x: below about 0.75 V it comes back, above it runs away.
    x = np.linspace(0.5, 1.0, LANES)
    flat, row = block(x=x, last_x=x, **TRUE)
    for _ in range(200):
        move_plant(flat, 0.0, 0.0)
    came_back = np.abs(row("x")) < 1.0
    edge = x[came_back].max()
    assert not came_back[x > edge].any()
    assert 0.7 < edge < 0.8


def test_noise_is_scaled_once_and_the_stream_of_a_waiting_lane_stands_still():
    words = np.random.default_rng(0).integers(1, 2**60, (4, LANES), dtype=np.uint64)
    names = ("stream_a", "stream_b", "stream_c", "stream_d")
    waiting = np.arange(LANES) % 2
    flat, row = block(waiting=waiting, **dict(zip(names, words.view(np.float64), strict=True)))
    draw_noise(flat)
    still = np.stack([row(name) for name in names]).copy().view(np.uint64) == words
    np.testing.assert_array_equal(still.all(axis=0), waiting == 1)


@pytest.mark.parametrize(("deviation", "off_record"), [(0.0, 0.0), (2e-8, 0.0), (-2e-8, 0.0), (1e-7, 1.0), (-0.1, 1.0)])
def test_a_record_answers_the_recorded_input_only(deviation, off_record):
    # A float32 action in [-1, 1] is within 3e-8 of the number that it stands for; here it is scaled by 0.15.
    flat, row = block(u=0.1 + deviation, recorded_u=0.1, recorded_y=-0.3)
    play_record(flat, 0.15)
    np.testing.assert_array_equal(row("u"), 0.1)
    np.testing.assert_array_equal(row("y"), -0.3)
    np.testing.assert_array_equal(row("off_record"), off_record)
