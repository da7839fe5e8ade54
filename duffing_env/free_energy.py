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
    """It reads what the update leaves."""
    free_energy, work = free_energy_of(kind), layout_of(kind)["WORK"] * LANES

    @jit
    def after(W, setup):
        for j in range(LANES):
            W[work + j] = -free_energy(W, j)

    return Hooks(nothing_in_lane, nothing, nothing, after)
