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

from agents.policies.learned import CARD, CONFIG, steps_of
from agents.policies.saving import write_policy
from agents.results import check_folder, write_json
from agents.stopping import Stopper, telling
from agents.training import family
from agents.training.checkpoints import (
    Progress,
    begin_with,
    drop_states,
    latest_checkpoint,
    load_progress,
    restore,
    save_checkpoint,
)
from agents.training.config import IN_NATS, TrainConfig, contrib, describe, read_config
from agents.training.heldout import METRICS, HeldOut
from agents.training.hyperparameters import track_of
from estimator.extras import need
from estimator.files import held, writing
from estimator.progress import progress

#: Picture of the returns in a run folder.
LEARNING = "learning_curve.png"

#: Samples that the network had learned from that a run began with (``begin``): all of them count.
BEFORE = "steps_before"

#: Folder of the policy before its first update.
UNTRAINED = "untrained"

#: Environments whose episodes under random choices show how features vary.
EXAMPLES = 64

#: After a signal, the update that is on its way may take so many seconds, before nothing more is saved.
_PATIENCE = 60.0


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
    - ``untrained/``: the policy before its first update,
    - ``progress.csv``: Stable-Baselines3's log,
    - ``evaluations.csv``, ``best/``: where ``eval_every`` is given, the policy's worth on held-out systems before the
      first update and on the way, and the policy that was best by its log posterior gain,
    - ``events.out.tfevents.*``: both logs for TensorBoard, where ``tensorboard`` is set,
    - ``learning_curve.png``, where an episode ended.

    Until it is finished, the latest checkpoint also holds what `resume` goes on from.

    Raises:
        Stopped: after a signal; its ``left`` says whether anything was kept, and how to go on.
        ModuleNotFoundError: without the packages of the extra ``train``.
        ValueError: for settings that make no sense, or a folder that another process trains in, before anything is
            written.
        OSError: naming the file that cannot be written; where there is no checkpoint to go on from, nothing is left.
    """
    need("torch", "stable_baselines3", "matplotlib", *contrib(config))
    with _new_folder(config) as folder, telling(lambda said: said or _left(folder)):
        return _Training(config, folder, on_evaluation).run()


def resume(folder: Path, on_evaluation: OnEvaluation = lambda steps, found: None) -> Run:
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
    if not (folder / CONFIG).is_file():
        raise ValueError(f"resume must be a run folder, which holds {CONFIG}, but {folder} is not one; name a run's")
    with held("resume", folder), telling(lambda said: said or _left(folder)):
        if (folder / CARD).exists():
            command = shlex.join(["duffing-env", "train", "--begin", str(folder)])
            raise ValueError(
                f"resume must be a run that was stopped, but {folder} is finished; for more samples begin another run "
                f"with its network: {command}"
            )
        check_folder("resume", folder)
        return _Training(read_config(folder), folder, on_evaluation).run()


def carry_on(config: TrainConfig, on_evaluation: OnEvaluation = lambda steps, found: None) -> None:
    """Train into ``config.output``, or go on with what is there; of a finished run there is nothing to do."""
    assert config.output is not None
    if not (config.output / CONFIG).exists():
        train(config, on_evaluation)
    elif not (config.output / CARD).exists():
        resume(config.output, on_evaluation)


def _left(folder: Path) -> str:
    """What is left of a training that is being stopped, and how to go on."""
    command = shlex.join(["duffing-env", "train", "--resume", str(folder)])
    if latest_checkpoint(folder) is not None:
        return f"go on with: {command}"
    return "nothing was kept" + (f"; begin again with: {command}" if (folder / CONFIG).exists() else "")


class _Training:
    """A model, its environments, and what is written on the way."""

    def __init__(self, config: TrainConfig, folder: Path, on_evaluation: OnEvaluation) -> None:
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
        elif config.imitate is not None:
            from agents.training.imitation import imitate

            with progress("Imitating") as tell:
                imitate(self._model, self._envs, config.imitate, config.imitations, config.seed, tell)
        self._checkpoints = self._due_checkpoints()
        self._held_out = HeldOut(folder, config, begun)
        self._evaluated = on_evaluation
        self._board: Any = None
        begun_as = folder / CONFIG
        self._description = json.loads(begun_as.read_text(encoding="utf-8")) if begun_as.exists() else describe(config)
        if not begun_as.exists() and config.begin is not None:
            self._description[BEFORE] = steps_of(config.begin)

    def run(self) -> Run:
        from stable_baselines3.common.logger import KVWriter

        from agents.evaluation.figures import figure_of_learning, save
        from agents.training.callbacks import Board, ContinuedCSV, Log

        if not (self._folder / CONFIG).exists():
            write_json(self._folder / CONFIG, self._description)
        logs: list[KVWriter] = [ContinuedCSV(self._folder / "progress.csv", self._progress.steps)]
        if self._config.tensorboard:
            self._board = Board(self._folder)
            logs.append(self._board)
        with closing(Log(self._folder, logs, self._progress.steps)) as logger:
            self._model.set_logger(logger)
            if self._progress.steps == 0:
                write_policy(self._folder / UNTRAINED, self._model, self._card())
            if self._config.eval_every > 0 and not self._held_out.has_begun:
                self._evaluate()
            self._learn()
        curve = [(steps, at, math.nan if mean is None else mean) for steps, at, mean in self._progress.curve]
        if not all(math.isnan(mean) for *_, mean in curve):
            figure = figure_of_learning(curve, self._config.reward, self._held_out.gains)
            save(figure, self._folder / LEARNING)
        write_policy(self._folder, self._model, self._card())
        drop_states(self._folder)
        self._envs.close()
        return Run(self._config, self._folder, curve, self._seconds())

    def _learn(self) -> None:
        """Learn, and show how far it is."""
        from agents.training.callbacks import Watch

        total, begun = self._config.steps, self._progress.steps
        with ExitStack() as stack:
            tell = stack.enter_context(progress("Training"))
            tell(begun / total)
            ended = ""

            def on_step(steps: int) -> None:
                tell(min(steps / total, 1.0), ended)

            def on_rollout(steps: int, mean_return: float) -> None:
                nonlocal ended
                self._progress.curve.append((steps, self._seconds(), None if math.isnan(mean_return) else mean_return))
                ended = "no episode has ended" if math.isnan(mean_return) else f"return {mean_return:.2f}"
                on_step(steps)

            def on_update() -> None:
                self._on_update()
                if stopper.is_asked and self._model.num_timesteps < total:
                    self._save()
                    stopper.check(_left(self._folder))

            stopper = stack.enter_context(Stopper(_PATIENCE))
            self._model.learn(
                total - begun,
                callback=Watch(
                    on_rollout, on_update, on_step, getattr(self._config.hyperparameters, "entropy_bonus", 0.0)
                ),
                log_interval=self._config.hyperparameters.log_interval,
                reset_num_timesteps=begun == 0,
            )

    def _on_update(self) -> None:
        """Evaluate, and write a checkpoint, where one is due; the last one is not gone on from."""
        if self._due_evaluation():
            self._evaluate()
        if self._due_checkpoints() > self._checkpoints:
            self._checkpoints = self._due_checkpoints()
            self._save()

    def _evaluate(self) -> None:
        """Evaluate, and tell what was found to all who want to know."""
        found = self._held_out.evaluate(self._model, self._card())
        if self._board is not None:
            for name in METRICS:
                self._board.writer.add_scalar(f"evaluation/{name}", found[name], self._model.num_timesteps)
        self._evaluated(self._model.num_timesteps, found)

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
        learned_from = self._model.num_timesteps + self._description.get(BEFORE, 0)
        return {"algorithm": self._config.algo, "steps": learned_from, **self._description}

    def _seconds(self) -> float:
        return time.perf_counter() - self._clock


def _make_envs(config: TrainConfig, seed: int) -> Any:
    """The environments of a run, seen as its hyperparameters say; features are normalised by the run's own seed."""
    from agents.vec_env import DuffingVecEnv

    asked = config.hyperparameters
    if not asked.features:
        options = {"reward": config.reward, **config.options}
        return DuffingVecEnv(config.env, asked.num_envs, seed=seed, levels=getattr(asked, "levels", 0), **options)
    envs, samples = _with_features(config, asked.num_envs, seed)
    examples, _ = _with_features(config, EXAMPLES, config.seed)
    envs.normalizer.fit(examples, samples, config.seed)
    return envs


