"""Training runs: a folder that says what it was made from, holds the policy, and can be resumed after a kill."""

from __future__ import annotations

import json
import math
import shlex
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from agents.interruption import InterruptHandler, add_resume_hint
from agents.output_paths import check_output_folder
from agents.policies.networks.policy_saving import write_policy
from agents.policies.networks.trained_policy import CARD_FILE, CONFIG_FILE, training_steps_of
from agents.result_files import write_json
from agents.training.checkpoints import (
    TrainingProgress,
    delete_training_states,
    latest_checkpoint,
    load_initial_network,
    load_progress,
    restore_training_state,
    save_checkpoint,
)
from agents.training.environments import oscillator_family
from agents.training.heldout_evaluation import HELDOUT_METRICS, HeldOutEvaluator
from agents.training.hyperparameters import track_name
from agents.training.training_config import (
    INFORMATION_REWARDS,
    TrainConfig,
    contrib_packages,
    describe_run,
    read_config,
)
from estimator.support.file_io import explain_write_errors, locked_folder
from estimator.support.optional_dependencies import require_packages
from estimator.support.progress import show_progress

#: Picture of the returns in a run folder.
LEARNING_CURVE_FILE = "learning_curve.png"

#: Samples that the network had learned from that a run began with (``begin``): all of them count.
STEPS_BEFORE_KEY = "steps_before"

#: Folder of the policy before its first update.
UNTRAINED_FOLDER = "untrained"

#: Environments whose episodes under random choices show how features vary.
N_NORMALISER_ENVS = 64

#: After a signal, the update that is on its way may take so many seconds, before nothing more is saved.
_INTERRUPT_PATIENCE = 60.0


@dataclass(frozen=True)
class TrainingRun:
    """A finished training.

    Attributes:
        config: what it was made from.
        folder: the run folder, which is also a policy folder.
        curve: (updates, 3) samples so far, seconds so far, mean return of the last episodes.
        seconds: of wall time, compilation included.
    """

    config: TrainConfig
    folder: Path
    curve: list[tuple[int, float, float]]
    seconds: float


#: Called with the samples so far and `heldout.METRICS`, after every evaluation.
OnEvaluation = Callable[[int, dict[str, float]], None]


def train(config: TrainConfig, on_evaluation: OnEvaluation = lambda steps, found: None) -> TrainingRun:
    """Train a policy, and write a run folder.

    The folder then holds

    - ``config.json``: the resolved configuration, the command and the versions,
    - ``policy.safetensors``, ``policy.json``: the policy,
    - ``checkpoints/STEPS/``: the policy on the way, after the update that these samples were for,
    - ``untrained/``: the policy before its first update,
    - ``progress.csv``: Stable-Baselines3's log,
    - ``evaluations.csv``, ``best/``: where ``eval_every`` is given, the policy's worth on held-out systems before the
      first update and on the way, and the policy that was best by its log posterior gain,
    - ``events.out.tfevents.*``: both logs for TensorBoard, where ``tensorboard`` is set,
    - ``learning_curve.png``, where an episode ended.

    Until it is finished, the latest checkpoint also holds what `resume` goes on from.

    Raises:
        Interrupted: after a signal; its ``left`` says whether anything was kept, and how to go on.
        ModuleNotFoundError: without the packages of the extra ``train``.
        ValueError: for settings that make no sense, or a folder that another process trains in, before anything is
            written.
        OSError: naming the file that cannot be written; where there is no checkpoint to go on from, nothing is left.
    """
    require_packages("torch", "stable_baselines3", "matplotlib", *contrib_packages(config))
    with _create_run_folder(config) as folder, add_resume_hint(lambda message: message or _resume_hint(folder)):
        return _TrainingLoop(config, folder, on_evaluation).run()


