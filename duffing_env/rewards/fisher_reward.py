"""The reward ``fisher``: Fisher information of the outputs about the coefficients, at the true plant.

The covariance recursion of the structured update runs with the true noises, linearised at the true plant and its true
state instead of the belief. Its covariance of the coefficients is (Λ0 + F)⁻¹, with the prior's precision Λ0 and the
Fisher information F of the outputs so far. The recursion uses no output, so no belief changes it.
"""

from __future__ import annotations

from typing import Any

from duffing_env.rewards.expected_free_energy_reward import expected_sample_source
from duffing_env.rewards.reward_hooks import RewardHooks, no_hook
from duffing_env.storage.kernel_spec import KernelSpec, block_layout, noise_std_rows
from estimator.compilation.simd import LANES, jit_closure
from estimator.engine.storage_layout import belief_rows


def hook_source(spec: KernelSpec, loop: Any) -> str:
    """``update_ideal(W)``: the covariance of an efficient estimator after a sample, linearised at the truth."""
    from estimator.engine.symbolic import symbol

    model = spec.belief_model
    truth_rows = {**{x: f"X_{x}" for x in model.states}, **{c: f"TRUE_{c}" for c in model.coefficients}}
    truth_rows |= {name: f"FISHER_{name}" for name in belief_rows(model) if name.startswith("P_")}
    names, stds = ["PROCESS_VARIANCE", *(f"R_{y}" for y in model.outputs)], noise_std_rows(spec.truth_model).values()
    noises = [(name, symbol(std) ** 2) for name, std in zip(names, stds, strict=True)]
    return expected_sample_source("update_ideal", spec, loop, truth_rows, noises, keeps_covariance=True)


def compile_hooks(spec: KernelSpec, generated: Any) -> RewardHooks:
    """Hooks that start from the prior and add each sample's information before the plant moves."""
    row_of, model, update_ideal = block_layout(spec), spec.belief_model, generated.update_ideal
    names = belief_rows(model)
    information_rows = tuple(
        (names.index(name), row_of[f"FISHER_{name}"] * LANES) for name in names if name.startswith("P_")
    )
    elapsed_row = row_of["ELAPSED_SAMPLES"] * LANES
    if model.n_outputs > 1:
        raise ValueError(f"reward 'fisher' is for one sensor, but {model.name!r} has {model.n_outputs}")

    @jit_closure(spec.name)
    def start_information(W, j, params):
        if W[elapsed_row + j] == 0.0:  # a truth that changes within an episode keeps the information so far
            for index, row in information_rows:
                W[row + j] = params.prior[index]

    @jit_closure(spec.name)
    def add_sample_information(W, params):
        update_ideal(W)

    return RewardHooks(start_information, add_sample_information, no_hook, no_hook)
