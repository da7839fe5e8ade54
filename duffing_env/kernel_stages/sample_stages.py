"""Stages of a compiled step on one block of environments: reset, replay, plant, belief update, held actions.

Each function here compiles one stage for a kind of experiment; `duffing_env.kernel` calls them in order. A stage closes
over plain integers, the offsets of rows in a block.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from duffing_env.kernel_stages import plant_stages
from duffing_env.rewards.reward_hooks import RewardHooks
from duffing_env.storage.kernel_spec import (
    SUMMED_OUTCOMES,
    KernelSpec,
    applied_row,
    block_layout,
    block_offsets,
    input_places,
    missing_mean_field_rows,
    parameter_names,
)
from estimator.compilation.simd import LANES, jit_closure, lanewise
from estimator.engine.kernels import compile_belief_update
from estimator.engine.storage_layout import belief_rows, input_history_row
from estimator.inference import mean_field
from estimator.models.model import MAX_INPUT_AGE


def compile_truth_update(spec: KernelSpec, generated: Any, hooks: RewardHooks) -> Any:
    """``update_truth(W, j, params)``: set lane j's true coefficients after its parameters changed."""
    set_true_coefficients, evaluate_belief = generated.set_true_coefficients, generated.evaluate_belief
    on_episode_start = hooks.on_episode_start

    @jit_closure(spec.name)
    def update_truth(W, j, params):
        set_true_coefficients(W, j, params.step)
        evaluate_belief(W, j, params.step)
        on_episode_start(W, j, params)

    return update_truth


def compile_reset(spec: KernelSpec, update_truth: Any, reset_filter_bank: Any) -> Any:
    """``reset_lane(W, members, b, j, params)``: start an episode in lane j of block b.

    Its plant is drawn and put at rest, or in the first states of `Model.initial_states`; its belief is the prior.
    """
    offset_of, n_record = block_offsets(spec), len(belief_rows(spec.belief_model))
    first_stream, first_parameter = offset_of["SFC64_a"], offset_of[f"PARAM_{parameter_names(spec.truth_model)[0]}"]
    jump_at, has_noise_hypotheses = offset_of["JUMP_AT"], spec.has_noise_hypotheses
    zeroed_names = ["ENERGY_SPENT", "EPISODE_RETURN", "ELAPSED_SAMPLES", "NEEDS_RESET", "HOOK_REWARD"]
    ages = range(MAX_INPUT_AGE + 1)
    zeroed_names += [input_history_row(name, age) for name in spec.truth_model.inputs for age in ages]
    # Mean field's rows of a θ2 that the model does not have must be 0, also after an episode that ended with NaN.
    zeroed_names += missing_mean_field_rows(spec)
    zeroed_names += [f"Y_{y}" for y in spec.truth_model.outputs] + [f"X_{x}" for x in spec.truth_model.states]
    zeroed_rows = tuple(offset_of[name] for name in zeroed_names)
    states, coefficients = list(spec.truth_model.states), list(spec.truth_model.coefficients)
    first_states = tuple(
        (offset_of[f"X_{states[i]}"], offset_of[f"TRUE_{coefficients[k]}"])
        for i, k in spec.truth_model.initial_state_coefficients
    )
    jump_rows = "SFC64_a SFC64_b SFC64_c SFC64_d JUMP_AT JUMP_FACTOR"
    draw_parameter_jump = lanewise(block_layout(spec), jump_rows, uniform="jump horizon", single_lane=True)(
        plant_stages.draw_parameter_jump
    )

    @jit_closure(spec.name)
    def reset_lane(W, members, b, j, params):
        for i in range(n_record):
            W[i * LANES + j] = params.prior[i]
        if has_noise_hypotheses:
            reset_filter_bank(members, b * LANES + j, params)
        # Passed as variables: Numba compiles a function anew for every constant.
        plant_stages.draw_plant_parameters(W, j, params, np.int64(first_stream), np.int64(first_parameter))
        W[jump_at + j] = -1.0
        if params.jump > 0.0:
            draw_parameter_jump(W, j, params.jump, params.horizon)
        for r in zeroed_rows:
            W[r + j] = 0.0
        update_truth(W, j, params)

    if not first_states:
        return reset_lane

    @jit_closure(spec.name)
    def reset_lane_in_motion(W, members, b, j, params):
        reset_lane(W, members, b, j, params)
        for state, coefficient in first_states:
            W[state + j] = W[coefficient + j]

    return reset_lane_in_motion


def compile_replay(spec: KernelSpec) -> Any:
    """``replay_sample(W, recorded, input_delay, max_input)``: a sample of the record in place of a plant.

    ``recorded`` (inputs + 1, T) holds the inputs and the first sensor's outputs. An action that deviates from the
    recorded input is off the record.
    """
    offset_of, count = block_offsets(spec), spec.truth_model.n_inputs
    elapsed, off_record = offset_of["ELAPSED_SAMPLES"], offset_of["OFF_RECORD"]
    output_row = offset_of[f"Y_{next(iter(spec.truth_model.outputs))}"]
    first_input, stride = input_places(spec, applied_row)
    rounding = plant_stages.FLOAT32_ROUNDING

    @jit_closure(spec.name)
    def replay_sample(W, recorded, input_delay, max_input):
        last = recorded.shape[1] - 1
        for j in range(LANES):
            t = np.int64(W[elapsed + j])
            W[output_row + j] = recorded[count, min(t + input_delay, last)]
            W[off_record + j] = 0.0
            for i in range(count):
                u = recorded[i, min(t, last)]
                if abs(W[first_input + i * stride + j] - u) > rounding * max_input[i]:
                    W[off_record + j] = 1.0
                W[first_input + i * stride + j] = u

    return replay_sample


