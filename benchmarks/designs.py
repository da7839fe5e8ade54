"""What inputs are worth: policies against the stored oracles, on the tracks that have one.

``python -m benchmarks.designs`` prints the tables of docs/planner.md.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import tyro
from scipy import stats

from agents.evaluation.oracle import Oracle
from agents.evaluation.oracle_task import Systems
from agents.evaluation.rollout import roll_out
from estimator.files import write_atomically
from estimator.parameters import FloatArray


@dataclass(frozen=True)
class Design:
    """What one policy did on one track.

    Attributes:
        track: id.
        policy: name.
        gain: (n,) decrease of the coefficients' entropy in the belief [nats].
        efficiency: (n,) D-efficiency, see `agents.evaluation.oracle.Oracle.efficiency`.
        early: episodes that the displacement limit ended.
        peak: largest output [V].
        rms: root mean square input over all samples [V].
        microseconds: of processor time for one environment's decision, mean over an episode.
    """

    track: str
    policy: str
    gain: FloatArray
    efficiency: FloatArray
    early: int
    peak: float
    rms: float
    microseconds: float


def measure(track: str, policy: str, systems: int = 256) -> Design:
    """One episode of every system that the track's oracle has, with seed 0."""
    oracle = Oracle.of(Systems.of(track, systems))
    evaluation, *_ = roll_out(policy, track, len(oracle.values), 0, {})
    found = evaluation.metrics
    return Design(
        track,
        policy,
        found["information_gain"],
        oracle.efficiency(evaluation.inputs.T, evaluation.outputs.T),
        int(found["ended_early"].sum()),
        float(np.nanmax(np.abs(evaluation.outputs))),
        float(np.sqrt(np.nanmean(evaluation.inputs**2))),
        1e6 * float(found["decision_time"][0]),
    )


def row(design: Design) -> str:
    """A row of the table, with the 95 % interval of the mean efficiency (Student)."""
    e = design.efficiency
    half = stats.t.ppf(0.975, len(e) - 1) * e.std(ddof=1) / np.sqrt(len(e))
    return (
        f"| {design.policy} | {design.gain.mean():.2f} | {e.mean():.3f} ± {half:.3f} | {np.median(e):.3f} | "
        f"{e.min():.3f} | {design.early} of {len(e)} | {design.peak:.3f} | {1e3 * design.rms:.1f} | "
        f"{design.microseconds:.0f} |"
    )


@dataclass(frozen=True)
class Config:
    """Print what the inputs of policies are worth against the stored oracles."""

    tracks: tuple[str, ...] = tuple(f"duffing_env/{name}-v0" for name in ("Amplitude", "Short", "Power", "Output"))
    """Ids of tracks with a stored oracle."""
    policies: tuple[str, ...] = ("efe", "efe-myopic", "prbs", "uniform", "silverbox-multisine")
    """Names of policies, or run folders."""
    systems: int = 256
    """Systems, at most as many as the oracle has."""
    json: Path | None = None
    """Where to write all numbers."""


def main(config: Config) -> None:
    """Measure, and print a table for each track."""
    designs = []
    for track in config.tracks:
        print(f"\n{track}\n")
        print("| policy | gain [nats] | D-efficiency | median | worst | ended early | peak [V] | RMS [mV] | µs |")
        print("|---|---|---|---|---|---|---|---|---|")
        for policy in config.policies:
            designs.append(measure(track, policy, config.systems))
            print(row(designs[-1]), flush=True)
    if config.json is not None:
        rows = [asdict(d) | {"gain": d.gain.tolist(), "efficiency": d.efficiency.tolist()} for d in designs]
        write_atomically(config.json, json.dumps(rows, indent=2))


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
