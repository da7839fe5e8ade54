"""Imitation: a policy network learns what a teacher would do where the network itself goes (DAgger).

A batch of environments is followed for several rounds, by the teacher in the first, by the network in the others. The
teacher says in every one of them what it would do, and after each round the network is fitted to all that was said so
far (Ross, Gordon and Bagnell 2011). So it also learns how to come back from where only its own mistakes lead.

The task is odd: turning inputs and displacements over changes nothing else. So half of the samples are learned turned
over; only a rest has no direction, and there the first push is taken to be positive, whichever the teacher chose.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from agents.policies import make_policy

if TYPE_CHECKING:
    from stable_baselines3 import PPO

    from agents.actor import Actor

FloatArray = npt.NDArray[np.float32]


@dataclass(frozen=True)
class ImitationSettings:
    """How much a network learns from a teacher before it learns by itself."""

    labels: int = 0
    """Decisions of the teacher to learn from; 0 for no imitation."""
    teacher: str = "efe"
    """Name of the teacher, see `agents.make_policy`; "efe" is the planner."""
    rounds: int = 8
    """Rounds of labels; the teacher acts in the first, the network in the others."""
    num_envs: int = 128
    """Environments that are followed together."""
    fits: int = 12
    """Times that a label is fitted after its own round, on average; later rounds fit it again."""
    batch_size: int = 512
    """Labels of a gradient step."""
    learning_rate: float = 3e-3
    """Step size (Adam) at the start of a round's fit; it falls linearly to 0."""

    def __post_init__(self) -> None:
        if self.labels < 0:
            raise ValueError(f"labels must be at least 0, but is {self.labels}; 0 is no imitation")
        for name in ("rounds", "num_envs", "fits", "batch_size"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, but is {getattr(self, name)}; labels=0 is no imitation")
        if self.labels and self.labels < self.rounds * self.num_envs:
            raise ValueError(
                f"labels must be at least rounds * num_envs = {self.rounds * self.num_envs}, "
                f"but is {self.labels}; ask for more labels or fewer rounds"
            )
        if not self.learning_rate > 0:
            raise ValueError(f"learning_rate must be positive, but is {self.learning_rate}")


def imitate(
    model: PPO,
    env_id: str,
    options: dict[str, Any],
    settings: ImitationSettings,
    seed: int,
    on_progress: Callable[[int, float], None] | None = None,
) -> None:
    """Fit the actor of a model to a teacher; the critic and the exploration stay as they are.

    The same seed gives the same weights, with one thread of torch. The global generator of torch is not used.

    Args:
        model: PPO on the track; its actor is changed in place.
        env_id: the track that is imitated on.
        options: of the environment.
        settings: how much; with ``labels=0`` nothing happens.
        seed: of systems, noise, teacher and batches.
        on_progress: called after each round with the labels so far and the mean squared error of the last ones.

    Raises:
        ValueError: for a teacher that does not exist or cannot play this track.
    """
    from agents.actor import Actor
    from agents.evaluation import make

    if settings.labels == 0:
        return
    envs = make(env_id, settings.num_envs, options)
    teacher = make_policy(settings.teacher, envs, seed=seed)
    actor, rng = Actor(model), np.random.default_rng([seed, 1])
    steps = settings.labels // (settings.rounds * settings.num_envs)
    seen: list[FloatArray] = []
    told: list[FloatArray] = []
    observations, _ = envs.reset(seed=seed)
    state, begins = None, np.ones(settings.num_envs, dtype=np.bool_)
    for k in range(settings.rounds):
        for _ in range(steps):
            labels, state = teacher.predict(observations, state, begins, deterministic=True)
            seen.append(observations)
            told.append(labels[:, 0])
            actions = labels if k == 0 else np.clip(actor.act(observations), -1.0, 1.0)[:, None]
            observations, _, terminated, truncated, _ = envs.step(actions)
            begins = terminated | truncated
        error = _fit(actor, np.concatenate(seen), np.concatenate(told), settings, rng)
        if on_progress is not None:
            on_progress((k + 1) * steps * settings.num_envs, error)
    envs.close()


def _fit(
    actor: Actor, observations: FloatArray, labels: FloatArray, settings: ImitationSettings, rng: np.random.Generator
) -> float:
    """Fit the actor to labels (n,) of observations (n, features); the mean squared error of the last tenth of steps."""
    import torch

    from agents.actor import at_rest, turned

    labels = np.where(at_rest(observations), np.abs(labels), labels)
    steps = max(1, settings.fits * len(labels) // settings.batch_size)
    errors = np.empty(steps)
    with actor.standardised(observations) as standard:
        optimiser = torch.optim.Adam(actor.parameters, settings.learning_rate)
        for k in range(steps):
            optimiser.param_groups[0]["lr"] = settings.learning_rate * (1 - k / steps)
            chosen = rng.integers(0, len(labels), settings.batch_size)
            some, signs = turned(observations[chosen], rng)
            targets = torch.from_numpy(signs * labels[chosen])
            loss = ((actor(torch.from_numpy(standard(some))) - targets) ** 2).mean()
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            errors[k] = loss.item()
    return float(errors[-max(1, steps // 10) :].mean())
