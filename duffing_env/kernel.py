"""One step of the experiment, compiled: input → plant → measurement → belief → reward → observation.

It exists once, and is put together from what the engine makes of the models (`compiled`). A single environment is a
batch with one live lane, so both faces give bit-identical trajectories.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numba import prange

from duffing_env import sources, stages
from duffing_env.hypotheses import NONE, members_of
from duffing_env.layout import OUTCOME, SUMMED, Kind, layout_of, left_out, observation_bounds, parameter_names, unpacker
from duffing_env.rewards import REWARDS, Hooks, nothing, nothing_in_lane
from estimator.engine.rows import belief_names
from estimator.engine.tasks import structured
from estimator.inference import mean_field
from estimator.lanes import LANES, kernel, lanewise, part

#: How finished environments are reset: by hand, in the step after, or in the same step; or what is done is a reset.
RESET_BY_HAND, RESET_NEXT_STEP, RESET_SAME_STEP, RESET_NOW = 0, 1, 2, 3


@dataclass(frozen=True)
class Kernel:
    """The entry points of one kind of experiment.

    They work on ``blocks`` (n_blocks, rows * LANES), the environments, of which there are n = n_blocks * LANES, and on
    the ``members`` (`duffing_env.hypotheses`) of those that are in use. They are told ``packed``, the
    `duffing_env.layout.Setup` as one array.

    Attributes:
        step: ``step(first, stop, blocks, members, saved, actions, packed, recorded, reset_mode, mask, observations,
            outcomes, final_observations, ended)`` steps the blocks from ``first`` to ``stop`` on the calling thread.
            ``saved`` (2 rows * LANES,) is work space, ``actions`` (n,) are inputs in parts of the largest, ``recorded``
            (2, T) inputs and outputs of the record that is replayed, and of one sample elsewhere. ``reset_mode`` says
            how finished environments are reset; RESET_NOW does nothing but start episodes in those of ``mask`` (n,).
            It writes ``observations`` (n, entries) float32, and ``outcomes`` (len(OUTCOME), n). Where environments
            were reset in this very step, it writes ``final_observations``, like ``observations``, and ``ended``
            (n_blocks, rows * LANES), their rows as the episode left them.
        step_parallel: all blocks on Numba's threads, as many as ``saved`` (threads, 2 rows * LANES) has rows.
    """

    step: Any
    step_parallel: Any


@cache
def compiled(kind: Kind) -> Kernel:
    """The kernel of a kind of experiment. Its parts are compiled when they are called first, and kept on disk."""
    place, code = layout_of(kind), sources.parts(kind)
    n_rows = max(place.values()) + 1
    row = {name: number * LANES for name, number in place.items()}
    n_record = len(belief_names(kind.belief))
    n_observation, n_outcome = len(observation_bounds(kind.belief)), len(OUTCOME)
    n_saved = n_record * LANES
    stream, drawn = row["STREAM_a"], row[f"PARAM_{parameter_names(kind.truth)[0]}"]
    asked, elapsed, waiting = row["ASKED"], row["ELAPSED"], row["WAITING"]
    terminated, truncated, diverged, off_record = (row[name] for name in OUTCOME[3:])
    outcome = row["REWARD"]
    recorded_u_row, recorded_y_row = row["RECORDED_u"], row["RECORDED_y"]
    jump_at, jump_factor = row["JUMP_AT"], row["JUMP_FACTOR"]
    summed = tuple(row[name] for name in SUMMED)
    sensors = [f"Y_{y}" for y in kind.truth.outputs]
    cleared = ["INPUT", "LAST_INPUT", "OLDER_INPUT", "SPENT", "EARNED", "ELAPSED", "WAITING", "WORK"]
    # Mean field's rows of a θ2 that the model does not have must be 0, also after an episode that ended with NaN.
    cleared += left_out(kind)
    at_rest = tuple(row[name] for name in [*cleared, *sensors, *(f"X_{x}" for x in kind.truth.states)])

    draw_noise = stages.noise_drawer(place)
    limited = "INPUT LAST_INPUT OLDER_INPUT RISE SPENT"
    limit_input = lanewise(place, limited, uniform="budget max_slew")(stages.limit_input)
    play_record = lanewise(place, f"INPUT {sensors[0]} OFF_RECORD", uniform="max_input")(stages.play_record)
    pay = lanewise(place, "REWARD EARNED", uniform="terminal forfeits terminated_return")(stages.pay)
    streams = "STREAM_a STREAM_b STREAM_c STREAM_d"
    draw_jump = lanewise(place, f"{streams} JUMP_AT JUMP_FACTOR", uniform="jump horizon", one=True)(stages.draw_jump)

    simulated = kind.plant is not None
    move: Any = _plant_of(kind, code, draw_noise) if simulated else None
    infer = updater(kind)
    weighs = kind.weighs
    begin_members, learn = members_of(kind) if weighs else NONE
    is_worked, is_structured = bool(kind.work), kind.factorisation == "structured"
    idle_hooks = Hooks(nothing_in_lane, nothing, nothing, nothing)
    begin_work, before, expect, after = REWARDS[kind.work].work.hooks(kind, code) if is_worked else idle_hooks
    settle_truth, appraise, settle, observe = code.settle_truth, code.appraise, code.settle, code.observe
    walk: Any = code.walk
    unpack = unpacker(kind)
    inner, entry = part(kind.name), kernel(kind=kind.name)

    @inner
    def meet_truth(W, j, setup):
        """Settle lane j's true coefficients after its parameters changed."""
        settle_truth(W, j, setup.step)
        appraise(W, j, setup.step)
        if is_worked:
            begin_work(W, j, setup)

    @inner
    def reset_lane(W, members, b, j, setup):
        """Start an episode in lane j of block b: draw its plant, put it at rest, and put the belief to the prior."""
        for i in range(n_record):
            W[i * LANES + j] = setup.prior[i]
        if weighs:
            begin_members(members, b * LANES + j, setup)
        # Variables, because a function is compiled anew for every constant.
        stages.draw_plant(W, j, setup, np.int64(stream), np.int64(drawn))
        W[jump_at + j] = -1.0
        if setup.jump > 0.0:
            draw_jump(W, j, setup.jump, setup.horizon)
        for r in at_rest:
            W[r + j] = 0.0
        meet_truth(W, j, setup)

    def step_blocks(
        first, stop, blocks, members, saved, actions, packed, recorded, reset_mode, mask, observations, outcomes,
        final_observations, ended,
    ):  # fmt: skip
        """Step some blocks, or start episodes in them.

        Few functions and no more layers: each is translated anew for every kind.
        """
        setup = unpack(packed)
        for b in range(first, stop):
            W = blocks[b]
            lane = b * LANES
            idle = 0
            for j in range(LANES):
                idle += W[waiting + j] != 0.0
            # Apply the actions for as many samples as they hold; an environment that ends meanwhile stays as it ended.
            for s in range(setup.hold if idle < LANES and reset_mode != RESET_NOW else 0):
                if s > 0:
                    for i in range(n_rows * LANES):
                        saved[n_saved + i] = W[i]
                for j in range(LANES):
                    W[asked + j] = setup.max_input * max(-1.0, min(1.0, actions[lane + j]))
                limit_input(W, setup.budget, setup.max_slew)
                if setup.jump > 0.0:
                    for j in range(LANES):
                        if W[elapsed + j] == W[jump_at + j]:
                            W[drawn + j] *= W[jump_factor + j]
                            meet_truth(W, j, setup)
                draw_noise(W)
                if is_worked:
                    before(W, setup)
                if simulated:
                    move(W)
                else:
                    last = recorded.shape[1] - 1
                    for j in range(LANES):
                        t = np.int64(W[elapsed + j])
                        W[recorded_u_row + j] = recorded[0, min(t, last)]
                        W[recorded_y_row + j] = recorded[1, min(t + setup.delay, last)]
                    play_record(W, setup.max_input)
                # What to return to if the update breaks the belief.
                for i in range(n_saved):
                    saved[i] = W[i]
                if setup.drifts:
                    walk(W, setup.walk)
                if is_worked:
                    expect(W, setup)
                if weighs:
                    learn(W, members, b, setup)
                elif is_structured:
                    infer(W)
                else:
                    infer(W, setup.iterations, setup.as_published)
                if is_worked:
                    after(W, setup)
                settle(
                    W, setup.step, setup.max_output, setup.horizon, setup.input_price, setup.weights[0],
                    setup.weights[1], setup.weights[2], setup.weights[3],
                )  # fmt: skip
                if setup.terminal or setup.forfeits:
                    pay(W, setup.terminal, setup.forfeits, setup.terminated_return)
                void = 0
                for j in range(LANES):
                    void += (W[diverged + j] != 0.0) | (W[off_record + j] != 0.0)
                for j in range(LANES if void else 0):
                    if W[diverged + j] != 0.0 or W[off_record + j] != 0.0:
                        for i in range(n_record):
                            W[i * LANES + j] = saved[i * LANES + j]
                if s > 0:
                    for j in range(LANES):
                        if saved[n_saved + terminated + j] + saved[n_saved + truncated + j] != 0.0:
                            for i in range(n_rows):
                                W[i * LANES + j] = saved[n_saved + i * LANES + j]
                        else:
                            for r in summed:
                                W[r + j] += saved[n_saved + r + j]
            # Start the episodes that are due, and mark those that have finished.
            finished = 0
            for j in range(LANES):
                if (
                    mask[lane + j]
                    if reset_mode == RESET_NOW
                    else W[waiting + j] != 0.0 and reset_mode == RESET_NEXT_STEP
                ):
                    reset_lane(W, members, b, j, setup)
                    for k in range(n_outcome):
                        W[outcome + k * LANES + j] = 0.0
                elif reset_mode != RESET_NOW:
                    if W[elapsed + j] >= setup.limit:
                        W[truncated + j] = 1.0
                    if W[terminated + j] + W[truncated + j] != 0.0:
                        W[waiting + j] = 1.0
                        finished += 1
            for k in range(n_outcome):
                for j in range(LANES):
                    outcomes[k, lane + j] = W[outcome + k * LANES + j]
            # What was saved is not needed any more, and rows that all blocks share stay in the nearest cache.
            for again in range(2):
                observe(
                    W, saved, setup.prior, setup.inverse_std, setup.log_precisions, 1.0 / setup.max_output,
                    1.0 / setup.max_input, setup.horizon, 1.0 / setup.horizon, setup.budget,
                )  # fmt: skip
                for j in range(LANES):
                    for k in range(n_observation):
                        observations[lane + j, k] = saved[k * LANES + j]
                if again or reset_mode != RESET_SAME_STEP or not finished:
                    break
                for j in range(LANES):
                    if W[waiting + j] != 0.0:
                        for k in range(n_observation):
                            final_observations[lane + j, k] = observations[lane + j, k]
                        for i in range(n_rows):
                            ended[b, i * LANES + j] = W[i * LANES + j]
                        reset_lane(W, members, b, j, setup)

    step, inner_step = entry(step_blocks), inner(step_blocks)

    @entry(parallel=True)
    def step_parallel(
        blocks, members, saved, actions, packed, recorded, reset_mode, mask, observations, outcomes,
        final_observations, ended,
    ):  # fmt: skip
        n = len(saved)
        for t in prange(n):
            inner_step(
                t * len(blocks) // n, (t + 1) * len(blocks) // n, blocks, members, saved[t], actions, packed, recorded,
                reset_mode, mask, observations, outcomes, final_observations, ended,
            )  # fmt: skip

    return Kernel(step, step_parallel)


