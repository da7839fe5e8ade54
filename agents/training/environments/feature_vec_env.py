"""Environments as a network with features sees them: `agents.policies.networks.rollout_features` in place of observations."""

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

#: Rewards are scaled to returns of about 1, where a critic begins.
REWARD_SCALE = 5.0

#: No feature is taken to vary by less, so that one that is constant in the training says nothing when it changes.
_MIN_STD = 0.05


def has_shaping_potential(envs: Any) -> bool:
    """Whether Ψ is what is still to come in unwrapped environments (`FeatureVecEnv`)."""
    setup = envs.experiment.kernel_params
    return not setup.has_drift and setup.budget == np.inf


class FeatureNormalizer:
    """Features with mean 0 and standard deviation 1, where random choices are played; as they are before `fit`."""

    def __init__(self, n_features: int) -> None:
        self.mean, self.std = np.zeros(n_features, np.float32), np.ones(n_features, np.float32)

    def __call__(self, values: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Normalised features, at most `BOUND` in size."""
        return np.clip((values - self.mean) / self.std, -np.float32(MAX_FEATURE), np.float32(MAX_FEATURE))

    def to_tensors(self) -> dict[str, npt.NDArray[Any]]:
        """By the names that a policy's file has them under."""
        return {"normalizer.mean": self.mean, "normalizer.std": self.std}

    def fit(self, envs: VecEnv, samples: int, seed: int) -> None:
        """Play random choices in environments whose features are as they are, for so many samples, and close them."""
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

    Rewards tell early what they are worth at the end: to each comes the increase of Ψ = ½ log det(I + C J), with C the
    covariance of the belief's coefficients and J the information that the rest of the episode will bring at the rate
    of a swing at the limit; Ψ is 0 when the episode has ended. It is a difference of potentials, so without a discount
    no policy gains by it (Ng, Harada and Russell 1999). But without it most information is gained in the first samples
    of an episode, whatever the input, and the rest weighs little. Where the energy is limited no swing at the limit is
    kept up, and where the belief forgets nothing is known for good: there rewards stay as they are.

    The end of an episode is an end, by time too: there is nothing to gain after it, and the features show it coming.

    Attributes:
        observations: what the environments show now.

    Args:
        venv: the environments, with any input between the limits as an action.
        raw_observation: whether the observation itself stands behind the features.
        levels: as of `DuffingVecEnv`.
        reward_in_nats: whether the reward counts information, so that Ψ is added to it.
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

    @property
    def tensors(self) -> dict[str, npt.NDArray[Any]]:
        """Setting and normaliser, as a policy's file holds them."""
        return {"setting": self._feature_map.to_tensor(), **self.normalizer.to_tensors()}

    @property
    def current_features(self) -> ShieldedFeatures:
        """What the environments show now, not normalised."""
        return self._current_features

    def reset(self) -> VecEnvObs:
        """Start an episode in every row."""
        return self._to_features(self.venv.reset())

    def restore_episode_state(self, memory: dict[str, npt.NDArray[Any]]) -> VecEnvObs:
        """As `DuffingVecEnv.restore_episode_state`."""
        return self._to_features(self.venv.restore_episode_state(memory))  # type: ignore[attr-defined]

    def step_async(self, actions: npt.NDArray[Any]) -> None:
        """Take what the network chose."""
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
