"""Training: PPO on any registered track, into a run folder that can rebuild itself."""

from __future__ import annotations

import json
import platform
import sys
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from agents.analytic_gradient import AscentSettings, ascend_policy
from agents.cli import JsonOptions
from agents.imitation import ImitationSettings, imitate
from agents.policies.learned import save_policy
from estimator.files import write_atomically

if TYPE_CHECKING:
    from stable_baselines3 import PPO

_PACKAGES = ("duffing-env", "gymnasium", "numpy", "numba", "scipy", "stable-baselines3", "torch")


@dataclass(frozen=True)
class PPOSettings:
    """Hyperparameters of PPO; chosen for a batched environment: large batches, few epochs."""

    num_envs: int = 512
    """Environments that are stepped together."""
    n_steps: int = 64
    """Samples that each environment collects between two updates."""
    batch_size: int = 8192
    """Samples of a gradient step."""
    n_epochs: int = 4
    """Passes over the collected samples in an update."""
    learning_rate: float = 1e-3
    """Step size at the start; it falls linearly to 0."""
    gamma: float = 0.99
    """Discount factor."""
    gae_lambda: float = 0.95
    """Trade-off of bias and variance in the advantage (generalised advantage estimation)."""
    log_std_init: float = -0.5
    """Log standard deviation of the action at the start."""
    hidden: tuple[int, ...] = (64, 64)
    """Units of the hidden layers of actor and critic."""

    def __post_init__(self) -> None:
        counts = {name: getattr(self, name) for name in ("num_envs", "n_steps", "batch_size", "n_epochs")}
        counts |= {f"hidden[{i}]": units for i, units in enumerate(self.hidden)}
        for name, value in counts.items():
            if value < 1:
                raise ValueError(f"{name} must be at least 1, but is {value}")
        if self.batch_size == 1 or self.num_envs * self.n_steps == 1:
            raise ValueError("batch_size and num_envs * n_steps must be at least 2; PPO normalises over a batch")
        if self.learning_rate <= 0:
            raise ValueError(f"learning_rate must be positive, but is {self.learning_rate}")
        for name in ("gamma", "gae_lambda"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} must be in [0, 1], but is {getattr(self, name)}")


@dataclass(frozen=True)
class TrainConfig:
    """What a training run is made from. Written to ``config.json`` of its folder."""

    env: str = "duffing_env/Amplitude-v0"
    """Id of the track."""
    reward: str = "information_gain"
    """Name of the reward: information_gain, log_posterior, parameter_error, fisher or free_energy."""
    steps: int = 5_000_000
    """Samples to train on with PPO, over all environments; 0 for none, after imitation or ascent."""
    seed: int = 0
    """Seed of systems, noise, weights and exploration; the same seed gives the same policy."""
    options: JsonOptions = field(default_factory=dict)
    """Further options of the environment, as JSON."""
    output: Path | None = None
    """Run folder; runs/ppo-TRACK-SEED where it is not given, with a number where that exists."""
    checkpoints: int = 5
    """Checkpoints over the run, evenly spaced."""
    torch_threads: int = 1
    """Threads of torch; it moves the last digits. More than one gain little, and lose much on a busy machine."""
    ppo: PPOSettings = field(default_factory=PPOSettings)
    """Hyperparameters of PPO."""
    imitation: ImitationSettings = field(default_factory=ImitationSettings)
    """What the network learns from a teacher, first of all."""
    ascent: AscentSettings = field(default_factory=AscentSettings)
    """How far it then climbs by exact derivatives, before PPO."""

    def __post_init__(self) -> None:
        least = 0 if self.imitation.labels or self.ascent.updates else 1
        for name, lowest in (("steps", least), ("checkpoints", 1), ("torch_threads", 1)):
            if getattr(self, name) < lowest:
                raise ValueError(f"{name} must be at least {lowest}, but is {getattr(self, name)}")
        if "reward" in self.options:
            raise ValueError(f"options must not hold reward, but are {self.options}; reward has a place of its own")


@dataclass(frozen=True)
class Run:
    """A finished training.

    Attributes:
        folder: the run folder, which is also a policy folder.
        curve: (updates, 3) samples so far, seconds so far, mean return of the last episodes.
        seconds: of wall time, compilation included.
    """

    folder: Path
    curve: list[tuple[int, float, float]]
    seconds: float


