"""Closed-loop benchmark: 256 samples on a simulated bench, by signals and the planner, by samples and in blocks."""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pprint import pprint
from typing import Any

import numpy as np

from agents import console_output
from benchmarks.rigs.bench_catalogue import BENCHES, PARAMETERS, Bench
from benchmarks.rigs.calibration import (
    INTERVAL_PROBABILITY,
    binomial_interval,
    compare_to_truth,
    judge_coverage,
    run_in_processes,
)
from benchmarks.rigs.dop853_simulator import SENSOR_KINDS, FloatArray, simulate
from benchmarks.rigs.rig_accuracy import format_percents
from benchmarks.rigs.simulated_records import draw_guess, rng_stream
from estimator.belief import Belief
from estimator.rigs.channel import Channel
from estimator.rigs.rig import Rig
from estimator.rigs.rig_prior import rig_prior

#: Policies that choose the inputs.
POLICIES = ("prbs", "efe")

#: Sample by sample through the environment, or in blocks as `duffing-env run` plays them.
PLAY_MODES = ("samples", "blocks")
#: Samples of a run.
N_SAMPLES = 256

#: Samples of a block.
BLOCK_SAMPLES = 64

#: Share of the runs that leave the range: the upper end of its 95 % interval, at most.
MAX_RANGE_EXIT_RATE = 0.05

#: Longest pause between two blocks, whose length is unknown [samples].
_MAX_PAUSE_SAMPLES = 200


