"""One step of the experiment, compiled: input → plant → measurement → belief → reward → observation.

It exists once. A single environment is a batch with one live lane, so both faces give bit-identical trajectories.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from duffing_env import expectation, fisher, simulation
from duffing_env.layout import (
    ESTIMATORS,
    LAYOUT,
    N_OBSERVATION,
    N_OUTCOME,
    N_ROWS,
    OBSERVATION,
    OSCILLATOR,
    PLANTS,
    SAVED,
    SETTINGS,
    SUMMED,
)
from duffing_env.noise import as_bits, as_word, draw, to_unit
from duffing_env.plant import draw_noise, integrate_plant, limit_input, move_plant, play_record
from duffing_env.rewards import REWARDS, appraise, settle
from estimator.elementary import log
from estimator.inference import continuous as ode
from estimator.inference import free_energy, update, walk
from estimator.lanes import LANES, at_lane, inlined, jit, kernel, lanewise
from estimator.record import RECORD_SIZE

#: How finished environments are reset: by hand, in the step after, or in the same step.
RESET_BY_HAND, RESET_NEXT_STEP, RESET_SAME_STEP = 0, 1, 2

# Where rows that the loops below touch by index begin in a block.
_RECORD = RECORD_SIZE * LANES
_U, _Y, _X, _LAST_X = (LAYOUT[name] * LANES for name in ("u", "y", "x", "last_x"))
_ASKED, _SPENT, _JUMP_AT = (LAYOUT[name] * LANES for name in ("asked", "spent", "jump_at"))
_LAST_U, _VELOCITY = LAYOUT["last_u"] * LANES, LAYOUT["velocity"] * LANES
_ELAPSED, _WAITING = LAYOUT["elapsed"] * LANES, LAYOUT["waiting"] * LANES
_RECORDED_U, _RECORDED_Y = LAYOUT["recorded_u"] * LANES, LAYOUT["recorded_y"] * LANES
_OUTCOME, _OBS = LAYOUT["reward"] * LANES, LAYOUT["obs_mean_t1"] * LANES
_TERMINATED, _TRUNCATED = LAYOUT["terminated"] * LANES, LAYOUT["truncated"] * LANES
_DIVERGED, _OFF_RECORD = LAYOUT["diverged"] * LANES, LAYOUT["off_record"] * LANES
_SURPRISE, _EARNED = LAYOUT["surprise"] * LANES, LAYOUT["earned"] * LANES
_ERROR, _MISFIT = LAYOUT["error"] * LANES, LAYOUT["misfit"] * LANES
_SUMMED = tuple(LAYOUT[name] * LANES for name in SUMMED)
_SAVED_RECORD = LAYOUT[SAVED[0]] * LANES
_OSCILLATOR, _ENDED_OSCILLATOR = LAYOUT["m"] * LANES, LAYOUT["ended_m"] * LANES
_N_OSCILLATOR = len(OSCILLATOR)

# Where settings stand.
_MAX_INPUT, _MAX_OUTPUT, _HORIZON = (SETTINGS[name] for name in ("max_input", "max_output", "horizon"))
_PROCESS_NOISE, _MEASUREMENT_NOISE = SETTINGS["process_noise"], SETTINGS["measurement_noise"]
_BUDGET, _MAX_SLEW, _INPUT_COST = (SETTINGS[name] for name in ("budget", "max_slew", "input_cost"))
_JUMP, _WALK = SETTINGS["jump"], SETTINGS["walk_t1"]
_SPREAD, _CENTER, _STEP = SETTINGS["spread"], SETTINGS["center_m"], SETTINGS["step"]
_REWARD, _ESTIMATOR, _ITERATIONS = SETTINGS["reward"], SETTINGS["estimator"], SETTINGS["iterations"]
_AS_PUBLISHED, _NONLINEAR = SETTINGS["as_published"], SETTINGS["nonlinear"]
_PLANT, _DELAY = SETTINGS["plant"], SETTINGS["delay"]
_REPLAY, _SDE = PLANTS["replay"], PLANTS["sde"]
_MEAN_FIELD, _ODE = ESTIMATORS["mean_field"], ESTIMATORS["ode"]
_FREE_ENERGY, _FISHER = REWARDS["free_energy"], REWARDS["fisher"]
_EXPECTED, _SIMULATION = REWARDS["expected_free_energy"], REWARDS["simulation_error"]
_HOLD, _TERMINAL = SETTINGS["hold"], SETTINGS["terminal"]
_FORFEITS, _TERMINATED_RETURN = SETTINGS["forfeits"], SETTINGS["terminated_return"]
_PRIOR_T1, _SCALE_T1 = SETTINGS["prior_t1"], SETTINGS["scale_t1"]
_PRIOR_LOG_GAMMA, _PRIOR_LOG_XI = SETTINGS["prior_log_gamma"], SETTINGS["prior_log_xi"]


@lanewise(
    LAYOUT,
    " ".join(f"obs_{name}" for name in OBSERVATION),
    uniform=(
        "center_t1 center_t2 center_t3 center_e scale_t1 scale_t2 scale_t3 scale_e log_gamma_0 log_xi_0 "
        "max_input max_output horizon budget"
    ),
)
def observe(
    x0, x1, t1, t2, t3, e,
    P_t1_t1, P_t1_t2, P_t1_t3, P_t1_e, P_t2_t2, P_t2_t3, P_t2_e, P_t3_t3, P_t3_e, P_e_e,
    g_shape, g_rate, n_shape, n_rate, u, y, elapsed, spent,
    center_t1, center_t2, center_t3, center_e, scale_t1, scale_t2, scale_t3, scale_e, log_gamma_0, log_xi_0,
    max_input, max_output, horizon, budget,
):  # fmt: skip
    """The observation, in the order of `OBSERVATION`. A scale is 1/std of the prior; 0 for a known θ2."""
    i1 = 1.0 / np.sqrt(P_t1_t1)
    i3 = 1.0 / np.sqrt(P_t3_t3)
    ie = 1.0 / np.sqrt(P_e_e)
    i2 = 1.0 / np.sqrt(P_t2_t2) if scale_t2 > 0.0 else 0.0
    log_std_2 = -log(i2 / scale_t2) if scale_t2 > 0.0 else 0.0
    return (
        _clip((t1 - center_t1) * scale_t1, -10.0, 10.0), _clip((t2 - center_t2) * scale_t2, -10.0, 10.0),
        _clip((t3 - center_t3) * scale_t3, -10.0, 10.0), _clip((e - center_e) * scale_e, -10.0, 10.0),
        _clip(-log(i1 / scale_t1), -20.0, 5.0), _clip(log_std_2, -20.0, 5.0),
        _clip(-log(i3 / scale_t3), -20.0, 5.0), _clip(-log(ie / scale_e), -20.0, 5.0),
        _clip(P_t1_t2 * i1 * i2, -1.0, 1.0), _clip(P_t1_t3 * i1 * i3, -1.0, 1.0), _clip(P_t1_e * i1 * ie, -1.0, 1.0),
        _clip(P_t2_t3 * i2 * i3, -1.0, 1.0), _clip(P_t2_e * i2 * ie, -1.0, 1.0), _clip(P_t3_e * i3 * ie, -1.0, 1.0),
        _clip(log(g_shape / g_rate) - log_gamma_0, -20.0, 20.0),
        _clip(log(n_shape / n_rate) - log_xi_0, -20.0, 20.0),
        _clip(x0 / max_output, -2.0, 2.0), _clip(x1 / max_output, -2.0, 2.0),
        _clip(u / max_input, -1.0, 1.0), _clip(y / max_output, -2.0, 2.0),
        _clip(1.0 - elapsed / horizon, 0.0, 1.0), _clip(1.0 - spent / budget, 0.0, 1.0),
    )  # fmt: skip


@inlined
def _clip(value, low, high):
    """A finite value within its bounds; NaN becomes the lower bound."""
    value = value if value > low else low
    return value if value < high else high


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


@jit
def reset_lane(W, j, settings, prior):
    """Start an episode in lane j: draw its oscillator, put it at rest, and put the belief to the prior."""
    continuous = 1.0 if settings[_ESTIMATOR] == _ODE else 0.0
    for i in range(RECORD_SIZE):
        W[i * LANES + j] = prior[i]
    draw_oscillator(
        W, j, settings[_SPREAD], settings[_CENTER], settings[_CENTER + 1], settings[_CENTER + 2],
        settings[_CENTER + 3], settings[_STEP], continuous,
    )  # fmt: skip
    W[_JUMP_AT + j] = -1.0
    if settings[_JUMP] > 0.0:
        draw_jump(W, j, settings[_JUMP], settings[_HORIZON])
    for row in (_U, _LAST_U, _Y, _X, _LAST_X, _VELOCITY, _ELAPSED, _WAITING, _SPENT, _EARNED):
        W[row + j] = 0.0
    _appraise(W, j, settings)
    if settings[_REWARD] == _FISHER:
        fisher.begin(W, j, prior, settings[_NONLINEAR])


@jit
def _appraise(W, j, settings):
    """Measure lane j's belief beside its oscillator, where either is new."""
    continuous = settings[_ESTIMATOR] == _ODE
    appraise(W, j, settings[_STEP], settings[_NONLINEAR], 1.0 if continuous else 0.0)
    if settings[_REWARD] == _SIMULATION:
        simulation.compare(W, settings[_MAX_INPUT], continuous)
        W[_ERROR + j] = W[_MISFIT + j]


