"""A `VecEnv` whose observations are normalised features (`agents.policies.networks.rollout_features`)."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from agents.policies.networks.feature_encoder import FeatureEncoder, ShieldedFeatures
from agents.policies.networks.feature_names import MAX_FEATURE
from agents.sb3_vec_env import DuffingVecEnv
from duffing_env.vector_env import DuffingVectorEnv

#: Factor of all rewards: returns are then about 1, as a new critic expects.
REWARD_SCALE = 5.0

#: Smallest standard deviation of a feature: a feature that is constant in the training then has little effect later.
_MIN_STD = 0.05


def has_shaping_potential(envs: DuffingVectorEnv) -> bool:
    """Whether `FeatureVecEnv` shapes rewards here: the belief forgets nothing, and the energy is not limited."""
    setup = envs.experiment.kernel_params
    return not setup.has_drift and setup.budget == np.inf


class FeatureNormalizer:
    """Scales features to mean 0 and standard deviation 1 under random actions; the identity before `fit`."""

    def __init__(self, n_features: int) -> None:
        self.mean, self.std = np.zeros(n_features, np.float32), np.ones(n_features, np.float32)

    def __call__(self, values: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Normalised features, clipped to ± `MAX_FEATURE`."""
        return np.clip((values - self.mean) / self.std, -np.float32(MAX_FEATURE), np.float32(MAX_FEATURE))

    def to_tensors(self) -> dict[str, npt.NDArray[Any]]:
        """Mean and standard deviation, by their names in a policy's file."""
        return {"normalizer.mean": self.mean, "normalizer.std": self.std}

    def fit(self, envs: VecEnv, samples: int, seed: int) -> None:
        """Play random actions for a number of samples in environments without normaliser, and close them."""
        rng, space = np.random.default_rng(seed), envs.action_space
        observations: list[Any] = [envs.reset()]
        for _ in range(samples):
            if isinstance(space, gym.spaces.Discrete):
                actions = rng.integers(int(space.n), size=envs.num_envs)
            else:
                actions = rng.uniform(-1.0, 1.0, (envs.num_envs, 1)).astype(np.float32)
            observations.append(envs.step(actions)[0])
        envs.close()
        values = np.concatenate(observations)
        self.mean = values.mean(axis=0, dtype=np.float64).astype(np.float32)
        self.std = np.maximum(values.std(axis=0, dtype=np.float64), _MIN_STD).astype(np.float32)


class FeatureVecEnv(VecEnvWrapper):
    """A `DuffingVecEnv` whose observations are normalised features, and whose actions the shield bounds.

    Reward shaping (Ng, Harada and Russell 1999): each reward is raised by the increase of the potential
    Ψ = ½ log det(I + C J), with C the covariance of the belief's coefficients, and J the information of the rest of the
    episode at the rate of an oscillation at the limit; Ψ is 0 at the end of the episode. Without a discount the optimal
    policy stays the same. Without shaping most reward comes in the first samples of an episode, whatever the input.
    Rewards are not shaped where the energy is limited, because an oscillation at the limit cannot be kept up, and
    where the belief forgets, because information is lost.

    The time limit is a terminal state: there is no reward after it, and the features hold the time that is left.

    Args:
        venv: the environments, whose actions are all inputs between the limits.
        raw_observation: whether the observation follows the features.
        levels: as of `DuffingVecEnv`.
        reward_in_nats: whether the reward is information, so that it is shaped by Ψ.

    Attributes:
        features: description of the features, as a policy's card holds it.
        normalizer: of the features.
        raw_observations: the last observations of the environments.
    """

    def __init__(
        self, venv: DuffingVecEnv, *, raw_observation: bool = True, levels: int = 0, reward_in_nats: bool = True
    ) -> None:
        self._feature_map = FeatureEncoder.of(venv.envs.unwrapped, with_observation=raw_observation)
        self.features = self._feature_map.describe()
        self.normalizer = FeatureNormalizer(self._feature_map.size)
        self._shaping_weight = np.float32(reward_in_nats and has_shaping_potential(venv.envs.unwrapped))
        self._discrete_actions = np.linspace(-1.0, 1.0, levels) if levels else None
        space = gym.spaces.Box(-MAX_FEATURE, MAX_FEATURE, (self._feature_map.size,), np.float32)
        super().__init__(venv, space, gym.spaces.Discrete(levels) if levels else venv.action_space)
        self._duffing_envs = venv

    @property
    def tensors(self) -> dict[str, npt.NDArray[Any]]:
        """Setting and normaliser, by their names in a policy's file."""
        return {"setting": self._feature_map.to_tensor(), **self.normalizer.to_tensors()}

    @property
    def current_features(self) -> ShieldedFeatures:
        """The features of the last observations, not normalised."""
        return self._current_features

    def reset(self) -> VecEnvObs:
        """Start an episode in every row."""
        return self._to_features(self.venv.reset())

    @property
    def episode_state(self) -> dict[str, npt.NDArray[Any]]:
        """As of `DuffingVecEnv`."""
        return self._duffing_envs.episode_state

    def restore_episode_state(self, memory: dict[str, npt.NDArray[Any]]) -> VecEnvObs:
        """As of `DuffingVecEnv`."""
        return self._to_features(self._duffing_envs.restore_episode_state(memory))

    def step_async(self, actions: npt.NDArray[Any]) -> None:
        """Take the actions of the network."""
        choices = actions[:, 0] if self._discrete_actions is None else self._discrete_actions[actions]
        self.venv.step_async(self._current_features.to_actions(choices))

    def step_wait(self) -> VecEnvStepReturn:
        """Step all rows."""
        potential_before = self._current_features.remaining_information
        observations, rewards, dones, infos = self.venv.step_wait()
        ended = np.flatnonzero(dones)
        if len(ended):
            last = self._feature_map([infos[row]["terminal_observation"] for row in ended]).values
            for row, values in zip(ended, self.normalizer(last), strict=True):
                infos[row] |= {"terminal_observation": values, "TimeLimit.truncated": False}
        normalised = self._to_features(observations)
        potential = np.where(dones, np.float32(0), self._current_features.remaining_information)
        return (
            normalised,
            np.float32(REWARD_SCALE) * (rewards + self._shaping_weight * (potential - potential_before)),
            dones,
            infos,
        )

    def _to_features(self, observations: Any) -> npt.NDArray[np.float32]:
        self.raw_observations = observations
        self._current_features = self._feature_map(observations)
        return self.normalizer(self._current_features.values)