def _with_features(config: TrainConfig, rows: int, seed: int) -> tuple[Any, int]:
    """Environments that show features, and the samples of an episode."""
    from agents.evaluation.batch import make
    from agents.training.feature_env import FeatureVecEnv
    from agents.training.mixed_env import MixedVecEnv, draw_options
    from agents.vec_env import DuffingVecEnv

    options, own = {"reward": config.reward, **config.options}, config.hyperparameters.own
    levels = getattr(config.hyperparameters, "levels", 0)
    mixed: dict[str, Any] = {"reward": config.reward, "levels": levels}
    if config.env == family.FAMILY:
        return MixedVecEnv(rows, seed, family.draw_rig, **mixed), family.TYPICAL
    if config.vary:
        for name, end in ((name, end) for name, ends in config.vary.items() for end in ends):
            made = make(config.env, 1, options | {name: end})  # which refuses what the option may not be
            made.close()
        draw = partial(draw_options, env_id=config.env, options=config.options, ranges=config.vary)
        return MixedVecEnv(rows, seed, draw, own=own, **mixed), made.horizon
    envs = DuffingVecEnv(config.env, rows, seed=seed, **options)
    samples = int(envs.envs.unwrapped.experiment.samples)
    return FeatureVecEnv(envs, own=own, levels=levels, in_nats=config.reward in IN_NATS), samples


@contextmanager
def _new_folder(config: TrainConfig) -> Iterator[Path]:
    """The folder to write to, held meanwhile; an error of the disk leaves nothing there without a checkpoint."""
    _check_output(config)
    base = Path("runs") / f"{config.algo}-{track_of(config.env).lower()}-{config.seed}"
    folder, number, is_made = config.output or base, 1, False
    missing = [place for place in (folder, *folder.parents) if not place.exists()]
    while not is_made:
        with writing(folder):
            try:
                folder.mkdir(parents=True, exist_ok=config.output is not None)
                is_made = True
            except FileExistsError:
                number += 1
                folder = base.with_name(f"{base.name}-{number}")
                missing = [folder, *missing[1:]]
    with held("output", folder):
        _check_output(config)  # nobody else had it before
        try:
            yield folder
        except OSError:
            if latest_checkpoint(folder) is None:
                for path in folder.iterdir():
                    shutil.rmtree(path) if path.is_dir() else path.unlink()
            raise
        finally:
            with suppress(OSError):  # one that holds something stays
                for place in missing:
                    place.rmdir()


def _check_output(config: TrainConfig) -> None:
    """Refuse a named folder that is neither new nor empty."""
    if config.output is not None:
        for kept, name in (("run", CONFIG), ("policy", CARD)):
            if (config.output / name).exists():
                raise ValueError(
                    f"output must be a new folder, but {config.output} holds a {kept}; remove it or name another"
                )
        if config.output.is_dir() and (other := min((path.name for path in config.output.iterdir()), default="")):
            raise ValueError(
                f"output must be a new or empty folder, but {config.output} holds {other}, which is no training's; "
                "name another"
            )
