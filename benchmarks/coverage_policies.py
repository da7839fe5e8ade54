"""Coverage under every policy that ships: whether the belief's 90 % intervals hold the truth for the inputs it chooses.

``python -m benchmarks.coverage_policies`` prints the table of docs/results.md.

Tracks are those whose estimator is matched to the plant: that of its own equation, with coefficients that stay. So
Drift-v0 is none: its belief is that of a random walk, and the mass jumps.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from scipy import stats

from agents.cli import run_script
from agents.evaluation.leaderboard import METRICS, center_and_interval
from agents.evaluation.rollout import roll_out
from agents.policies import POLICIES, trained_policies
from estimator.files import write_atomically
from estimator.physical import coefficients_of

TRACKS = tuple(f"duffing_env/{name}-v0" for name in ("Amplitude", "Short", "Power", "Output", "Continuous"))

#: Planners of the difference equation, which do not know another.
_OF_DIFFERENCES = ("efe", "efe-myopic")

LEVEL, LOWEST, HIGHEST = 0.90, 0.85, 0.95


@dataclass(frozen=True)
class Coverage:
    """What came out for one policy on one track.

    Attributes:
        policy: its name.
        track: id.
        coverage: share of the coefficients that their 90 % intervals hold, over systems.
        low, high: its 95 % bootstrap interval over systems.
        by_coefficient: the same share for each coefficient.
        passed: whether ``coverage`` is from 0.85 to 0.95.
    """

    policy: str
    track: str
    coverage: float
    low: float
    high: float
    by_coefficient: list[float]
    passed: bool


@dataclass(frozen=True)
class Config:
    """Coverage of the 90 % intervals under every policy that ships, on every matched track."""

    policies: tuple[str, ...] = ()
    """Names or run folders; all that ship where none is given."""
    tracks: tuple[str, ...] = TRACKS
    """Ids of tracks."""
    systems: int = 512
    """Systems, the same for all policies."""
    seed: int = 0
    """Seed of systems and noise."""
    json: Path | None = None
    """Where to write all numbers."""


def measure(policy: str, track: str, systems: int, seed: int) -> Coverage:
    """One episode of every system; an episode that a limit ends counts with the belief it ended with."""
    evaluation, beliefs, truth, _ = roll_out(policy, track, systems, seed, {})
    means = np.array([belief.coefficients_mean for belief in beliefs])
    stds = np.sqrt([np.diag(belief.coefficients_cov) for belief in beliefs])
    model = beliefs[0].model
    known = coefficients_of(model, truth, beliefs[0].step)
    inside = np.abs(means - known) <= stats.norm.ppf(0.5 + LEVEL / 2) * stds
    entry = center_and_interval(evaluation.metrics["coverage"][None], METRICS["coverage"])
    passed = LOWEST <= entry["mean"] <= HIGHEST
    return Coverage(policy, track, entry["mean"], entry["low"], entry["high"], inside.mean(axis=0).tolist(), passed)


def run(config: Config) -> list[Coverage]:
    """Measure every policy on every track that it can play."""
    from rich.progress import track as progress

    names = config.policies or (*trained_policies(), *POLICIES)
    pairs = [
        (name, track)
        for track in config.tracks
        for name in names
        if not (name in _OF_DIFFERENCES and "Continuous" in track)
    ]
    return [measure(*pair, config.systems, config.seed) for pair in progress(pairs, description="Playing")]


def show(rows: list[Coverage]) -> None:
    """Print the table, in the format of docs/results.md."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    tracks = list(dict.fromkeys(row.track for row in rows))
    found = {(row.policy, row.track): row for row in rows}
    table = Table("policy", *(track.removeprefix("duffing_env/") for track in tracks), box=box.MARKDOWN)
    for policy in dict.fromkeys(row.policy for row in rows):
        table.add_row(policy, *(_cell(found.get((policy, track))) for track in tracks))
    console = Console(markup=False)
    console.width = max(console.width, 30 + 30 * len(tracks))
    console.print(table)
    missed = [f"{row.policy} on {row.track}" for row in rows if not row.passed]
    told = f"; missed: {', '.join(missed)}" if missed else ""
    console.print(f"{len(rows) - len(missed)} of {len(rows)} are in [{LOWEST}, {HIGHEST}]{told}")
    single = [share for row in rows for share in row.by_coefficient]
    console.print(f"single coefficients: from {min(single):.3f} to {max(single):.3f}")


def _cell(row: Coverage | None) -> str:
    if row is None:
        return "-"
    return f"{row.coverage:.3f} [{row.low:.3f}, {row.high:.3f}] {'PASS' if row.passed else 'MISS'}"


def main(config: Config) -> None:
    """Measure, print, and write where a file is named."""
    rows = run(config)
    show(rows)
    if config.json is not None:
        write_atomically(config.json, json.dumps([asdict(row) for row in rows], indent=1) + "\n")


if __name__ == "__main__":
    run_script(main, Config, __doc__ or "")
