"""The reward ``free_energy``: minus the free energy of the sample, which the update leaves."""

from __future__ import annotations

from typing import Any

from duffing_env.inference import free_energy_of
from duffing_env.layout import Kind, layout_of
from duffing_env.rewards import Hooks, nothing, nothing_in_lane
from estimator.lanes import LANES, jit


def source(kind: Kind, loop: Any) -> str:
    """Nothing of its own: the update leaves what it needs."""
    return ""


def hooks(kind: Kind, code: Any) -> Hooks:
    """It keeps the noises' rates before the update, and reads the update's trace."""
    free_energy, place = free_energy_of(kind), layout_of(kind)
    work, sensor = place["WORK"] * LANES, next(iter(kind.belief.outputs))
    structured = kind.factorisation == "structured"
    rates = (place["GAMMA_RATE"] * LANES, place[f"XI_RATE_{sensor}"] * LANES)
    kept = tuple(place[f"PRIOR_RATE_{n}"] * LANES for n in "gn") if structured else rates

    @jit
    def expect(W, setup):
        for j in range(LANES):
            W[kept[0] + j] = W[rates[0] + j]
            W[kept[1] + j] = W[rates[1] + j]

    @jit
    def after(W, setup):
        for j in range(LANES):
            W[work + j] = -free_energy(W, j)

    return Hooks(nothing_in_lane, nothing, expect, after)
