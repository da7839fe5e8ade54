"""The family of oscillators as Stable-Baselines3's `VecEnv`: groups of rows, each on a rig of its own."""

from __future__ import annotations

from collections.abc import Sequence
from time import perf_counter
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn

from agents.evaluation.batch import make
from agents.policies.foresight import CommonForesight, Sight
from agents.policies.imagined import BOUND, FEATURES
from agents.training.family import draw_member
from duffing_env.vector_env import DuffingVectorEnv
from estimator.lanes import LANES

#: Rewards are scaled to returns of about 1: a critic that errs by more takes the whole of the clipped gradient.
_SCALE = 0.3

_TO_COME = FEATURES.index("to_come")


class _Group:
    """Rows on one rig, for as long as one of its episodes lasts."""

    def __init__(self, rng: np.random.Generator, reward: str) -> None:
        self.member = draw_member(rng)
        options = {**self.member.options, "reward": reward, "autoreset_mode": AutoresetMode.SAME_STEP}
        self.envs: DuffingVectorEnv = make("duffing_env/Rig-v0", LANES, options)
        self.foresight = CommonForesight(self.envs)
        observations, _ = self.envs.reset(seed=int(rng.integers(2**31)))
        self.view: Sight = self.foresight.look(observations)
        self.left = self.envs.horizon


class FamilyVecEnv(VecEnv):
    """Rows in groups of `estimator.lanes.LANES`, each group on a rig of the family, as `CommonForesight` shows them.

    A group gets its next rig when an episode of its rig has gone by; the rows that began another on the way, because a
    limit ended theirs, are cut short. As in `agents.training.foresight_env` the increase of what is still to come is
    added to the reward.

    Args:
        num_envs: rows, a multiple of `LANES`.
        seed: of rigs, oscillators and noise.
        reward: that counts information.
        levels: an action is one of so many evenly spaced choices from -1 to 1, by its number; 0: any between.

    Raises:
        ValueError: for another number of rows.
    """

    def __init__(self, num_envs: int, seed: int, *, reward: str = "information_gain", levels: int = 0) -> None:
        if num_envs % LANES:
            raise ValueError(f"num_envs must be a multiple of {LANES} for the family, but is {num_envs}")
        self.render_mode = None
        self._rngs = [np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(num_envs // LANES)]
        self._reward = reward
        self._levels = np.linspace(-1.0, 1.0, levels) if levels else None
        self._groups = [_Group(rng, reward) for rng in self._rngs]
        space = gym.spaces.Discrete(levels) if levels else gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
        super().__init__(num_envs, gym.spaces.Box(-BOUND, BOUND, (len(FEATURES),), np.float32), space)
        self.foresight = self._groups[0].foresight
        self._choices = np.zeros(num_envs)
        self._returns, self._lengths = np.zeros(num_envs), np.zeros(num_envs, dtype=np.int64)
        self._started = perf_counter()

    def reset(self) -> VecEnvObs:
        """Show what every row sees; the episodes have begun."""
        self.reset_infos = [{} for _ in range(self.num_envs)]
        return np.concatenate([group.view.features for group in self._groups])

    def step_async(self, actions: npt.NDArray[Any]) -> None:
        """Take what the network chose."""
        self._choices = actions[:, 0] if self._levels is None else self._levels[actions]

    def step_wait(self) -> VecEnvStepReturn:
        """Step all groups."""
        features = np.empty((self.num_envs, len(FEATURES)), dtype=np.float32)
        rewards, dones = np.empty(self.num_envs, dtype=np.float32), np.empty(self.num_envs, dtype=np.bool_)
        rows: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for g, group in enumerate(self._groups):
            mine = slice(g * LANES, (g + 1) * LANES)
            before = group.view.features[:, _TO_COME]
            actions = group.foresight.act(self._choices[mine], group.view)
            observations, gained, terminated, truncated, _ = group.envs.step(actions)
            ended = terminated | truncated
            group.view = group.foresight.look(observations)
            group.left -= 1
            after = np.where(ended, np.float32(0), group.view.features[:, _TO_COME])
            rewards[mine] = _SCALE * (gained + after - before)
            self._returns[mine] += gained
            self._lengths[mine] += 1
            dones[mine] = ended | (group.left == 0)
            for row in np.flatnonzero(dones[mine]):
                at = g * LANES + row
                rows[at] = {
                    "terminal_observation": group.view.features[row].copy(),
                    "TimeLimit.truncated": bool(not ended[row]),
                    "episode": {"r": self._returns[at], "l": self._lengths[at], "t": perf_counter() - self._started},
                }
                self._returns[at], self._lengths[at] = 0.0, 0
            if group.left == 0:
                group.envs.close()
                group = self._groups[g] = _Group(self._rngs[g], self._reward)
            features[mine] = group.view.features
        return features, rewards, dones, rows

    def close(self) -> None:
        """Close the environments."""
        for group in self._groups:
            group.envs.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """An attribute, once for every row asked for."""
        return [getattr(self, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute; it is one for all rows."""
        setattr(self, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any) -> list[Any]:
        """Call a method once; its result stands for every row asked for."""
        return [getattr(self, method_name)(*args, **kwargs)] * len(list(self._get_indices(indices)))

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        """No row is wrapped; their episodes are monitored here."""
        return [False] * len(list(self._get_indices(indices)))

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Nothing: the seed is that of the constructor."""
        return [None] * self.num_envs
