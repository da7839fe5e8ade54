"""Soak test: long runs on every track and of filters, with checks of numbers, covariances and memory.

$ python -m benchmarks.soak_test --steps 10000000
$ python -m benchmarks.soak_test --steps 1000000 --runs Short-v0 Rig-v0 filter-duffing

A track's samples are shared among four kinds of actions (random, constant, alternating, at the believed resonance),
with usual and with extreme options. A filter repeats one record. The covariances of a track are checked after every
64th sample, the covariance of a filter after every 16,384th. The exit status is 1 where a number was not finite or out
of bounds, a covariance not positive semi-definite, or where memory grew by more than 2 MB in the second half of a run.
"""

import json
import resource
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

import duffing_env  # noqa: F401  registers the tracks
from agents.cli import run_script
from duffing_env.plants.silverbox_record import record_available
from duffing_env.tracks.track_registry import TRACKS
from estimator import Channel, OnlineEstimator, Rig
from estimator.belief import check_belief_record, covariance_indices
from estimator.models.difference_equation import difference
from estimator.models.duffing import duffing
from estimator.support.progress import iterate_with_progress

#: Environments side by side.
_ROWS = 1024

#: Extreme options that compile no further kernel.
_EXTREME = {"max_input": 300.0, "max_output": 4000.0, "process_noise": 0.3, "noise_shape": 0.1}

#: Columns of the table.
COUNTED = ("samples", "episodes", "not finite", "out of bounds", "not a covariance", "growth")

#: Models of the filters, which have their default priors.
FILTERS: dict[str, Callable[[], Any]] = {"filter-paper": difference, "filter-duffing": duffing}

#: Samples of a record that a filter processes at once.
_PIECE = 16_384

#: Samples of half a period of the tracks' middle oscillator.
_HALF = 4