def resume(folder: Path, on_evaluation: OnEvaluation = lambda steps, found: None) -> TrainingRun:
    """Go on with a run that was stopped, from its latest checkpoint, up to the samples that it was to have.

    It is then the run that was never stopped, bit for bit: weights, moments of the optimisers, replay buffer, episodes,
    streams of random numbers and schedules go on, and the log loses what came after the checkpoint. Of the family, and
    with ``vary``, the environments begin new episodes, which follow from the run's seed and the samples so far.

    Args:
        folder: the run folder.
        on_evaluation: as of `train`.

    Raises:
        ValueError: where it is no run folder, the run is finished, or another process trains in it.
        OSError: where nothing can be written there.
    """
    if not (folder / CONFIG_FILE).is_file():
        raise ValueError(
            f"resume must be a run folder, which holds {CONFIG_FILE}, but {folder} is not one; name a run's"
        )
    with locked_folder("resume", folder), add_resume_hint(lambda message: message or _resume_hint(folder)):
        if (folder / CARD_FILE).exists():
            command = shlex.join(["duffing-env", "train", "--begin", str(folder)])
            raise ValueError(
                f"resume must be a run that was stopped, but {folder} is finished; for more samples begin another run "
                f"with its network: {command}"
            )
        check_output_folder("resume", folder)
        return _TrainingLoop(read_config(folder), folder, on_evaluation).run()


def train_or_resume(config: TrainConfig, on_evaluation: OnEvaluation = lambda steps, found: None) -> None:
    """Train into ``config.output``, or go on with what is there; of a finished run there is nothing to do."""
    assert config.output is not None
    if not (config.output / CONFIG_FILE).exists():
        train(config, on_evaluation)
    elif not (config.output / CARD_FILE).exists():
        resume(config.output, on_evaluation)


def _resume_hint(folder: Path) -> str:
    """What is left of a training that is being stopped, and how to go on."""
    command = shlex.join(["duffing-env", "train", "--resume", str(folder)])
    if latest_checkpoint(folder) is not None:
        return f"go on with: {command}"
    return "nothing was kept" + (f"; begin again with: {command}" if (folder / CONFIG_FILE).exists() else "")