@jit
def _infer(W, settings):
    """Update the beliefs of a block with its samples, and tell what the reward needs of the update."""
    if settings[_WALK] > 0.0:
        walk(W, settings[_WALK], settings[_WALK + 1], settings[_WALK + 2], settings[_WALK + 3])
    structured = settings[_ESTIMATOR] != _MEAN_FIELD
    iterations = np.int64(settings[_ITERATIONS])
    if settings[_ESTIMATOR] == _ODE:
        ode.update(W, iterations, ode.SUBSTEPS)
    else:
        # Eq. (2) takes the input at x_t. Between two actions of the plant ``sde`` that is the last one.
        if settings[_PLANT] == _SDE:
            _swap_inputs(W)
        update(W, structured, iterations, settings[_AS_PUBLISHED] != 0.0, W[:0])
        if settings[_REWARD] == _EXPECTED and not structured:
            expectation.predict(W)
        if settings[_PLANT] == _SDE:
            _swap_inputs(W)
    if settings[_REWARD] == _FREE_ENERGY:
        for j in range(LANES):
            W[_SURPRISE + j] = free_energy(W, j, structured)
    if settings[_REWARD] == _EXPECTED:
        expectation.expect(
            W, settings[_WALK], settings[_WALK + 1], settings[_WALK + 2], settings[_WALK + 3], settings[_NONLINEAR],
            1.0 if settings[_ESTIMATOR] == _ODE else 0.0,
        )  # fmt: skip
    if settings[_REWARD] == _SIMULATION:
        simulation.compare(W, settings[_MAX_INPUT], settings[_ESTIMATOR] == _ODE)


