"""Input limits, noise, parameter draws and reward payment of one environment, as scalar functions of its rows."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from duffing_env.storage.random_streams import box_muller, float_to_word, sfc64_next, to_open_uniform, word_to_float
from estimator.compilation.simd import LANES, jit, jit_closure, lanewise
from estimator.rigs.rig_prior import STDS_PER_90_PERCENT

#: Distance of a float32 action from the float64 value that it stands for, at most, in parts of the input's scale.
FLOAT32_ROUNDING = 2.0**-22


def draw_two_normals(SFC64_a, SFC64_b, SFC64_c, SFC64_d, NEEDS_RESET):
    """Draw two standard normal numbers; the stream of an environment that waits for its reset stands still."""
    first, a, b, c, d = sfc64_next(
        float_to_word(SFC64_a), float_to_word(SFC64_b), float_to_word(SFC64_c), float_to_word(SFC64_d)
    )
    second, a, b, c, d = sfc64_next(a, b, c, d)
    w, v = box_muller(to_open_uniform(first), to_open_uniform(second))
    live = NEEDS_RESET == 0.0
    return (
        word_to_float(a) if live else SFC64_a, word_to_float(b) if live else SFC64_b,
        word_to_float(c) if live else SFC64_c, word_to_float(d) if live else SFC64_d, w, v,
    )  # fmt: skip


def compile_noise_draw(row_of: Mapping[str, int], pairs: Sequence[tuple[str, str]] = (("NOISE_w", "NOISE_v"),)) -> Any:
    """``draw_noise(W)``: two standard normal numbers in every lane for each source of noise.

    Args:
        row_of: name of a quantity to its row.
        pairs: rows of each source's numbers (`duffing_env.storage.kernel_spec.noise_draw_rows`).
    """
    draws = [lanewise(row_of, f"SFC64_a SFC64_b SFC64_c SFC64_d {w} {v}")(draw_two_normals) for w, v in pairs]
    if len(draws) == 1:
        return draws[0]
    names = {f"draw_{k}": draw for k, draw in enumerate(draws)}
    source = "def draw_noise(W):\n" + "".join(f"    {name}(W)\n" for name in names)
    namespace: dict[str, Any] = dict(names)
    exec(source, namespace)
    return jit_closure("_".join(str(row_of[row]) for pair in pairs for row in pair))(namespace["draw_noise"])


def limit_input(REQUESTED_INPUT, INPUT, LAST_INPUT, ENERGY_SPENT, budget, max_slew):
    """An only input as requested, cut to the largest change from the last input and to the rest of the energy budget.

    ``ENERGY_SPENT`` is the energy Σ u² so far; the rest of the budget bounds the next input, so it cannot be exceeded.
    """
    applied_input = min(max(REQUESTED_INPUT, INPUT - max_slew), INPUT + max_slew)
    max_affordable = np.sqrt(max(budget - ENERGY_SPENT, 0.0))
    applied_input = min(max(applied_input, -max_affordable), max_affordable)
    return applied_input, INPUT, LAST_INPUT, applied_input - INPUT, ENERGY_SPENT + applied_input * applied_input


def pay_reward(REWARD, EPISODE_RETURN, TERMINATED, TRUNCATED, terminal, has_terminated_return, terminated_return):
    """Pay the reward now or at the end of the episode, and correct the return of a terminated episode.

    ``EPISODE_RETURN`` is the sum of the episode's rewards so far, as if every sample were paid.
    """
    already_paid = 0.0 if terminal else EPISODE_RETURN
    EPISODE_RETURN += REWARD
    episode_return = EPISODE_RETURN if TERMINATED + TRUNCATED != 0.0 else 0.0
    REWARD = episode_return if terminal else REWARD
    return terminated_return - already_paid if has_terminated_return and TERMINATED != 0.0 else REWARD, EPISODE_RETURN


def draw_parameter_jump(SFC64_a, SFC64_b, SFC64_c, SFC64_d, jump, horizon):
    """Draw the sample of the first parameter's jump, in the middle half of the episode, and its log-uniform factor."""
    low = math.log(1.0 - jump)
    first, a, b, c, d = sfc64_next(
        float_to_word(SFC64_a), float_to_word(SFC64_b), float_to_word(SFC64_c), float_to_word(SFC64_d)
    )
    second, a, b, c, d = sfc64_next(a, b, c, d)
    jump_sample = math.floor(horizon * (0.25 + 0.5 * to_open_uniform(first)))
    factor = math.exp(low + (math.log(1.0 + jump) - low) * to_open_uniform(second))
    return word_to_float(a), word_to_float(b), word_to_float(c), word_to_float(d), jump_sample, factor


@jit
def draw_plant_parameters(W, j, params, first_stream, first_parameter):
    """Draw the parameters of lane j's plant, each log-uniform, Gaussian or log-normal; then its noises.

    ``first_stream`` and ``first_parameter`` are the places of the stream's first word and of the first parameter.
    """
    a, b = float_to_word(W[first_stream + j]), float_to_word(W[first_stream + LANES + j])
    c, d = float_to_word(W[first_stream + 2 * LANES + j]), float_to_word(W[first_stream + 3 * LANES + j])
    log_low = math.log(1.0 - params.spread)
    log_width = math.log(1.0 + params.spread) - log_low
    for p in range(len(params.nominal_parameters)):
        first, a, b, c, d = sfc64_next(a, b, c, d)
        if params.parameter_stds[p] != 0.0:
            second, a, b, c, d = sfc64_next(a, b, c, d)
            deviation, _ = box_muller(to_open_uniform(first), to_open_uniform(second))
            value = params.nominal_parameters[p] + params.parameter_stds[p] * deviation
            if params.parameter_stds[p] < 0.0:
                value = params.nominal_parameters[p] * math.exp(params.parameter_stds[p] * deviation)
            elif (
                abs(params.nominal_parameters[p]) > STDS_PER_90_PERCENT * params.parameter_stds[p]
                and value * params.nominal_parameters[p] < 0.0
            ):
                value = -value  # a parameter that is believed to have one sign keeps it
            W[first_parameter + p * LANES + j] = value
        else:
            W[first_parameter + p * LANES + j] = params.nominal_parameters[p] * math.exp(
                log_low + log_width * to_open_uniform(first)
            )
    first_noise_std, log_noise_range = (
        first_parameter + len(params.nominal_parameters) * LANES,
        math.log(params.noise_range),
    )
    for k in range(1 + len(params.measurement_noise)):
        std = params.process_noise if k == 0 else params.measurement_noise[k - 1]
        if params.noise_range > 1.0:
            first, a, b, c, d = sfc64_next(a, b, c, d)
            std *= math.exp(log_noise_range * (to_open_uniform(first) - 0.5))
        W[first_noise_std + k * LANES + j] = std
    W[first_stream + j], W[first_stream + LANES + j] = word_to_float(a), word_to_float(b)
    W[first_stream + 2 * LANES + j], W[first_stream + 3 * LANES + j] = word_to_float(c), word_to_float(d)
