"""The protocol: one way to say what a policy is worth on a track, so that figures of different people compare.

docs/protocol.md is the page for its users. What is measured goes into an entry of a board (`agents.leaderboard.leaderboard_file`).
"""

from __future__ import annotations

import hashlib
import inspect
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from agents.evaluation.metric_summary import IQM, METRIC_COLUMNS, MetricColumn, center_and_interval
from agents.evaluation.metrics import fisher_information_gain
from agents.evaluation.oracle import Oracle, TrackSystems
from agents.evaluation.policy_evaluation import Evaluation, run_episodes
from agents.evaluation.policy_groups import policy_group
from agents.evaluation.track_batch import TEST_OPTIONS
from agents.policies import TRAINED, trained_policies
from agents.policies.networks.trained_policy import CARD_FILE, MAX_STEPS, WEIGHTS_FILE, training_steps_of
from agents.result_files import package_versions
from agents.user_code import load_object
from estimator.support.argument_checks import check_integer
from estimator.support.array_types import FloatArray
from estimator.support.progress import ProgressCallback, ignore_progress

#: Of the protocol: entries of another version do not compare.
PROTOCOL_VERSION = 1

#: Tracks with a stored oracle, which a score needs.
PROTOCOL_TRACKS = tuple(
    f"duffing_env/{name}-v{n}" for n in (0, 1) for name in ("Short", "Amplitude", "Output", "Power")
)

#: Samples that a policy may learn from, by the name of the budget; what takes more is open.
TRAINING_BUDGETS = {"0.1M": 100_000, "1M": 1_000_000, "10M": 10_000_000}

#: A last update that is begun within the budget may be finished.
_BUDGET_TOLERANCE = 1.05

N_SYSTEMS = 256
EVALUATION_SEED = 0

#: The headline: share of what is possible.
SCORE_COLUMN = MetricColumn("score / %", 1, 100, IQM, IQM)

#: What stands beside it.
REPORTED_METRICS = ("information_gain", "log_posterior_gain", "coverage", "ended_early", "decision_time")
SHIFTED_METRICS = ("fisher_gain", "log_posterior_gain", "coverage", "ended_early")


def shifted_test_sets(track: str) -> dict[str, tuple[str, dict[str, Any]]]:
    """The shifted test sets of a track, by name: the environment and its options. What is believed is not told of them.

    ``parameters``: oscillators from ± 50 % about the centre instead of ± 30 %. ``noises``: twice as strong as the
    estimator is told or, where it is told none, as in training. ``limits``: of input and output, 0.8 of the track's.
    ``equation``: the plant is the differential equation, and the estimator keeps the difference equation; of ``-v0``.
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
) -> dict[str, Any]:
    """What a policy is worth by the protocol, as an entry of a board.

    Args:
        policy: as of `agents.evaluation.policy_evaluation.evaluate_policies`; five training seeds of one recipe are TITLE=PATTERN.
        track: one of `PROTOCOL_TRACKS`.
        entry_name: that it has on the board.
        training_samples: that it learned from; a run folder says it itself.
        on_progress: is told the share that is done, and what is measured next (`estimator.support.progress.show_progress`).

    Raises:
        ValueError: for another track, a missing name, samples that are no number of them, or something that is not a
            policy.
    """
    if track not in PROTOCOL_TRACKS:
        raise ValueError(f"protocol must be one of {', '.join(PROTOCOL_TRACKS)}, but is {track}; others have no oracle")
    if not entry_name.strip():
        raise ValueError("submit must be a name, but is empty; it is what the board shows")
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
    shifted: dict[str, Any] = {}
    for k, (shift, (env_id, options)) in enumerate(shifts.items(), start=1):
        try:
            shifted_evaluations = evaluate_members(
                env_id, TEST_OPTIONS | options, k * len(members), f"{entry_name}, shifted: {shift}"
            )
        except ValueError as error:
            shifted[shift] = {"refused": str(error)}
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
    evaluation.metrics["fisher_gain"] = fisher_information_gain(
        evaluation.inputs, truth, experiment, evaluation.outputs
    )
    return evaluation


def _efficiency_scores(evaluation: Evaluation, oracle: Oracle) -> FloatArray:
    """(n,) D-efficiency against the bound of each system that has one, else against the best input that is known."""
    n = len(oracle.values)
    efficiencies, lower_bounds = oracle.efficiency(evaluation.inputs.T[:n], np.swapaxes(evaluation.outputs, 0, 1)[:n])
    return np.where(np.isfinite(lower_bounds), lower_bounds, efficiencies)


def _summarise_over_seeds(evaluations: list[Evaluation], names: tuple[str, ...]) -> dict[str, Any]:
    return {
        name: center_and_interval(
            np.array([evaluation.metrics[name] for evaluation in evaluations]), METRIC_COLUMNS[name]
        )
        for name in names
    }


def _budget_name(samples: int) -> str:
    """The smallest budget that the samples are within; none for a policy that has not learned, else open."""
    if not samples:
        return "none"
    return next((name for name, most in TRAINING_BUDGETS.items() if samples <= _BUDGET_TOLERANCE * most), "open")


def _policy_folder(policy: str) -> Path | None:
    """The folder of a trained policy."""
    folder = TRAINED / policy if policy in trained_policies() else Path(policy)
    return folder if (folder / CARD_FILE).is_file() else None


def _training_samples(policy: str) -> int | None:
    """Samples that a trained policy learned from, by its card."""
    folder = _policy_folder(policy)
    if folder is None:
        return None
    return training_steps_of(folder)


def policy_fingerprint(policy: str) -> str:
    """What tells a policy from another of its name: of its weights, or its source; one of ours has the version."""
    folder = _policy_folder(policy)
    if folder is not None:
        return file_digest(folder / WEIGHTS_FILE)
    if ":" in policy:
        policy_object = load_object(policy, "policy")
        try:
            source = inspect.getsourcefile(policy_object)
        except TypeError:  # an object, whose class it is that has a source
            source = inspect.getsourcefile(type(policy_object))
        return "" if source is None else file_digest(Path(source))
    return ""


def file_digest(path: Path) -> str:
    """Of a file's content."""
    return f"sha256:{hashlib.sha256(path.read_bytes()).hexdigest()}"
