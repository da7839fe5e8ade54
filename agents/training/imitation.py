"""Imitation: the networks of a model learn what another policy decides and is worth, before they learn by reward.

DAgger (Ross, Gordon and Bagnell 2011): in every other environment the teacher's own action is taken, in the others the
student's, and the teacher says everywhere what it would do. So the student also sees where its own mistakes lead. The
critic learns the returns of the episodes that end meanwhile: one that knows nothing would unlearn the actor.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt

from agents.policies import make_policy
from agents.training.feature_env import FeatureVecEnv

#: Samples between two fits, in each environment; passes over all decisions so far in a fit; decisions of a step.
_ROUND, _EPOCHS, _BATCH = 64, 4, 1024

#: Step size of the fits.
_LEARNING_RATE = 1e-3


def imitate(
    model: Any, envs: FeatureVecEnv, teacher: str, samples: int, seed: int, tell: Callable[[float], None]
) -> None:
    """Let the actor of a model of Stable-Baselines3's PPO choose as another policy does, and its critic know the worth.

    Args:
        model: to teach.
        envs: its environments, which are stepped; the next `learn` begins new episodes.
        teacher: a policy's name, as of `agents.make_policy`.
        samples: decisions to learn from, over all environments.
        seed: of the teacher's randomness, and of the order of the decisions.
        tell: called with the share that is done.
    """
    import torch

    asked = make_policy(teacher, envs.venv.envs, seed=seed)  # type: ignore[attr-defined]
    generator = torch.Generator().manual_seed(seed)
    optimizer = torch.optim.Adam(model.policy.parameters(), _LEARNING_RATE)
    taught = np.arange(envs.num_envs) % 2 == 0
    seen: list[npt.NDArray[np.float32]] = []
    wanted: list[npt.NDArray[Any]] = []
    rewards: list[npt.NDArray[np.float32]] = []
    ends: list[npt.NDArray[np.bool_]] = []
    shown, state, starts = envs.reset(), None, np.ones(envs.num_envs, dtype=np.bool_)
    while (done := len(seen) * envs.num_envs) < samples:
        actions, state = asked.predict(envs.observations, state, starts, deterministic=True)
        choices = _choices(envs, actions)
        seen.append(np.array(shown))
        wanted.append(choices)
        own, _ = model.policy.predict(shown, deterministic=False)
        played = np.where(taught if choices.ndim == 1 else taught[:, None], choices, own)
        shown, reward, starts, _ = envs.step(played)
        rewards.append(reward)
        ends.append(starts)
        if len(seen) % _ROUND == 0 or done + envs.num_envs >= samples:
            _fit_actor(model.policy, optimizer, np.concatenate(seen), np.concatenate(wanted), generator)
        tell(min(1.0, (done + envs.num_envs) / samples))
    returns = returns_of(np.array(rewards), np.array(ends), model.gamma)
    known = np.isfinite(returns)
    if known.any():
        _fit_critic(model.policy, optimizer, np.array(seen)[known], returns[known], generator)


def returns_of(rewards: npt.NDArray[Any], ends: npt.NDArray[np.bool_], discount: float) -> npt.NDArray[np.float32]:
    """Discounted returns (T, n) from every sample to the end of its episode; NaN where that has not come.

    Example:
        >>> rewards, ends = np.ones((4, 1), np.float32), np.array([[False], [True], [False], [False]])
        >>> returns_of(rewards, ends, 0.5).ravel()
        array([1.5, 1. , nan, nan], dtype=float32)
    """
    returns = np.full(rewards.shape, np.nan, dtype=np.float32)
    after = np.full(rewards.shape[1], np.nan, dtype=np.float32)
    for t in reversed(range(len(rewards))):
        after = returns[t] = rewards[t] + np.float32(discount) * np.where(ends[t], np.float32(0), after)
    return returns


def _choices(envs: FeatureVecEnv, actions: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """What the network would have to choose for these actions: upright, as its action space has it."""
    features = envs.shown
    pushes = np.maximum(features.pushes, 1e-6)
    upright = np.clip(actions[:, 0] * features.signs / pushes, -1.0, 1.0)
    if not isinstance(envs.action_space, gym.spaces.Discrete):
        return upright[:, None].astype(np.float32)
    return np.rint((upright + 1.0) / 2.0 * (int(envs.action_space.n) - 1)).astype(np.int64)


def _minimise(loss_of: Callable[[Any], Any], rows: int, optimizer: Any, generator: Any) -> None:
    """Step down a loss of batches of so many rows, given by their places."""
    import torch

    for _ in range(_EPOCHS):
        for batch in torch.randperm(rows, generator=generator).split(_BATCH):
            loss = loss_of(batch)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()


def _fit_actor(policy: Any, optimizer: Any, seen: Any, wanted: Any, generator: Any) -> None:
    """Raise the likelihood of the teacher's choices."""
    import torch

    seen, wanted = torch.from_numpy(seen), torch.from_numpy(wanted)
    likelihood = lambda batch: policy.get_distribution(seen[batch]).log_prob(wanted[batch]).mean()  # noqa: E731
    _minimise(lambda batch: -likelihood(batch), len(seen), optimizer, generator)


def _fit_critic(policy: Any, optimizer: Any, seen: Any, returns: Any, generator: Any) -> None:
    """Lower the squared error of the critic."""
    import torch

    seen, returns = torch.from_numpy(seen), torch.from_numpy(returns)
    error = lambda batch: policy.predict_values(seen[batch])[:, 0] - returns[batch]  # noqa: E731
    _minimise(lambda batch: error(batch).square().mean(), len(seen), optimizer, generator)
