"""Information gain of policies for any oscillator, relative to the planner, on six rigs that no network was trained on.

The rigs are random, and older than `ppo/universal`. Each episode is 256 samples on the simulated twin, ``Rig-v0``, with
unknown noises.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from agents import console_output
from agents.training.environments.oscillator_family import FamilyMember
from estimator.rigs.channel import Channel
from estimator.rigs.rig import Rig
from research.studies.unseen_oscillators import PLANNER, play_episode

#: Name to rig.
UNSEEN_RIGS = {
    "softening": Rig(
        1e-3, input=Channel("N", limit=27.0, noise=0.11), output=Channel("m", range=0.00268, noise=3.04e-6),
        guess={"m": (0.277, 0.515), "c": (7.79, 14.5), "a": (51300.0, 95200.0), "b": (-1.97e9, -1.06e9)},
    ),
    "two wells": Rig(
        2e-3, input=Channel("N", limit=97.7, noise=1.82), output=Channel("m", range=0.0163, noise=4.28e-5),
        guess={"m": (0.46, 0.853), "c": (4.45, 8.27), "a": (-35800.0, -19300.0), "b": (2.26e8, 4.2e8)},
    ),
    "velocity": Rig(
        1e-3, input=Channel("N", limit=163.0, noise=0.659),
        output=Channel("m/s", range=2.2, noise=0.00475, kind="velocity"),
        guess={"m": (0.358, 0.665), "c": (5.57, 10.4), "a": (76000.0, 141000.0), "b": (2.8e9, 5.19e9)},
    ),
    "5 kHz": Rig(
        2e-4, input=Channel("N", limit=15.6, noise=0.0662), output=Channel("m", range=7.16e-4, noise=2.59e-6),
        guess={"m": (0.0176, 0.0326), "c": (3.94, 7.32), "a": (55000.0, 102000.0), "b": (1.43e11, 2.66e11)},
    ),
    "30 Hz": Rig(
        1 / 30, input=Channel("N", limit=30.1, noise=0.323), output=Channel("m", range=0.0312, noise=1.76e-5),
        guess={"m": (3.4, 6.32), "c": (3.47, 6.45), "a": (1390.0, 2580.0), "b": (2.38e6, 4.43e6)},
    ),
    "micrometres": Rig(
        5e-4, input=Channel("mN", limit=78.7, noise=0.223), output=Channel("µm", range=41.4, noise=0.125),
        guess={"m": (1.76e-6, 3.28e-6), "c": (1.4e-4, 2.6e-4), "a": (1.53, 2.83), "b": (7.84e-4, 1.46e-3)},
    ),
}  # fmt: skip

#: Number of coefficients of the belief: m, c, a, b, and the offsets of input and output.
_N_COEFFICIENTS = 6


def run_episodes(names: Sequence[str], policies: Sequence[str], seeds: int) -> dict[str, dict[str, list[float]]]:
    """Information gain of each episode [nats], by rig and policy, with the planner first."""
    information_gain: dict[str, dict[str, list[float]]] = {}
    for name in names:
        member = FamilyMember(name, 0.0, 0.0, 0.0, {"rig": UNSEEN_RIGS[name], "horizon": 256})
        for policy in (PLANNER, *policies):
            episodes = [play_episode(member, policy, seed)[0] for seed in range(seeds)]
            information_gain.setdefault(name, {})[policy] = episodes
    return information_gain


def print_report(information_gain: dict[str, dict[str, list[float]]]) -> dict[str, Any]:
    """Print the table; return the D-efficiency exp(2 Δ / K) relative to the planner, by rig and policy."""
    d_efficiency: dict[str, Any] = {}
    rows = []
    for name, found in information_gain.items():
        best = np.mean(found[PLANNER])
        d_efficiency[name] = {p: float(np.exp(2 * (np.mean(g) - best) / _N_COEFFICIENTS)) for p, g in found.items()}
        rows.append(
            [name, f"{best:.2f}", *(f"{np.mean(found[p]):.2f} ({d_efficiency[name][p]:.2f})" for p in list(found)[1:])]
        )
    policies = list(next(iter(information_gain.values())))[1:]
    console_output.print_texts_and_tables(
        "nats, and in brackets the D-efficiency relative to efe",
        console_output.format_table(("rig", PLANNER, *policies), rows, markdown=True),
    )
    return d_efficiency
