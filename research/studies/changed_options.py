"""Compares policies with the planner under options that differ from their training options.

    python -m research.studies.changed_options

plays `efe`, the track's own policy and `ppo/universal` with other noises, a weaker input, more energy and a longer
episode, on the tracks of both equations. D-efficiency is exp(2 (F - F_efe) / K), with F the Fisher information [nats]
about the K coefficients at the truth that an episode gave (`fisher_gain` of `evaluate.py`), and F_efe the planner's on
the same system with the same noise.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from agents.cli import run_script
from agents.console_output import format_table, print_texts_and_tables
from agents.evaluation.metric_summary import METRIC_COLUMNS, center_and_interval_text
from agents.evaluation.metrics import fisher_information_gain
from agents.evaluation.policy_rollout import run_episodes
from agents.evaluation.track_batch import TEST_OPTIONS
from agents.result_files import write_json
from duffing_env.experiment_config import SimulatedExperiment
from estimator.support.progress import iterate_with_progress

#: Comparisons: a title, the track without its version, the options.
CASES: tuple[tuple[str, str, dict[str, Any]], ...] = (
    ("σ_w ÷ 5, σ_v × 5", "Amplitude", {"process_noise": 1e-4, "measurement_noise": 2.5e-3}),
    ("max_input 0.05", "Amplitude", {"max_input": 0.05}),
    ("max_rms 0.05", "Power", {"max_rms": 0.05}),
    ("horizon 512", "Power", {"horizon": 512}),
)
PLANNER, UNIVERSAL = "efe", "ppo/universal"


@dataclass(frozen=True)
class Config:
    """Compare policies with the planner under other options than they were trained with."""

    systems: int = 256
    """Systems of every case."""
    cases: tuple[int, ...] = (1, 2, 3, 4)
    """Which of the cases."""
    versions: tuple[int, ...] = (0, 1)
    """Of the tracks."""
    output: Path | None = None
    """File for the figures of every system, as JSON."""

    def __post_init__(self) -> None:
        for name, known in (("cases", range(1, len(CASES) + 1)), ("versions", (0, 1))):
            given = getattr(self, name)
            if not given or not set(given) <= set(known):
                raise ValueError(f"{name} must be of {list(known)}, but are {list(given)}; name some of these")


def shipped_policy_name(track: str, version: int) -> str:
    """The policy that ships for a track."""
    return f"ppo/{track.lower()}" + ("" if version == 0 else f"-v{version}")


def compare_with_planner(
    track: str, options: dict[str, Any], policies: tuple[str, ...], systems: int
) -> Iterator[dict[str, Any]]:
    """Evaluate every policy relative to the planner, which comes first.

    Yields:
        ``policy``, and arrays (systems,): ``efficiency``, ``fisher_gain`` [nats], and 1 in ``ended_early`` where a
        limit ended the episode.
    """
    best = None
    for policy in (PLANNER, *policies):
        played, _, truth, experiment = run_episodes(policy, track, systems, 0, TEST_OPTIONS | options)
        assert isinstance(experiment, SimulatedExperiment)
        information_gained = fisher_information_gain(played.inputs, truth, experiment, played.outputs)
        best = information_gained if best is None else best
        efficiency = np.exp(2.0 * (information_gained - best) / experiment.plant.n_coefficients)
        yield {
            "policy": policy,
            "efficiency": efficiency,
            "fisher_gain": information_gained,
            "ended_early": played.metrics["ended_early"],
        }


def main(config: Config) -> None:
    """Play, and print the table."""
    rows, results = [], []
    metrics = {
        "efficiency": replace(METRIC_COLUMNS["efficiency"], decimals=3, scale=1.0),
        "fisher_gain": METRIC_COLUMNS["fisher_gain"],
    }
    tasks = [(version, *CASES[case - 1]) for version in config.versions for case in config.cases]
    for task in iterate_with_progress((f"{task[2]}-v{task[0]}, {task[1]}", task) for task in tasks):
        version, title, name, options = task
        track, policies = f"{name}-v{version}", (shipped_policy_name(name, version), UNIVERSAL)
        for found in compare_with_planner(f"duffing_env/{track}", options, policies, config.systems):
            cells = [center_and_interval_text(metrics[key], found[key]) for key in metrics]
            early = f"{int(found['ended_early'].sum())} of {config.systems}"
            rows.append([track, title, found["policy"], *cells, early])
            plain = {key: value.tolist() if isinstance(value, np.ndarray) else value for key, value in found.items()}
            results.append({"track": track, "case": title, **plain})
    heads = ("track", "options", "policy", "D-efficiency beside efe", "Fisher information / nat", "ended early")
    if config.output is not None:
        write_json(config.output, results)
    print_texts_and_tables(format_table(heads, rows, markdown=True, n_labels=3))


if __name__ == "__main__":
    run_script(main, Config, __doc__ or "")