@jit
def _swap_inputs(W):
    for j in range(LANES):
        W[_U + j], W[_LAST_U + j] = W[_LAST_U + j], W[_U + j]


@jit
def _integrate_and_infer(W, settings, recorded_u, recorded_y):
    """Plant, measurement, belief and reward for all lanes of a block; their inputs stand in row ``u``."""
    draw_noise(W)
    if settings[_REWARD] == _FISHER:
        fisher.inform(W, settings[_PROCESS_NOISE], settings[_MEASUREMENT_NOISE], settings[_NONLINEAR])
    if settings[_PLANT] == _REPLAY:
        last = len(recorded_y) - 1
        for j in range(LANES):
            t = np.int64(W[_ELAPSED + j])
            W[_RECORDED_U + j] = recorded_u[min(t, last)]
            W[_RECORDED_Y + j] = recorded_y[min(t + np.int64(settings[_DELAY]), last)]
        play_record(W, settings[_MAX_INPUT])
    elif settings[_PLANT] == _SDE:
        integrate_plant(W, settings[_PROCESS_NOISE], settings[_MEASUREMENT_NOISE], settings[_STEP])
    else:
        move_plant(W, settings[_PROCESS_NOISE], settings[_MEASUREMENT_NOISE])
    for i in range(_RECORD):
        W[_SAVED_RECORD + i] = W[i]
    _infer(W, settings)
    settle(
        W, settings[_MAX_OUTPUT], settings[_HORIZON], settings[_STEP], settings[_NONLINEAR],
        1.0 if settings[_ESTIMATOR] == _ODE else 0.0, settings[_REWARD],
        settings[_INPUT_COST], settings[_TERMINAL], settings[_FORFEITS], settings[_TERMINATED_RETURN],
    )  # fmt: skip
    for j in range(LANES):
        if W[_DIVERGED + j] != 0.0 or W[_OFF_RECORD + j] != 0.0:
            for i in range(RECORD_SIZE):
                W[i * LANES + j] = W[_SAVED_RECORD + i * LANES + j]


