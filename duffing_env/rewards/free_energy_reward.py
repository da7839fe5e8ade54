"""The reward ``free_energy``: minus the variational free energy of the sample after the belief update."""

from __future__ import annotations

from typing import Any

import numpy as np

from duffing_env.rewards.reward_hooks import RewardHooks, no_hook, no_lane_hook
from duffing_env.storage.kernel_spec import KernelSpec, block_layout
from estimator.compilation.array_operations import copy
from estimator.compilation.simd import LANES, jit_closure
from estimator.engine.variational_free_energy import compile_free_energies
from estimator.inference import mean_field


def compile_hooks(spec: KernelSpec, generated: Any) -> RewardHooks:
    """A hook that reads the free energy after the update."""
    free_energies_of, reward_row = _compile_free_energies(spec), block_layout(spec)["HOOK_REWARD"] * LANES

    @jit_closure(spec.name)
    def after(W, params):
        energies = np.empty(LANES)
        free_energies_of(W, energies)
        for j in range(LANES):
            W[reward_row + j] = -energies[j]

    return RewardHooks(no_lane_hook, no_hook, no_hook, after)


def _compile_free_energies(spec: KernelSpec) -> Any:
    """``free_energies_of(W, energies)``: every lane's free energy after the last update [nats]."""
    row_of = block_layout(spec)
    if spec.has_noise_hypotheses:
        free_energy_row = row_of["FREE_ENERGY"] * LANES

        @jit_closure(spec.name)
        def mixture_free_energy(W, energies):
            copy(energies, 0, W[free_energy_row:], LANES)

        return mixture_free_energy
    if spec.factorisation == "mean_field":
        free_energy = mean_field.compile_mean_field(row_of).free_energy

        @jit_closure(spec.name)
        def mean_field_free_energy(W, energies):
            for j in range(LANES):
                energies[j] = free_energy(W, j)

        return mean_field_free_energy
    return compile_free_energies(spec.belief_model, spec.iterations, LANES, row_of, every_iteration=False)
