"""The reward ``simulation_error``: error of a free simulation of the believed oscillator beside the true one.

Both start at rest and get the same test input, without noise; their outputs are compared:

    misfit = min(sqrt(Σ (x_believed - x_true)² / Σ x_true²), 1).

The believed oscillator has the posterior's means for its coefficients. If it diverges or is NaN, its misfit is 1.

The test input is a Schroeder multisine of `TEST_SAMPLES` samples: the first 20 multiples of 9.5 Hz at equal amplitude,
so up to 191 Hz as the Silverbox's multisine. Its peak is half of ``max_input``, which moves the oscillators of the
standard tracks by at most 0.35 V. Of several inputs each gets the multisine from another place of its period on, so
that they can be distinguished.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from duffing_env.rewards.reward_hooks import RewardHooks, no_hook
from duffing_env.storage.kernel_spec import KernelSpec, block_layout
from estimator.compilation.array_operations import copy_range
from estimator.compilation.simd import LANES, jit_closure
from estimator.engine.input_hold import compile_input_writer
from estimator.engine.storage_layout import input_rows
from estimator.support.array_types import FloatArray

#: Length of the test input [samples]: 105 ms.
TEST_SAMPLES = 64

#: Harmonics of the test input.
_N_HARMONICS = 20

#: Peak of the test input, in parts of ``max_input``.
_PEAK_FRACTION = 0.5


def _schroeder_multisine() -> FloatArray:
    """The test input (TEST_SAMPLES,), in parts of ``max_input``."""
    harmonics = np.arange(1, _N_HARMONICS + 1)
    phases = -np.pi * harmonics * (harmonics - 1) / _N_HARMONICS
    times = np.arange(TEST_SAMPLES)[:, None] / TEST_SAMPLES
    waves: FloatArray = np.cos(2 * np.pi * harmonics * times + phases).sum(axis=1)
    return _PEAK_FRACTION * waves / np.abs(waves).max()


TEST_INPUT = _schroeder_multisine()


def hook_source(spec: KernelSpec, loop: Any) -> str:
    """``step_believed`` and ``step_true`` step the plants, ``add_difference`` and ``finish_misfit`` compare them."""
    import sympy as sp

    from estimator.engine.symbolic import differentiate, propagate_state, substitute, symbol

    model = spec.belief_model
    believed = {x: f"SIMULATED_BELIEVED_{x}" for x in model.states} | {c: c for c in model.coefficients}
    true = {x: f"SIMULATED_TRUE_{x}" for x in model.states} | {c: f"TRUE_{c}" for c in model.coefficients}
    substep_arguments = ("TAU",) if model.is_continuous else ()
    source_text = loop(
        "step_believed", "The believed plant moves.", *propagate_state(model, spec.degree, believed), *substep_arguments
    )
    source_text += loop(
        "step_true", "The true plant moves.", *propagate_state(model, spec.degree, true), *substep_arguments
    )
    output_expression = (
        differentiate(model).outputs[0].subs({symbol(name): 0 for name in (*model.input_ages, *model.acting_inputs)})
    )
    believed_output, true_output = (substitute([("", output_expression)], names)[0][1] for names in (believed, true))
    lines = [
        ("E_d", symbol("SUM_SQUARED_DIFFERENCE") + (believed_output - true_output) ** 2),
        ("E_p", symbol("SUM_SQUARED_TRUE") + true_output**2),
    ]
    source_text += loop(
        "add_difference", "Add up what differs.", lines, {"SUM_SQUARED_DIFFERENCE": "E_d", "SUM_SQUARED_TRUE": "E_p"}
    )
    misfit = sp.sqrt(symbol("SUM_SQUARED_DIFFERENCE") / symbol("SUM_SQUARED_TRUE"))
    # ``reaches`` is 0 for NaN, which so counts as 1.
    bounded_misfit = sp.Function("select")(sp.Function("reaches")(sp.S.One, symbol("RATIO")), symbol("RATIO"), sp.S.One)
    lines = [("RATIO", misfit), ("KEPT", bounded_misfit), ("FALL", symbol("SIMULATION_ERROR") - symbol("KEPT"))]
    return source_text + loop(
        "finish_misfit", "The misfit, and its decrease.", lines, {"HOOK_REWARD": "FALL", "SIMULATION_ERROR": "KEPT"}
    )


def compile_hooks(spec: KernelSpec, generated: Any) -> RewardHooks:
    """Hooks that run both plants at the start of an episode and after every update."""
    row_of, model = block_layout(spec), spec.belief_model
    first, last = (
        row_of[f"SIMULATED_BELIEVED_{next(iter(model.states))}"] * LANES,
        (row_of["SUM_SQUARED_TRUE"] + 1) * LANES,
    )
    rows = [row_of[row] for row in input_rows(model, spec.degree)]
    inputs, feed_input = tuple(row * LANES for row in rows), compile_input_writer(model, spec.degree, rows, LANES)
    reward_row, misfit_row = row_of["HOOK_REWARD"] * LANES, row_of["SIMULATION_ERROR"] * LANES
    step_believed, step_true, add_difference, finish_misfit = (
        generated.step_believed,
        generated.step_true,
        generated.add_difference,
        generated.finish_misfit,
    )
    substeps, is_continuous = model.substeps, model.is_continuous
    n_inputs, shift = model.n_inputs, TEST_SAMPLES // model.n_inputs

    @jit_closure(spec.name)
    def run_free_simulation(W, max_input):
        """Write the misfit of every lane's belief, and its decrease."""
        saved_inputs = np.empty(len(inputs) * LANES)
        for k in range(len(inputs)):
            copy_range(saved_inputs, k * LANES, W, inputs[k], LANES)
        for i in range(first, last):
            W[i] = 0.0
        for t in range(TEST_SAMPLES):
            for i in range(n_inputs):
                place = t + i * shift
                input_now = max_input[i] * TEST_INPUT[place % TEST_SAMPLES]
                input_before = max_input[i] * TEST_INPUT[(place - 1) % TEST_SAMPLES] if t > 0 else 0.0
                input_before_last = max_input[i] * TEST_INPUT[(place - 2) % TEST_SAMPLES] if t > 1 else 0.0
                for j in range(LANES):
                    feed_input(W, j, i, input_now, input_before, input_before_last)
            if is_continuous:
                for s in range(substeps):
                    step_believed(W, s / substeps)
                    step_true(W, s / substeps)
            else:
                step_believed(W)
                step_true(W)
            add_difference(W)
        finish_misfit(W)
        for k in range(len(inputs)):
            copy_range(W, inputs[k], saved_inputs, k * LANES, LANES)

    @jit_closure(spec.name)
    def start_simulation_error(W, j, params):
        """Write the misfit of lane j alone: the other lanes keep theirs."""
        saved_rewards, saved_misfits = np.empty(LANES), np.empty(LANES)
        copy_range(saved_rewards, 0, W, reward_row, LANES)
        copy_range(saved_misfits, 0, W, misfit_row, LANES)
        run_free_simulation(W, params.max_input)
        saved_misfits[j] = W[misfit_row + j]
        copy_range(W, reward_row, saved_rewards, 0, LANES)
        copy_range(W, misfit_row, saved_misfits, 0, LANES)

    @jit_closure(spec.name)
    def update_simulation_error(W, params):
        run_free_simulation(W, params.max_input)

    return RewardHooks(start_simulation_error, no_hook, no_hook, update_simulation_error)
