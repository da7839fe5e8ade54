"""A bank of filters in each environment, one for each hypothesis about the noises; the environment shows their mixture.

`estimator.inference.noise_grid` gives their priors and weights. A *member* is the belief of one filter. The M members
of a block's n environments (``interleaved_envs``) lie in ``ceil(M n / LANES)`` blocks of their own: member m of
environment j in lane m n + j, so that each operation on a member runs for n environments at once. A member block holds
records and weights only; the rest of an update is scratch, which stays in the nearest cache.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from duffing_env.storage.kernel_spec import KernelSpec, block_layout
from estimator.compilation.array_operations import copy_range
from estimator.compilation.simd import LANES, jit_closure
from estimator.engine.kernels import compile_belief_update
from estimator.engine.storage_layout import belief_rows, input_rows
from estimator.engine.variational_free_energy import compile_free_energies
from estimator.inference.noise_mixture import apply_switching, compile_mixture, reweight


def interleave_width(n_envs: int) -> int:
    """Number of environments whose members lie side by side in a block: a power of two that divides `LANES`."""
    return min(LANES, 1 << (n_envs - 1).bit_length())


def n_member_blocks(n_envs: int, n_hypotheses: int) -> int:
    """Number of blocks that the members of all environments take."""
    return -(-n_envs // LANES) * -(-n_hypotheses * interleave_width(n_envs) // LANES)


class FilterBank(NamedTuple):
    """Compiled functions on ``members`` (blocks, (size + 1) * LANES), the members of a whole batch.

    Attributes:
        reset: ``reset(members, env_index, params)`` puts the members of an environment to their priors.
        update: ``update(W, members, block, params)`` updates the members of a block's environments with its inputs and
            outputs, and sets the environments' beliefs to the mixtures. The members of an environment that waits for
            its reset stay as they are.

    Lanes of a block from ``params.interleaved_envs`` on have no members, and keep their beliefs.
    """

    reset: Any
    update: Any


#: For environments with a single belief.
NO_FILTER_BANK = FilterBank(None, None)


def compile_filter_bank(spec: KernelSpec) -> FilterBank:
    """Compile the filter bank of a kind of experiment."""
    row_of, model = block_layout(spec), spec.belief_model
    expectations = "sigma_points" if spec.uses_cubature else "first_order"
    task = compile_belief_update(
        model, spec.degree, iterations=spec.iterations, keep_trace=True, expectations=expectations
    )
    update, member_rows, record_size = task.update, task.layout, len(belief_rows(model))
    mix = compile_mixture(len(model.names)).mix
    observed_names = [*input_rows(model, spec.degree), *(f"Y_{sensor}" for sensor in model.outputs)]
    copied_rows = tuple((member_rows[row] * LANES, row_of[row] * LANES) for row in observed_names)
    variance_rows = tuple(member_rows[f"P_{c}_{c}"] * LANES for c in model.coefficients)
    weight_row, scratch_size, free_energy_row = (
        record_size * LANES,
        (max(member_rows.values()) + 1) * LANES,
        row_of.get("FREE_ENERGY", -1) * LANES,
    )
    unsound_row, needs_reset = member_rows.get("INDEFINITE_COUNT", -1) * LANES, row_of["NEEDS_RESET"] * LANES
    free_energies_of = compile_free_energies(model, spec.iterations, LANES, member_rows, every_iteration=False)
    compile_inner = jit_closure(spec.name)

    @compile_inner
    def reset_members(members, env_index, params):
        count, n = len(params.hypothesis_priors), params.interleaved_envs
        first = env_index // LANES * -(-count * n // LANES)
        for m in range(count if env_index % LANES < n else 0):
            slot = m * n + env_index % LANES
            U, lane = members[first + slot // LANES], slot % LANES
            for i in range(record_size - 4):
                U[i * LANES + lane] = params.prior[i]
            for i in range(5):
                U[(record_size - 4 + i) * LANES + lane] = params.hypothesis_priors[m, i]

    @compile_inner
    def update_block(U, V, W, n, has_waiting, params, energies_found):
        """Update the members in block U by way of scratch block V; ``energies_found`` receives the free energies."""
        copy_range(V, 0, U, 0, weight_row)
        for to, source in copied_rows:
            for lane in range(0, LANES, n):
                copy_range(V, to + lane, W, source, n)
        for c in range(len(variance_rows) if params.has_drift else 0):
            for j in range(LANES):
                V[variance_rows[c] + j] += params.walk_variances[c]
        for j in range(LANES if unsound_row >= 0 else 0):
            V[unsound_row + j] = 0.0
        update(V)
        free_energies_of(V, energies_found)
        for j in range(LANES if unsound_row >= 0 else 0):
            energies_found[j] = np.nan if V[unsound_row + j] > 0.0 else energies_found[j]
        for lane in range(0, LANES if has_waiting else 0, n):
            for j in range(n):
                if W[needs_reset + j] != 0.0:
                    for i in range(record_size):
                        V[i * LANES + lane + j] = U[i * LANES + lane + j]
        copy_range(U, 0, V, 0, weight_row)

    @compile_inner
    def update_members(W, members, block, params):
        count, n = len(params.hypothesis_priors), params.interleaved_envs
        stop = -(-count * n // LANES)
        first, V, energies_found = block * stop, np.zeros(scratch_size), np.empty(stop * LANES)
        weights, normalised_weights, energies = np.empty(count * n), np.empty(count * n), np.empty(n)
        n_waiting = 0
        for j in range(n):
            n_waiting += W[needs_reset + j] != 0.0
        for b in range(stop):
            found = energies_found[b * LANES : (b + 1) * LANES]
            update_block(members[first + b], V, W, n, n_waiting > 0, params, found)
        for m in range(0, count * n, n):
            copy_range(weights, m, members[first + m // LANES], weight_row + m % LANES, n)
        member_weights, member_energies = weights.reshape((count, n)), energies_found[: count * n].reshape((count, n))
        apply_switching(member_weights, member_energies)
        reweight(member_weights, member_energies, energies)
        for m in range(0, count * n, n):
            U, lane = members[first + m // LANES], m % LANES
            for j in range(n):
                if W[needs_reset + j] == 0.0:
                    U[weight_row + lane + j] = weights[m + j]
        mix(members, first, member_weights, normalised_weights, W, LANES)
        if free_energy_row >= 0:
            copy_range(W, free_energy_row, energies, 0, n)

    return FilterBank(reset_members, update_members)
