"""The evaluation protocol: one score of a policy on a track, comparable between users, as an entry of a leaderboard.

docs/protocol.md is its documentation; `agents.leaderboard.leaderboard_file` stores the entries.
"""

from __future__ import annotations

import hashlib
import inspect
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypedDict

import numpy as np

from agents.evaluation.metric_summary import IQM, METRIC_COLUMNS, MetricColumn, MetricSummary, center_and_interval
from agents.evaluation.metrics import fisher_information_gain
from agents.evaluation.oracle import Oracle, TrackSystems
from agents.evaluation.policy_arguments import policy_group
from agents.evaluation.policy_rollout import Evaluation, run_episodes
from agents.evaluation.track_batch import TEST_OPTIONS
from agents.policies import TRAINED, trained_policies
from agents.policies.networks.trained_policy import CARD_FILE, MAX_STEPS, WEIGHTS_FILE, training_steps_of
from agents.result_files import package_versions
from agents.user_code import load_object
from duffing_env.experiment_config import SimulatedExperiment
from estimator.support.argument_checks import check_integer
from estimator.support.array_types import FloatArray
from estimator.support.progress import ProgressCallback, ignore_progress

#: Version of the protocol: entries of different versions are not comparable.
PROTOCOL_VERSION = 1

#: Tracks of the protocol, which have a stored oracle for the score.
PROTOCOL_TRACKS = tuple(
    f"duffing_env/{name}-v{n}" for n in (0, 1) for name in ("Short", "Amplitude", "Output", "Power")
)

#: Name of a budget to its number of training samples; more samples are an open budget.
TRAINING_BUDGETS = {"0.1M": 100_000, "1M": 1_000_000, "10M": 10_000_000}

#: Factor by which a training may exceed its budget, because the last update may be finished.
_BUDGET_TOLERANCE = 1.05

#: Systems of an evaluation.
N_SYSTEMS = 256

#: Seed of these systems.
EVALUATION_SEED = 0

#: The score: D-efficiency.
SCORE_COLUMN = MetricColumn("score / %", 1, 100, IQM, IQM)

#: Metrics of an entry, beside the score.
REPORTED_METRICS = ("information_gain", "log_posterior_gain", "coverage", "ended_early", "decision_time")

#: Metrics of an entry on each shifted test set.
SHIFTED_METRICS = ("fisher_gain", "log_posterior_gain", "coverage", "ended_early")


class Refusal(TypedDict):
    """Message of a policy that does not play a shifted test set."""

    refused: str


class OracleReference(TypedDict):
    """The oracle of a score: its digest, its number of systems, and how many of them have an upper bound."""

    oracle: str
    systems: int
    certified: int


class LeaderboardEntry(TypedDict):
    """A measurement of a policy on a track, as a line of a leaderboard file holds it."""

    name: str
    track: str
    protocol: int
    samples: int
    budget: str
    seeds: int
    score: MetricSummary
    metrics: dict[str, MetricSummary]
    shifted: dict[str, dict[str, MetricSummary] | Refusal]
    reference: OracleReference
    policies: dict[str, str]
    command: list[str]
    versions: dict[str, str]
    date: str


def shifted_test_sets(track: str) -> dict[str, tuple[str, dict[str, Any]]]:
    """The shifted test sets of a track, by name: track and options. The estimator's prior is not shifted.

    ``parameters``: oscillators from ± 50 % about the centre instead of ± 30 %. ``noises``: twice as strong as the
    estimator's, or as in training where it estimates them. ``limits``: of input and output, 0.8 of the track's.
    ``equation``, for ``-v0``: the plant is the differential equation, and the estimator keeps the difference equation.
    """
    import gymnasium as gym

    limits = gym.spec(track).kwargs
    stronger_noises = {"process_noise": 1e-3, "measurement_noise": 1e-3}
    noise_guesses = {} if track.endswith("-v1") else {"process_noise_guess": 5e-4, "measurement_noise_guess": 5e-4}
    test_sets = {
        "parameters": (track, {"plant_spread": 0.5}),
        "noises": (track, stronger_noises | noise_guesses),
        "limits": (track, {name: 0.8 * limits[name] for name in ("max_input", "max_output")}),
    }
    if track.endswith("-v0"):
        estimator_options = {"estimator": "nlarx", "noise_range": 1.0, "noise_hypotheses": 1}
        test_sets["equation"] = (track.replace("-v0", "-v1"), estimator_options)
    return test_sets


