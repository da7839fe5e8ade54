"""The closed loop: 256 samples chosen through ``Rig-v0`` around the adaptive integrator, by prbs and by the planner."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from benchmarks.rigs.accuracy import percents
from benchmarks.rigs.catalogue import BENCHES, PARAMETERS, Bench
from benchmarks.rigs.judge import LEVEL, POOLED, binomial_interval, calibrated, in_processes
from benchmarks.rigs.records import generator, guess
from benchmarks.rigs.simulator import KINDS, simulate

POLICIES = ("prbs", "efe")

#: Share of runs that may leave the range, of which the upper end of the 95 % interval must stay below.
ASKED = 0.05

Task = tuple[str, str, int]


class BenchPlant:
    """A bench as a plant of ``Rig-v0``: the input is held over each sample, and the force is disturbed.

    Args:
        bench: which.
        seed: of its noises.
    """

    def __init__(self, bench: Bench, seed: int) -> None:
        self._bench, self._parameters = bench, np.array([*bench.truth, bench.quintic])
        self._rng = generator(bench, seed, "noise")
        self.reset()

    def reset(self) -> None:
        """To rest, without input."""
        self._state = np.array([self._bench.rest, 0.0])

    def step(self, u: float) -> float:
        """Hold an input for a sample; what the sensor shows at its end."""
        bench = self._bench
        force = np.array([u + bench.process_noise * self._rng.standard_normal()])
        states, ends = simulate(self._parameters, force, np.zeros(1), self._state, bench.step, bench.scale)
        self._state = states[1]
        place = KINDS.index(bench.kind)
        shown = ends[1] if place == 2 else states[1, place]
        return float(shown + bench.offset + bench.sensor_noise * self._rng.standard_normal())


@dataclass(frozen=True)
class Run:
    """What a policy made of one run.

    Attributes:
        gain: information about the coefficients that the posterior has gained [nats].
        inside: (4,) whether the 90 % intervals of m, c, a and b hold the truth.
        error: (4,) of the estimates, relative.
        left: whether the output left its range, or the numbers ran away.
    """

    gain: float
    inside: list[bool]
    error: list[float]
    left: bool


def trial(task: Task) -> Run:
    """Play 256 samples on a rig by a policy."""
    import gymnasium as gym

    import duffing_env  # noqa: F401  registers the tracks
    from agents import make_policy
    from estimator import Channel, Rig

    name, policy, seed = task
    bench = replace(BENCHES[name], decimate=1, interpolation="zero_order")
    rig = Rig(
        bench.step, input=Channel(bench.units[0], limit=bench.limit),
        output=Channel(bench.units[1], kind=bench.kind, range=bench.output_range), guess=guess(bench, seed),
    )  # fmt: skip
    # The signal is scaled so that it stays in the range; the planner is left to its own judgement.
    largest = bench.amplitude / bench.limit if policy != "efe" else 1.0
    env = gym.make("duffing_env/Rig-v0", rig=rig, plant=BenchPlant(bench, seed), horizon=256, max_input=largest)
    player = make_policy(policy, env, seed=seed)
    observation, _ = env.reset(seed=seed)
    prior, state, begins, done = env.unwrapped.belief, None, np.ones(1, dtype=bool), False
    while not done:
        action, state = player.predict(observation, state=state, episode_start=begins, deterministic=True)
        begins = np.zeros(1, dtype=bool)
        observation, _, terminated, truncated, info = env.step(action)
        done = terminated or truncated
    belief, truth = info["belief"], np.array(bench.truth)
    mean, std = np.array([belief.parameters()[p][:2] for p in PARAMETERS]).T
    from scipy.stats import norm

    half = norm.ppf(0.5 + LEVEL / 2) * std
    return Run(
        prior.entropy() - belief.entropy(), (np.abs(mean - truth) <= half).tolist(), (mean / truth - 1).tolist(),
        bool(terminated),
    )  # fmt: skip


def run(names: Sequence[str], seeds: int, workers: int) -> dict[tuple[str, str], list[Run]]:
    """Runs by rig and policy."""
    tasks = [(name, policy, seed) for name in names for policy in POLICIES for seed in range(seeds)]
    runs = in_processes(trial, tasks, workers, "Playing")
    return {(name, policy): [runs[name, policy, s] for s in range(seeds)] for name in names for policy in POLICIES}


def show(runs: dict[tuple[str, str], list[Run]]) -> dict[str, Any]:
    """Print the table and the verdict; return it for the JSON file."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    console = Console(width=150)
    table = Table("rig", "policy", "gained, nats", "median error of m, c, a, b, %", "coverage of 90 %",
                  "left its range", box=box.MARKDOWN)  # fmt: skip
    hits, trials, kept, ahead = [], [], [], []
    for (name, policy), found in runs.items():
        number = len(found)
        inside = np.sum([one.inside for one in found], axis=0).tolist()
        gains = np.array([one.gain for one in found])
        left = sum(one.left for one in found)
        hits += inside
        trials += [number] * len(inside)
        table.add_row(
            name, policy, f"{gains.mean():.2f} ± {1.96 * gains.std(ddof=1) / np.sqrt(number):.2f}",
            percents(np.median(np.abs([one.error for one in found]), axis=0)),
            ", ".join(f"{count / number:.2f}" for count in inside), f"{left} of {number}",
        )  # fmt: skip
        if policy == "efe":
            # One-sided: the upper end of the central 90 % interval.
            kept.append(binomial_interval(left, number, 0.9)[1] < ASKED)
            ahead.append(gains.mean() > np.mean([one.gain for one in runs[name, "prbs"]]))
    console.print(table)
    pooled, meets = calibrated(hits, trials)
    verdict = {
        "calibrated": POOLED[0] <= pooled <= POOLED[1] and all(meets),
        "pooled coverage": pooled,
        "cells outside": len(meets) - sum(meets),
        "efe ahead on": sum(ahead),
        "efe within its limits on": sum(kept),
        "rigs": len(ahead),
    }
    console.print(verdict)
    return verdict
