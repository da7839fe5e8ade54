"""The reward ``fisher``: what the outputs say of the coefficients to one who knows the truth.

The covariance recursion of the structured update, linearised not at the belief but at the true plant, where it truly
is, and with the true noises: its covariance of the coefficients is (Λ0 + F)⁻¹ with Λ0 the prior's precision and F the
Fisher information of the outputs so far. The recursion needs no output, so no estimator can talk it into anything.
"""

from __future__ import annotations

from typing import Any

from duffing_env.layout import Kind, layout_of
from duffing_env.rewards import Hooks, nothing
from estimator.engine.tasks import belief_names
from estimator.lanes import LANES, jit


def source(kind: Kind, loop: Any) -> str:
    """``ideal_begin``, ``ideal_move`` and ``ideal_finish``: an imagined sample at the truth."""
    import sympy as sp

    from duffing_env.sources import log_det_and_density
    from estimator.engine import algebra, derive

    model, symbol = kind.belief, derive.symbol
    true = {**{x: f"X_{x}" for x in model.states}, **{c: f"TRUE_{c}" for c in model.coefficients}}
    true |= {name: f"I_{name}" for name in belief_names(model) if name.startswith("P_")}
    text = ""
    if model.is_continuous:
        start = [(f"V_{name}", value) for name, value in derive.carried_at_start(model).items()]
        start = derive.renamed(start, true)
        text += loop("ideal_begin", "At the truth.", start, {name: f"V_{name}" for name in derive.carried(model)})
        moved = {name: f"{name}_E" for name in derive.carried(model)}
        step = derive.renamed(derive.motion_step(model, kind.degree), true)
        text += loop("ideal_move", "One Runge-Kutta step.", step, moved, "T")
        lines: Any = []
        motion = derive.carried_at_end(model)
    else:
        lines, motion = derive.difference_step(model)
    more, results = algebra.expected_sample(model, motion, kind.degree)
    before, now, _, _ = log_det_and_density(model, tag="B")
    covariances = {name: symbol(value) for name, value in results.items() if name.startswith("P_")}
    after, then, _, _ = log_det_and_density(model, entries=covariances, tag="A")
    log = sp.Function("log")
    lines = derive.renamed([*lines, *more, *before, *after, ("GAINED", (log(now) - log(then)) / 2)], true)
    kept = {f"I_{name}": derive.renamed([("", value)], true)[0][1] for name, value in covariances.items()}
    noises = ("Q", *(f"R_{y}" for y in model.outputs))
    kept_names = {row: str(value) for row, value in kept.items()}
    return text + loop(
        "ideal_finish", "Its covariance, and what is gained.", lines, {**kept_names, "WORK": "GAINED"}, *noises
    )


def hooks(kind: Kind, code: Any) -> Hooks:
    """It starts from the prior, and counts a sample before the plant moves."""
    place, model = layout_of(kind), kind.belief
    names = belief_names(model)
    covariances = tuple((names.index(name), place[f"I_{name}"] * LANES) for name in names if name.startswith("P_"))
    finish, steps = code.ideal_finish, model.substeps
    elapsed = place["ELAPSED"] * LANES
    if model.n_outputs > 1:
        raise ValueError(f"reward 'fisher' is for one sensor, but {model.name!r} has {model.n_outputs}")

    @jit
    def begin(W, j, setup):
        if W[elapsed + j] == 0.0:  # a truth that changes in an episode does not take back what was known
            for index, row in covariances:
                W[row + j] = setup.prior[index]

    if model.is_continuous:
        start, move = code.ideal_begin, code.ideal_move

        @jit
        def before(W, setup):
            start(W)
            for s in range(steps):
                move(W, s / steps)
            finish(W, setup.process_noise**2, setup.measurement_noise[0] ** 2)

        return Hooks(begin, before, nothing, nothing)

    @jit
    def before_difference(W, setup):
        finish(W, setup.process_noise**2, setup.measurement_noise[0] ** 2)

    return Hooks(begin, before_difference, nothing, nothing)
