"""The reward ``expected_free_energy``: what a sample teaches as it is expected, before its outcome is seen.

The belief before the sample, with the input that is chosen, predicts the outputs. Conditioning on them shrinks the
coefficients' covariance from C to C', whatever they turn out to be, to first order:

    I = ½ log det C - ½ log det C'    [nats],

which is what the expected free energy counts as epistemic: the mutual information of outputs and coefficients. The
prediction is the structured one for every belief; of a mean-field one the covariances between its factors are zero.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from duffing_env.layout import Kind
from duffing_env.rewards import Hooks, nothing, nothing_in_lane
from estimator.engine.rows import carried_names
from estimator.lanes import part


def source(kind: Kind, loop: Any) -> str:
    """``expect(W)``: an imagined sample at the belief."""
    from estimator.engine.derive import symbol

    # γ counts the noise as the first sensor shows that of one sample; N is of unit strength.
    noises = {"Q": symbol("GAMMA_RATE") / symbol("GAMMA_SHAPE")}
    noises |= {f"R_{y}": symbol(f"XI_RATE_{y}") / symbol(f"XI_SHAPE_{y}") for y in kind.belief.outputs}
    return imagined_sample("expect", kind, loop, noises)


def imagined_sample(
    name: str, kind: Kind, loop: Any, at: Mapping[str, Any], given: Sequence[tuple[str, Any]] = (), keeps: bool = False
) -> str:
    """Source of ``name(W)``: outputs as expected; leaves ½ log det C - ½ log det C' in ``WORK`` [nats].

    Args:
        name: of the function.
        kind: whose model is believed.
        loop: as `duffing_env.sources` makes it.
        at: quantity of the model to what stands in its place: another row, or an expression.
        given: assignments that come first.
        keeps: whether the covariance afterwards is kept, in the rows of ``at``.
    """
    import sympy as sp

    from duffing_env.sources import log_det_and_density
    from estimator.engine import algebra, derive, sensitivity

    model, text, body = kind.belief, "", ""
    lines, motion = derive.moved(model)
    if model.is_continuous:
        carried = carried_names(model)
        start = [(f"V_{row}", value) for row, value in derive.carried_at_start(model).items()]
        text += loop(
            f"{name}_begin", "The point that moves.", derive.renamed(start, at), {row: f"V_{row}" for row in carried}
        )
        step = derive.renamed(sensitivity.motion_step(model, kind.degree), at)
        text += loop(f"{name}_move", "One Runge-Kutta step.", step, {row: f"{row}_E" for row in carried}, "T")
        steps = model.substeps
        body = f"    {name}_begin(W)\n    for s in range({steps}):\n        {name}_move(W, s / {steps})\n"
    more, results = algebra.expected_sample(model, motion, kind.degree)
    log, covariances = sp.Function("log"), [row for row in results if row.startswith("P_")]
    before, now, _, _ = log_det_and_density(model, tag="B")
    entries = {row: derive.symbol(results[row]) for row in covariances}
    after, then, _, _ = log_det_and_density(model, entries=entries, tag="A")
    lines = derive.renamed([*given, *lines, *more, *before, *after, ("GAINED", (log(now) - log(then)) / 2)], at)
    kept = {at[row]: str(derive.renamed([("", entries[row])], at)[0][1]) for row in covariances} if keeps else {}
    text += loop(f"{name}_finish", "Its covariance, and what is gained.", lines, {**kept, "WORK": "GAINED"})
    return text + f"@straight\ndef {name}(W):\n{body}    {name}_finish(W)\n"


def hooks(kind: Kind, code: Any) -> Hooks:
    """It expects before the belief is updated."""
    expect = code.expect

    @part(kind.name)
    def before_the_update(W, setup):
        expect(W)

    return Hooks(nothing_in_lane, nothing, before_the_update, nothing)