def train(config: TrainConfig) -> Run:
    """Train a policy, and write a run folder.

    The folder then holds

    - ``config.json``: the resolved configuration, the command and the versions,
    - ``policy.safetensors``, ``policy.json``: the policy,
    - ``checkpoints/STEPS/``: the policy on the way,
    - ``progress.csv``: Stable-Baselines3's log of every update,
    - ``learning_curve.png``.
    """
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.logger import configure

    from agents.figures import draw_learning_curve
    from agents.vec_env import DuffingVecEnv

    started = time.perf_counter()
    torch.set_num_threads(config.torch_threads)
    ppo = config.ppo
    envs = DuffingVecEnv(config.env, ppo.num_envs, seed=config.seed, reward=config.reward, **config.options)
    model = PPO(
        "MlpPolicy",
        envs,
        n_steps=ppo.n_steps,
        batch_size=ppo.batch_size,
        n_epochs=ppo.n_epochs,
        learning_rate=lambda left: ppo.learning_rate * left,
        gamma=ppo.gamma,
        gae_lambda=ppo.gae_lambda,
        policy_kwargs={"net_arch": list(ppo.hidden), "log_std_init": ppo.log_std_init},
        stats_window_size=ppo.num_envs,
        seed=config.seed,
        device="cpu",
    )
    folder = _run_folder(config)
    description = _describe(config)
    write_atomically(folder / "config.json", json.dumps(description, indent=2))
    curve: list[tuple[int, float, float]] = []
    checkpoints = 0

    def save(target: Path) -> None:
        save_policy(target, model, {"algorithm": "ppo", "steps": model.num_timesteps, **description})

    def on_update(steps: int, mean_return: float) -> None:
        nonlocal checkpoints
        curve.append((steps, time.perf_counter() - started, mean_return))
        if steps * config.checkpoints // config.steps > checkpoints:
            checkpoints += 1
            save(folder / "checkpoints" / f"{steps:09d}")

    imitate(model, config.env, config.options, config.imitation, config.seed)
    ascend_policy(model, config.env, config.options, config.ascent, config.seed)
    with closing(configure(str(folder), ["csv"])) as logger:
        model.set_logger(logger)
        if config.steps:
            _learn(model, config.steps, on_update)
    save(folder)
    draw_learning_curve(folder / "learning_curve.png", curve, config.reward)
    envs.close()
    return Run(folder, curve, time.perf_counter() - started)


def _learn(model: PPO, steps: int, on_update: Callable[[int, float], None]) -> None:
    """Learn with a progress bar, calling ``on_update(steps, mean return)`` after every roll-out."""
    import numpy as np
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
    from stable_baselines3.common.callbacks import BaseCallback

    columns = (TextColumn("Training"), BarColumn(), TextColumn("{task.fields[status]}"), TimeRemainingColumn())
    with Progress(*columns) as progress:
        task = progress.add_task("", total=steps, status="compiling")
        started = time.perf_counter()

        class Report(BaseCallback):
            def _on_step(self) -> bool:
                return True

            def _on_rollout_end(self) -> None:
                episodes: Any = self.model.ep_info_buffer or []
                mean_return = float(np.mean([episode["r"] for episode in episodes])) if episodes else float("nan")
                rate = self.num_timesteps / (time.perf_counter() - started)
                status = f"{self.num_timesteps:,} samples, {rate:,.0f}/s, return {mean_return:.2f}"
                progress.update(task, completed=min(self.num_timesteps, steps), status=status)
                on_update(self.num_timesteps, mean_return)

        model.learn(steps, callback=Report())


def _run_folder(config: TrainConfig) -> Path:
    """The folder to write to; one that is named must not hold a run already."""
    if config.output is not None:
        if (config.output / "config.json").exists():
            raise ValueError(f"output must be a new folder, but {config.output} holds a run; remove it or name another")
        return config.output
    track = config.env.split("/")[-1].lower()
    base = Path("runs") / f"ppo-{track}-{config.seed}"
    folder, number = base, 1
    while folder.exists():
        number += 1
        folder = base.with_name(f"{base.name}-{number}")
    return folder


def _describe(config: TrainConfig) -> dict[str, Any]:
    resolved = asdict(config)
    resolved["output"] = None if config.output is None else str(config.output)
    return {
        "config": resolved,
        "command": [Path(sys.argv[0]).name, *sys.argv[1:]],
        "versions": {"python": platform.python_version(), **{name: version(name) for name in _PACKAGES}},
    }
