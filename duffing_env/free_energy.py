"""The reward ``free_energy``: minus the free energy of the sample, which the update leaves."""

from __future__ import annotations

from typing import Any

import numpy as np

from duffing_env.layout import Kind, layout_of
from duffing_env.rewards import Hooks, nothing, nothing_in_lane
from estimator.engine.free_energy import free_energies
from estimator.inference import mean_field
from estimator.lanes import LANES, part


def source(kind: Kind, loop: Any) -> str:
    """Nothing of its own: the update leaves what it needs."""
    return ""


def hooks(kind: Kind, code: Any) -> Hooks:
    """It reads what the update leaves."""
    free_energy, work = _free_energy_of(kind), layout_of(kind)["WORK"] * LANES

    @part(kind.name)
    def after(W, setup):
        for j in range(LANES):
            W[work + j] = -free_energy(W, j)

    return Hooks(nothing_in_lane, nothing, nothing, after)


def _free_energy_of(kind: Kind) -> Any:
    """``free_energy(W, j)``: what the last update left lane j with [nats]."""
    place = layout_of(kind)
    if kind.factorisation == "mean_field":
        return mean_field.pieces(place).free_energy
    if kind.weighs:
        told = place["FREE_ENERGY"] * LANES

        @part(kind.name)
        def of_the_mixture(W, j):
            return W[told + j]

        return of_the_mixture
    traced, last = free_energies(kind.belief, kind.iterations, LANES, place), kind.iterations - 1

    @part(kind.name)
    def free_energy(W, j):
        after = np.empty(last + 1)
        traced(W, j, after)
        return after[last]

    return free_energy