def compile_simulation(spec: KernelSpec, generated: Any, draw_noise: Any) -> Any:
    """``simulate_sample(W)``: step the plant over a sample with its noise, and measure; the first noise is drawn."""
    assert spec.plant_model is not None
    model, n_outputs = spec.plant_model, spec.plant_model.n_outputs
    if n_outputs > 3:
        raise ValueError(f"outputs must be at most 3 in an environment, but {model.name!r} has {n_outputs}")
    step_plant, steps, draws_each_step = generated.step_plant, model.substeps, not model.held
    substep_length, sqrt_length, sqrt_3 = 1.0 / steps, math.sqrt(1.0 / steps), math.sqrt(3.0)
    measure_0: Any = getattr(generated, "measure_0", None)
    measure_1 = getattr(generated, "measure_1", measure_0)
    measure_2 = getattr(generated, "measure_2", measure_0)
    is_continuous = model.is_continuous

    @jit_closure(spec.name)
    def simulate_sample(W):
        if is_continuous:
            for s in range(steps):
                step_plant(W, s / steps, substep_length, sqrt_length, sqrt_3)
                if draws_each_step:
                    draw_noise(W)
            measure_0(W)
        else:
            step_plant(W)
        if n_outputs > 1:
            draw_noise(W)
            measure_1(W)
        if n_outputs > 2:
            draw_noise(W)
            measure_2(W)

    return simulate_sample


def compile_update(spec: KernelSpec) -> Any:
    """``update(W)``, or of mean field ``update(W, iterations, as_published)``: the belief after a sample."""
    row_of = block_layout(spec)
    if spec.factorisation == "mean_field":
        return mean_field.compile_mean_field_update(row_of)
    trace = spec.reward_hooks == "free_energy"
    return compile_belief_update(
        spec.belief_model, spec.degree, iterations=spec.iterations, block_layout=row_of, keep_trace=trace
    ).update


def compile_belief_restoration(spec: KernelSpec) -> Any:
    """``restore_broken_beliefs(W, workspace)``: put a belief that diverged back to its state before the sample."""
    offset_of, n_record = block_offsets(spec), len(belief_rows(spec.belief_model))
    diverged, off_record = offset_of["DIVERGED"], offset_of["OFF_RECORD"]

    @jit_closure(spec.name)
    def restore_broken_beliefs(W, workspace):
        n_void = 0
        for j in range(LANES):
            n_void += (W[diverged + j] != 0.0) | (W[off_record + j] != 0.0)
        for j in range(LANES if n_void else 0):
            if W[diverged + j] != 0.0 or W[off_record + j] != 0.0:
                for i in range(n_record):
                    W[i * LANES + j] = workspace[i * LANES + j]

    return restore_broken_beliefs


class HoldStages(NamedTuple):
    """Functions around every sample of a held action but the first.

    Attributes:
        save_sample: ``save_sample(W, workspace)`` keeps the block before the sample; lanes that have ended wait.
        add_sample: ``add_sample(W, workspace)`` adds the rewards of the samples so far; lanes that had ended before the
            sample go back to their end.
    """

    save_sample: Any
    add_sample: Any


def compile_hold(spec: KernelSpec) -> HoldStages:
    """Compile them; the workspace keeps the block behind the belief that the kernel saves in each sample."""
    offset_of, n_rows = block_offsets(spec), max(block_layout(spec).values()) + 1
    n_saved = len(belief_rows(spec.belief_model)) * LANES
    terminated, truncated, needs_reset = (offset_of[name] for name in ("TERMINATED", "TRUNCATED", "NEEDS_RESET"))
    summed_rows = tuple(offset_of[name] for name in SUMMED_OUTCOMES)
    compile_inner = jit_closure(spec.name)

    @compile_inner
    def save_sample(W, workspace):
        for i in range(n_rows * LANES):
            workspace[n_saved + i] = W[i]
        for j in range(LANES):  # a lane that waits draws no noise and updates no filter bank
            if W[terminated + j] + W[truncated + j] != 0.0:
                W[needs_reset + j] = 1.0

    @compile_inner
    def add_sample(W, workspace):
        for j in range(LANES):
            if workspace[n_saved + terminated + j] + workspace[n_saved + truncated + j] != 0.0:
                for i in range(n_rows):
                    W[i * LANES + j] = workspace[n_saved + i * LANES + j]
            else:
                for r in summed_rows:
                    W[r + j] += workspace[n_saved + r + j]

    return HoldStages(save_sample, add_sample)
