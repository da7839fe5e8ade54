"""One step of the experiment, compiled: input → plant → measurement → belief → reward → observation.

It exists once, and is put together from what the engine makes of the models (`compile_kernel`). A single environment is
a batch with one live lane, so single and vector environments give bit-identical trajectories.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

from numba import prange

from duffing_env.kernel_stages import plant_stages, sample_stages
from duffing_env.kernel_stages.env_codegen import generated_functions
from duffing_env.kernel_stages.noise_filter_bank import NO_FILTER_BANK, compile_filter_bank
from duffing_env.rewards.reward_registry import compile_reward_hooks
from duffing_env.storage.kernel_spec import (
    OUTCOME_ROWS,
    KernelSpec,
    block_layout,
    block_offsets,
    compile_unpacker,
    observation_bounds,
    parameter_names,
)
from estimator.compilation.simd import LANES, jit_closure, kernel, lanewise
from estimator.engine.storage_layout import belief_rows

#: How finished environments are reset: by hand, in the step after, or in the same step; or what is done is a reset.
RESET_MANUALLY, RESET_NEXT_STEP, RESET_SAME_STEP, RESET_ONLY = 0, 1, 2, 3


@dataclass(frozen=True)
class Kernel:
    """The entry points of one kind of experiment.

    They work on ``blocks`` (n_blocks, rows * LANES), the environments, of which there are n = n_blocks * LANES, and on
    the ``members`` (`duffing_env.kernel_stages.noise_filter_bank`) of those that are in use. ``packed_params`` are the
    `duffing_env.storage.kernel_spec.KernelParams` as one array.

    Attributes:
        step: ``step(first, stop, blocks, members, workspace, actions, packed_params, recorded, reset_mode, mask,
            observations, outcomes, final_observations, ended)`` steps the blocks from ``first`` to ``stop`` on the
            calling thread. ``workspace`` (2 rows * LANES,) is scratch, ``actions`` (n,) are inputs in parts of the
            largest, ``recorded`` (2, T) inputs and outputs of the record that is replayed, and of one sample elsewhere.
            ``reset_mode`` says how finished environments are reset; RESET_ONLY does nothing but start episodes in
            those of ``mask`` (n,). It writes ``observations`` (n, entries) float32, and ``outcomes``
            (len(OUTCOME_ROWS), n). Where environments were reset in this very step, it writes ``final_observations``,
            like ``observations``, and ``ended`` (n_blocks, rows * LANES), their rows as the episode left them.
        step_parallel: all blocks on Numba's threads, as many as ``workspace`` (threads, 2 rows * LANES) has rows.
    """

    step: Any
    step_parallel: Any


@cache
def compile_kernel(spec: KernelSpec) -> Kernel:
    """The kernel of a kind of experiment. Its stages are compiled at the first call, and kept on disk."""
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

    It stays in one piece, and its arguments apart: a stage that takes all ``params`` costs half a second of compilation
    and a tenth of a microsecond at every call.
    """
    row_of, offset_of, generated = block_layout(spec), block_offsets(spec), generated_functions(spec)
    n_rows, n_saved = max(row_of.values()) + 1, len(belief_rows(spec.belief_model)) * LANES
    n_observation, n_outcome = len(observation_bounds(spec.belief_model)), len(OUTCOME_ROWS)
    elapsed, needs_reset, first_outcome = offset_of["ELAPSED"], offset_of["WAITING"], offset_of[OUTCOME_ROWS[0]]
    terminated, truncated = offset_of["TERMINATED"], offset_of["TRUNCATED"]
    jump_at, jump_factor = offset_of["JUMP_AT"], offset_of["JUMP_FACTOR"]
    first_parameter = offset_of[f"PARAM_{parameter_names(spec.truth_model)[0]}"]
    is_simulated, has_noise_hypotheses = spec.plant_model is not None, spec.has_noise_hypotheses
    is_structured = spec.factorisation == "structured"

    draw_noise, hooks = plant_stages.compile_noise_draw(row_of), compile_reward_hooks(spec, generated)
    _, before_plant_step, before_update, after_update = hooks
    apply_input, replay_sample = sample_stages.compile_input(spec), sample_stages.compile_replay(spec)
    simulate_sample: Any = sample_stages.compile_simulation(spec, generated, draw_noise) if is_simulated else None
    add_random_walk, update_belief = generated.add_random_walk, sample_stages.compile_update(spec)
    reset_filter_bank, update_filter_bank = compile_filter_bank(spec) if has_noise_hypotheses else NO_FILTER_BANK
    finish_step, observe = generated.finish_step, generated.observe
    paid_by = "terminal has_terminated_return terminated_return"
    pay_reward = lanewise(row_of, "REWARD EARNED", uniform=paid_by)(plant_stages.pay_reward)
    restore_broken_beliefs = sample_stages.compile_belief_restoration(spec)
    save_sample, add_sample = sample_stages.compile_hold(spec)
    update_truth = sample_stages.compile_truth_update(spec, generated, hooks)
    reset_lane = sample_stages.compile_reset(spec, update_truth, reset_filter_bank)
    unpack = compile_unpacker(spec)

    def step_blocks(
        first, stop, blocks, members, workspace, actions, packed_params, recorded, reset_mode, mask, observations, outcomes,
        final_observations, ended,
    ):  # fmt: skip
        """Step some blocks, or start episodes in them."""
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
                for i in range(n_saved):  # what to return to if the update breaks the belief
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
                    W, params.step, params.max_output, params.horizon, params.sqrt_input_cost, params.reward_weights[0],
                    params.reward_weights[1], params.reward_weights[2], params.reward_weights[3],
                )  # fmt: skip
                if params.terminal or params.has_terminated_return:
                    pay_reward(W, params.terminal, params.has_terminated_return, params.terminated_return)
                restore_broken_beliefs(W, workspace)
                if s > 0:
                    add_sample(W, workspace)
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

    return step_blocks
