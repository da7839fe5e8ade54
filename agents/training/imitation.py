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
from agents.training.environments.feature_vec_env import FeatureVecEnv

#: Samples between two fits, in each environment; passes over all decisions so far in a fit; decisions of a step.
_SAMPLES_BETWEEN_FITS, _EPOCHS_PER_FIT, _BATCH_SIZE = 64, 4, 1024

#: Step size of the fits.
_LEARNING_RATE = 1e-3


def imitate_policy(
    model: Any, envs: FeatureVecEnv, teacher: str, samples: int, seed: int, on_progress: Callable[[float], None]
) -> None:
    """Let the actor of a model of Stable-Baselines3's PPO choose as another policy does, and its critic know the worth.

    Args:
        model: to teach.
        envs: its environments, which are stepped; the next `learn` begins new episodes.
        teacher: a policy's name, as of `agents.make_policy`.
        samples: decisions to learn from, over all environments.
        seed: of the teacher's randomness, and of the order of the decisions.
        on_progress: called with the share that is done.
    """
    import torch

    teacher_policy = make_policy(teacher, envs.venv.envs, seed=seed)  # type: ignore[attr-defined]
    generator = torch.Generator().manual_seed(seed)
    optimizer = torch.optim.Adam(model.policy.parameters(), _LEARNING_RATE)
    is_teacher_row = np.arange(envs.num_envs) % 2 == 0
    observations: list[npt.NDArray[np.float32]] = []
    teacher_actions: list[npt.NDArray[Any]] = []
    rewards: list[npt.NDArray[np.float32]] = []
    episode_ends: list[npt.NDArray[np.bool_]] = []
    observation, state, episode_starts = envs.reset(), None, np.ones(envs.num_envs, dtype=np.bool_)
    while (done := len(observations) * envs.num_envs) < samples:
        actions, state = teacher_policy.predict(envs.raw_observations, state, episode_starts, deterministic=True)
        network_actions = _network_actions(envs, actions)
        observations.append(np.array(observation))
        teacher_actions.append(network_actions)
        student_actions, _ = model.policy.predict(observation, deterministic=False)
        played = np.where(
            is_teacher_row if network_actions.ndim == 1 else is_teacher_row[:, None], network_actions, student_actions
        )
        observation, reward, episode_starts, _ = envs.step(played)
        rewards.append(reward)
        episode_ends.append(episode_starts)
        if len(observations) % _SAMPLES_BETWEEN_FITS == 0 or done + envs.num_envs >= samples:
            _fit_actor(
                model.policy, optimizer, np.concatenate(observations), np.concatenate(teacher_actions), generator
            )
        on_progress(min(1.0, (done + envs.num_envs) / samples))
    returns = discounted_returns(np.array(rewards), np.array(episode_ends), model.gamma)
    is_complete = np.isfinite(returns)
    if is_complete.any():
        _fit_critic(model.policy, optimizer, np.array(observations)[is_complete], returns[is_complete], generator)


def discounted_returns(
    rewards: npt.NDArray[Any], episode_ends: npt.NDArray[np.bool_], discount: float
) -> npt.NDArray[np.float32]:
    """Discounted returns (T, n) from every sample to the end of its episode; NaN where that has not come.

    Example:
        >>> rewards, ends = np.ones((4, 1), np.float32), np.array([[False], [True], [False], [False]])
        >>> discounted_returns(rewards, ends, 0.5).ravel()
        array([1.5, 1. , nan, nan], dtype=float32)
    """
    returns = np.full(rewards.shape, np.nan, dtype=np.float32)
    next_returns = np.full(rewards.shape[1], np.nan, dtype=np.float32)
    for t in reversed(range(len(rewards))):
        next_returns = returns[t] = rewards[t] + np.float32(discount) * np.where(
            episode_ends[t], np.float32(0), next_returns
        )
    return returns


def _network_actions(envs: FeatureVecEnv, actions: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """What the network would have to choose for these actions: upright, as its action space has it."""
    features = envs.current_features
    max_actions = np.maximum(features.action_scales, 1e-6)
    mirrored = np.clip(actions[:, 0] * features.mirror_signs / max_actions, -1.0, 1.0)
    if not isinstance(envs.action_space, gym.spaces.Discrete):
        return mirrored[:, None].astype(np.float32)
    return np.rint((mirrored + 1.0) / 2.0 * (int(envs.action_space.n) - 1)).astype(np.int64)


def _minimise_loss(batch_loss: Callable[[Any], Any], n_samples: int, optimizer: Any, generator: Any) -> None:
    """Step down a loss of batches of so many rows, given by their places."""
    import torch

    for _ in range(_EPOCHS_PER_FIT):
        for batch in torch.randperm(n_samples, generator=generator).split(_BATCH_SIZE):
            loss = batch_loss(batch)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()


def _fit_actor(policy: Any, optimizer: Any, observations: Any, teacher_actions: Any, generator: Any) -> None:
    """Raise the likelihood of the teacher's choices."""
    import torch

    observations, teacher_actions = torch.from_numpy(observations), torch.from_numpy(teacher_actions)
    log_likelihood = lambda batch: policy.get_distribution(observations[batch]).log_prob(teacher_actions[batch]).mean()  # noqa: E731
    _minimise_loss(lambda batch: -log_likelihood(batch), len(observations), optimizer, generator)


def _fit_critic(policy: Any, optimizer: Any, observations: Any, returns: Any, generator: Any) -> None:
    """Lower the squared error of the critic."""
    import torch

    observations, returns = torch.from_numpy(observations), torch.from_numpy(returns)
    error = lambda batch: policy.predict_values(observations[batch])[:, 0] - returns[batch]  # noqa: E731
    _minimise_loss(lambda batch: error(batch).square().mean(), len(observations), optimizer, generator)
