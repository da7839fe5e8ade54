"""The oscillator of an episode: how it is drawn, and how its mass jumps."""

from __future__ import annotations

import math

from duffing_env.layout import LAYOUT
from duffing_env.noise import as_bits, as_word, draw, to_unit
from estimator.lanes import at_lane, inlined


@at_lane(
    LAYOUT,
    "stream_a stream_b stream_c stream_d m c a b true_t1 true_t2 true_t3 true_e",
    uniform="spread center_m center_c center_a center_b step continuous",
)
def draw_oscillator(
    stream_a, stream_b, stream_c, stream_d, spread, center_m, center_c, center_a, center_b, step, continuous
):  # fmt: skip
    """m, c, a and b log-uniform about the centre, and their coefficients: those of the estimator's equation.

    By Eq. (3); for the physical one stiffness, cubic stiffness, damping and gain per sample.
    """
    low = math.log(1.0 - spread)
    width = math.log(1.0 + spread) - low
    first, i, j, k, n = draw(as_word(stream_a), as_word(stream_b), as_word(stream_c), as_word(stream_d))
    second, i, j, k, n = draw(i, j, k, n)
    third, i, j, k, n = draw(i, j, k, n)
    fourth, i, j, k, n = draw(i, j, k, n)
    m = center_m * math.exp(low + width * to_unit(first))
    c = center_c * math.exp(low + width * to_unit(second))
    a = center_a * math.exp(low + width * to_unit(third))
    b = center_b * math.exp(low + width * to_unit(fourth))
    t1, t2, t3, e = _coefficients(m, c, a, b, step, continuous)
    return as_bits(i), as_bits(j), as_bits(k), as_bits(n), m, c, a, b, t1, t2, t3, e


@at_lane(LAYOUT, "stream_a stream_b stream_c stream_d jump_at jump_factor", uniform="jump horizon")
def draw_jump(stream_a, stream_b, stream_c, stream_d, jump, horizon):
    """The sample at which the mass jumps, in the middle half of the episode, and its log-uniform factor."""
    low = math.log(1.0 - jump)
    first, a, b, c, d = draw(as_word(stream_a), as_word(stream_b), as_word(stream_c), as_word(stream_d))
    second, a, b, c, d = draw(a, b, c, d)
    at = math.floor(horizon * (0.25 + 0.5 * to_unit(first)))
    factor = math.exp(low + (math.log(1.0 + jump) - low) * to_unit(second))
    return as_bits(a), as_bits(b), as_bits(c), as_bits(d), at, factor


@at_lane(LAYOUT, "m true_t1 true_t2 true_t3 true_e", uniform="step continuous")
def jump_mass(m, c, a, b, jump_factor, step, continuous):
    """Change the mass, and with it the coefficients, by Eq. (3) or per sample of Eq. (1)."""
    m = jump_factor * m
    t1, t2, t3, e = _coefficients(m, c, a, b, step, continuous)
    return m, t1, t2, t3, e


@inlined
def _coefficients(m, c, a, b, step, continuous):
    """θ1, θ2, θ3 and η by Eq. (3); or stiffness, cubic stiffness, damping and gain per sample."""
    if continuous != 0.0:
        gain = step * step / m
        return a * gain, b * gain, c * step / m, gain
    e = step * step / (m + c * step)
    return (2.0 * m + c * step) * e / (step * step) - a * e, -b * e, -m * e / (step * step), e
