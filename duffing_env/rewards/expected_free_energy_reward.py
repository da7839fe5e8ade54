"""The reward ``expected_free_energy``: expected information gain of a sample, before its outcome.

The belief before the sample predicts the outputs for the chosen input. To first order, conditioning on the outputs
shrinks the coefficients' covariance from C to C', whatever their values:

    I = ½ log det C - ½ log det C'    [nats],

the epistemic term of the expected free energy: the mutual information of outputs and coefficients. The prediction is
the structured one for every belief; in a mean-field belief the covariances between its factors are zero.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from duffing_env.rewards.log_determinant import log_det_and_density
from duffing_env.rewards.reward_hooks import RewardHooks, no_hook, no_lane_hook
from duffing_env.storage.kernel_spec import KernelSpec
from estimator.compilation.simd import jit_closure
from estimator.engine.storage_layout import integrator_rows


def hook_source(spec: KernelSpec, loop: Any) -> str:
    """``expect_sample(W)``: the expected information of the next sample, linearised at the belief."""
    from estimator.engine.symbolic import symbol

    # γ is the precision of one sample's process noise in the first sensor; the model's noise has unit strength.
    noises = {"PROCESS_VARIANCE": symbol("GAMMA_RATE") / symbol("GAMMA_SHAPE")}
    noises |= {f"R_{y}": symbol(f"XI_RATE_{y}") / symbol(f"XI_SHAPE_{y}") for y in spec.belief_model.outputs}
    return expected_sample_source("expect_sample", spec, loop, noises)


def expected_sample_source(
    name: str,
    spec: KernelSpec,
    loop: Any,
    substitutions: Mapping[str, Any],
    first_assignments: Sequence[tuple[str, Any]] = (),
    keeps_covariance: bool = False,
) -> str:
    """Source of ``name(W)``, which leaves ½ log det C - ½ log det C' of a sample in ``HOOK_REWARD`` [nats].

    Args:
        name: name of the function.
        spec: kind of experiment with the believed model.
        loop: loop printer of `duffing_env.kernel_stages.generated_environment_functions`.
        substitutions: quantity of the model to the row or expression in its place.
        first_assignments: assignments that come first.
        keeps_covariance: whether the covariance afterwards is kept, in the rows of ``substitutions``.
    """
    import sympy as sp

    from estimator.engine import gaussian_update, symbolic, variational_rk4

    model, source, body = spec.belief_model, "", ""
    lines, motion = symbolic.propagate_sample(model)
    if model.is_continuous:
        carried = integrator_rows(model)
        start = [(f"V_{row}", value) for row, value in symbolic.integrator_start(model).items()]
        source += loop(
            f"{name}_begin",
            "The point that moves.",
            symbolic.substitute(start, substitutions),
            {row: f"V_{row}" for row in carried},
        )
        step = symbolic.substitute(variational_rk4.variational_rk4_step(model, spec.degree), substitutions)
        source += loop(f"{name}_move", "One Runge-Kutta step.", step, {row: f"{row}_END" for row in carried}, "TAU")
        steps = model.substeps
        body = f"    {name}_begin(W)\n    for s in range({steps}):\n        {name}_move(W, s / {steps})\n"
    update_lines, results = gaussian_update.update_without_data(model, motion, spec.degree)
    log, covariances = sp.Function("log"), [row for row in results if row.startswith("P_")]
    lines_before, det_before, _, _ = log_det_and_density(model, prefix="B")
    entries = {row: symbolic.symbol(results[row]) for row in covariances}
    lines_after, det_after, _, _ = log_det_and_density(model, covariance_entries=entries, prefix="A")
    lines = symbolic.substitute(
        [
            *first_assignments,
            *lines,
            *update_lines,
            *lines_before,
            *lines_after,
            ("GAINED", (log(det_before) - log(det_after)) / 2),
        ],
        substitutions,
    )
    kept_rows = (
        {substitutions[row]: str(symbolic.substitute([("", entries[row])], substitutions)[0][1]) for row in covariances}
        if keeps_covariance
        else {}
    )
    source += loop(
        f"{name}_finish", "Its covariance, and what is gained.", lines, {**kept_rows, "HOOK_REWARD": "GAINED"}
    )
    return source + f"@scalar_jit\ndef {name}(W):\n{body}    {name}_finish(W)\n"


def compile_hooks(spec: KernelSpec, generated: Any) -> RewardHooks:
    """A hook that computes the expected information before the belief update."""
    expect_sample = generated.expect_sample

    @jit_closure(spec.name)
    def before_update(W, params):
        expect_sample(W)

    return RewardHooks(no_lane_hook, no_hook, before_update, no_hook)
