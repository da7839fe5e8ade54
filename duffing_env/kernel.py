"""One step of the experiment, compiled: input → plant → measurement → belief → reward → observation.

It exists once, and is put together from what the engine makes of the models (`compile_kernel`). A single environment is
a batch with one live lane, so single and vector environments give bit-identical trajectories.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

from numba import prange

from duffing_env.kernel_stages import input_limits, plant_stages, sample_stages
from duffing_env.kernel_stages.generated_environment_functions import generated_functions
from duffing_env.kernel_stages.noise_filter_bank import NO_FILTER_BANK, compile_filter_bank
from duffing_env.rewards.named_rewards import compile_reward_hooks
from duffing_env.storage.kernel_spec import (
    OUTCOME_ROWS,
    KernelSpec,
    block_layout,
    block_offsets,
    compile_unpacker,
    noise_draw_rows,
    observation_bounds,
    parameter_names,
)
from estimator.compilation.simd import LANES, jit_closure, kernel, lanewise
from estimator.engine.storage_layout import belief_rows

#: When a step resets finished environments: never, in the next step, or in the same step. RESET_ONLY steps nothing and
#: resets the environments of a mask.
RESET_MANUALLY, RESET_NEXT_STEP, RESET_SAME_STEP, RESET_ONLY = 0, 1, 2, 3


@dataclass(frozen=True)
class Kernel:
    """The compiled entry points of one kind of experiment.

    They work on ``blocks`` (n_blocks, rows * LANES), which hold n = n_blocks * LANES environments, and on ``members``,
    the filter banks of the environments in use (`duffing_env.kernel_stages.noise_filter_bank`). ``packed_params`` are
    the `duffing_env.storage.kernel_spec.KernelParams` as one array.

    Attributes:
        step: ``step(first, stop, blocks, members, workspace, actions, packed_params, recorded, reset_mode, mask,
            observations, outcomes, final_observations, ended)`` steps the blocks from ``first`` to ``stop`` on the
            calling thread. ``workspace`` (2 rows * LANES,) is scratch. ``actions`` (n * inputs,) are the inputs of each
            environment in parts of their largest. ``recorded`` (inputs + 1, T) holds the inputs and outputs of the
            record to replay, and one sample where a plant is simulated. ``reset_mode`` says how finished environments
            are reset; RESET_ONLY only starts episodes where ``mask`` (n,) is true. The function writes ``observations``
            (n, entries) float32 and ``outcomes`` (len(OUTCOME_ROWS), n). For environments reset within this step it
            also writes ``final_observations``, like ``observations``, and ``ended`` (n_blocks, rows * LANES), their
            rows at the end of the episode.
        step_parallel: the same for all blocks, on one Numba thread for each row of ``workspace``
            (threads, 2 rows * LANES).
    """

    step: Any
    step_parallel: Any


@cache
def compile_kernel(spec: KernelSpec) -> Kernel:
    """The kernel of a kind of experiment; Numba compiles it at the first call and keeps it on disk."""
    step_blocks = _define_step_blocks(spec)
    compile_entry, inner_step = kernel(variant=spec.name), jit_closure(spec.name)(step_blocks)

    @compile_entry(parallel=True)
    def step_parallel(
        blocks, members, workspace, actions, packed_params, recorded, reset_mode, mask, observations, outcomes,
        final_observations, ended,
    ):  # fmt: skip
        n = len(workspace)
        for t in prange(n):
            inner_step(
                t * len(blocks) // n, (t + 1) * len(blocks) // n, blocks, members, workspace[t], actions, packed_params,
                recorded, reset_mode, mask, observations, outcomes, final_observations, ended,
            )  # fmt: skip

    return Kernel(compile_entry(step_blocks), step_parallel)


def _define_step_blocks(spec: KernelSpec) -> Any:
    """The function behind both entry points, with the stages of a kind of experiment.

    It stays in one piece: each stage that takes all ``params`` as a function of its own costs 0.4 s of compilation and
    0.1 µs at every call. Its arguments stay single arrays, which Numba takes faster than named tuples.
    """
    row_of, offset_of, generated = block_layout(spec), block_offsets(spec), generated_functions(spec)
    n_rows, n_saved = max(row_of.values()) + 1, len(belief_rows(spec.belief_model)) * LANES
    n_observation, n_outcome = len(observation_bounds(spec.belief_model)), len(OUTCOME_ROWS)
    elapsed, needs_reset, first_outcome = (
        offset_of["ELAPSED_SAMPLES"],
        offset_of["NEEDS_RESET"],
        offset_of[OUTCOME_ROWS[0]],
    )
    terminated, truncated = offset_of["TERMINATED"], offset_of["TRUNCATED"]
    jump_at, jump_factor = offset_of["JUMP_AT"], offset_of["JUMP_FACTOR"]
    first_parameter = offset_of[f"PARAM_{parameter_names(spec.truth_model)[0]}"]
    is_simulated, has_noise_hypotheses = spec.plant_model is not None, spec.has_noise_hypotheses
    is_structured = spec.factorisation == "structured"

    draw_noise = plant_stages.compile_noise_draw(row_of, noise_draw_rows(spec.truth_model))
    hooks = compile_reward_hooks(spec, generated)
    _, before_plant_step, before_update, after_update = hooks
    apply_input, replay_sample = input_limits.compile_input(spec, generated), sample_stages.compile_replay(spec)
    simulate_sample: Any = sample_stages.compile_simulation(spec, generated, draw_noise) if is_simulated else None
    add_random_walk, update_belief = generated.add_random_walk, sample_stages.compile_update(spec)
    reset_filter_bank, update_filter_bank = compile_filter_bank(spec) if has_noise_hypotheses else NO_FILTER_BANK
    finish_step, observe = generated.finish_step, generated.observe
    paid_by = "terminal has_terminated_return terminated_return"
    pay_reward = lanewise(row_of, "REWARD EPISODE_RETURN", uniform=paid_by)(plant_stages.pay_reward)
    restore_broken_beliefs = sample_stages.compile_belief_restoration(spec)
    save_sample, add_sample = sample_stages.compile_hold(spec)
    update_truth = sample_stages.compile_truth_update(spec, generated, hooks)
    reset_lane = sample_stages.compile_reset(spec, update_truth, reset_filter_bank)
    unpack = compile_unpacker(spec)

    def step_blocks(
        first, stop, blocks, members, workspace, actions, packed_params, recorded, reset_mode, mask, observations,
        outcomes, final_observations, ended,
    ):  # fmt: skip
        """Step the blocks from ``first`` to ``stop``, or start episodes in them."""
        params = unpack(packed_params)
        for b in range(first, stop):
            W = blocks[b]
            lane = b * LANES
            n_idle = 0
            for j in range(LANES):
                n_idle += W[needs_reset + j] != 0.0
            # Hold the actions for `hold` samples; an environment whose episode ends on the way stays as it ended.
            for s in range(params.hold if n_idle < LANES and reset_mode != RESET_ONLY else 0):
                if s > 0:
                    save_sample(W, workspace)
                apply_input(W, actions, lane, params.max_input, params.budget, params.max_slew)
                if params.jump > 0.0:
                    for j in range(LANES):
                        if W[elapsed + j] == W[jump_at + j]:
                            W[first_parameter + j] *= W[jump_factor + j]
                            update_truth(W, j, params)
                draw_noise(W)
                before_plant_step(W, params)
                if is_simulated:
                    simulate_sample(W)
                else:
                    replay_sample(W, recorded, params.input_delay, params.max_input)
                for i in range(n_saved):  # the belief to return to if the update breaks it
                    workspace[i] = W[i]
                if params.has_drift:
                    add_random_walk(W, params.walk_variances)
                before_update(W, params)
                if has_noise_hypotheses:
                    update_filter_bank(W, members, b, params)
                elif is_structured:
                    update_belief(W)
                else:
                    update_belief(W, params.iterations, params.as_published)
                after_update(W, params)
                finish_step(
                    W, params.step, params.max_output, params.horizon, params.sqrt_input_cost, params.sensor_limits,
                    params.reward_weights,
                )  # fmt: skip
                if params.terminal or params.has_terminated_return:
                    pay_reward(W, params.terminal, params.has_terminated_return, params.terminated_return)
                restore_broken_beliefs(W, workspace)
                if s > 0:
                    add_sample(W, workspace)
            # Start the episodes that are due, and mark the environments that have finished.
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
            # The saved belief is used up: observations go through the workspace, which stays in the nearest cache.
            for observation_pass in range(2):
                observe(
                    W, workspace, params.prior, params.prior_inverse_std, params.prior_log_precisions,
                    params.max_input, 1.0 / params.max_output, params.horizon, 1.0 / params.horizon, params.budget,
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

    return step_blocks
