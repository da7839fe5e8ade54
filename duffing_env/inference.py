"""The belief update within an environment's block: structured for any model, or the paper's mean field."""

from __future__ import annotations

from itertools import combinations_with_replacement
from typing import Any

import numpy as np

from duffing_env.layout import Kind, layout_of
from estimator.engine.free_energy import free_energies
from estimator.engine.tasks import structured
from estimator.inference import mean_field
from estimator.lanes import LANES, at_lane, jit, relaid
from estimator.record import MEAN_FIELD_SCRATCH

#: Old name of a quantity of the paper's belief to its name in a block.
_PAPER = {"x0": "x1", "x1": "x2", "t1": "theta1", "t2": "theta2", "t3": "theta3", "e": "eta"}


def updater(kind: Kind) -> Any:
    """Update every lane's belief, with its input and outputs in their rows.

    ``update(W)``, or of mean field ``update(W, iterations, as_published)``.
    """
    if kind.factorisation == "mean_field":
        return _mean_field(kind)
    return structured(
        kind.belief, kind.degree, iterations=kind.iterations, within=layout_of(kind), trace=kind.work == "free_energy"
    ).update


def free_energy_of(kind: Kind) -> Any:
    """``free_energy(W, j)``: what the last update left lane j with [nats]."""
    place = layout_of(kind)
    if kind.factorisation == "mean_field":
        function, _, outputs, uniform = mean_field.free_energy.declaration
        return at_lane(paper_layout(kind), outputs, uniform)(function)
    traced, last = free_energies(kind.belief, kind.iterations, LANES, place), kind.iterations - 1

    @jit
    def free_energy(W, j):
        after = np.empty(last + 1)
        traced(W, j, after)
        return after[last]

    return free_energy


def paper_layout(kind: Kind) -> dict[str, int]:
    """The rows of mean field's own names; those of a θ2 that the model does not have hold zeros."""
    place = layout_of(kind)
    layout = {old: place[new] if new in place else place["MF_theta2"] for old, new in _PAPER.items()}
    for first, second in combinations_with_replacement(_PAPER, 2):
        name = f"P_{_PAPER[first]}_{_PAPER[second]}"
        layout[f"P_{first}_{second}"] = place[name] if name in place else place[f"MF_{name}"]
    layout |= {"x2": place["MF_x2"], "u": place["U_0"], "y": place["Y_y"]}
    layout |= {"g_shape": place["GAMMA_SHAPE"], "g_rate": place["GAMMA_RATE"]}
    layout |= {"n_shape": place["XI_SHAPE_y"], "n_rate": place["XI_RATE_y"]}
    return layout | {name: place[f"MF_{name}"] for name in (*MEAN_FIELD_SCRATCH, "prior_g_rate", "prior_n_rate")}


def _mean_field(kind: Kind) -> Any:
    layout = paper_layout(kind)
    begin, iterate, end = (relaid(f, layout) for f in (mean_field.begin, mean_field.iterate, mean_field.end))

    @jit
    def update(W, iterations, as_published):
        begin(W)
        for _ in range(iterations):
            iterate(W, as_published)
        end(W)

    return update