@jit
def _write_observations(W, settings, observations):
    """Compute the observations of a block and write them to (LANES, N_OBSERVATION) float32."""
    observe(
        W, settings[_PRIOR_T1], settings[_PRIOR_T1 + 1], settings[_PRIOR_T1 + 2], settings[_PRIOR_T1 + 3],
        settings[_SCALE_T1], settings[_SCALE_T1 + 1], settings[_SCALE_T1 + 2], settings[_SCALE_T1 + 3],
        settings[_PRIOR_LOG_GAMMA], settings[_PRIOR_LOG_XI],
        settings[_MAX_INPUT], settings[_MAX_OUTPUT], settings[_HORIZON], settings[_BUDGET],
    )  # fmt: skip
    for j in range(LANES):
        for k in range(N_OBSERVATION):
            observations[j, k] = W[_OBS + k * LANES + j]


@jit
def _play_sample(W, actions, settings, recorded_u, recorded_y):
    """One sample of a block: the inputs within their limits, a jump where it is due, and what follows."""
    for j in range(LANES):
        W[_LAST_U + j] = W[_U + j]
        W[_ASKED + j] = settings[_MAX_INPUT] * max(-1.0, min(1.0, actions[j]))
    limit_input(W, settings[_BUDGET], settings[_MAX_SLEW])
    if settings[_JUMP] > 0.0:
        for j in range(LANES):
            if W[_ELAPSED + j] == W[_JUMP_AT + j]:
                jump_mass(W, j, settings[_STEP], 1.0 if settings[_ESTIMATOR] == _ODE else 0.0)
                _appraise(W, j, settings)
    _integrate_and_infer(W, settings, recorded_u, recorded_y)


@jit
def _play(W, actions, settings, recorded_u, recorded_y):
    """Apply the actions for as many samples as they hold; an environment that ends meanwhile stays as it ended."""
    for s in range(np.int64(settings[_HOLD])):
        before = W.copy() if s > 0 else W[:0]
        _play_sample(W, actions, settings, recorded_u, recorded_y)
        if s > 0:
            for j in range(LANES):
                if before[_TERMINATED + j] + before[_TRUNCATED + j] != 0.0:
                    for row in range(N_ROWS):
                        W[row * LANES + j] = before[row * LANES + j]
                else:
                    for row in _SUMMED:
                        W[row + j] += before[row + j]


