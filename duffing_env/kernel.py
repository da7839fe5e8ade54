"""One step of the experiment, compiled: input → plant → measurement → belief → reward → observation.

It exists once, and is put together from what the engine makes of the models (`compile_kernel`). A single environment is a
batch with one live lane, so both faces give bit-identical trajectories.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numba import prange

from duffing_env.kernel_stages import env_codegen, plant_stages
from duffing_env.kernel_stages.noise_filter_bank import NO_FILTER_BANK, compile_filter_bank
from duffing_env.rewards.reward_registry import REWARDS, RewardHooks, no_hook, no_lane_hook
from duffing_env.storage.kernel_spec import (
    OUTCOME_ROWS,
    SUMMED_OUTCOMES,
    KernelSpec,
    block_layout,
    compile_unpacker,
    missing_mean_field_rows,
    observation_bounds,
    parameter_names,
)
from estimator.compilation.simd import LANES, jit_closure, kernel, lanewise
from estimator.engine.kernels import compile_belief_update
from estimator.engine.storage_layout import belief_rows
from estimator.inference import mean_field

#: How finished environments are reset: by hand, in the step after, or in the same step; or what is done is a reset.
RESET_MANUALLY, RESET_NEXT_STEP, RESET_SAME_STEP, RESET_ONLY = 0, 1, 2, 3


@dataclass(frozen=True)
class Kernel:
    """The entry points of one kind of experiment.

    They work on ``blocks`` (n_blocks, rows * LANES), the environments, of which there are n = n_blocks * LANES, and on
    the ``members`` (`duffing_env.kernel_stages.noise_filter_bank`) of those that are in use. They are told ``packed_params``, the
    `duffing_env.storage.kernel_spec.KernelParams` as one array.

    Attributes:
        step: ``step(first, stop, blocks, members, saved, actions, packed, recorded, reset_mode, mask, observations,
            outcomes, final_observations, ended)`` steps the blocks from ``first`` to ``stop`` on the calling thread.
            ``workspace`` (2 rows * LANES,) is work space, ``actions`` (n,) are inputs in parts of the largest, ``recorded``
            (2, T) inputs and outputs of the record that is replayed, and of one sample elsewhere. ``reset_mode`` says
            how finished environments are reset; RESET_ONLY does nothing but start episodes in those of ``mask`` (n,).
            It writes ``observations`` (n, entries) float32, and ``outcomes`` (len(OUTCOME), n). Where environments
            were reset in this very step, it writes ``final_observations``, like ``observations``, and ``ended``
            (n_blocks, rows * LANES), their rows as the episode left them.
        step_parallel: all blocks on Numba's threads, as many as ``workspace`` (threads, 2 rows * LANES) has rows.
    """

    step: Any
    step_parallel: Any


@cache
def compile_kernel(spec: KernelSpec) -> Kernel:
    """The kernel of a kind of experiment. Its parts are compiled when they are called first, and kept on disk."""
    row_of, generated = block_layout(spec), env_codegen.generated_functions(spec)
    n_rows = max(row_of.values()) + 1
    offset_of = {name: number * LANES for name, number in row_of.items()}
    n_record = len(belief_rows(spec.belief_model))
    n_observation, n_outcome = len(observation_bounds(spec.belief_model)), len(OUTCOME_ROWS)
    n_saved = n_record * LANES
    first_stream, first_parameter = offset_of["STREAM_a"], offset_of[f"PARAM_{parameter_names(spec.truth_model)[0]}"]
    requested_input, elapsed, needs_reset = offset_of["ASKED"], offset_of["ELAPSED"], offset_of["WAITING"]
    terminated, truncated, diverged, off_record = (offset_of[name] for name in OUTCOME_ROWS[3:])
    first_outcome = offset_of["REWARD"]
    recorded_u_row, recorded_y_row = offset_of["RECORDED_u"], offset_of["RECORDED_y"]
    jump_at, jump_factor = offset_of["JUMP_AT"], offset_of["JUMP_FACTOR"]
    summed_rows = tuple(offset_of[name] for name in SUMMED_OUTCOMES)
    sensors = [f"Y_{y}" for y in spec.truth_model.outputs]
    zeroed_names = ["INPUT", "LAST_INPUT", "OLDER_INPUT", "SPENT", "EARNED", "ELAPSED", "WAITING", "WORK"]
    # Mean field's rows of a θ2 that the model does not have must be 0, also after an episode that ended with NaN.
    zeroed_names += missing_mean_field_rows(spec)
    zeroed_rows = tuple(
        offset_of[name] for name in [*zeroed_names, *sensors, *(f"X_{x}" for x in spec.truth_model.states)]
    )

    draw_noise = plant_stages.compile_noise_draw(row_of)
    limited_rows = "INPUT LAST_INPUT OLDER_INPUT RISE SPENT"
    limit_input = lanewise(row_of, limited_rows, uniform="budget max_slew")(plant_stages.limit_input)
    replay_sample = lanewise(row_of, f"INPUT {sensors[0]} OFF_RECORD", uniform="max_input")(plant_stages.replay_sample)
    pay_reward = lanewise(row_of, "REWARD EARNED", uniform="terminal has_terminated_return terminated_return")(
        plant_stages.pay_reward
    )
    streams = "STREAM_a STREAM_b STREAM_c STREAM_d"
    draw_parameter_jump = lanewise(row_of, f"{streams} JUMP_AT JUMP_FACTOR", uniform="jump horizon", single_lane=True)(
        plant_stages.draw_parameter_jump
    )

    is_simulated = spec.plant_model is not None
    step_plant: Any = _compile_plant_step(spec, generated, draw_noise) if is_simulated else None
    update_belief = compile_update_stage(spec)
    has_noise_hypotheses = spec.has_noise_hypotheses
    reset_filter_bank, update_filter_bank = compile_filter_bank(spec) if has_noise_hypotheses else NO_FILTER_BANK
    has_reward_hooks, is_structured = bool(spec.reward_hooks), spec.factorisation == "structured"
    no_hooks = RewardHooks(no_lane_hook, no_hook, no_hook, no_hook)
    hook_episode_start, hook_before_plant, hook_before_update, hook_after_update = (
        REWARDS[spec.reward_hooks].reward_hooks.compile_hooks(spec, generated) if has_reward_hooks else no_hooks
    )
    set_true_coefficients, evaluate_belief, finish_step, observe = (
        generated.set_true_coefficients,
        generated.evaluate_belief,
        generated.finish_step,
        generated.observe,
    )
    add_random_walk: Any = generated.add_random_walk
    unpack = compile_unpacker(spec)
    compile_inner, compile_entry = jit_closure(spec.name), kernel(variant=spec.name)

    @compile_inner
    def compare_to_truth(W, j, params):
        """Settle lane j's true coefficients after its parameters changed."""
        set_true_coefficients(W, j, params.step)
        evaluate_belief(W, j, params.step)
        if has_reward_hooks:
            hook_episode_start(W, j, params)

    @compile_inner
    def reset_lane(W, members, b, j, params):
        """Start an episode in lane j of block b: draw its plant, put it at rest, and put the belief to the prior."""
        for i in range(n_record):
            W[i * LANES + j] = params.prior[i]
        if has_noise_hypotheses:
            reset_filter_bank(members, b * LANES + j, params)
        # Variables, because a function is compiled anew for every constant.
        plant_stages.draw_plant_parameters(W, j, params, np.int64(first_stream), np.int64(first_parameter))
        W[jump_at + j] = -1.0
        if params.jump > 0.0:
            draw_parameter_jump(W, j, params.jump, params.horizon)
        for r in zeroed_rows:
            W[r + j] = 0.0
        compare_to_truth(W, j, params)

    def step_blocks(
        first, stop, blocks, members, workspace, actions, packed_params, recorded, reset_mode, mask, observations, outcomes,
        final_observations, ended,
    ):  # fmt: skip
        """Step some blocks, or start episodes in them.

        Few functions and no more layers: each is translated anew for every kind.
        """
        params = unpack(packed_params)
        for b in range(first, stop):
            W = blocks[b]
            lane = b * LANES
            n_idle = 0
            for j in range(LANES):
                n_idle += W[needs_reset + j] != 0.0
            # Apply the actions for as many samples as they hold; an environment that ends meanwhile stays as it ended.
            for s in range(params.hold if n_idle < LANES and reset_mode != RESET_ONLY else 0):
                if s > 0:
                    for i in range(n_rows * LANES):
                        workspace[n_saved + i] = W[i]
                    for j in range(LANES):  # what has ended waits: its noise and its filter bank stay as they are
                        if W[terminated + j] + W[truncated + j] != 0.0:
                            W[needs_reset + j] = 1.0
                for j in range(LANES):
                    W[requested_input + j] = params.max_input * max(-1.0, min(1.0, actions[lane + j]))
                limit_input(W, params.budget, params.max_slew)
                if params.jump > 0.0:
                    for j in range(LANES):
                        if W[elapsed + j] == W[jump_at + j]:
                            W[first_parameter + j] *= W[jump_factor + j]
                            compare_to_truth(W, j, params)
                draw_noise(W)
                if has_reward_hooks:
                    hook_before_plant(W, params)
                if is_simulated:
                    step_plant(W)
                else:
                    last = recorded.shape[1] - 1
                    for j in range(LANES):
                        t = np.int64(W[elapsed + j])
                        W[recorded_u_row + j] = recorded[0, min(t, last)]
                        W[recorded_y_row + j] = recorded[1, min(t + params.input_delay, last)]
                    replay_sample(W, params.max_input)
                # What to return to if the update breaks the belief.
                for i in range(n_saved):
                    workspace[i] = W[i]
                if params.has_drift:
                    add_random_walk(W, params.walk_variances)
                if has_reward_hooks:
                    hook_before_update(W, params)
                if has_noise_hypotheses:
                    update_filter_bank(W, members, b, params)
                elif is_structured:
                    update_belief(W)
                else:
                    update_belief(W, params.iterations, params.as_published)
                if has_reward_hooks:
                    hook_after_update(W, params)
                finish_step(
                    W, params.step, params.max_output, params.horizon, params.sqrt_input_cost, params.reward_weights[0],
                    params.reward_weights[1], params.reward_weights[2], params.reward_weights[3],
                )  # fmt: skip
                if params.terminal or params.has_terminated_return:
                    pay_reward(W, params.terminal, params.has_terminated_return, params.terminated_return)
                n_void = 0
                for j in range(LANES):
                    n_void += (W[diverged + j] != 0.0) | (W[off_record + j] != 0.0)
                for j in range(LANES if n_void else 0):
                    if W[diverged + j] != 0.0 or W[off_record + j] != 0.0:
                        for i in range(n_record):
                            W[i * LANES + j] = workspace[i * LANES + j]
                if s > 0:
                    for j in range(LANES):
                        if workspace[n_saved + terminated + j] + workspace[n_saved + truncated + j] != 0.0:
                            for i in range(n_rows):
                                W[i * LANES + j] = workspace[n_saved + i * LANES + j]
                        else:
                            for r in summed_rows:
                                W[r + j] += workspace[n_saved + r + j]
            # Start the episodes that are due, and mark those that have finished.
            finished = 0
            for j in range(LANES):
                if (
                    mask[lane + j]
                    if reset_mode == RESET_ONLY
                    else W[needs_reset + j] != 0.0 and reset_mode == RESET_NEXT_STEP
                ):
                    reset_lane(W, members, b, j, params)
                    for k in range(n_outcome):
                        W[first_outcome + k * LANES + j] = 0.0
                elif reset_mode != RESET_ONLY:
                    if W[elapsed + j] >= params.max_samples:
                        W[truncated + j] = 1.0
                    if W[terminated + j] + W[truncated + j] != 0.0:
                        W[needs_reset + j] = 1.0
                        finished += 1
            for k in range(n_outcome):
                for j in range(LANES):
                    outcomes[k, lane + j] = W[first_outcome + k * LANES + j]
            # What was saved is not needed any more, and rows that all blocks share stay in the nearest cache.
            for observation_pass in range(2):
                observe(
                    W, workspace, params.prior, params.prior_inverse_std, params.prior_log_precisions, 1.0 / params.max_output,
                    1.0 / params.max_input, params.horizon, 1.0 / params.horizon, params.budget,
                )  # fmt: skip
                for j in range(LANES):
                    for k in range(n_observation):
                        observations[lane + j, k] = workspace[k * LANES + j]
                if observation_pass or reset_mode != RESET_SAME_STEP or not finished:
                    break
                for j in range(LANES):
                    if W[needs_reset + j] != 0.0:
                        for k in range(n_observation):
                            final_observations[lane + j, k] = observations[lane + j, k]
                        for i in range(n_rows):
                            ended[b, i * LANES + j] = W[i * LANES + j]
                        reset_lane(W, members, b, j, params)

    step, inner_step = compile_entry(step_blocks), compile_inner(step_blocks)

    @compile_entry(parallel=True)
    def step_parallel(
        blocks, members, workspace, actions, packed_params, recorded, reset_mode, mask, observations, outcomes,
        final_observations, ended,
    ):  # fmt: skip
        n = len(workspace)
        for t in prange(n):
            inner_step(
                t * len(blocks) // n, (t + 1) * len(blocks) // n, blocks, members, workspace[t], actions, packed_params, recorded,
                reset_mode, mask, observations, outcomes, final_observations, ended,
            )  # fmt: skip

    return Kernel(step, step_parallel)


