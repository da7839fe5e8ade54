"""One step of the experiment, compiled: input → plant → measurement → belief → reward → observation.

It exists once, and is put together from what the experiment needs (`compiled`): its plant, its estimator and, where the
reward takes work of its own, its reward. A single environment is a batch with one live lane, so both faces give
bit-identical trajectories.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib import import_module
from typing import Any

import numpy as np
from numba import prange

from duffing_env.layout import ENDED, LAYOUT, N_OBSERVATION, N_OUTCOME, N_ROWS, OSCILLATOR, SETTINGS, SUMMED
from duffing_env.observation import observe
from duffing_env.oscillator import draw_jump, draw_oscillator, jump_mass
from duffing_env.plant import draw_noise, integrate_plant, limit_input, move_plant, play_record
from duffing_env.rewards import appraise, pay, settle
from estimator.inference import continuous as ode
from estimator.inference import mean_field, structured, update_mean_field, update_structured, walk
from estimator.lanes import LANES, jit, kernel, part
from estimator.record import RECORD_SIZE

#: How finished environments are reset: by hand, in the step after, or in the same step.
RESET_BY_HAND, RESET_NEXT_STEP, RESET_SAME_STEP = 0, 1, 2

# Where rows that the loops below touch by index begin in a block, and in one of what ended.
_U, _Y, _X, _LAST_X = (LAYOUT[name] * LANES for name in ("u", "y", "x", "last_x"))
_ASKED, _SPENT, _JUMP_AT = (LAYOUT[name] * LANES for name in ("asked", "spent", "jump_at"))
_LAST_U, _VELOCITY = LAYOUT["last_u"] * LANES, LAYOUT["velocity"] * LANES
_ELAPSED, _WAITING = LAYOUT["elapsed"] * LANES, LAYOUT["waiting"] * LANES
_RECORDED_U, _RECORDED_Y = LAYOUT["recorded_u"] * LANES, LAYOUT["recorded_y"] * LANES
_OUTCOME, _OBS = LAYOUT["reward"] * LANES, LAYOUT["obs_mean_t1"] * LANES
_TERMINATED, _TRUNCATED = LAYOUT["terminated"] * LANES, LAYOUT["truncated"] * LANES
_DIVERGED, _OFF_RECORD = LAYOUT["diverged"] * LANES, LAYOUT["off_record"] * LANES
_SURPRISE, _OSCILLATOR = LAYOUT["surprise"] * LANES, LAYOUT["m"] * LANES
_ENDED_OSCILLATOR, _N_OSCILLATOR = ENDED["m"] * LANES, len(OSCILLATOR)
_EARNED, _ERROR, _MISFIT = (LAYOUT[name] * LANES for name in ("earned", "error", "misfit"))
_SUMMED = tuple(LAYOUT[name] * LANES for name in SUMMED)
_RECORD = RECORD_SIZE * LANES

# Where settings stand.
_MAX_INPUT, _MAX_OUTPUT, _HORIZON = (SETTINGS[name] for name in ("max_input", "max_output", "horizon"))
_PROCESS_NOISE, _MEASUREMENT_NOISE = SETTINGS["process_noise"], SETTINGS["measurement_noise"]
_BUDGET, _MAX_SLEW, _INPUT_COST = (SETTINGS[name] for name in ("budget", "max_slew", "input_cost"))
_JUMP, _WALK = SETTINGS["jump"], SETTINGS["walk_t1"]
_SPREAD, _CENTER, _STEP = SETTINGS["spread"], SETTINGS["center_m"], SETTINGS["step"]
_REWARD, _ITERATIONS, _HOLD = (SETTINGS[name] for name in ("reward", "iterations", "hold"))
_TERMINAL, _FORFEITS = SETTINGS["terminal"], SETTINGS["forfeits"]
_TERMINATED_RETURN = SETTINGS["terminated_return"]
_AS_PUBLISHED, _NONLINEAR, _DELAY = SETTINGS["as_published"], SETTINGS["nonlinear"], SETTINGS["delay"]
_PRIOR_T1, _SCALE_T1 = SETTINGS["prior_t1"], SETTINGS["scale_t1"]
_PRIOR_LOG_GAMMA, _PRIOR_LOG_XI = SETTINGS["prior_log_gamma"], SETTINGS["prior_log_xi"]


@jit
def _move(W, settings, recorded_u, recorded_y):
    move_plant(W, settings[_PROCESS_NOISE], settings[_MEASUREMENT_NOISE])


@jit
def _integrate(W, settings, recorded_u, recorded_y):
    integrate_plant(W, settings[_PROCESS_NOISE], settings[_MEASUREMENT_NOISE], settings[_STEP])


@jit
def _replay(W, settings, recorded_u, recorded_y):
    last = len(recorded_y) - 1
    for j in range(LANES):
        t = np.int64(W[_ELAPSED + j])
        W[_RECORDED_U + j] = recorded_u[min(t, last)]
        W[_RECORDED_Y + j] = recorded_y[min(t + np.int64(settings[_DELAY]), last)]
    play_record(W, settings[_MAX_INPUT])


#: Name of a plant to its step, ``f(W, settings, recorded_u, recorded_y)``.
PLANTS = {"difference": _move, "replay": _replay, "sde": _integrate}


@jit
def _infer_mean_field(W, settings):
    update_mean_field(W, np.int64(settings[_ITERATIONS]), settings[_AS_PUBLISHED] != 0.0, W[:0])


@jit
def _infer_structured(W, settings):
    update_structured(W, np.int64(settings[_ITERATIONS]), W[:0])


@jit
def _infer_ode(W, settings):
    ode.update(W, np.int64(settings[_ITERATIONS]), ode.SUBSTEPS)


#: Name of an estimator to its update, ``f(W, settings)``, and to the free energy of the sample, ``f(W, lane)``.
ESTIMATORS = {
    "mean_field": (_infer_mean_field, mean_field.free_energy),
    "structured": (_infer_structured, structured.free_energy),
    "ode": (_infer_ode, structured.free_energy),
}


@jit
def _swap_inputs(W):
    for j in range(LANES):
        W[_U + j], W[_LAST_U + j] = W[_LAST_U + j], W[_U + j]


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


@dataclass(frozen=True)
class Kernel:
    """The entry points of one kind of experiment.

    They work on ``blocks`` (n_blocks, N_ROWS * LANES), the environments, of which there are n = n_blocks * LANES; are
    told ``settings`` (len(SETTINGS),) and ``prior`` (RECORD_SIZE,), the belief that episodes start from; and write
    ``observations`` (n, N_OBSERVATION) float32.

    Attributes:
        reset: ``reset(blocks, mask, settings, prior, observations)`` starts episodes in the environments of ``mask``
            (n,), and writes all observations.
        step: ``step(blocks, saved, actions, settings, prior, recorded_u, recorded_y, reset_mode, observations,
            final_observations, ended)`` steps all blocks on the calling thread. ``saved`` (n_threads, RECORD_SIZE *
            LANES) is work space, ``actions`` (n,) are inputs in parts of the largest, ``recorded_u`` and ``recorded_y``
            (T,) the record of the plant ``replay`` and one sample elsewhere, ``reset_mode`` is RESET_BY_HAND,
            RESET_NEXT_STEP or RESET_SAME_STEP. What the step leaves is in the rows `OUTCOME` of the blocks. Where
            environments were reset in this very step, it writes ``final_observations``, like ``observations``, and
            ``ended`` (n_blocks, len(ENDED) * LANES).
        step_parallel: the same on ``n_threads`` of Numba's threads.
    """

    reset: Any
    step: Any
    step_parallel: Any


#: The rewards that take work of their own.
_WORKED = ("fisher", "free_energy", "expected_free_energy", "simulation_error")


def compiled(plant: str, estimator: str, reward: str) -> Kernel:
    """The kernel of an experiment; names as in `PLANTS`, `ESTIMATORS` and `duffing_env.rewards.REWARDS`.

    Its parts are compiled when they are called first, and kept on disk.
    """
    return _compiled(plant, estimator, reward if reward in _WORKED else "")


@cache
def _compiled(plant: str, estimator: str, worked: str) -> Kernel:
    """The kernel of all experiments that differ at most in settings; ``worked`` is a reward that takes work."""
    move, (infer, free_energy) = PLANTS[plant], ESTIMATORS[estimator]
    # Constants to the compiler, which leaves out what they make idle.
    is_fisher, is_free_energy = worked == "fisher", worked == "free_energy"
    is_expected, is_simulation = worked == "expected_free_energy", worked == "simulation_error"
    # Nobody waits for what another reward needs.
    fisher: Any = import_module("duffing_env.fisher") if is_fisher else None
    expectation: Any = import_module("duffing_env.expectation") if is_expected else None
    simulation: Any = import_module("duffing_env.simulation") if is_simulation else None
    # Eq. (2) takes the input at x_t. Between two actions of the plant ``sde`` that is the last one.
    takes_last_input = plant == "sde" and estimator != "ode"
    continuous = 1.0 if estimator == "ode" else 0.0
    kind = "_".join((plant, estimator, worked))
    inner, entry = part(kind), kernel(kind=kind)

    @inner
    def judge(W, j, settings):
        """Measure lane j's belief beside its oscillator, where either is new."""
        appraise(W, j, settings[_STEP], settings[_NONLINEAR], continuous)
        if is_simulation:
            simulation.compare(W, settings[_MAX_INPUT], continuous)
            W[_ERROR + j] = W[_MISFIT + j]

    @inner
    def reset_lane(W, j, settings, prior):
        """Start an episode in lane j: draw its oscillator, put it at rest, and put the belief to the prior."""
        for i in range(RECORD_SIZE):
            W[i * LANES + j] = prior[i]
        draw_oscillator(
            W, j, settings[_SPREAD], settings[_CENTER], settings[_CENTER + 1], settings[_CENTER + 2],
            settings[_CENTER + 3], settings[_STEP], continuous,
        )  # fmt: skip
        W[_JUMP_AT + j] = -1.0
        if settings[_JUMP] > 0.0:
            draw_jump(W, j, settings[_JUMP], settings[_HORIZON])
        for row in (_U, _Y, _X, _LAST_X, _VELOCITY, _ELAPSED, _WAITING, _SPENT, _EARNED):
            W[row + j] = 0.0
        judge(W, j, settings)
        if is_fisher:
            fisher.begin(W, j, prior, settings[_NONLINEAR])

    @inner
    def limit(W, actions, settings):
        """The inputs that are given, of actions (LANES,), and what else happens before a sample."""
        for j in range(LANES):
            W[_LAST_U + j] = W[_U + j]
            W[_ASKED + j] = settings[_MAX_INPUT] * max(-1.0, min(1.0, actions[j]))
        limit_input(W, settings[_BUDGET], settings[_MAX_SLEW])
        if settings[_JUMP] > 0.0:
            for j in range(LANES):
                if W[_ELAPSED + j] == W[_JUMP_AT + j]:
                    jump_mass(W, j, settings[_STEP], continuous)
                    judge(W, j, settings)

    @inner
    def sample(W, saved, settings, recorded_u, recorded_y):
        """Plant, measurement, belief and reward for all lanes of a block; their inputs stand in row ``u``."""
        draw_noise(W)
        if is_fisher:
            fisher.inform(W, settings[_PROCESS_NOISE], settings[_MEASUREMENT_NOISE], settings[_NONLINEAR])
        move(W, settings, recorded_u, recorded_y)
        # What to return to where the step comes to nothing.
        for i in range(_RECORD):
            saved[i] = W[i]
        if settings[_WALK] > 0.0:
            walk(W, settings[_WALK], settings[_WALK + 1], settings[_WALK + 2], settings[_WALK + 3])
        if takes_last_input:
            _swap_inputs(W)
        if is_expected:
            expectation.foresee(W, settings[_NONLINEAR], continuous)
        infer(W, settings)
        if takes_last_input:
            _swap_inputs(W)
        if is_free_energy:
            for j in range(LANES):
                W[_SURPRISE + j] = free_energy(W, j)
        if is_simulation:
            simulation.compare(W, settings[_MAX_INPUT], continuous)
        settle(
            W, settings[_MAX_OUTPUT], settings[_HORIZON], settings[_STEP], settings[_NONLINEAR], continuous,
            settings[_REWARD], settings[_INPUT_COST],
        )  # fmt: skip
        if settings[_TERMINAL] + settings[_FORFEITS] > 0.0:
            pay(W, settings[_TERMINAL], settings[_FORFEITS], settings[_TERMINATED_RETURN])
        void = 0
        for j in range(LANES):
            void += (W[_DIVERGED + j] != 0.0) | (W[_OFF_RECORD + j] != 0.0)
        if void:
            for j in range(LANES):
                if W[_DIVERGED + j] != 0.0 or W[_OFF_RECORD + j] != 0.0:
                    for i in range(RECORD_SIZE):
                        W[i * LANES + j] = saved[i * LANES + j]

    @inner
    def begin_or_end(W, settings, prior, reset_mode):
        """Start the episodes that are due, and mark those that have finished; gives their number."""
        concerned = 0
        for j in range(LANES):
            concerned += (W[_WAITING + j] != 0.0) | (W[_TERMINATED + j] != 0.0) | (W[_TRUNCATED + j] != 0.0)
        finished = 0
        if concerned:
            for j in range(LANES):
                if W[_WAITING + j] != 0.0 and reset_mode == RESET_NEXT_STEP:
                    reset_lane(W, j, settings, prior)
                    for k in range(N_OUTCOME):
                        W[_OUTCOME + k * LANES + j] = 0.0
                elif W[_TERMINATED + j] + W[_TRUNCATED + j] != 0.0:
                    W[_WAITING + j] = 1.0
                    finished += 1
        return finished

    @inner
    def play(W, saved, actions, settings, recorded_u, recorded_y):
        """Apply the actions for as many samples as they hold; an environment that ends meanwhile stays as it ended."""
        for s in range(np.int64(settings[_HOLD])):
            before = W.copy() if s > 0 else W[:0]
            limit(W, actions, settings)
            sample(W, saved, settings, recorded_u, recorded_y)
            if s > 0:
                for j in range(LANES):
                    if before[_TERMINATED + j] + before[_TRUNCATED + j] != 0.0:
                        for row in range(N_ROWS):
                            W[row * LANES + j] = before[row * LANES + j]
                    else:
                        for row in _SUMMED:
                            W[row + j] += before[row + j]

    @inner
    def step_block(
        W, saved, actions, settings, prior, recorded_u, recorded_y, reset_mode, observations, final_observations, ended
    ):  # fmt: skip
        """One step of a block: actions (LANES,), observations (LANES, N_OBSERVATION)."""
        waiting = 0
        for j in range(LANES):
            waiting += W[_WAITING + j] != 0.0
        if waiting < LANES:
            play(W, saved, actions, settings, recorded_u, recorded_y)
        finished = begin_or_end(W, settings, prior, reset_mode)
        _write_observations(W, settings, observations)
        if reset_mode == RESET_SAME_STEP and finished:
            for j in range(LANES):
                if W[_WAITING + j] != 0.0:
                    for k in range(N_OBSERVATION):
                        final_observations[j, k] = observations[j, k]
                    for i in range(RECORD_SIZE):
                        ended[i * LANES + j] = W[i * LANES + j]
                    for i in range(_N_OSCILLATOR):
                        ended[_ENDED_OSCILLATOR + i * LANES + j] = W[_OSCILLATOR + i * LANES + j]
                    reset_lane(W, j, settings, prior)
            _write_observations(W, settings, observations)

    @entry
    def reset(blocks, mask, settings, prior, observations):
        for b in range(len(blocks)):
            for j in range(LANES):
                if mask[b * LANES + j]:
                    reset_lane(blocks[b], j, settings, prior)
            _write_observations(blocks[b], settings, observations[b * LANES : (b + 1) * LANES])

    @inner
    def step_blocks(
        first, last, blocks, saved, actions, settings, prior, recorded_u, recorded_y, reset_mode, observations,
        final_observations, ended,
    ):  # fmt: skip
        for b in range(first, last):
            lanes = slice(b * LANES, (b + 1) * LANES)
            step_block(
                blocks[b], saved, actions[lanes], settings, prior, recorded_u, recorded_y, reset_mode,
                observations[lanes], final_observations[lanes], ended[b],
            )  # fmt: skip

    @entry
    def step(
        blocks, saved, actions, settings, prior, recorded_u, recorded_y, reset_mode, observations, final_observations,
        ended,
    ):  # fmt: skip
        step_blocks(
            0, len(blocks), blocks, saved[0], actions, settings, prior, recorded_u, recorded_y, reset_mode,
            observations, final_observations, ended,
        )  # fmt: skip

    @entry(parallel=True)
    def step_parallel(
        blocks, saved, actions, settings, prior, recorded_u, recorded_y, reset_mode, observations, final_observations,
        ended,
    ):  # fmt: skip
        n = len(saved)
        for t in prange(n):
            step_blocks(
                t * len(blocks) // n, (t + 1) * len(blocks) // n, blocks, saved[t], actions, settings, prior,
                recorded_u, recorded_y, reset_mode, observations, final_observations, ended,
            )  # fmt: skip

    return Kernel(reset, step, step_parallel)