def measure_policy(
    policy: str,
    track: str,
    entry_name: str,
    training_samples: int | None = None,
    on_progress: ProgressCallback = ignore_progress,
) -> LeaderboardEntry:
    """Measure a policy by the protocol; returns an entry of a leaderboard.

    Args:
        policy: as of `agents.evaluation.policy_evaluation.evaluate_policies`; several training seeds of one
            configuration are TITLE=PATTERN.
        track: one of `PROTOCOL_TRACKS`.
        entry_name: name on the leaderboard.
        training_samples: number of samples of the training; a run folder holds it itself.
        on_progress: called with the fraction that is done, and the present test set
            (`estimator.support.progress.show_progress`).

    Raises:
        ValueError: for another track, an empty name, a number of samples that is no whole number from 0, or an unknown
            policy.
    """
    if track not in PROTOCOL_TRACKS:
        raise ValueError(f"protocol must be one of {', '.join(PROTOCOL_TRACKS)}, but is {track}; others have no oracle")
    if not entry_name.strip():
        raise ValueError("submit must be a name, but is empty; the board shows it")
    check_integer("samples", 0 if training_samples is None else training_samples, MAX_STEPS, 0)
    _, members = policy_group(policy)
    training_samples = max((_training_samples(member) or training_samples or 0 for member in members), default=0)
    budget = _budget_name(training_samples)
    shifts = shifted_test_sets(track)
    total = (1 + len(shifts)) * len(members)

    def evaluate_members(env_id: str, options: dict[str, Any], done: int, label: str) -> list[Evaluation]:
        return [
            _evaluate_on_track(
                member, env_id, options, lambda share, k=k: on_progress((done + k + share) / total, label)
            )
            for k, member in enumerate(members)
        ]

    evaluations = evaluate_members(track, TEST_OPTIONS, 0, f"{entry_name} on {track}")
    oracle = Oracle.of(TrackSystems.of(track, N_SYSTEMS))
    score = np.array([_efficiency_scores(evaluation, oracle) for evaluation in evaluations])
    shifted: dict[str, dict[str, MetricSummary] | Refusal] = {}
    for k, (shift, (env_id, options)) in enumerate(shifts.items(), start=1):
        try:
            shifted_evaluations = evaluate_members(
                env_id, TEST_OPTIONS | options, k * len(members), f"{entry_name}, shifted: {shift}"
            )
        except ValueError as error:
            shifted[shift] = Refusal(refused=str(error))
            continue
        shifted[shift] = _summarise_over_seeds(shifted_evaluations, SHIFTED_METRICS)
    return {
        "name": entry_name,
        "track": track,
        "protocol": PROTOCOL_VERSION,
        "samples": training_samples,
        "budget": budget,
        "seeds": len(members),
        "score": center_and_interval(score, SCORE_COLUMN),
        "metrics": _summarise_over_seeds(evaluations, REPORTED_METRICS),
        "shifted": shifted,
        "reference": {
            "oracle": file_digest(oracle.systems.path),
            "systems": len(oracle.values),
            "certified": int(np.isfinite(oracle.bounds).sum()),
        },
        "policies": {member: policy_fingerprint(member) for member in members},
        "command": [Path(sys.argv[0]).name, *sys.argv[1:]],
        "versions": package_versions(),
        "date": datetime.now(UTC).strftime("%Y-%m-%d"),
    }


def _evaluate_on_track(policy: str, env_id: str, options: dict[str, Any], on_progress: ProgressCallback) -> Evaluation:
    evaluation, _, truth, experiment = run_episodes(policy, env_id, N_SYSTEMS, EVALUATION_SEED, options, on_progress)
    assert isinstance(experiment, SimulatedExperiment)
    evaluation.metrics["fisher_gain"] = fisher_information_gain(
        evaluation.inputs, truth, experiment, evaluation.outputs
    )
    return evaluation


def _efficiency_scores(evaluation: Evaluation, oracle: Oracle) -> FloatArray:
    """D-efficiency (n,) relative to the upper bound of each system, or to the best known input where none is known."""
    n = len(oracle.values)
    efficiencies, lower_bounds = oracle.efficiency(evaluation.inputs.T[:n], np.swapaxes(evaluation.outputs, 0, 1)[:n])
    return np.where(np.isfinite(lower_bounds), lower_bounds, efficiencies)


def _summarise_over_seeds(evaluations: list[Evaluation], names: tuple[str, ...]) -> dict[str, MetricSummary]:
    return {
        name: center_and_interval(
            np.array([evaluation.metrics[name] for evaluation in evaluations]), METRIC_COLUMNS[name]
        )
        for name in names
    }


def _budget_name(samples: int) -> str:
    """Name of the smallest budget with this many samples; ``none`` for 0, ``open`` beyond the largest."""
    if not samples:
        return "none"
    return next((name for name, most in TRAINING_BUDGETS.items() if samples <= _BUDGET_TOLERANCE * most), "open")


def _policy_folder(policy: str) -> Path | None:
    """The folder of a trained policy; None for any other policy."""
    folder = TRAINED / policy if policy in trained_policies() else Path(policy)
    return folder if (folder / CARD_FILE).is_file() else None


def _training_samples(policy: str) -> int | None:
    """Number of training samples on the card of a trained policy; None for any other policy."""
    folder = _policy_folder(policy)
    return None if folder is None else training_steps_of(folder)


def policy_fingerprint(policy: str) -> str:
    """Digest of a policy's weights or source file; empty for a policy of this package, whose version is known."""
    folder = _policy_folder(policy)
    if folder is not None:
        return file_digest(folder / WEIGHTS_FILE)
    if ":" in policy:
        policy_object = load_object(policy, "policy")
        try:
            source = inspect.getsourcefile(policy_object)
        except TypeError:  # an object has the source of its class
            source = inspect.getsourcefile(type(policy_object))
        return "" if source is None else file_digest(Path(source))
    return ""


def file_digest(path: Path) -> str:
    """SHA-256 digest of a file."""
    return f"sha256:{hashlib.sha256(path.read_bytes()).hexdigest()}"
