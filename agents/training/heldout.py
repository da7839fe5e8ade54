"""What a policy is worth on the way: by the metrics of `evaluate.py`, on systems of the branch ``validation``."""

from __future__ import annotations

import csv
import io
import json
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

from agents.evaluation.rollout import roll_out
from agents.policies.learned import CARD
from agents.policies.saving import write_policy
from estimator.files import write_atomically

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

    from agents.training.config import TrainConfig

#: The metrics, each the mean over the systems; the score is what policies are ranked by.
METRICS = ("information_gain", "log_posterior_gain", "coverage", "ended_early")
SCORE = "log_posterior_gain"

FILE = "evaluations.csv"
BEST = "best"

_SYSTEMS = 128
_SEED = 0


def score_of(folder: Path) -> float:
    """The score of a finished run, which was evaluated at its end."""
    *_, last = csv.DictReader((folder / FILE).read_text(encoding="utf-8").splitlines())
    return float(last[SCORE])


class HeldOut:
    """Evaluations on the same systems throughout, in ``evaluations.csv``; the best policy so far is in ``best/``.

    Args:
        folder: the run folder.
        config: of the run.
        steps: samples that the training goes on from; rows beyond them are dropped.
    """

    def __init__(self, folder: Path, config: TrainConfig, steps: int = 0) -> None:
        self._folder, self._config = folder, config
        self._rows: list[dict[str, float]] = []
        if (folder / FILE).exists():
            for row in csv.DictReader((folder / FILE).read_text(encoding="utf-8").splitlines()):
                if int(row["steps"]) <= steps:
                    self._rows.append({name: int(v) if name == "steps" else float(v) for name, v in row.items()})
        self._best = float("-inf")
        if (folder / BEST / CARD).exists():
            self._best = json.loads((folder / BEST / CARD).read_text(encoding="utf-8"))["evaluation"][SCORE]

    @property
    def has_begun(self) -> bool:
        """Whether there was an evaluation."""
        return bool(self._rows)

    @property
    def steps(self) -> int:
        """Samples at the last evaluation."""
        return int(self._rows[-1]["steps"]) if self._rows else 0

    @property
    def gains(self) -> list[tuple[int, float]]:
        """Samples, and the information [nats] that was gained then, of every evaluation."""
        return [(int(row["steps"]), row["information_gain"]) for row in self._rows]

    def evaluate(self, model: BaseAlgorithm, card: dict[str, Any]) -> dict[str, float]:
        """Evaluate a model by the mean of its policy, as it would be saved; write the row, and a policy that is best.

        Args:
            model: the algorithm.
            card: of the policy, see `save_policy`.

        Returns:
            `METRICS`.
        """
        with tempfile.TemporaryDirectory() as candidate:
            write_policy(Path(candidate), model, card)
            options = self._config.options | {"branch": "validation"}
            evaluation, *_ = roll_out(candidate, self._config.env, _SYSTEMS, _SEED, options)
        found = {name: float(evaluation.metrics[name].mean()) for name in METRICS}
        self._rows.append({"steps": model.num_timesteps, **found})
        table = io.StringIO()
        writer = csv.DictWriter(table, ["steps", *METRICS], lineterminator="\n")
        writer.writeheader()
        writer.writerows(self._rows)
        write_atomically(self._folder / FILE, table.getvalue())
        if found[SCORE] > self._best:
            self._best = found[SCORE]
            judged = card | {"evaluation": {"seed": _SEED, "systems": _SYSTEMS, **found}}
            write_policy(self._folder / BEST, model, judged)
        return found
