"""Imitation learning (DAgger) of another policy by actor and critic, before a training by reward.

DAgger (Ross, Gordon and Bagnell 2011): in every other environment the teacher's action is played, in the others the
student's, and the teacher's action is the target everywhere. So the data hold the states after the student's own
mistakes, too. The critic learns the returns of the episodes that end meanwhile: with an untrained critic, PPO's first
updates would destroy the actor.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt

from agents.policies import make_policy
from agents.training.environments.feature_vec_env import FeatureVecEnv

#: Samples of each environment between two fits.
_SAMPLES_BETWEEN_FITS = 64

#: Passes of a fit over all samples so far.
_EPOCHS_PER_FIT = 4

#: Samples of a gradient step.
_BATCH_SIZE = 1024

#: Learning rate of the fits.
_LEARNING_RATE = 1e-3


def imitate_policy(
    model: Any, envs: FeatureVecEnv, teacher: str, samples: int, seed: int, on_progress: Callable[[float], None]
) -> None:
    """Fit the actor of a Stable-Baselines3 PPO model to another policy's actions, and the critic to the returns.

    Args:
        model: whose networks are fitted.
        envs: its environments, which are stepped; the next `learn` begins new episodes.
        teacher: a policy's name, as of `agents.make_policy`.
        samples: to learn from, over all environments.
        seed: of the teacher, and of the order of the samples.
        on_progress: called with the fraction that is done.
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
    """Discounted returns (T, n) from every sample to the end of its episode; NaN where the episode has not ended.

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
    """The network's actions, in its own action space and mirrored to the upright frame, for these actions."""
    features = envs.current_features
    max_actions = np.maximum(features.action_scales, 1e-6)
    mirrored = np.clip(actions[:, 0] * features.mirror_signs / max_actions, -1.0, 1.0)
    if not isinstance(envs.action_space, gym.spaces.Discrete):
        return mirrored[:, None].astype(np.float32)
    return np.rint((mirrored + 1.0) / 2.0 * (int(envs.action_space.n) - 1)).astype(np.int64)


def _minimise_loss(batch_loss: Callable[[Any], Any], n_samples: int, optimizer: Any, generator: Any) -> None:
    """Minimise a loss over batches of row indices by gradient steps."""
    import torch

    for _ in range(_EPOCHS_PER_FIT):
        for batch in torch.randperm(n_samples, generator=generator).split(_BATCH_SIZE):
            loss = batch_loss(batch)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()


def _fit_actor(policy: Any, optimizer: Any, observations: Any, teacher_actions: Any, generator: Any) -> None:
    """Maximise the likelihood of the teacher's actions."""
    import torch

    observations, teacher_actions = torch.from_numpy(observations), torch.from_numpy(teacher_actions)
    log_likelihood = lambda batch: policy.get_distribution(observations[batch]).log_prob(teacher_actions[batch]).mean()  # noqa: E731
    _minimise_loss(lambda batch: -log_likelihood(batch), len(observations), optimizer, generator)


def _fit_critic(policy: Any, optimizer: Any, observations: Any, returns: Any, generator: Any) -> None:
    """Minimise the squared error of the critic."""
    import torch

    observations, returns = torch.from_numpy(observations), torch.from_numpy(returns)
    error = lambda batch: policy.predict_values(observations[batch])[:, 0] - returns[batch]  # noqa: E731
    _minimise_loss(lambda batch: error(batch).square().mean(), len(observations), optimizer, generator)
