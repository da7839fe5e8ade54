"""The reward ``expected_free_energy``: what a sample teaches as it is expected, before its outcome is seen.

The belief before the sample, with the input that is chosen, predicts the outputs. Conditioning on them shrinks the
coefficients' covariance from C to C', whatever they turn out to be, to first order:

    I = ½ log det C - ½ log det C'    [nats],

which is what the expected free energy counts as epistemic: the mutual information of outputs and coefficients. The
prediction is the structured one for every belief; of a mean-field one the covariances between its factors are zero.
"""

from __future__ import annotations

from typing import Any

from duffing_env.layout import Kind
from duffing_env.rewards import Hooks, nothing, nothing_in_lane
from estimator.lanes import jit


def source(kind: Kind, loop: Any) -> str:
    """``expect_begin``, ``expect_move`` and ``expect_finish``: an imagined sample at the belief."""
    import sympy as sp

    from duffing_env.sources import log_det_and_density
    from estimator.engine import algebra, derive

    model, symbol = kind.belief, derive.symbol
    text = ""
    if model.is_continuous:
        start = [(f"V_{name}", value) for name, value in derive.carried_at_start(model).items()]
        text += loop("expect_begin", "At the mean.", start, {name: f"V_{name}" for name in derive.carried(model)})
        moved = {name: f"{name}_E" for name in derive.carried(model)}
        text += loop("expect_move", "One Runge-Kutta step.", derive.motion_step(model, kind.degree), moved, "T")
        lines: Any = []
        motion = derive.carried_at_end(model)
    else:
        lines, motion = derive.difference_step(model)
    more, results = algebra.expected_sample(model, motion, kind.degree)
    noises = {"Q": symbol("GAMMA_RATE") / symbol("GAMMA_SHAPE")}
    noises |= {f"R_{y}": symbol(f"XI_RATE_{y}") / symbol(f"XI_SHAPE_{y}") for y in model.outputs}
    # γ counts the noise as the first sensor shows that of one sample; N is of unit strength.
    lines = derive.renamed([*lines, *more], noises)
    log = sp.Function("log")
    before, now, _, _ = log_det_and_density(model, tag="B")
    covariances = {name: symbol(value) for name, value in results.items() if name.startswith("P_")}
    after, then, _, _ = log_det_and_density(model, entries=covariances, tag="A")
    lines += [*before, *after, ("GAINED", (log(now) - log(then)) / 2)]
    return text + loop("expect_finish", "What is expected to be learned.", lines, {"WORK": "GAINED"})


def hooks(kind: Kind, code: Any) -> Hooks:
    """It expects before the belief is updated."""
    finish = code.expect_finish
    if not kind.belief.is_continuous:

        @jit
        def expect(W, setup):
            finish(W)

        return Hooks(nothing_in_lane, nothing, expect, nothing)

    begin, move, steps = code.expect_begin, code.expect_move, kind.belief.substeps

    @jit
    def expect_continuous(W, setup):
        begin(W)
        for s in range(steps):
            move(W, s / steps)
        finish(W)

    return Hooks(nothing_in_lane, nothing, expect_continuous, nothing)
