"""Evaluation during a training, on held-out systems: the metrics of `evaluate.py` on the branch ``validation``."""

from __future__ import annotations

import csv
import io
import json
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from agents.evaluation.policy_rollout import run_episodes
from agents.policies.networks.policy_saving import write_policy
from agents.policies.networks.trained_policy import CARD_FILE
from estimator.support.file_io import write_atomically

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

    from agents.training.training_config import TrainConfig


class HeldOutScores(NamedTuple):
    """Metrics of a policy, each the mean over the held-out systems.

    Attributes:
        information_gain: [nats].
        log_posterior_gain: gain of the posterior's log density at the truth [nats]; policies are ranked by it.
        coverage: fraction of the 90 % credible intervals that hold the truth.
        ended_early: fraction of the episodes that a limit ended.
    """

    information_gain: float
    log_posterior_gain: float
    coverage: float
    ended_early: float


#: Name of the metric by which policies are ranked.
HELDOUT_SCORE = "log_posterior_gain"

#: Table of the evaluations, in a run folder.
EVALUATIONS_FILE = "evaluations.csv"

#: Folder of the policy with the best score so far, in a run folder.
BEST_POLICY_FOLDER = "best"

#: Held-out systems of an evaluation.
_N_SYSTEMS = 128

#: Seed of these systems and their noise.
_SEED = 0


def final_score(folder: Path) -> float:
    """The score of a finished run at its end."""
    *_, last = csv.DictReader((folder / EVALUATIONS_FILE).read_text(encoding="utf-8").splitlines())
    return float(last[HELDOUT_SCORE])


class HeldOutEvaluator:
    """Evaluates policies on the same systems, and writes ``evaluations.csv`` and the best policy so far, ``best/``.

    Args:
        folder: the run folder.
        config: of the run.
        first_step: samples from which the training goes on; rows of more samples are dropped.
    """

    def __init__(self, folder: Path, config: TrainConfig, first_step: int = 0) -> None:
        self._folder, self._config = folder, config
        self._rows: list[dict[str, float]] = []
        if (folder / EVALUATIONS_FILE).exists():
            for row in csv.DictReader((folder / EVALUATIONS_FILE).read_text(encoding="utf-8").splitlines()):
                if int(row["steps"]) <= first_step:
                    self._rows.append({name: int(v) if name == "steps" else float(v) for name, v in row.items()})
        self._best = float("-inf")
        if (card_file := folder / BEST_POLICY_FOLDER / CARD_FILE).exists():
            self._best = json.loads(card_file.read_text(encoding="utf-8"))["evaluation"][HELDOUT_SCORE]

    @property
    def has_begun(self) -> bool:
        """Whether there was an evaluation."""
        return bool(self._rows)

    @property
    def steps(self) -> int:
        """Samples at the last evaluation."""
        return int(self._rows[-1]["steps"]) if self._rows else 0

    @property
    def information_gains(self) -> list[tuple[int, float]]:
        """Samples and information gain [nats] of every evaluation."""
        return [(int(row["steps"]), row["information_gain"]) for row in self._rows]

    def evaluate(self, model: BaseAlgorithm, card: dict[str, Any]) -> HeldOutScores:
        """Evaluate the mean action of a model, write the row, and save the policy if it is the best so far.

        Args:
            model: the algorithm.
            card: of the policy, see `save_policy`.
        """
        with tempfile.TemporaryDirectory() as candidate:
            write_policy(Path(candidate), model, card)
            options = self._config.options | {"branch": "validation"}
            evaluation, *_ = run_episodes(candidate, self._config.env, _N_SYSTEMS, _SEED, options)
        scores = HeldOutScores(*(float(evaluation.metrics[name].mean()) for name in HeldOutScores._fields))
        self._rows.append({"steps": model.num_timesteps, **scores._asdict()})
        table = io.StringIO()
        writer = csv.DictWriter(table, ["steps", *HeldOutScores._fields], lineterminator="\n")
        writer.writeheader()
        writer.writerows(self._rows)
        write_atomically(self._folder / EVALUATIONS_FILE, table.getvalue())
        if scores.log_posterior_gain > self._best:
            self._best = scores.log_posterior_gain
            best_card = card | {"evaluation": {"seed": _SEED, "systems": _N_SYSTEMS, **scores._asdict()}}
            write_policy(self._folder / BEST_POLICY_FOLDER, model, best_card)
        return scores
