"""The loop of a training: a model of Stable-Baselines3, its environments, and the files that are written meanwhile."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from agents.interruption import InterruptHandler
from agents.policies.networks.policy_saving import write_policy
from agents.policies.networks.trained_policy import CONFIG_FILE, training_steps_of
from agents.result_files import write_json
from agents.training.checkpoints import (
    LearningPoint,
    TrainingProgress,
    delete_training_states,
    latest_checkpoint,
    load_initial_network,
    load_progress,
    restore_training_state,
    save_checkpoint,
)
from agents.training.heldout_evaluation import HeldOutEvaluator, HeldOutScores
from agents.training.run_folder import LEARNING_CURVE_FILE, UNTRAINED_FOLDER, resume_hint
from agents.training.training_config import TrainConfig, describe_run
from estimator.support.progress import ProgressCallback, ignore_progress, show_progress

if TYPE_CHECKING:
    from agents.training.training_logs import TensorBoardLog

#: Key of policy.json: samples that the initial network (``begin``) had learned from; they count as samples, too.
STEPS_BEFORE_KEY = "steps_before"

#: Longest time that the present update may take after a signal; after it, no checkpoint is saved [s].
_INTERRUPT_PATIENCE = 60.0

#: Called with the samples so far and the scores, after every evaluation on held-out systems.
OnEvaluation = Callable[[int, HeldOutScores], None]


@dataclass(frozen=True)
class TrainingRun:
    """A finished training.

    Attributes:
        config: of the run.
        folder: the run folder, which is also a policy folder.
        curve: a point for every update.
        seconds: of wall time, compilation included.
    """

    config: TrainConfig
    folder: Path
    curve: list[LearningPoint]
    seconds: float


class TrainingLoop:
    """A training in a run folder, from its beginning or from the latest checkpoint.

    Args:
        config: of the run.
        folder: the run folder.
        on_evaluation: called after every evaluation on held-out systems.
    """

    def __init__(self, config: TrainConfig, folder: Path, on_evaluation: OnEvaluation) -> None:
        import torch

        self._start_time = time.perf_counter()
        self._config, self._folder = config, folder
        torch.set_num_threads(config.torch_threads)
        checkpoint = latest_checkpoint(folder)
        self._progress = TrainingProgress() if checkpoint is None else load_progress(checkpoint)
        self._start_time -= self._progress.seconds
        first_step = self._progress.steps
        seed = (
            int(np.random.SeedSequence((config.seed, first_step)).generate_state(1)[0]) if first_step else config.seed
        )
        from agents.training.environments.training_envs import make_training_envs

        self._envs = make_training_envs(config, seed)
        self._model = config.hyperparameters.make(self._envs, seed)
        self._initialise_model(checkpoint)
        self._n_checkpoints = self._n_checkpoints_due()
        self._evaluator = HeldOutEvaluator(folder, config, first_step)
        self._on_evaluation = on_evaluation
        self._tensorboard: TensorBoardLog | None = None
        self._report_progress: ProgressCallback = ignore_progress
        self._episode_note = ""
        self._interrupt_handler = InterruptHandler(_INTERRUPT_PATIENCE)
        self._description = self._describe()

    def _initialise_model(self, checkpoint: Path | None) -> None:
        """Load the weights of a checkpoint or another policy, or imitate a policy, or leave the model as it is."""
        config = self._config
        if checkpoint is not None:
            restore_training_state(checkpoint, self._model)
        elif config.begin is not None:
            load_initial_network(config.begin, self._model)
        elif config.imitate is not None:
            from agents.training.dagger_pretraining import imitate_policy
            from agents.training.environments.feature_vec_env import FeatureVecEnv

            assert isinstance(self._envs, FeatureVecEnv)
            with show_progress("Imitating") as on_progress:
                imitate_policy(self._model, self._envs, config.imitate, config.imitations, config.seed, on_progress)

    def _describe(self) -> dict[str, Any]:
        """The content of config.json, as it is in the folder, or of a new run."""
        config_file = self._folder / CONFIG_FILE
        if config_file.exists():
            description: dict[str, Any] = json.loads(config_file.read_text(encoding="utf-8"))
            return description
        steps_before = {} if self._config.begin is None else {STEPS_BEFORE_KEY: training_steps_of(self._config.begin)}
        return {**describe_run(self._config), **steps_before}

    def run(self) -> TrainingRun:
        """Train up to the samples of the configuration, and write the policy."""
        from agents.training.training_logs import WallTimeLogger

        if not (self._folder / CONFIG_FILE).exists():
            write_json(self._folder / CONFIG_FILE, self._description)
        with closing(WallTimeLogger(self._folder, self._open_logs(), self._progress.steps)) as logger:
            self._model.set_logger(logger)
            if self._progress.steps == 0:
                write_policy(self._folder / UNTRAINED_FOLDER, self._model, self._policy_card())
            if self._config.eval_every > 0 and not self._evaluator.has_begun:
                self._evaluate()
            self._learn()
        self._plot_learning_curve()
        write_policy(self._folder, self._model, self._policy_card())
        delete_training_states(self._folder)
        self._envs.close()
        return TrainingRun(self._config, self._folder, self._progress.curve, self._elapsed_seconds())

    def _open_logs(self) -> list[Any]:
        """Stable-Baselines3's log as CSV, and for TensorBoard where that is set."""
        from agents.training.training_logs import ResumedCSVLog, TensorBoardLog

        csv_log = ResumedCSVLog(self._folder / "progress.csv", self._progress.steps)
        if not self._config.tensorboard:
            return [csv_log]
        self._tensorboard = TensorBoardLog(self._folder)
        return [csv_log, self._tensorboard]

    def _plot_learning_curve(self) -> None:
        """Write the learning curve, where an episode has ended."""
        from agents.evaluation.figures import plot_learning_curve, save_png

        if any(point.mean_return is not None for point in self._progress.curve):
            figure = plot_learning_curve(self._progress.curve, self._config.reward, self._evaluator.information_gains)
            save_png(figure, self._folder / LEARNING_CURVE_FILE)

    def _learn(self) -> None:
        """Learn, with checkpoints and evaluations meanwhile, and show the progress."""
        from agents.training.training_logs import TrainingCallback

        total, first_step = self._config.steps, self._progress.steps
        callback = TrainingCallback(
            self._on_rollout,
            self._on_update,
            self._on_step,
            getattr(self._config.hyperparameters, "entropy_bonus", 0.0),
        )
        with ExitStack() as stack:
            self._report_progress = stack.enter_context(show_progress("Training"))
            self._report_progress(first_step / total)
            stack.enter_context(self._interrupt_handler)
            self._model.learn(
                total - first_step,
                callback=callback,
                log_interval=self._config.hyperparameters.log_interval,
                reset_num_timesteps=first_step == 0,
            )

    def _on_step(self, steps: int) -> None:
        self._report_progress(min(steps / self._config.steps, 1.0), self._episode_note)

    def _on_rollout(self, steps: int, mean_return: float) -> None:
        """Add a point to the learning curve; ``mean_return`` is NaN where no episode has ended."""
        has_ended = not math.isnan(mean_return)
        self._progress.curve.append(LearningPoint(steps, self._elapsed_seconds(), mean_return if has_ended else None))
        self._episode_note = f"return {mean_return:.2f}" if has_ended else "no episode has ended"
        self._on_step(steps)

    def _on_update(self) -> None:
        """Evaluate, and write a checkpoint, where one is due or a signal came."""
        if self._is_evaluation_due():
            self._evaluate()
        if self._n_checkpoints_due() > self._n_checkpoints:
            self._n_checkpoints = self._n_checkpoints_due()
            self._save_checkpoint()
        if self._interrupt_handler.is_requested and self._model.num_timesteps < self._config.steps:
            self._save_checkpoint()
            self._interrupt_handler.raise_if_interrupted(resume_hint(self._folder))

    def _evaluate(self) -> None:
        """Evaluate on held-out systems, and report the scores to TensorBoard and to the caller."""
        scores = self._evaluator.evaluate(self._model, self._policy_card())
        if self._tensorboard is not None:
            for name, score in scores._asdict().items():
                self._tensorboard.writer.add_scalar(f"evaluation/{name}", score, self._model.num_timesteps)
        self._on_evaluation(self._model.num_timesteps, scores)

    def _save_checkpoint(self) -> None:
        """Write a checkpoint, with the state of the training unless it is finished."""
        model, progress = self._model, self._progress
        progress.steps, progress.updates = model.num_timesteps, model._n_updates
        progress.episodes, progress.seconds = model._episode_num, self._elapsed_seconds()
        unfinished = model.num_timesteps < self._config.steps
        save_checkpoint(self._folder, model, self._policy_card(), progress if unfinished else None)

    def _is_evaluation_due(self) -> bool:
        """Whether the next multiple of ``eval_every`` is reached, or the end."""
        steps, every, before = self._model.num_timesteps, self._config.eval_every, self._evaluator.steps
        return every > 0 and (steps // every > before // every or steps >= self._config.steps > before)

    def _n_checkpoints_due(self) -> int:
        """Number of checkpoints that are due by now."""
        done = min(self._model.num_timesteps, self._config.steps)
        return done * self._config.checkpoints // self._config.steps

    def _policy_card(self) -> dict[str, Any]:
        """The content of policy.json for the model as it is now."""
        learned_from = self._model.num_timesteps + self._description.get(STEPS_BEFORE_KEY, 0)
        return {"algorithm": self._config.algo, "steps": learned_from, **self._description}

    def _elapsed_seconds(self) -> float:
        return time.perf_counter() - self._start_time