@jit
def _step_block(
    W, actions, settings, prior, recorded_u, recorded_y, reset_mode, observations, final_observations, outcome
):  # fmt: skip
    """One step of a block: ``actions`` (LANES,), observations (LANES, N_OBSERVATION), outcome (len(OUTCOME), LANES)."""
    waiting = 0
    for j in range(LANES):
        waiting += W[_WAITING + j] != 0.0
    if waiting < LANES:
        _play(W, actions, settings, recorded_u, recorded_y)
    finished = 0
    for j in range(LANES):
        if W[_WAITING + j] != 0.0 and reset_mode == RESET_NEXT_STEP:
            reset_lane(W, j, settings, prior)
            for k in range(N_OUTCOME):
                W[_OUTCOME + k * LANES + j] = 0.0
        elif W[_TERMINATED + j] + W[_TRUNCATED + j] != 0.0:
            W[_WAITING + j] = 1.0
            finished += 1
    for k in range(N_OUTCOME):
        for j in range(LANES):
            outcome[k, j] = W[_OUTCOME + k * LANES + j]
    _write_observations(W, settings, observations)
    if reset_mode == RESET_SAME_STEP and finished:
        for j in range(LANES):
            if W[_WAITING + j] != 0.0:
                for k in range(N_OBSERVATION):
                    final_observations[j, k] = observations[j, k]
                for i in range(RECORD_SIZE):
                    W[_SAVED_RECORD + i * LANES + j] = W[i * LANES + j]
                for i in range(_N_OSCILLATOR):
                    W[_ENDED_OSCILLATOR + i * LANES + j] = W[_OSCILLATOR + i * LANES + j]
                reset_lane(W, j, settings, prior)
        _write_observations(W, settings, observations)


@kernel
def reset(blocks, mask, settings, prior, observations):
    """Start episodes in the environments of ``mask`` (n,), and write all observations (n, N_OBSERVATION)."""
    for i in range(len(mask)):
        if mask[i]:
            reset_lane(blocks[i // LANES], i % LANES, settings, prior)
    for b in range(len(blocks)):
        _write_observations(blocks[b], settings, observations[b * LANES : (b + 1) * LANES])


@kernel
def step_serial(
    blocks, actions, settings, prior, recorded_u, recorded_y, reset_mode, observations, final_observations, outcome
):  # fmt: skip
    """Step all blocks on the calling thread.

    Args:
        blocks: (n_blocks, N_ROWS * LANES) the environments.
        actions: (n,) inputs in parts of the largest; n = n_blocks * LANES.
        settings: (len(SETTINGS),).
        prior: (RECORD_SIZE,) the belief that episodes start from.
        recorded_u: (T,) input of the plant ``replay``; one sample elsewhere.
        recorded_y: (T,) its output.
        reset_mode: RESET_BY_HAND, RESET_NEXT_STEP or RESET_SAME_STEP.
        observations: (n, N_OBSERVATION) float32, written.
        final_observations: the same; rows of environments that were reset in this very step are written.
        outcome: (len(OUTCOME), n), written.
    """
    for b in range(len(blocks)):
        lanes = slice(b * LANES, (b + 1) * LANES)
        _step_block(
            blocks[b], actions[lanes], settings, prior, recorded_u, recorded_y, reset_mode,
            observations[lanes], final_observations[lanes], outcome[:, lanes],
        )  # fmt: skip


@kernel(parallel=True)
def step_parallel(
    blocks, actions, settings, prior, recorded_u, recorded_y, reset_mode, observations, final_observations, outcome
):  # fmt: skip
    """Step all blocks on Numba's threads; arguments and results are those of `step_serial`."""
    for b in prange(len(blocks)):
        lanes = slice(b * LANES, (b + 1) * LANES)
        _step_block(
            blocks[b], actions[lanes], settings, prior, recorded_u, recorded_y, reset_mode,
            observations[lanes], final_observations[lanes], outcome[:, lanes],
        )  # fmt: skip