def updater(kind: Kind) -> Any:
    """Update every lane's belief, with its input and outputs in their rows.

    ``update(W)``, or of mean field ``update(W, iterations, as_published)``.
    """
    place = layout_of(kind)
    if kind.factorisation == "mean_field":
        return mean_field.updater(place)
    trace = kind.work == "free_energy"
    return structured(kind.belief, kind.degree, iterations=kind.iterations, within=place, trace=trace).update


def _plant_of(kind: Kind, code: Any, draw_noise: Any) -> Any:
    """``move(W)``: the simulated plant over a sample with its noise, and its sensors. Noise has been drawn."""
    assert kind.plant is not None
    model, n_outputs = kind.plant, kind.plant.n_outputs
    if n_outputs > 3:
        raise ValueError(f"outputs must be at most 3 in an environment, but {model.name!r} has {n_outputs}")
    plant, steps, draws_each_step = code.plant, model.substeps, not model.held
    length, root, root_3 = 1.0 / steps, math.sqrt(1.0 / steps), math.sqrt(3.0)
    sense_0: Any = getattr(code, "sense_0", None)
    sense_1 = getattr(code, "sense_1", sense_0)
    sense_2 = getattr(code, "sense_2", sense_0)
    continuous = model.is_continuous

    @part(kind.name)
    def move(W):
        if continuous:
            for s in range(steps):
                plant(W, s / steps, length, root, root_3)
                if draws_each_step:
                    draw_noise(W)
            sense_0(W)
        else:
            plant(W)
        if n_outputs > 1:
            draw_noise(W)
            sense_1(W)
        if n_outputs > 2:
            draw_noise(W)
            sense_2(W)

    return move