class _TrainingLoop:
    """A model, its environments, and what is written on the way."""

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
        self._envs = _make_training_envs(config, seed)
        self._model = config.hyperparameters.make(self._envs, seed)
        if checkpoint is not None:
            restore_training_state(checkpoint, self._model)
        elif config.begin is not None:
            load_initial_network(config.begin, self._model)
        elif config.imitate is not None:
            from agents.training.imitation import imitate_policy

            with show_progress("Imitating") as on_progress:
                imitate_policy(self._model, self._envs, config.imitate, config.imitations, config.seed, on_progress)
        self._n_checkpoints = self._n_checkpoints_due()
        self._evaluator = HeldOutEvaluator(folder, config, first_step)
        self._on_evaluation = on_evaluation
        self._tensorboard: Any = None
        config_file = folder / CONFIG_FILE
        self._description = (
            json.loads(config_file.read_text(encoding="utf-8")) if config_file.exists() else describe_run(config)
        )
        if not config_file.exists() and config.begin is not None:
            self._description[STEPS_BEFORE_KEY] = training_steps_of(config.begin)

    def run(self) -> TrainingRun:
        from stable_baselines3.common.logger import KVWriter

        from agents.evaluation.figures import plot_learning_curve, save_png
        from agents.training.training_logs import ResumedCSVLog, TensorBoardLog, WallTimeLogger

        if not (self._folder / CONFIG_FILE).exists():
            write_json(self._folder / CONFIG_FILE, self._description)
        logs: list[KVWriter] = [ResumedCSVLog(self._folder / "progress.csv", self._progress.steps)]
        if self._config.tensorboard:
            self._tensorboard = TensorBoardLog(self._folder)
            logs.append(self._tensorboard)
        with closing(WallTimeLogger(self._folder, logs, self._progress.steps)) as logger:
            self._model.set_logger(logger)
            if self._progress.steps == 0:
                write_policy(self._folder / UNTRAINED_FOLDER, self._model, self._policy_card())
            if self._config.eval_every > 0 and not self._evaluator.has_begun:
                self._evaluate()
            self._learn()
        curve = [(steps, seconds, math.nan if mean is None else mean) for steps, seconds, mean in self._progress.curve]
        if not all(math.isnan(mean) for *_, mean in curve):
            figure = plot_learning_curve(curve, self._config.reward, self._evaluator.information_gains)
            save_png(figure, self._folder / LEARNING_CURVE_FILE)
        write_policy(self._folder, self._model, self._policy_card())
        delete_training_states(self._folder)
        self._envs.close()
        return TrainingRun(self._config, self._folder, curve, self._elapsed_seconds())

    def _learn(self) -> None:
        """Learn, and show how far it is."""
        from agents.training.training_logs import TrainingCallback

        total, first_step = self._config.steps, self._progress.steps
        with ExitStack() as stack:
            on_progress = stack.enter_context(show_progress("Training"))
            on_progress(first_step / total)
            episode_note = ""

            def on_step(steps: int) -> None:
                on_progress(min(steps / total, 1.0), episode_note)

            def on_rollout(steps: int, mean_return: float) -> None:
                nonlocal episode_note
                self._progress.curve.append(
                    (steps, self._elapsed_seconds(), None if math.isnan(mean_return) else mean_return)
                )
                episode_note = "no episode has ended" if math.isnan(mean_return) else f"return {mean_return:.2f}"
                on_step(steps)

            def on_update() -> None:
                self._on_update()
                if interrupt_handler.is_requested and self._model.num_timesteps < total:
                    self._save_checkpoint()
                    interrupt_handler.raise_if_interrupted(_resume_hint(self._folder))

            interrupt_handler = stack.enter_context(InterruptHandler(_INTERRUPT_PATIENCE))
            self._model.learn(
                total - first_step,
                callback=TrainingCallback(
                    on_rollout, on_update, on_step, getattr(self._config.hyperparameters, "entropy_bonus", 0.0)
                ),
                log_interval=self._config.hyperparameters.log_interval,
                reset_num_timesteps=first_step == 0,
            )

    def _on_update(self) -> None:
        """Evaluate, and write a checkpoint, where one is due; the last one is not gone on from."""
        if self._is_evaluation_due():
            self._evaluate()
        if self._n_checkpoints_due() > self._n_checkpoints:
            self._n_checkpoints = self._n_checkpoints_due()
            self._save_checkpoint()

    def _evaluate(self) -> None:
        """Evaluate, and tell what was found to all who want to know."""
        scores = self._evaluator.evaluate(self._model, self._policy_card())
        if self._tensorboard is not None:
            for name in HELDOUT_METRICS:
                self._tensorboard.writer.add_scalar(f"evaluation/{name}", scores[name], self._model.num_timesteps)
        self._on_evaluation(self._model.num_timesteps, scores)

    def _save_checkpoint(self) -> None:
        """Write a checkpoint."""
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
        """How many checkpoints there should be by now."""
        done = min(self._model.num_timesteps, self._config.steps)
        return done * self._config.checkpoints // self._config.steps

    def _policy_card(self) -> dict[str, Any]:
        learned_from = self._model.num_timesteps + self._description.get(STEPS_BEFORE_KEY, 0)
        return {"algorithm": self._config.algo, "steps": learned_from, **self._description}

    def _elapsed_seconds(self) -> float:
        return time.perf_counter() - self._start_time


