"""`train` and `resume`: a training run in a folder, which holds its configuration and goes on after a kill."""

from __future__ import annotations

import shlex
from pathlib import Path

from agents.interruption import add_resume_hint
from agents.output_paths import check_output_folder
from agents.policies.networks.trained_policy import CARD_FILE, CONFIG_FILE
from agents.training.heldout_evaluation import HeldOutScores
from agents.training.run_folder import create_run_folder, resume_hint
from agents.training.training_config import TrainConfig, contrib_packages, read_config
from agents.training.training_loop import OnEvaluation, TrainingLoop, TrainingRun
from estimator.support.file_io import locked_folder
from estimator.support.optional_dependencies import require_packages


def ignore_evaluation(steps: int, scores: HeldOutScores) -> None:
    """An `OnEvaluation` that does nothing."""


def train(config: TrainConfig, on_evaluation: OnEvaluation = ignore_evaluation) -> TrainingRun:
    """Train a policy, and write a run folder.

    The folder then holds

    - ``config.json``: the resolved configuration, the command and the versions,
    - ``policy.safetensors``, ``policy.json``: the policy,
    - ``checkpoints/STEPS/``: the policy after the update by these samples,
    - ``untrained/``: the policy before its first update,
    - ``progress.csv``: Stable-Baselines3's log,
    - ``evaluations.csv``, ``best/``: where ``eval_every`` is given, the scores on held-out systems before the first
      update and during the training, and the policy with the best log posterior gain,
    - ``events.out.tfevents.*``: both logs for TensorBoard, where ``tensorboard`` is set,
    - ``learning_curve.png``, where an episode ended.

    Until the run is finished, the latest checkpoint also holds the state from which `resume` goes on.

    Args:
        config: of the run.
        on_evaluation: called after every evaluation on held-out systems.

    Raises:
        Interrupted: after a signal; its ``resume_hint`` says whether anything was kept, and how to go on.
        ModuleNotFoundError: without the packages of the extra ``train``.
        ValueError: for settings that contradict each other, or a folder that another process trains in, before anything
            is written.
        OSError: naming the file that cannot be written; without a checkpoint nothing is left in the folder.
    """
    require_packages("torch", "stable_baselines3", "matplotlib", *contrib_packages(config))
    with create_run_folder(config) as folder, add_resume_hint(lambda message: message or resume_hint(folder)):
        return TrainingLoop(config, folder, on_evaluation).run()


def resume(folder: Path, on_evaluation: OnEvaluation = ignore_evaluation) -> TrainingRun:
    """Go on with a run that was stopped, from its latest checkpoint, up to the samples of its configuration.

    The result is the run without the stop, bit for bit: weights, moments of the optimisers, replay buffer, episodes,
    streams of random numbers and schedules go on, and the log loses its rows after the checkpoint. On the family, and
    with ``vary``, the environments begin new episodes, which follow from the run's seed and the samples so far.

    Args:
        folder: the run folder.
        on_evaluation: as of `train`.

    Raises:
        ValueError: for a folder that is no run folder, a run that is finished, or a folder that another process trains
            in.
        OSError: where nothing can be written in the folder.
    """
    if not (folder / CONFIG_FILE).is_file():
        raise ValueError(
            f"resume must be a run folder, which holds {CONFIG_FILE}, but {folder} is not one; name a run's"
        )
    with locked_folder("resume", folder), add_resume_hint(lambda message: message or resume_hint(folder)):
        if (folder / CARD_FILE).exists():
            command = shlex.join(["duffing-env", "train", "--begin", str(folder)])
            raise ValueError(
                f"resume must be a run that was stopped, but {folder} is finished; for more samples begin another run "
                f"with its network: {command}"
            )
        check_output_folder("resume", folder)
        return TrainingLoop(read_config(folder), folder, on_evaluation).run()


def train_or_resume(config: TrainConfig, on_evaluation: OnEvaluation = ignore_evaluation) -> None:
    """Train into ``config.output``, or go on with the run in it; a finished run is left as it is."""
    assert config.output is not None
    if not (config.output / CONFIG_FILE).exists():
        train(config, on_evaluation)
    elif not (config.output / CARD_FILE).exists():
        resume(config.output, on_evaluation)
