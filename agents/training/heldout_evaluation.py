"""What a policy is worth on the way: by the metrics of `evaluate.py`, on systems of the branch ``validation``."""

from __future__ import annotations

import csv
import io
import json
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

from agents.evaluation.policy_evaluation import run_episodes
from agents.policies.networks.policy_saving import write_policy
from agents.policies.networks.trained_policy import CARD_FILE
from estimator.support.file_io import write_atomically

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

    from agents.training.training_config import TrainConfig

#: The metrics, each the mean over the systems; the score is what policies are ranked by.
HELDOUT_METRICS = ("information_gain", "log_posterior_gain", "coverage", "ended_early")
HELDOUT_SCORE = "log_posterior_gain"

EVALUATIONS_FILE = "evaluations.csv"
BEST_POLICY_FOLDER = "best"

_N_SYSTEMS = 128
_SEED = 0


def final_score(folder: Path) -> float:
    """The score of a finished run, which was evaluated at its end."""
    *_, last = csv.DictReader((folder / EVALUATIONS_FILE).read_text(encoding="utf-8").splitlines())
    return float(last[HELDOUT_SCORE])


class HeldOutEvaluator:
    """Evaluations on the same systems throughout, in ``evaluations.csv``; the best policy so far is in ``best/``.

    Args:
        folder: the run folder.
        config: of the run.
        first_step: samples that the training goes on from; rows beyond them are dropped.
    """

    def __init__(self, folder: Path, config: TrainConfig, first_step: int = 0) -> None:
        self._folder, self._config = folder, config
        self._rows: list[dict[str, float]] = []
        if (folder / EVALUATIONS_FILE).exists():
            for row in csv.DictReader((folder / EVALUATIONS_FILE).read_text(encoding="utf-8").splitlines()):
                if int(row["steps"]) <= first_step:
                    self._rows.append({name: int(v) if name == "steps" else float(v) for name, v in row.items()})
        self._best = float("-inf")
        if (folder / BEST_POLICY_FOLDER / CARD_FILE).exists():
            self._best = json.loads((folder / BEST_POLICY_FOLDER / CARD_FILE).read_text(encoding="utf-8"))[
                "evaluation"
            ][HELDOUT_SCORE]

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
        """Samples, and the information [nats] that was gained then, of every evaluation."""
        return [(int(row["steps"]), row["information_gain"]) for row in self._rows]

    def evaluate(self, model: BaseAlgorithm, card: dict[str, Any]) -> dict[str, float]:
        """Evaluate a model by the mean of its policy, as it would be saved; write the row, and a policy that is best.

        Args:
            model: the algorithm.
            card: of the policy, see `save_policy`.

        Returns:
            `HELDOUT_METRICS`.
        """
        with tempfile.TemporaryDirectory() as candidate:
            write_policy(Path(candidate), model, card)
            options = self._config.options | {"branch": "validation"}
            evaluation, *_ = run_episodes(candidate, self._config.env, _N_SYSTEMS, _SEED, options)
        scores = {name: float(evaluation.metrics[name].mean()) for name in HELDOUT_METRICS}
        self._rows.append({"steps": model.num_timesteps, **scores})
        table = io.StringIO()
        writer = csv.DictWriter(table, ["steps", *HELDOUT_METRICS], lineterminator="\n")
        writer.writeheader()
        writer.writerows(self._rows)
        write_atomically(self._folder / EVALUATIONS_FILE, table.getvalue())
        if scores[HELDOUT_SCORE] > self._best:
            self._best = scores[HELDOUT_SCORE]
            best_card = card | {"evaluation": {"seed": _SEED, "systems": _N_SYSTEMS, **scores}}
            write_policy(self._folder / BEST_POLICY_FOLDER, model, best_card)
        return scores
