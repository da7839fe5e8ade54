"""The cost of wrong noise priors, in coverage and in nats.

``python -m benchmarks.wrong_noise_priors`` prints tables of docs/evidence/coverage.md. The priors of both noises are
centred at multiples of the truth. Systems, noises and inputs are the same in every row, also for an estimator with the
true noises.
"""

from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from agents.console_output import format_table, print_texts_and_tables
from agents.evaluation.track_batch import make_track_batch
from agents.policies import make_policy
from agents.result_files import write_json
from benchmarks.interval_coverage import NO_LIMIT, QUANTILE
from benchmarks.rigs.calibration import judge_coverage
from estimator.inference.noise_grid import NoiseGridSize
from estimator.rigs.physical_parameters import coefficients_of
from estimator.support.array_types import FloatArray

#: Policies to play on each track; they know of the noises only what the track says.
PLAYED = {
    "duffing_env/Amplitude-v1": ("prbs", "ppo/amplitude-v1"),
    "duffing_env/Amplitude-v0": ("prbs", "ppo/amplitude"),
}

#: True standard deviation of both noises [V].
NOISE = 5e-4

#: Samples of an episode.
SAMPLES = 256

#: Options of an estimator with known noises.
KNOWN: dict[str, Any] = {"noise_hypotheses": 1, "noise_shape": 1e6}

#: Numbers of process and measurement noises that an estimator weighs on a rig.
HYPOTHESES = (7, 7)

#: Largest loss by wrong priors that passes [nat].
ASKED = 0.3


@dataclass(frozen=True)
class Config:
    """Coverage with wrong priors of the noises, and the loss against known noises."""

    systems: int = 200
    """Number of oscillators in each cell."""
    hypotheses: tuple[int, ...] = HYPOTHESES
    """Noise hypotheses of the estimator: one number, or two."""
    factors: tuple[float, ...] = (0.1, 1 / 3, 1.0, 3.0, 10.0)
    """Centres of the priors over the truth: all pairs, without both at the truth."""
    tracks: tuple[str, ...] = tuple(PLAYED)
    """Tracks of Eq. (1) and Eq. (2)."""
    seed: int = 0
    """Seed of all draws."""
    json: Path | None = None
    """File for the results."""


@dataclass(frozen=True)
class Cell:
    """Results of one pair of priors.

    Attributes:
        center: of the priors of process and measurement noise, in parts of the truth.
        inside: (systems, coefficients) whether the 90 % interval holds the truth.
        density: (systems,) logarithm of the posterior density at the truth [nats].
    """

    center: tuple[float, float]
    inside: FloatArray
    density: FloatArray


def inputs_of(policy: str, track: str, systems: int, seed: int) -> FloatArray:
    """Actions (samples, systems, 1) of a policy on the track with the true noises of this benchmark."""
    envs = make_track_batch(track, systems, {"noise_range": 1.0, "horizon": SAMPLES})
    player = make_policy(policy, envs, seed=seed)
    observations, _ = envs.reset(seed=seed)
    state, begins, actions = None, np.ones(systems, dtype=np.bool_), []
    for _ in range(SAMPLES):
        action, state = player.predict(observations, state, begins, deterministic=True)
        actions.append(np.array(action))
        observations, _, terminated, truncated, _ = envs.step(actions[-1])
        begins = terminated | truncated
    return np.array(actions)


def identified(
    track: str, center: tuple[float, float], actions: FloatArray, seed: int, weighing: dict[str, Any]
) -> Cell:
    """Update estimators whose priors have these centres, on the same inputs."""
    systems = actions.shape[1]
    guesses = dict(zip(("process_noise_guess", "measurement_noise_guess"), np.multiply(center, NOISE), strict=True))
    options = {"process_noise": NOISE, "measurement_noise": NOISE, "noise_range": 1.0, "max_output": NO_LIMIT}
    envs = make_track_batch(track, systems, {"horizon": SAMPLES, **options, **guesses, **weighing})
    envs.reset(seed=seed)
    for action in actions:
        envs.step(action)
    beliefs = [envs.belief(row) for row in range(systems)]
    model = envs.experiment.model
    physical = {name: np.asarray(getattr(envs.truth, name)) for name in model.physical}
    truth = coefficients_of(model, physical, beliefs[0].scales)
    std = np.sqrt([np.diag(belief.coefficients_cov) for belief in beliefs])
    away = (truth - [belief.coefficients_mean for belief in beliefs]) / std
    densities = [belief.log_prob(true) for belief, true in zip(beliefs, truth, strict=True)]
    return Cell(center, np.abs(away) <= QUANTILE, np.array(densities))


def rows(cells: list[Cell], known: Cell) -> list[list[str]]:
    """Rows of a table: the priors, coverage of each coefficient and of all, and the loss with its interval."""
    found = []
    for cell in cells:
        lost = known.density - cell.density
        shares = [f"{share:.2f}" for share in cell.inside.mean(axis=0)]
        error = lost.std(ddof=1) / np.sqrt(len(lost))
        center = [f"{factor:.2g}" for factor in cell.center]
        found.append([*center, *shares, f"{cell.inside.mean():.3f}", f"{lost.mean():.2f} ± {1.96 * error:.2f}"])
    return found


def verdict(cells: list[Cell], known: Cell) -> dict[str, Any]:
    """Say whether the cells are calibrated and lose at most `ASKED`."""
    hits = [int(count) for cell in cells for count in cell.inside.sum(axis=0)]
    pooled, meets, is_calibrated = judge_coverage(hits, [len(known.density)] * len(hits))
    lost = [float((known.density - cell.density).mean()) for cell in cells]
    good = {
        f"calibrated; pooled coverage {pooled:.3f}, {len(meets) - sum(meets)} of {len(meets)} cells outside": (
            is_calibrated
        ),
        f"at most {max(lost):.2f} nats lost, {np.mean(lost):.2f} on average": max(lost) <= ASKED,
    }
    print_texts_and_tables(*(f"{'PASS' if passed else 'MISS'}: {text}" for text, passed in good.items()))
    return good


def main(config: Config) -> None:
    """Print a table for each track and policy, and the verdict on it."""
    from rich.progress import track as shown

    numbers = config.hypotheses
    hypotheses: NoiseGridSize = numbers[0] if len(numbers) == 1 else (numbers[0], numbers[1])
    centers = [pair for pair in product(config.factors, config.factors) if pair != (1.0, 1.0)]
    results = {}
    for track in config.tracks:
        for policy in PLAYED[track]:
            actions = inputs_of(policy, track, config.systems, config.seed)
            known = identified(track, (1.0, 1.0), actions, config.seed, KNOWN)
            weighing = {"noise_hypotheses": hypotheses}
            cells = [
                identified(track, center, actions, config.seed, weighing)
                for center in shown(centers, description=f"{track} {policy}")
            ]
            names = list(make_track_batch(track, 1).experiment.model.coefficients)
            titles = ["prior of σ_w", "of σ_v", *names, "all", "lost, nats"]
            print_texts_and_tables(
                f"\n{track}, {policy}, {weighing}", format_table(titles, rows(cells, known), markdown=True)
            )
            results[f"{track} {policy}"] = {
                "verdict": verdict(cells, known),
                "known": {"coverage": known.inside.mean(axis=0).tolist(), "density": known.density.tolist()},
                "cells": [
                    {"center": c.center, "coverage": c.inside.mean(axis=0).tolist(), "density": c.density.tolist()}
                    for c in cells
                ],
            }
    if config.json is not None:
        write_json(config.json, results)


if __name__ == "__main__":
    from agents.cli import run_script

    run_script(main, Config, __doc__ or "")
