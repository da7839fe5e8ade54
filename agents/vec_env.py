"""Our vector environment as Stable-Baselines3's `VecEnv`."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn

from duffing_env.vector_env import DuffingVectorEnv


class DuffingVecEnv(VecEnv):
    """Stable-Baselines3's view of a `DuffingVectorEnv` in mode ``SAME_STEP``.

    A finished row's info holds ``terminal_observation``, ``TimeLimit.truncated`` (so that a time limit is not taken
    for a terminal state), the ``belief`` it ended with, and ``episode`` (return, length, time), which is what
    Stable-Baselines3 otherwise needs a `VecMonitor` for. All buffers that are handed out are copies.

    Args:
        env_id: a registered track.
        num_envs: number of rows.
        seed: of the batch; the next reset uses it.
        levels: an action is one of so many evenly spaced inputs from -1 to 1, by its number; 0: any input between.
        options: of the environment, and ``threads``.
    """

    def __init__(self, env_id: str, num_envs: int, seed: int | None = None, *, levels: int = 0, **options: Any) -> None:
        made = gym.make_vec(
            env_id,
            num_envs=num_envs,
            vectorization_mode="vector_entry_point",
            autoreset_mode=AutoresetMode.SAME_STEP,
            **options,
        )
        assert isinstance(made, DuffingVectorEnv)
        self.envs = made
        self.render_mode = None
        self._levels = np.linspace(-1.0, 1.0, levels, dtype=np.float32) if levels else None
        action_space = gym.spaces.Discrete(levels) if levels else made.single_action_space
        super().__init__(num_envs, made.single_observation_space, action_space)
        self._seed_of_batch = seed
        self._actions = np.zeros((num_envs, 1), dtype=np.float32)
        self._returns = np.zeros(num_envs)
        self._lengths = np.zeros(num_envs, dtype=np.int64)
        self._started = time.time()

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seed the batch at its next reset."""
        self._seed_of_batch = seed
        return [seed] * self.num_envs

    def reset(self) -> VecEnvObs:
        """Start an episode in every row."""
        observations, _ = self.envs.reset(seed=self._seed_of_batch)
        self._seed_of_batch = None
        self._returns[:] = 0.0
        self._lengths[:] = 0
        self.reset_infos = [{} for _ in range(self.num_envs)]
        return observations

    def step_async(self, actions: npt.NDArray[Any]) -> None:
        """Take the actions of the next `step_wait`."""
        self._actions = actions if self._levels is None else self._levels[actions][:, None]

    def step_wait(self) -> VecEnvStepReturn:
        """Step all rows; rows that finish start their next episode."""
        observations, rewards, terminated, truncated, infos = self.envs.step(self._actions)
        self._returns += rewards
        self._lengths += 1
        dones = terminated | truncated
        rows: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        if dones.any():
            elapsed = round(time.time() - self._started, 6)
            for row in np.flatnonzero(dones):
                rows[row] = {
                    "terminal_observation": infos["final_obs"][row],
                    "TimeLimit.truncated": bool(truncated[row] and not terminated[row]),
                    "belief": infos["final_info"]["belief"][row],
                    "episode": {"r": float(self._returns[row]), "l": int(self._lengths[row]), "t": elapsed},
                }
            self._returns[dones] = 0.0
            self._lengths[dones] = 0
        return observations, rewards.astype(np.float32), dones, rows

    def close(self) -> None:
        """Close the environments."""
        self.envs.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """An attribute of the batch, once for every row asked for."""
        return [getattr(self.envs, attr_name)] * len(self._rows(indices))

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of the batch; it is one for all rows."""
        setattr(self.envs, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any) -> list[Any]:
        """Call a method of the batch once; its result stands for every row asked for."""
        return [getattr(self.envs, method_name)(*args, **kwargs)] * len(self._rows(indices))

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        """No row is wrapped; their episodes are monitored here."""
        from stable_baselines3.common.monitor import Monitor

        return [wrapper_class is Monitor] * len(self._rows(indices))

    def _rows(self, indices: VecEnvIndices) -> list[int]:
        return list(self._get_indices(indices))
