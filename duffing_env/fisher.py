"""The reward ``fisher``: what the outputs say of the coefficients to one who knows the truth.

The covariance recursion of the structured update, linearised not at the belief but at the true plant, where it truly
is, and with the true noises: its covariance of the coefficients is (Λ0 + F)⁻¹ with Λ0 the prior's precision and F the
Fisher information of the outputs so far. The recursion needs no output, so no estimator can talk it into anything.
"""

from __future__ import annotations

from typing import Any

from duffing_env.expectation import imagined_sample
from duffing_env.layout import Kind, layout_of, noise_rows
from duffing_env.rewards import Hooks, nothing
from estimator.engine.rows import belief_names
from estimator.lanes import LANES, part


def source(kind: Kind, loop: Any) -> str:
    """``ideal(W)``: an imagined sample at the truth."""
    from estimator.engine.derive import symbol

    model = kind.belief
    true = {**{x: f"X_{x}" for x in model.states}, **{c: f"TRUE_{c}" for c in model.coefficients}}
    true |= {name: f"I_{name}" for name in belief_names(model) if name.startswith("P_")}
    names, stds = ["Q", *(f"R_{y}" for y in model.outputs)], noise_rows(kind.truth).values()
    noises = [(name, symbol(std) ** 2) for name, std in zip(names, stds, strict=True)]
    return imagined_sample("ideal", kind, loop, true, noises, keeps=True)


def hooks(kind: Kind, code: Any) -> Hooks:
    """It starts from the prior, and counts a sample before the plant moves."""
    place, model, ideal = layout_of(kind), kind.belief, code.ideal
    names = belief_names(model)
    covariances = tuple((names.index(name), place[f"I_{name}"] * LANES) for name in names if name.startswith("P_"))
    elapsed = place["ELAPSED"] * LANES
    if model.n_outputs > 1:
        raise ValueError(f"reward 'fisher' is for one sensor, but {model.name!r} has {model.n_outputs}")

    @part(kind.name)
    def begin(W, j, setup):
        if W[elapsed + j] == 0.0:  # a truth that changes in an episode does not take back what was known
            for index, row in covariances:
                W[row + j] = setup.prior[index]

    @part(kind.name)
    def before(W, setup):
        ideal(W)

    return Hooks(begin, before, nothing, nothing)
