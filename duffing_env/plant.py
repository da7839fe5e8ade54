"""The plants: what the oscillator does with an input, and what the sensor shows.

``difference`` is Eq. (2) of the paper. It is explicit, and blows up above about 0.75 V where the real circuit does
not, so every track ends the episode at a displacement limit. ``replay`` is a recorded pair of input and output.
``sde`` is Eq. (1) itself, a stochastic differential equation, integrated in sub-steps of each sample.
"""

from __future__ import annotations

import math

import numpy as np

from duffing_env.layout import LAYOUT
from duffing_env.noise import as_bits, as_word, draw, normal_pair, to_unit
from estimator.inference.continuous import runge_kutta
from estimator.lanes import jit, lanewise

#: Sub-steps of a sample in the plant ``sde``.
SUBSTEPS = 8

_ROOT_3 = math.sqrt(3.0)

# A float32 action times the input's scale is this near to the float64 value it stands for (in parts of the scale).
_FLOAT32_ROUNDING = 2.0**-22


@lanewise(LAYOUT, "stream_a stream_b stream_c stream_d noise_w noise_v")
def draw_noise(stream_a, stream_b, stream_c, stream_d, waiting):
    """Two standard normal numbers. The stream of an environment that waits for its reset stands still."""
    first, a, b, c, d = draw(as_word(stream_a), as_word(stream_b), as_word(stream_c), as_word(stream_d))
    second, a, b, c, d = draw(a, b, c, d)
    noise_w, noise_v = normal_pair(to_unit(first), to_unit(second))
    live = waiting == 0.0
    return (
        as_bits(a) if live else stream_a, as_bits(b) if live else stream_b,
        as_bits(c) if live else stream_c, as_bits(d) if live else stream_d, noise_w, noise_v,
    )  # fmt: skip


@lanewise(LAYOUT, "x last_x y", uniform="process_noise measurement_noise")
def move_plant(x, last_x, u, true_t1, true_t2, true_t3, true_e, noise_w, noise_v, process_noise, measurement_noise):
    """The plant ``difference``: Eq. (2) with Gaussian process noise, and the sensor."""
    moved = true_t1 * x + true_t2 * x * x * x + true_t3 * last_x + true_e * u + process_noise * noise_w
    return moved, x, moved + measurement_noise * noise_v


@lanewise(LAYOUT, "u spent", uniform="budget max_slew")
def limit_input(asked, u, spent, budget, max_slew):
    """The input that the generator gives when it is asked for one: near enough to the last, and paid for.

    ``spent`` is the energy Σ u² [V²]; what is left of the budget bounds the next input, so it cannot be exceeded.
    """
    low, high = u - max_slew, u + max_slew
    given = min(max(asked, low), high)
    left = np.sqrt(max(budget - spent, 0.0))
    given = min(max(given, -left), left)
    return given, spent + given * given


@lanewise(LAYOUT, "x velocity", uniform="start length process_noise step")
def _move_substep(
    x, velocity, last_u, u, m, c, a, b, noise_w, noise_v, start, length, process_noise, step
):  # fmt: skip
    """Eq. (1) over ``length`` of a sample, from ``start`` in it: the drift, then the increments of the noise.

    Time is counted in samples. The input goes linearly from the last action's to this one's over the sample, as a
    causal first-order hold gives it. The acceleration is white noise of intensity 3 process_noise², which alone would
    move x by ``process_noise`` over a sample. Its two integrals over the sub-step are drawn jointly.
    """
    gain = step * step / m
    rise = u - last_u
    u0 = last_u + start * rise
    u1 = last_u + (start + 0.5 * length) * rise
    u2 = last_u + (start + length) * rise
    moved, speed, _, _, _, _, _, _ = runge_kutta(
        x, velocity, a * gain, b * gain, c * step / m, gain, u0, u1, u2, length
    )  # fmt: skip
    kick = _ROOT_3 * process_noise * np.sqrt(length)
    return moved + 0.5 * length * kick * (noise_w + noise_v / _ROOT_3), speed + kick * noise_w


@lanewise(LAYOUT, "y", uniform="measurement_noise")
def _read_sensor(x, noise_v, measurement_noise):
    return x + measurement_noise * noise_v


@jit
def integrate_plant(W, process_noise, measurement_noise, step):
    """The plant ``sde`` over a sample, and the sensor. A pair of random numbers has been drawn; it draws 8 more."""
    for s in range(SUBSTEPS):
        _move_substep(W, s / SUBSTEPS, 1.0 / SUBSTEPS, process_noise, step)
        draw_noise(W)
    _read_sensor(W, measurement_noise)


@lanewise(LAYOUT, "u y off_record", uniform="max_input")
def play_record(u, recorded_u, recorded_y, max_input):
    """The plant ``replay``: a record answers the recorded input only."""
    deviates = abs(u - recorded_u) > _FLOAT32_ROUNDING * max_input
    return recorded_u, recorded_y, 1.0 if deviates else 0.0
