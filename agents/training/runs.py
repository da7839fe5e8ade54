"""Training runs: a folder that says what it was made from, holds the policy, and can be resumed after a kill."""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from agents.cli import RIG_TRACK, JsonOptions, check_track, with_rig
from agents.policies.learned import CARD
from agents.policies.saving import save_policy
from agents.results import versions, write_json
from agents.running.stopping import Stopper
from agents.training.algorithms import ALGORITHMS, AlgorithmSettings, as_written
from agents.training.checkpoints import (
    Progress,
    begin_with,
    drop_states,
    latest_checkpoint,
    load_progress,
    restore,
    save_checkpoint,
)
from agents.training.family import FAMILY
from agents.training.heldout import METRICS, HeldOut
from agents.training.hyperparameters import read_settings, settings_of, track_of
from estimator.extras import need
from estimator.files import whole_file

if TYPE_CHECKING:
    from stable_baselines3.common.vec_env import VecEnv

_PACKAGES = ("duffing-env", "gymnasium", "numpy", "numba", "scipy", "stable-baselines3", "torch")


#: After a signal, the update that is on its way may take so many seconds, before nothing more is saved.
_PATIENCE = 60.0


@dataclass(frozen=True)
class Subject:
    """What is trained on what; the hyperparameters follow from it, where they are not given."""

    algo: Literal["ppo", "sac", "td3", "tqc", "recurrent_ppo"] = "ppo"
    """Algorithm."""
    env: str = "duffing_env/Amplitude-v0"
    """Id of the track; or family, the oscillators of all kinds that ppo/universal is trained on."""
    rig: str | None = None
    """Rig file; the track is then Rig-v0."""
    settings: Path | None = None
    """File of hyperparameters, TOML; the one that comes with the package where it is not given."""

    def __post_init__(self) -> None:
        if self.rig is not None:
            object.__setattr__(self, "env", RIG_TRACK)


