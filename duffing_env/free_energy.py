"""The reward ``free_energy``: minus the free energy of the sample, which the update leaves."""

from __future__ import annotations

from typing import Any

import numpy as np

from duffing_env.layout import Kind, layout_of
from duffing_env.rewards import Hooks, nothing, nothing_in_lane
from estimator.arrays import copy
from estimator.engine.free_energy import free_energies
from estimator.inference import mean_field
from estimator.lanes import LANES, part


def source(kind: Kind, loop: Any) -> str:
    """Nothing of its own: the update leaves what it needs."""
    return ""


def hooks(kind: Kind, code: Any) -> Hooks:
    """It reads what the update leaves."""
    find, work = _free_energies_of(kind), layout_of(kind)["WORK"] * LANES

    @part(kind.name)
    def after(W, setup):
        found = np.empty(LANES)
        find(W, found)
        for j in range(LANES):
            W[work + j] = -found[j]

    return Hooks(nothing_in_lane, nothing, nothing, after)


def _free_energies_of(kind: Kind) -> Any:
    """``find(W, found)``: what the last update left every lane with [nats]."""
    place = layout_of(kind)
    if kind.weighs:
        told = place["FREE_ENERGY"] * LANES

        @part(kind.name)
        def of_the_mixture(W, found):
            copy(found, 0, W[told:], LANES)

        return of_the_mixture
    if kind.factorisation == "mean_field":
        free_energy = mean_field.pieces(place).free_energy

        @part(kind.name)
        def of_mean_field(W, found):
            for j in range(LANES):
                found[j] = free_energy(W, j)

        return of_mean_field
    return free_energies(kind.belief, kind.iterations, LANES, place, every=False)