#: Actions by name, from the sample's index and a generator.
ACTIONS: dict[str, Callable[[int, np.random.Generator], Any]] = {
    "random": lambda t, rng: rng.uniform(-1, 1, (_ROWS, 1)),
    "constant": lambda t, rng: np.ones((_ROWS, 1)),
    "alternating": lambda t, rng: np.full((_ROWS, 1), 1.0 if t % 2 else -1.0),
    "resonant": lambda t, rng: np.full((_ROWS, 1), 1.0 if t // _HALF % 2 else -1.0),
}


@dataclass(frozen=True)
class Config:
    """Long runs on every track."""

    steps: int = 1_000_000
    """Number of samples of each track."""
    runs: tuple[str, ...] = ()
    """Names of tracks, filter-paper or filter-duffing; none stands for all."""
    json: Path | None = None
    """File for the counts."""


def main(config: Config) -> None:
    """Run all, and print the table."""
    from agents.console_output import format_table, print_texts_and_tables

    names = [name.split("/")[1] for name in TRACKS if record_available() or "Replay" not in name] + list(FILTERS)
    unknown = set(config.runs) - set(names)
    if unknown:
        raise ValueError(f"runs must be of {names}, but are {sorted(unknown)}")
    found = {}
    for name in iterate_with_progress((name, name) for name in config.runs or names):
        found[name] = filtered(name, config.steps) if name in FILTERS else soak(name, config.steps)
    rows = [[name, *(f"{value:,}" for value in counts.values())] for name, counts in found.items()]
    heads = ("run", "samples", "episodes", "not finite", "out of bounds", "not a covariance", "growth / kB")
    print_texts_and_tables(format_table(heads, rows, markdown=True))
    if config.json is not None:
        config.json.write_text(json.dumps(found, indent=2))
    bad = [name for name, c in found.items() if c["not finite"] + c["out of bounds"] + c["not a covariance"]]
    bad += [name for name, c in found.items() if c["growth"] > 2000]
    sys.exit(bool(bad))


def _rig(limit: float, span: float) -> Rig:
    """A rig with an input limit [N] and an output range [m]."""
    guess = {"m": (0.3, 0.5), "c": (0.4, 0.8), "a": (2e3, 3e3), "b": (2e7, 6e7)}
    return Rig(1e-3, input=Channel("N", limit=limit), output=Channel("m", range=span, noise=5e-6), guess=guess)


def soak(name: str, steps: int) -> dict[str, int]:
    """Run a track's samples, and check them."""
    counts = dict.fromkeys(COUNTED, 0)
    usual: dict[str, Any] = {"rig": _rig(6.0, 0.03)} if "Rig" in name else {}
    extreme = {"rig": _rig(600.0, 30.0)} if "Rig" in name else {} if "Replay" in name else _EXTREME
    rng = np.random.default_rng(0)
    for options in (usual, extreme):
        envs: Any = gym.make_vec(f"duffing_env/{name}", _ROWS, vectorization_mode="vector_entry_point", **options)
        for play in ACTIONS.values():
            _play(envs, play, max(1, steps // (_ROWS * 2 * len(ACTIONS))), rng, counts)
        envs.close()
    return counts


def _play(envs: Any, play: Callable[..., Any], rounds: int, rng: np.random.Generator, counts: dict[str, int]) -> None:
    """Step all rows for some samples, and count."""
    envs.reset(seed=int(rng.integers(2**31)))
    low, high = envs.observation_space.low, envs.observation_space.high
    model, before = envs.experiment.model, 0
    for t in range(rounds):
        observations, rewards, terminated, truncated, _ = envs.step(play(t, rng))
        counts["samples"] += _ROWS
        counts["episodes"] += int((terminated | truncated).sum())
        counts["not finite"] += int((~np.isfinite(rewards)).sum() + (~np.isfinite(observations)).sum())
        counts["out of bounds"] += int(((observations < low) | (observations > high)).sum())
        if t % 64 == 63:
            counts["not a covariance"] += _unsound(model, envs.records)
        if t == rounds // 2:
            before = _memory()
    counts["growth"] = max(counts["growth"], _memory() - before)


def filtered(name: str, steps: int) -> dict[str, int]:
    """Run a filter over a repeated record, and check its samples."""
    estimator, counts, before = OnlineEstimator(FILTERS[name]()), dict.fromkeys(COUNTED, 0), 0
    rng = np.random.default_rng(0)
    u = 0.02 * rng.standard_normal(_PIECE)
    y = estimator.simulate(u, np.zeros(2)) + 5e-4 * rng.standard_normal(_PIECE)
    pieces = max(2, steps // len(u))
    for piece in range(pieces):
        energies = estimator.run(u, y)
        belief = estimator.belief
        counts["samples"] += len(u)
        counts["not finite"] += int((~np.isfinite(energies)).sum())
        counts["not a covariance"] += _unsound(belief.model, belief.record[None])
        if piece == pieces // 2:
            before = _memory()
    counts["growth"] = _memory() - before
    return counts


def _unsound(model: Any, records: Any) -> int:
    """Number of records (n, size) that are no belief: a check of all together, then of each doubtful one."""
    covs = records[:, covariance_indices(model)]
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        stds = np.sqrt(np.diagonal(covs, axis1=1, axis2=2))
        correlations = covs / stds[:, :, None] / stds[:, None]
    plain = np.isfinite(correlations).all((1, 2)) & np.isfinite(records).all(1)
    plain &= (records[:, -2 - 2 * model.n_outputs :] > 0).all(1)
    plain[plain] = np.linalg.eigvalsh(correlations[plain])[:, 0] > 0
    return sum(not _is_sound(model, record) for record in records[~plain])


def _is_sound(model: Any, record: Any) -> bool:
    """Whether a record is a belief."""
    try:
        check_belief_record("belief", model, record, 1e-5)
    except ValueError:
        return False
    return True


def _memory() -> int:
    """Largest memory of this process so far [kB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


if __name__ == "__main__":
    run_script(main, Config, __doc__)