@dataclass(frozen=True)
class TrainConfig(Subject):
    """What a training run is made from. Written to ``config.json`` of its folder."""

    reward: str = "information_gain"
    """Name of the reward, such as information_gain, log_posterior or fisher (`duffing_env.rewards` has all)."""
    steps: int = 5_000_000
    """Samples to learn from, over all environments."""
    seed: int = 0
    """Seed of systems, noise, weights and exploration; the same seed gives the same policy."""
    options: JsonOptions = field(default_factory=dict)
    """Further options of the environment, as JSON."""
    output: Path | None = None
    """Run folder; runs/ALGO-TRACK-SEED where it is not given, with a number where that exists."""
    begin: Path | None = None
    """Policy folder whose network to begin with, of the same algorithm and shape. Where it is not given: at the rule
    that its features tell (`agents.training.rule`), where they are those of all oscillators, or else at random."""
    checkpoints: int = 5
    """Checkpoints over the run, evenly spaced."""
    eval_every: int = 0
    """Samples between evaluations on systems held out from training; 0 for none."""
    tensorboard: bool = False
    """Whether to write the log for TensorBoard, too."""
    torch_threads: int = 1
    """Threads of torch; it moves the last digits. More than one gain little, and lose much on a busy machine."""
    hyperparameters: AlgorithmSettings = field(default=None)  # type: ignore[assignment]
    """Hyperparameters; those that the file has for the track where they are not given."""

    def __post_init__(self) -> None:
        super().__post_init__()
        # A run has its rig in itself, and not the name of a file that may change.
        object.__setattr__(self, "options", with_rig(self.options, self.rig))
        object.__setattr__(self, "rig", None)
        for name in ("steps", "checkpoints", "torch_threads"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, but is {getattr(self, name)}")
        if self.eval_every < 0:
            raise ValueError(f"eval_every must be at least 0, but is {self.eval_every}")
        if self.tensorboard:
            need("tensorboard")
        if "reward" in self.options:
            raise ValueError(f"options must not hold reward, but are {self.options}; reward has a place of its own")
        if "branch" in self.options:
            raise ValueError(f"options must not hold branch, but are {self.options}; the others are to compare on")
        if self.env != FAMILY:
            check_track(self.env)
        elif self.options or self.eval_every or self.algo != "ppo":
            raise ValueError(
                f"env {FAMILY!r} takes no options, no eval_every, and ppo alone; leave them out, and compare with "
                "python -m agents.studies.universal"
            )
        if self.hyperparameters is None:
            object.__setattr__(self, "hyperparameters", read_settings(self.algo, self.env, self.settings))
        if type(self.hyperparameters) is not ALGORITHMS[self.algo]:
            raise ValueError(
                f"hyperparameters must be {ALGORITHMS[self.algo].__name__} for {self.algo}, "
                f"but are {type(self.hyperparameters).__name__}"
            )
        if (first := getattr(self.hyperparameters, "learning_starts", 0)) >= self.steps:
            raise ValueError(
                f"learning_starts must be below steps, but is {first} of {self.steps}: nothing would be learned; "
                "lower it, or take more steps"
            )

    @property
    def samples(self) -> int:
        """Samples that are learned from: ``steps``, up to a whole number of updates."""
        each = self.hyperparameters.samples_per_update
        return -(-self.steps // each) * each


@dataclass(frozen=True)
class Run:
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


def train(config: TrainConfig, on_evaluation: OnEvaluation = lambda steps, found: None) -> Run:
    """Train a policy, and write a run folder.

    The folder then holds

    - ``config.json``: the resolved configuration, the command and the versions,
    - ``policy.safetensors``, ``policy.json``: the policy,
    - ``checkpoints/STEPS/``: the policy on the way, after the update that these samples were for,
    - ``progress.csv``: Stable-Baselines3's log,
    - ``evaluations.csv``, ``best/``: where ``eval_every`` is given, the policy's worth on held-out systems on the
      way, and the policy that was best by its log posterior gain,
    - ``events.out.tfevents.*``: both logs for TensorBoard, where ``tensorboard`` is set,
    - ``learning_curve.png``.

    Until it is finished, the latest checkpoint also holds what `resume` goes on from.

    Raises:
        ModuleNotFoundError: without the packages of the extra ``train``.
        ValueError: for settings that make no sense, before anything is written.
    """
    need("torch", "stable_baselines3", "matplotlib", *_contrib(config))
    return _Training(config, _run_folder(config), on_evaluation).run()


def resume(folder: Path) -> Run:
    """Go on with a run that was stopped, from its latest checkpoint, up to the samples that it was to have.

    The count of samples, the moments of the optimisers, the schedule of the learning rate and the replay buffer go on;
    the log loses what came after the checkpoint. All environments begin new episodes, with systems and noise that
    follow from the run's seed and the samples so far: so a resumed run repeats itself, but is not the run that was
    never stopped.

    Args:
        folder: the run folder.

    Raises:
        ValueError: where it is no run folder, or the run is finished.
    """
    if not (folder / "config.json").is_file():
        raise ValueError(f"resume must be a run folder, which holds config.json, but is {folder}")
    if (folder / CARD).exists():
        raise ValueError(f"resume must be a run that was stopped, but {folder} is finished; it holds its policy")
    return _Training(_read_config(folder), folder).run()


class _Training:
    """A model, its environments, and what is written on the way."""

    def __init__(
        self, config: TrainConfig, folder: Path, on_evaluation: OnEvaluation = lambda steps, found: None
    ) -> None:
        import torch

        self._clock = time.perf_counter()
        self._config, self._folder = config, folder
        torch.set_num_threads(config.torch_threads)
        checkpoint = latest_checkpoint(folder)
        self._progress = Progress() if checkpoint is None else load_progress(checkpoint)
        self._clock -= self._progress.seconds
        begun = self._progress.steps
        seed = int(np.random.SeedSequence((config.seed, begun)).generate_state(1)[0]) if begun else config.seed
        self._envs = _make_envs(config, seed)
        self._model = config.hyperparameters.make(self._envs, seed)
        if checkpoint is not None:
            restore(checkpoint, self._model)
        elif config.begin is not None:
            begin_with(config.begin, self._model)
        else:
            from agents.training.rule import begin_with_rule

            begin_with_rule(self._model, self._envs, seed)
        self._checkpoints = self._due_checkpoints()
        self._held_out = HeldOut(folder, config, begun)
        self._evaluated = on_evaluation
        self._board: Any = None
        self._description = describe(config)

    def run(self) -> Run:
        from stable_baselines3.common.logger import KVWriter, Logger, TensorBoardOutputFormat

        from agents.evaluation.figures import figure_of_learning, save
        from agents.training.callbacks import ContinuedCSV

        if not (self._folder / "config.json").exists():
            write_json(self._folder / "config.json", self._description)
        logs: list[KVWriter] = [ContinuedCSV(self._folder / "progress.csv", self._progress.steps)]
        if self._config.tensorboard:
            self._board = TensorBoardOutputFormat(str(self._folder))
            logs.append(self._board)
        with closing(Logger(str(self._folder), logs)) as logger:
            self._model.set_logger(logger)
            self._learn()
        curve = [(steps, at, math.nan if mean is None else mean) for steps, at, mean in self._progress.curve]
        save(figure_of_learning(curve, self._config.reward), self._folder / "learning_curve.png")
        save_policy(self._folder, self._model, self._card())
        drop_states(self._folder)
        self._envs.close()
        return Run(self._config, self._folder, curve, self._seconds())

    def _learn(self) -> None:
        """Learn with a progress bar."""
        from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

        from agents.training.callbacks import Watch

        columns = (TextColumn("Training"), BarColumn(), TextColumn("{task.fields[status]}"), TimeRemainingColumn())
        total, begun = self._config.steps, self._progress.steps
        with ExitStack() as stack:
            bar = stack.enter_context(Progress(*columns))
            task = bar.add_task("", total=total, completed=begun, status="compiling")
            started = time.perf_counter()

            def on_rollout(steps: int, mean_return: float) -> None:
                self._progress.curve.append((steps, self._seconds(), None if math.isnan(mean_return) else mean_return))
                rate = (steps - begun) / (time.perf_counter() - started)
                status = f"{steps:,} samples, {rate:,.0f}/s, return {mean_return:.2f}"
                bar.update(task, completed=min(steps, total), status=status)

            def on_update() -> None:
                self._on_update()
                if stopper.is_asked and self._model.num_timesteps < total:
                    self._save()
                    stopper.check(f"go on with: duffing-env train --resume {self._folder}")

            stopper = stack.enter_context(Stopper(_PATIENCE))
            self._model.learn(
                total - begun,
                callback=Watch(on_rollout, on_update, getattr(self._config.hyperparameters, "entropy_bonus", 0.0)),
                log_interval=self._config.hyperparameters.log_interval,
                reset_num_timesteps=begun == 0,
            )

    def _on_update(self) -> None:
        """Evaluate, and write a checkpoint, where one is due; the last one is not gone on from."""
        if self._due_evaluation():
            found = self._held_out.evaluate(self._model, self._card())
            if self._board is not None:
                for name in METRICS:
                    self._board.writer.add_scalar(f"evaluation/{name}", found[name], self._model.num_timesteps)
            self._evaluated(self._model.num_timesteps, found)
        if self._due_checkpoints() > self._checkpoints:
            self._checkpoints = self._due_checkpoints()
            self._save()

    def _save(self) -> None:
        """Write a checkpoint."""
        model, progress = self._model, self._progress
        progress.steps, progress.updates = model.num_timesteps, model._n_updates
        progress.episodes, progress.seconds = model._episode_num, self._seconds()
        unfinished = model.num_timesteps < self._config.steps
        save_checkpoint(self._folder, model, self._card(), progress if unfinished else None)

    def _due_evaluation(self) -> bool:
        """Whether the next multiple of ``eval_every`` is reached, or the end."""
        steps, every, before = self._model.num_timesteps, self._config.eval_every, self._held_out.steps
        return every > 0 and (steps // every > before // every or steps >= self._config.steps > before)

    def _due_checkpoints(self) -> int:
        """How many checkpoints there should be by now."""
        done = min(self._model.num_timesteps, self._config.steps)
        return done * self._config.checkpoints // self._config.steps

    def _card(self) -> dict[str, Any]:
        return {"algorithm": self._config.algo, "steps": self._model.num_timesteps, **self._description}

    def _seconds(self) -> float:
        return time.perf_counter() - self._clock


def _make_envs(config: TrainConfig, seed: int) -> VecEnv:
    """The environments of a run, seen as its hyperparameters say."""
    from agents.vec_env import DuffingVecEnv

    asked = config.hyperparameters
    levels = getattr(asked, "levels", 0)
    options = {"reward": config.reward, **config.options}
    if config.env == FAMILY:
        from agents.training.family_env import FamilyVecEnv

        return FamilyVecEnv(asked.num_envs, seed, reward=config.reward, levels=levels)
    if not asked.foresight:
        return DuffingVecEnv(config.env, asked.num_envs, seed=seed, levels=levels, **options)
    from agents.training.foresight_env import IN_NATS, ForesightVecEnv, foresight_of

    envs = DuffingVecEnv(config.env, asked.num_envs, seed=seed, **options)
    foresight = foresight_of(envs.envs, config.env, config.options, config.seed)
    return ForesightVecEnv(envs, foresight, levels, in_nats=config.reward in IN_NATS)


def _run_folder(config: TrainConfig) -> Path:
    """The folder to write to; one that is named must not hold a run already."""
    if config.output is not None:
        if (config.output / "config.json").exists():
            raise ValueError(f"output must be a new folder, but {config.output} holds a run; remove it or name another")
        return config.output
    base = Path("runs") / f"{config.algo}-{track_of(config.env).lower()}-{config.seed}"
    folder, number = base, 1
    while folder.exists():
        number += 1
        folder = base.with_name(f"{base.name}-{number}")
    return folder


def describe(config: TrainConfig) -> dict[str, Any]:
    """What a run was made from: the resolved configuration, the command and the versions."""
    resolved = asdict(config) | {"hyperparameters": as_written(config.hyperparameters)}
    resolved = {name: str(value) if isinstance(value, Path) else value for name, value in resolved.items()}
    return {
        "config": resolved,
        "command": [Path(sys.argv[0]).name, *sys.argv[1:]],
        "versions": versions(*_PACKAGES, *_contrib(config)),
    }


def _contrib(config: TrainConfig) -> tuple[str, ...]:
    """sb3-contrib, where the algorithm is of it."""
    return ("sb3_contrib",) if config.algo in ("tqc", "recurrent_ppo") else ()


def _read_config(folder: Path) -> TrainConfig:
    """The configuration that a run folder was made from; what only a script had in it is left out."""
    try:
        place = whole_file(folder / "config.json", "resume must be a run folder, with a config.json", 2**20)
        found = json.loads(place.read_text())["config"]
        known = {f.name: found[f.name] for f in fields(TrainConfig)}
        known |= {name: None if known[name] is None else Path(known[name]) for name in ("output", "settings", "begin")}
        known["hyperparameters"] = settings_of(ALGORITHMS[known["algo"]], known["hyperparameters"])
        return TrainConfig(**known)
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError(f"config.json must be that of a run, but that of {folder} is not: {error!r}") from error
