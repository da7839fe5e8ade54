"""Stages of a step that no model changes: scalar functions of a lane, which the kernel makes run across lanes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from duffing_env.noise import as_bits, as_word, draw, normal_pair, to_unit
from estimator.lanes import LANES, jit, lanewise
from estimator.rig_prior import HALF_WIDTH

# A float32 action times the input's scale is this near to the float64 value it stands for (in parts of the scale).
_FLOAT32_ROUNDING = 2.0**-22


def draw_noise(STREAM_a, STREAM_b, STREAM_c, STREAM_d, WAITING):
    """Two standard normal numbers. The stream of an environment that waits for its reset stands still."""
    first, a, b, c, d = draw(as_word(STREAM_a), as_word(STREAM_b), as_word(STREAM_c), as_word(STREAM_d))
    second, a, b, c, d = draw(a, b, c, d)
    w, v = normal_pair(to_unit(first), to_unit(second))
    live = WAITING == 0.0
    return (
        as_bits(a) if live else STREAM_a, as_bits(b) if live else STREAM_b,
        as_bits(c) if live else STREAM_c, as_bits(d) if live else STREAM_d, w, v,
    )  # fmt: skip


def noise_drawer(place: Mapping[str, int]) -> Any:
    """``draw_noise(W)``: two standard normal numbers in every lane, into rows ``NOISE_w`` and ``NOISE_v``."""
    return lanewise(place, "STREAM_a STREAM_b STREAM_c STREAM_d NOISE_w NOISE_v")(draw_noise)


def limit_input(ASKED, INPUT, LAST_INPUT, SPENT, budget, max_slew):
    """The input that the generator gives when it is asked for one: near enough to the last, and paid for.

    ``SPENT`` is the energy Σ u²; what is left of the budget bounds the next input, so it cannot be exceeded.
    """
    given = min(max(ASKED, INPUT - max_slew), INPUT + max_slew)
    left = np.sqrt(max(budget - SPENT, 0.0))
    given = min(max(given, -left), left)
    return given, INPUT, LAST_INPUT, given - INPUT, SPENT + given * given


def play_record(INPUT, RECORDED_u, RECORDED_y, max_input):
    """The recorded plant: a record answers the recorded input only."""
    deviates = abs(INPUT - RECORDED_u) > _FLOAT32_ROUNDING * max_input
    return RECORDED_u, RECORDED_y, 1.0 if deviates else 0.0


def pay(REWARD, EARNED, TERMINATED, TRUNCATED, terminal, forfeits, terminated_return):
    """When the reward is paid, and what an episode that is terminated returns.

    ``EARNED`` is what the episode gave so far, as if it were paid sample by sample.
    """
    received = 0.0 if terminal else EARNED
    EARNED += REWARD
    at_end = EARNED if TERMINATED + TRUNCATED != 0.0 else 0.0
    REWARD = at_end if terminal else REWARD
    return terminated_return - received if forfeits and TERMINATED != 0.0 else REWARD, EARNED


def draw_jump(STREAM_a, STREAM_b, STREAM_c, STREAM_d, jump, horizon):
    """The sample at which the first parameter jumps, in the middle half of the episode, and its log-uniform factor."""
    low = math.log(1.0 - jump)
    first, a, b, c, d = draw(as_word(STREAM_a), as_word(STREAM_b), as_word(STREAM_c), as_word(STREAM_d))
    second, a, b, c, d = draw(a, b, c, d)
    at = math.floor(horizon * (0.25 + 0.5 * to_unit(first)))
    factor = math.exp(low + (math.log(1.0 + jump) - low) * to_unit(second))
    return as_bits(a), as_bits(b), as_bits(c), as_bits(d), at, factor


@jit
def draw_plant(W, j, setup, stream, drawn):
    """The parameters of lane j's plant, each log-uniform about its centre, Gaussian or log-normal; then its noises.

    ``stream`` and ``drawn`` say where the first word of the stream and the first parameter stand.
    """
    a, b = as_word(W[stream + j]), as_word(W[stream + LANES + j])
    c, d = as_word(W[stream + 2 * LANES + j]), as_word(W[stream + 3 * LANES + j])
    low = math.log(1.0 - setup.spread)
    width = math.log(1.0 + setup.spread) - low
    for p in range(len(setup.center)):
        first, a, b, c, d = draw(a, b, c, d)
        if setup.width[p] != 0.0:
            second, a, b, c, d = draw(a, b, c, d)
            deviation, _ = normal_pair(to_unit(first), to_unit(second))
            value = setup.center[p] + setup.width[p] * deviation
            if setup.width[p] < 0.0:
                value = setup.center[p] * math.exp(setup.width[p] * deviation)
            elif abs(setup.center[p]) > HALF_WIDTH * setup.width[p] and value * setup.center[p] < 0.0:
                value = -value  # what is believed to have one sign keeps it
            W[drawn + p * LANES + j] = value
        else:
            W[drawn + p * LANES + j] = setup.center[p] * math.exp(low + width * to_unit(first))
    noises, decades = drawn + len(setup.center) * LANES, math.log(setup.noise_range)
    for k in range(1 + len(setup.measurement_noise)):
        std = setup.process_noise if k == 0 else setup.measurement_noise[k - 1]
        if setup.noise_range > 1.0:
            first, a, b, c, d = draw(a, b, c, d)
            std *= math.exp(decades * (to_unit(first) - 0.5))
        W[noises + k * LANES + j] = std
    W[stream + j], W[stream + LANES + j] = as_bits(a), as_bits(b)
    W[stream + 2 * LANES + j], W[stream + 3 * LANES + j] = as_bits(c), as_bits(d)
