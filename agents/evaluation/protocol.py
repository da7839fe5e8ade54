"""The protocol: one way to say what a policy is worth on a track, so that figures of different people compare.

docs/protocol.md is the page for its users. What is measured goes into an entry of a board (`agents.evaluation.board`).
"""

from __future__ import annotations

import hashlib
import inspect
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from agents.evaluation.batch import TESTED
from agents.evaluation.entries import members_of
from agents.evaluation.leaderboard import IQM, METRICS, Metric, center_and_interval
from agents.evaluation.metrics import information
from agents.evaluation.oracle import Oracle, Systems
from agents.evaluation.rollout import Evaluation, roll_out
from agents.loading import load_object
from agents.policies import TRAINED, trained_policies
from agents.policies.learned import CARD, MOST_STEPS, WEIGHTS, steps_of
from agents.results import versions
from estimator.checks import whole
from estimator.parameters import FloatArray
from estimator.progress import Tell, untold

#: Of the protocol: entries of another version do not compare.
VERSION = 1

#: Tracks with a stored oracle, which a score needs.
TRACKS = tuple(f"duffing_env/{name}-v{n}" for n in (0, 1) for name in ("Short", "Amplitude", "Output", "Power"))

#: Samples that a policy may learn from, by the name of the budget; what takes more is open.
BUDGETS = {"0.1M": 100_000, "1M": 1_000_000, "10M": 10_000_000}

#: A last update that is begun within the budget may be finished.
_ROUNDING = 1.05

SYSTEMS = 256
SEED = 0

#: The headline: share of what is possible.
SCORE = Metric("score / %", 1, 100, IQM, IQM)

#: What stands beside it.
BESIDE = ("information_gain", "log_posterior_gain", "coverage", "ended_early", "decision_time")
SHIFTED = ("fisher_gain", "log_posterior_gain", "coverage", "ended_early")


def shifts_of(track: str) -> dict[str, tuple[str, dict[str, Any]]]:
    """The shifted test sets of a track, by name: the environment and its options. What is believed is not told of them.

    ``parameters``: oscillators from ± 50 % about the centre instead of ± 30 %. ``noises``: twice as strong as the
    estimator is told or, where it is told none, as in training. ``limits``: of input and output, 0.8 of the track's.
    ``equation``: the plant is the differential equation, and the estimator keeps the difference equation; of ``-v0``.
    """
    import gymnasium as gym

    limits = gym.spec(track).kwargs
    louder = {"process_noise": 1e-3, "measurement_noise": 1e-3}
    told = {} if track.endswith("-v1") else {"process_noise_guess": 5e-4, "measurement_noise_guess": 5e-4}
    found = {
        "parameters": (track, {"plant_spread": 0.5}),
        "noises": (track, louder | told),
        "limits": (track, {name: 0.8 * limits[name] for name in ("max_input", "max_output")}),
    }
    if track.endswith("-v0"):
        alone = {"estimator": "nlarx", "noise_range": 1.0, "noise_hypotheses": 1}
        found["equation"] = (track.replace("-v0", "-v1"), alone)
    return found