def _make_training_envs(config: TrainConfig, seed: int) -> Any:
    """The environments of a run, seen as its hyperparameters say; features are normalised by the run's own seed."""
    from agents.sb3_vec_env import DuffingVecEnv

    hyperparameters = config.hyperparameters
    if not hyperparameters.features:
        options = {"reward": config.reward, **config.options}
        return DuffingVecEnv(
            config.env, hyperparameters.num_envs, seed=seed, levels=getattr(hyperparameters, "levels", 0), **options
        )
    envs, samples = _make_feature_envs(config, hyperparameters.num_envs, seed)
    normaliser_envs, _ = _make_feature_envs(config, N_NORMALISER_ENVS, config.seed)
    envs.normalizer.fit(normaliser_envs, samples, config.seed)
    return envs


def _make_feature_envs(config: TrainConfig, num_envs: int, seed: int) -> tuple[Any, int]:
    """Environments that show features, and the samples of an episode."""
    from agents.evaluation.track_batch import make_track_batch
    from agents.sb3_vec_env import DuffingVecEnv
    from agents.training.environments.feature_vec_env import FeatureVecEnv
    from agents.training.environments.mixed_vec_env import MixedVecEnv, draw_track_options

    options, raw_observation = {"reward": config.reward, **config.options}, config.hyperparameters.own
    levels = getattr(config.hyperparameters, "levels", 0)
    mixed_options: dict[str, Any] = {"reward": config.reward, "levels": levels}
    if config.env == oscillator_family.FAMILY:
        return MixedVecEnv(
            num_envs, seed, oscillator_family.draw_rig_track, **mixed_options
        ), oscillator_family.TYPICAL_SAMPLES
    if config.vary:
        for name, bound in ((name, end) for name, bounds in config.vary.items() for end in bounds):
            checked_envs = make_track_batch(
                config.env, 1, options | {name: bound}
            )  # which refuses what the option may not be
            checked_envs.close()
        draw = partial(draw_track_options, env_id=config.env, options=config.options, ranges=config.vary)
        return MixedVecEnv(num_envs, seed, draw, raw_observation=raw_observation, **mixed_options), checked_envs.horizon
    envs = DuffingVecEnv(config.env, num_envs, seed=seed, **options)
    samples = int(envs.envs.unwrapped.experiment.samples)
    return FeatureVecEnv(
        envs, raw_observation=raw_observation, levels=levels, reward_in_nats=config.reward in INFORMATION_REWARDS
    ), samples


@contextmanager
def _create_run_folder(config: TrainConfig) -> Iterator[Path]:
    """The folder to write to, held meanwhile; an error of the disk leaves nothing there without a checkpoint."""
    _check_run_folder(config)
    base = Path("runs") / f"{config.algo}-{track_name(config.env).lower()}-{config.seed}"
    folder, number, is_made = config.output or base, 1, False
    created_parents = [place for place in (folder, *folder.parents) if not place.exists()]
    while not is_made:
        with explain_write_errors(folder):
            try:
                folder.mkdir(parents=True, exist_ok=config.output is not None)
                is_made = True
            except FileExistsError:
                number += 1
                folder = base.with_name(f"{base.name}-{number}")
                created_parents = [folder, *created_parents[1:]]
    with locked_folder("output", folder):
        _check_run_folder(config)  # nobody else had it before
        try:
            yield folder
        except OSError:
            if latest_checkpoint(folder) is None:
                for path in folder.iterdir():
                    shutil.rmtree(path) if path.is_dir() else path.unlink()
            raise
        finally:
            with suppress(OSError):  # one that holds something stays
                for parent in created_parents:
                    parent.rmdir()


def _check_run_folder(config: TrainConfig) -> None:
    """Refuse a named folder that is neither new nor empty."""
    if config.output is not None:
        for content, name in (("run", CONFIG_FILE), ("policy", CARD_FILE)):
            if (config.output / name).exists():
                raise ValueError(
                    f"output must be a new folder, but {config.output} holds a {content}; remove it or name another"
                )
        if config.output.is_dir() and (other := min((path.name for path in config.output.iterdir()), default="")):
            raise ValueError(
                f"output must be a new or empty folder, but {config.output} holds {other}, which is no training's; "
                "name another"
            )