class BenchPlant:
    """A bench as a plant: `reset` and `step` for ``Rig-v0``, the other methods for a run in blocks.

    The input is held over each sample, and the force has a disturbance.

    Args:
        bench: the bench.
        seed: of its noises.
    """

    has_watchdog = True

    def __init__(self, bench: Bench, seed: int) -> None:
        self._bench, self._rng = bench, rng_stream(bench, seed, "noise")
        self.reset()

    def reset(self) -> None:
        """Put the oscillator to rest, without input."""
        self._state, self._acceleration = np.array([self._bench.rest, 0.0]), 0.0

    def step(self, u: float) -> float:
        """Hold an input for a sample, and return the output at its end."""
        bench = self._bench
        force = np.array([u + bench.process_noise * self._rng.standard_normal()])
        states, ends = simulate(bench.parameters, force, np.zeros(1), self._state, bench.step, bench.scale)
        self._state, self._acceleration = states[1], ends[1]
        return self._sensor_output()

    def play(self, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Play inputs (N,) after a pause; return them, and the output at the begin of each."""
        for _ in range(1 + self._rng.integers(_MAX_PAUSE_SAMPLES)):
            self.step(0.0)
        shown = self._sensor_output()
        outputs = [shown, *(self.step(value) for value in u)]
        return u, np.array(outputs[:-1])

    def arm(self, watchdog: float | None) -> None:
        """Do nothing: every block ends without input."""

    def zero(self) -> None:
        """Do nothing: every block ends without input."""

    def disarm(self) -> None:
        """Do nothing: every block ends without input."""

    def apply(self, u: float) -> float:
        """Refuse single inputs: the plant plays blocks."""
        raise NotImplementedError

    def read(self) -> float:
        """Refuse single outputs: the plant plays blocks."""
        raise NotImplementedError

    def _sensor_output(self) -> float:
        """The present output, with offset and noise."""
        bench = self._bench
        clean = (*self._state, self._acceleration)[SENSOR_KINDS.index(bench.kind)]
        return float(clean + bench.offset + bench.sensor_noise * self._rng.standard_normal())


@dataclass(frozen=True)
class LoopOutcome:
    """The result of one closed-loop run.

    Attributes:
        gain: information about the coefficients that the posterior has gained [nats].
        inside: (4,) whether the 90 % intervals of m, c, a and b hold the truth.
        error: (4,) relative errors of the estimates.
        narrower: (4,) standard deviations before over standard deviations after.
        left: whether the output left its range, or the simulation diverged.
        refused: whether the run ended because no block was safe, not even without input.
    """

    gain: float
    inside: list[bool]
    error: list[float]
    narrower: list[float]
    left: bool
    refused: bool


def with_held_input(name: str) -> Bench:
    """A bench with a held input and without decimation."""
    return replace(BENCHES[name], decimate=1, interpolation="zero_order")


def rig_of_bench(bench: Bench, seed: int, with_noises: bool = False) -> Rig:
    """The rig of a bench with a held input, with a guess that is off, and with or without its noises."""
    return Rig(
        bench.step,
        input=Channel(bench.units[0], limit=bench.limit, noise=bench.process_noise if with_noises else None),
        output=Channel(bench.units[1], kind=bench.kind, range=bench.output_range,
                       noise=bench.sensor_noise if with_noises else None),
        guess=draw_guess(bench, seed),
    )  # fmt: skip


def run_trial(task: tuple[str, str, str, int]) -> LoopOutcome:
    """Play 256 samples on a bench by a policy; the task is bench, policy, mode and seed."""
    name, policy, mode, seed = task
    bench = with_held_input(name)
    rig = rig_of_bench(bench, seed)
    plant = BenchPlant(bench, seed)
    # A signal sample by sample is scaled to stay in the range; blocks, planner and networks find out themselves.
    max_input = 1.0 if policy.startswith(("efe", "ppo/")) else bench.amplitude / bench.limit
    play = _play_samples if mode == "samples" else _play_blocks
    belief, ended = play(rig, plant, policy, seed, max_input)
    prior = rig_prior(rig)
    error, std, inside = compare_to_truth(
        belief.parameters(), belief.interval(INTERVAL_PROBABILITY), np.array(bench.truth)
    )
    before = np.array([prior.parameters()[p][1] for p in PARAMETERS])
    return LoopOutcome(
        prior.entropy() - belief.entropy(), inside.tolist(), error.tolist(), (before / std).tolist(),
        ended == "range", ended == "design",
    )  # fmt: skip


def _play_samples(rig: Rig, plant: BenchPlant, policy: str, seed: int, max_input: float) -> tuple[Belief, str]:
    """Play sample by sample through ``Rig-v0``; return the belief at the end, and the reason of the end."""
    import gymnasium as gym

    import duffing_env  # noqa: F401  registers the tracks
    from agents import make_policy

    env = gym.make("duffing_env/Rig-v0", rig=rig, plant=plant, horizon=N_SAMPLES, max_input=max_input)
    player = make_policy(policy, env, seed=seed)
    observation, _ = env.reset(seed=seed)
    state, begins, done = None, np.ones(1, dtype=bool), False
    while not done:
        action, state = player.predict(observation, state=state, episode_start=begins, deterministic=True)
        begins = np.zeros(1, dtype=bool)
        observation, _, terminated, truncated, _ = env.step(action)
        done = terminated or truncated
    unwrapped: Any = env.unwrapped
    return unwrapped.belief, "range" if terminated else "complete"


def _play_blocks(rig: Rig, plant: BenchPlant, policy: str, seed: int, max_input: float) -> tuple[Belief, str]:
    """Play in blocks as ``duffing-env run`` does; each block has its share of the exit probability of a run."""
    from agents.hardware.clock import JumpingClock
    from agents.hardware.experiment_run import RunSettings, run_experiment

    plan = RunSettings(
        policy, N_SAMPLES, BLOCK_SAMPLES, bound=MAX_RANGE_EXIT_RATE * BLOCK_SAMPLES / N_SAMPLES, seed=seed
    )
    with tempfile.TemporaryDirectory() as folder:
        outcome = run_experiment(rig, plant, folder, plan, clock=JumpingClock())
    if outcome.outcome not in ("complete", "range", "design"):
        raise RuntimeError(f"a run in blocks ended: {outcome.message}")
    return outcome.belief, outcome.outcome


def run_trials(
    names: Sequence[str], policies: Sequence[str], modes: Sequence[str], seeds: int, workers: int
) -> dict[tuple[str, str, str], list[LoopOutcome]]:
    """Runs by bench, policy and mode."""
    return run_in_processes(run_trial, list(product(names, policies, modes)), seeds, workers, "Playing")


def print_report(runs: dict[tuple[str, str, str], list[LoopOutcome]]) -> dict[str, Any]:
    """Print the table and the verdicts by mode; return the verdicts for the JSON file."""
    rows = []
    for (name, policy, mode), found in runs.items():
        gains, number = np.array([one.gain for one in found]), len(found)
        rows.append((
            name, mode, policy, f"{gains.mean():.2f} ± {1.96 * gains.std(ddof=1) / np.sqrt(number):.2f}",
            format_percents(np.median(np.abs([one.error for one in found]), axis=0)),
            ", ".join(f"{share:.2f}" for share in np.mean([one.inside for one in found], axis=0)),
            ", ".join(f"{times:.3g}" for times in np.median([one.narrower for one in found], axis=0)),
            f"{sum(one.left for one in found)} of {number}", f"{sum(one.refused for one in found)} of {number}",
        ))  # fmt: skip
    titles = ("rig", "played by", "policy", "gained, nats", "median error of m, c, a, b, %", "coverage of 90 %",
              "times narrower", "left its range", "refused")  # fmt: skip
    console_output.print_texts_and_tables(console_output.format_table(titles, rows, markdown=True))
    verdicts = {way: judge_mode(runs, way) for way in dict.fromkeys(way for *_, way in runs)}
    pprint(verdicts, width=175)
    return verdicts


def judge_mode(runs: dict[tuple[str, str, str], list[LoopOutcome]], mode: str) -> dict[str, Any]:
    """Verdict of a mode: calibration of the intervals, information and range exits of the planner."""
    hits, trials, is_within_limits, is_efe_ahead = [], [], [], []
    for (name, policy, played_mode), found in runs.items():
        if played_mode != mode:
            continue
        hits += np.sum([one.inside for one in found], axis=0).tolist()
        trials += [len(found)] * len(PARAMETERS)
        if policy == "efe":
            # One-sided: the upper end of the central 90 % interval.
            is_within_limits.append(
                binomial_interval(sum(one.left for one in found), len(found), 0.9)[1] < MAX_RANGE_EXIT_RATE
            )
            means = {
                each: np.mean([one.gain for one in played_by])
                for (rig, each, how), played_by in runs.items()
                if (rig, how) == (name, mode)
            }
            chosen = means.pop("efe")
            is_efe_ahead.append(all(bool(chosen > gain) for gain in means.values()))
    pooled, meets, is_calibrated = judge_coverage(hits, trials)
    return {
        "calibrated": is_calibrated,
        "pooled coverage": pooled,
        "cells outside": len(meets) - sum(meets),
        "efe ahead on": sum(is_efe_ahead),
        "efe within its limits on": sum(is_within_limits),
        "rigs": len(is_efe_ahead),
    }