def measure(
    policy: str,
    track: str,
    name: str,
    samples: int | None = None,
    tell: Tell = untold,
) -> dict[str, Any]:
    """What a policy is worth by the protocol, as an entry of a board.

    Args:
        policy: as of `agents.evaluation.rollout.evaluate`; five training seeds of one recipe are TITLE=PATTERN.
        track: one of `TRACKS`.
        name: that it has on the board.
        samples: that it learned from; a run folder says it itself.
        tell: is told the share that is done, and what is measured next (`estimator.progress.progress`).

    Raises:
        ValueError: for another track, a missing name, samples that are no number of them, or something that is not a
            policy.
    """
    if track not in TRACKS:
        raise ValueError(f"protocol must be one of {', '.join(TRACKS)}, but is {track}; others have no oracle")
    if not name.strip():
        raise ValueError("submit must be a name, but is empty; it is what the board shows")
    whole("samples", 0 if samples is None else samples, MOST_STEPS, 0)
    _, members = members_of(policy)
    samples = max((_samples_of(member) or samples or 0 for member in members), default=0)
    budget = _budget(samples)
    shifts = shifts_of(track)
    total = (1 + len(shifts)) * len(members)

    def played(env_id: str, options: dict[str, Any], done: int, at: str) -> list[Evaluation]:
        return [
            _evaluation(member, env_id, options, lambda share, k=k: tell((done + k + share) / total, at))
            for k, member in enumerate(members)
        ]

    evaluations = played(track, TESTED, 0, f"{name} on {track}")
    oracle = Oracle.of(Systems.of(track, SYSTEMS))
    score = np.array([_score(evaluation, oracle) for evaluation in evaluations])
    shifted: dict[str, Any] = {}
    for k, (shift, (env_id, options)) in enumerate(shifts.items(), start=1):
        try:
            there = played(env_id, TESTED | options, k * len(members), f"{name}, shifted: {shift}")
        except ValueError as error:
            shifted[shift] = {"refused": str(error)}
            continue
        shifted[shift] = _summary(there, SHIFTED)
    return {
        "name": name,
        "track": track,
        "protocol": VERSION,
        "samples": samples,
        "budget": budget,
        "seeds": len(members),
        "score": center_and_interval(score, SCORE),
        "metrics": _summary(evaluations, BESIDE),
        "shifted": shifted,
        "reference": {
            "oracle": digest(oracle.systems.path),
            "systems": len(oracle.values),
            "certified": int(np.isfinite(oracle.bounds).sum()),
        },
        "policies": {member: fingerprint(member) for member in members},
        "command": [Path(sys.argv[0]).name, *sys.argv[1:]],
        "versions": versions(),
        "date": datetime.now(UTC).strftime("%Y-%m-%d"),
    }


def _evaluation(policy: str, env_id: str, options: dict[str, Any], tell: Tell) -> Evaluation:
    evaluation, _, truth, experiment = roll_out(policy, env_id, SYSTEMS, SEED, options, tell)
    evaluation.metrics["fisher_gain"] = information(evaluation.inputs, truth, experiment, evaluation.outputs)
    return evaluation


def _score(evaluation: Evaluation, oracle: Oracle) -> FloatArray:
    """(n,) D-efficiency against the bound of each system that has one, else against the best input that is known."""
    n = len(oracle.values)
    best, least = oracle.efficiency(evaluation.inputs.T[:n], np.swapaxes(evaluation.outputs, 0, 1)[:n])
    return np.where(np.isfinite(least), least, best)


def _summary(evaluations: list[Evaluation], names: tuple[str, ...]) -> dict[str, Any]:
    return {
        name: center_and_interval(np.array([evaluation.metrics[name] for evaluation in evaluations]), METRICS[name])
        for name in names
    }


def _budget(samples: int) -> str:
    """The smallest budget that the samples are within; none for a policy that has not learned, else open."""
    if not samples:
        return "none"
    return next((name for name, most in BUDGETS.items() if samples <= _ROUNDING * most), "open")


def _folder_of(policy: str) -> Path | None:
    """The folder of a trained policy."""
    folder = TRAINED / policy if policy in trained_policies() else Path(policy)
    return folder if (folder / CARD).is_file() else None


def _samples_of(policy: str) -> int | None:
    """Samples that a trained policy learned from, by its card."""
    folder = _folder_of(policy)
    if folder is None:
        return None
    return steps_of(folder)


def fingerprint(policy: str) -> str:
    """What tells a policy from another of its name: of its weights, or its source; one of ours has the version."""
    folder = _folder_of(policy)
    if folder is not None:
        return digest(folder / WEIGHTS)
    if ":" in policy:
        found = load_object(policy, "policy")
        try:
            source = inspect.getsourcefile(found)
        except TypeError:  # an object, whose class it is that has a source
            source = inspect.getsourcefile(type(found))
        return "" if source is None else digest(Path(source))
    return ""


def digest(path: Path) -> str:
    """Of a file's content."""
    return f"sha256:{hashlib.sha256(path.read_bytes()).hexdigest()}"
