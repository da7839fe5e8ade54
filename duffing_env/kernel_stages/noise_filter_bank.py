"""A bank of filters in each environment, one for each hypothesis about the noises; the environment shows their mixture.

`estimator.inference.noise_grid` gives their priors and weights. A *member* is the belief of one filter. The M members
of a block's n environments (``interleaved_envs``) lie in ``ceil(M n / LANES)`` blocks of their own: member m of
environment j in lane m n + j, so that each operation on a member runs for n environments at once. A member block holds
records, weights and free energies; what the members share is in one block, which stays in the nearest cache.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from duffing_env.storage.kernel_spec import KernelSpec, block_layout
from estimator.compilation.array_operations import copy_range
from estimator.compilation.simd import LANES, jit_closure, number_rows
from estimator.engine.kernels import compile_belief_update
from estimator.engine.shared_update import SharedUpdate, compile_shared_update
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
    """Compiled functions on ``members`` (blocks, `member_row_count` * LANES), the members of a whole batch.

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
    condition_block, member_rows = _compile_member_update(spec)
    record_size = len(belief_rows(model))
    noises_size = 2 + 2 * model.n_outputs
    mix = compile_mixture(len(model.names), 1 + model.n_outputs).mix
    variance_rows = tuple(member_rows[f"P_{c}_{c}"] * LANES for c in model.coefficients)
    weight_row, energy_row = member_rows["WEIGHT"] * LANES, member_rows[f"FREE_ENERGY_{spec.iterations - 1}"] * LANES
    free_energy_row, needs_reset = row_of.get("FREE_ENERGY", -1) * LANES, row_of["NEEDS_RESET"] * LANES
    shared_size, prepare = _compile_preparation(spec)
    compile_inner = jit_closure(spec.name)

    @compile_inner
    def reset_members(members, env_index, params):
        count, n = len(params.hypothesis_priors), params.interleaved_envs
        first = env_index // LANES * -(-count * n // LANES)
        for m in range(count if env_index % LANES < n else 0):
            slot = m * n + env_index % LANES
            U, lane = members[first + slot // LANES], slot % LANES
            for i in range(record_size - noises_size):
                U[i * LANES + lane] = params.prior[i]
            for i in range(noises_size + 1):
                U[(record_size - noises_size + i) * LANES + lane] = params.hypothesis_priors[m, i]

    @compile_inner
    def keep_waiting(U, before, W, n):
        """Put the members of environments that wait for their reset back to what they were."""
        for lane in range(0, LANES, n):
            for j in range(n):
                if W[needs_reset + j] != 0.0:
                    for i in range(lane + j, weight_row, LANES):
                        U[i] = before[i]

    @compile_inner
    def update_members(W, members, block, params):
        count, n = len(params.hypothesis_priors), params.interleaved_envs
        stop = -(-count * n // LANES)
        first, C = block * stop, np.zeros(shared_size)
        weights, energies_found, energies = np.empty(count * n), np.empty(count * n), np.empty(n)
        n_waiting = 0
        for j in range(n):
            n_waiting += W[needs_reset + j] != 0.0
        before = np.empty(weight_row if n_waiting else 0)
        prepare(W, members[first], C, n)
        for b in range(stop):
            U = members[first + b]
            if n_waiting:
                copy_range(before, 0, U, 0, weight_row)
            for c in range(len(variance_rows) if params.has_drift else 0):
                for j in range(LANES):
                    U[variance_rows[c] + j] += params.walk_variances[c]
            condition_block(U, C)
            if n_waiting:
                keep_waiting(U, before, W, n)
        for m in range(0, count * n, n):
            U, lane = members[first + m // LANES], m % LANES
            copy_range(weights, m, U, weight_row + lane, n)
            copy_range(energies_found, m, U, energy_row + lane, n)
        member_weights, member_energies = weights.reshape((count, n)), energies_found.reshape((count, n))
        apply_switching(member_weights, member_energies)
        reweight(member_weights, member_energies, energies)
        for m in range(0, count * n, n):
            U, lane = members[first + m // LANES], m % LANES
            for j in range(n):
                weights[m + j] = U[weight_row + lane + j] if W[needs_reset + j] != 0.0 else weights[m + j]
                U[weight_row + lane + j] = weights[m + j]
        mix(members, first, weights, n, W, LANES)
        if free_energy_row >= 0:
            copy_range(W, free_energy_row, energies, 0, n)

    return FilterBank(reset_members, update_members)


def _shared_update(spec: KernelSpec) -> SharedUpdate:
    """The update of members about their mixture's mean."""
    return compile_shared_update(spec.belief_model, spec.degree, spec.iterations)


def _compile_preparation(spec: KernelSpec) -> tuple[int, Any]:
    """Numbers in the block that members share, and ``prepare(W, U, C, n)``, which fills it for n environments.

    It takes the mixture's mean, the input and the outputs from the environments' block W and the noises' shapes, which
    all members have alike, from the first members' block U, repeats them in every lane, and linearises. Sigma points
    have no common linearisation: there the members share the input and the outputs alone.
    """
    row_of, model = block_layout(spec), spec.belief_model
    observed = [*input_rows(model, spec.degree), *(f"Y_{sensor}" for sensor in model.outputs)]
    compile_inner = jit_closure(spec.name)

    def copies(shared_rows: Mapping[str, int], source: Mapping[str, int], names: Sequence[str]) -> Any:
        pairs = tuple((shared_rows[name] * LANES, source[name] * LANES) for name in names)

        @compile_inner
        def repeat_in_all_lanes(C, B, n):
            for lane in range(0, LANES, n):
                for to, start in pairs:
                    copy_range(C, to + lane, B, start, n)

        return repeat_in_all_lanes

    if spec.uses_cubature:
        copy_sample = copies(number_rows(*observed), row_of, observed)

        @compile_inner
        def prepare_sample(W, U, C, n):
            copy_sample(C, W, n)

        return len(observed) * LANES, prepare_sample
    shared = _shared_update(spec)
    copy_mixture = copies(shared.shared_layout, row_of, [*model.names, *observed])
    shapes = ["GAMMA_SHAPE", *(f"XI_SHAPE_{sensor}" for sensor in model.outputs)]
    copy_shapes = copies(shared.shared_layout, shared.layout, shapes)
    linearise = shared.linearise

    @compile_inner
    def prepare(W, U, C, n):
        copy_mixture(C, W, n)
        copy_shapes(C, U, n)
        linearise(C)

    return len(shared.shared_layout) * LANES, prepare


def _compile_member_update(spec: KernelSpec) -> tuple[Any, Mapping[str, int]]:
    """``condition(U, C)`` of a block of members with what they share, and the rows of U.

    Sigma points are placed by a member's own covariance, so there each member is propagated by itself.
    """
    shared = _shared_update(spec)
    if not spec.uses_cubature:
        return shared.update, shared.layout
    model, layout = spec.belief_model, shared.layout
    task = compile_belief_update(
        model, spec.degree, iterations=spec.iterations, keep_trace=True, expectations="sigma_points"
    )
    update, rows = task.update, task.layout
    observed = [*input_rows(model, spec.degree), *(f"Y_{sensor}" for sensor in model.outputs)]
    copies = tuple((rows[row] * LANES, k * LANES) for k, row in enumerate(observed))
    record, scratch_size = len(belief_rows(model)) * LANES, (max(rows.values()) + 1) * LANES
    unsound, energy = rows["INDEFINITE_COUNT"] * LANES, layout[f"FREE_ENERGY_{spec.iterations - 1}"] * LANES
    free_energies_of = compile_free_energies(model, spec.iterations, LANES, rows, every_iteration=False)

    @jit_closure(spec.name)
    def condition(U, C):
        V = np.zeros(scratch_size)
        copy_range(V, 0, U, 0, record)
        for to, source in copies:
            copy_range(V, to, C, source, LANES)
        update(V)
        free_energies_of(V, U[energy : energy + LANES])
        for j in range(LANES):
            U[energy + j] = np.nan if V[unsound + j] > 0.0 else U[energy + j]
        for i in range(0, record, LANES):
            for j in range(LANES):
                U[energy + j] += 0.0 * V[i + j]
        copy_range(U, 0, V, 0, record)

    return condition, layout


def member_row_count(spec: KernelSpec) -> int:
    """Rows of a block of members: the record, the weight, and the free energy."""
    return len(belief_rows(spec.belief_model)) + 2