def compile_update_stage(spec: KernelSpec) -> Any:
    """Update every lane's belief, with its input and outputs in their rows.

    ``update(W)``, or of mean field ``update(W, iterations, as_published)``.
    """
    row_of = block_layout(spec)
    if spec.factorisation == "mean_field":
        return mean_field.compile_mean_field_loop(row_of)
    trace = spec.reward_hooks == "free_energy"
    return compile_belief_update(
        spec.belief_model, spec.degree, iterations=spec.iterations, block_layout=row_of, keep_trace=trace
    ).update


def _compile_plant_step(spec: KernelSpec, generated: Any, draw_noise: Any) -> Any:
    """``step_plant(W)``: the simulated plant over a sample with its noise, and its sensors. Noise has been drawn."""
    assert spec.plant_model is not None
    model, n_outputs = spec.plant_model, spec.plant_model.n_outputs
    if n_outputs > 3:
        raise ValueError(f"outputs must be at most 3 in an environment, but {model.name!r} has {n_outputs}")
    plant, steps, draws_each_step = generated.step_plant, model.substeps, not model.held
    substep_length, sqrt_length, sqrt_3 = 1.0 / steps, math.sqrt(1.0 / steps), math.sqrt(3.0)
    measure_0: Any = getattr(generated, "measure_0", None)
    measure_1 = getattr(generated, "measure_1", measure_0)
    measure_2 = getattr(generated, "measure_2", measure_0)
    is_continuous = model.is_continuous

    @jit_closure(spec.name)
    def step_plant(W):
        if is_continuous:
            for s in range(steps):
                plant(W, s / steps, substep_length, sqrt_length, sqrt_3)
                if draws_each_step:
                    draw_noise(W)
            measure_0(W)
        else:
            plant(W)
        if n_outputs > 1:
            draw_noise(W)
            measure_1(W)
        if n_outputs > 2:
            draw_noise(W)
            measure_2(W)

    return step_plant
