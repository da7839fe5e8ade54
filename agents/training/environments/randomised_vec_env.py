"""A `VecEnv` whose environments have randomly drawn options: groups of rows, each group with its own options."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from time import perf_counter
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn

from agents.evaluation.track_batch import make_track_batch
from agents.policies.networks.feature_encoder import FeatureEncoder, ShieldedFeatures
from agents.policies.networks.feature_names import MAX_FEATURE
from agents.sb3_vec_env import BatchVecEnv, info_of_row, infos_by_row
from agents.training.environments.feature_vec_env import REWARD_SCALE, FeatureNormalizer, has_shaping_potential
from duffing_env.vector_env import DuffingVectorEnv
from estimator.compilation.simd import LANES
from estimator.support.argument_checks import short_repr


class TrackOptions(NamedTuple):
    """The id of a track, and the options of its environments."""

    env_id: str
    options: dict[str, Any]


#: Draws the track and the options of a group of rows.
DrawOptions = Callable[[np.random.Generator], TrackOptions]


def draw_track_options(
    rng: np.random.Generator, env_id: str, options: dict[str, Any], ranges: Mapping[str, Sequence[float]]
) -> TrackOptions:
    """A track with log-uniformly drawn options; between two whole numbers, a whole number is drawn.

    Example:
        >>> import numpy as np
        >>> from agents.training.environments.randomised_vec_env import draw_track_options
        >>> drawn = draw_track_options(np.random.default_rng(1), "duffing_env/Power-v0", {}, {"horizon": (128, 1024)})
        >>> drawn
        TrackOptions(env_id='duffing_env/Power-v0', options={'horizon': 371})
    """
    drawn = {}
    for name, (low, high) in ranges.items():
        value = min(float(np.exp(rng.uniform(np.log(low), np.log(high)))), high)
        drawn[name] = round(value) if isinstance(low, int) and isinstance(high, int) else value
    return TrackOptions(env_id, options | drawn)


class _RowGroup:
    """Rows with the same options, for the length of an episode."""

    def __init__(
        self, rng: np.random.Generator, draw: DrawOptions, options: dict[str, Any], raw_observation: bool
    ) -> None:
        env_id, drawn = draw(rng)
        self.envs: DuffingVectorEnv = make_track_batch(env_id, LANES, drawn | options)
        self.feature_map = FeatureEncoder.of(self.envs, with_observation=raw_observation)
        observations, self.infos = self.envs.reset(seed=int(rng.integers(2**31)))
        self.current_features: ShieldedFeatures = self.feature_map(observations)
        self.samples_left = self.envs.horizon
        self.weight = np.float32(has_shaping_potential(self.envs))

    def row_infos(self, **extra: Any) -> list[dict[str, Any]]:
        """The infos of the rows at the last reset or step."""
        single = self.envs.single_env_class
        return infos_by_row(self.infos, (*single._info_gains, *single._info_flags), LANES, **extra)


class MixedVecEnv(BatchVecEnv):
    """Environments in groups of `estimator.compilation.simd.LANES` rows, each group with its own options, as features.

    A group draws new options after the length of an episode; an episode that began meanwhile, because a limit ended the
    one before, is truncated. Rewards are shaped as in `FeatureVecEnv`.

    Args:
        num_envs: number of rows, a multiple of `LANES`.
        seed: of options, oscillators and noise.
        draw: draws the track and the options of a group.
        reward: name of a reward that is information.
        levels: number of evenly spaced actions from -1 to 1, chosen by their index; 0: all actions between.
        raw_observation: whether the observation follows the features; all tracks then must have one model.

    Raises:
        ValueError: for a number of rows that is no multiple of `LANES`.
    """

    def __init__(
        self,
        num_envs: int,
        seed: int,
        draw: DrawOptions,
        *,
        reward: str = "information_gain",
        levels: int = 0,
        raw_observation: bool = False,
    ) -> None:
        if num_envs % LANES:
            raise ValueError(f"num_envs must be a multiple of {LANES} for drawn options, but is {num_envs}")
        self.render_mode = None
        self._rngs = [np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(num_envs // LANES)]
        self._draw, self._raw_observation = draw, raw_observation
        self._fixed_options = {"reward": reward, "autoreset_mode": AutoresetMode.SAME_STEP}
        self._discrete_actions = np.linspace(-1.0, 1.0, levels) if levels else None
        self._groups = [self._draw_group(rng) for rng in self._rngs]
        first = self._groups[0].feature_map
        self.features = first.describe() if raw_observation else {"own": False}
        self.normalizer = FeatureNormalizer(first.size)
        space = gym.spaces.Discrete(levels) if levels else gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
        seen = gym.spaces.Box(-MAX_FEATURE, MAX_FEATURE, (first.size,), np.float32)
        super().__init__(num_envs, seen, space)
        self._choices = np.zeros(num_envs)
        self._returns, self._lengths = np.zeros(num_envs), np.zeros(num_envs, dtype=np.int64)
        self._start_time = perf_counter()

    def _draw_group(self, rng: np.random.Generator) -> _RowGroup:
        return _RowGroup(rng, self._draw, self._fixed_options, self._raw_observation)

    def reset(self) -> VecEnvObs:
        """The first observations of the episodes, which have begun.

        Raises:
            ValueError: for options of `set_options`, because options are drawn here.
        """
        if any(self._options):
            raise ValueError(
                f"options must be none where they are drawn, but are {short_repr(self._options)}; leave them out"
            )
        self.reset_infos = [info for group in self._groups for info in group.row_infos()]
        return self.normalizer(np.concatenate([group.current_features.values for group in self._groups]))

    @property
    def tensors(self) -> dict[str, npt.NDArray[Any]]:
        """The normaliser, by its names in a policy's file, which takes the setting from the environment it plays in."""
        return self.normalizer.to_tensors()

    def step_async(self, actions: npt.NDArray[Any]) -> None:
        """Take the actions of the network."""
        self._choices = actions[:, 0] if self._discrete_actions is None else self._discrete_actions[actions]

    def step_wait(self) -> VecEnvStepReturn:
        """Step all groups."""
        values = np.empty((self.num_envs, len(self.normalizer.mean)), dtype=np.float32)
        rewards, dones = np.empty(self.num_envs, dtype=np.float32), np.empty(self.num_envs, dtype=np.bool_)
        rows: list[dict[str, Any]] = []
        for g, group in enumerate(self._groups):
            group_rows = slice(g * LANES, (g + 1) * LANES)
            potential_before = group.current_features.remaining_information
            actions = group.current_features.to_actions(self._choices[group_rows])
            observations, group_rewards, terminated, truncated, group.infos = group.envs.step(actions)
            ended = terminated | truncated
            rows += group.row_infos(**{"TimeLimit.truncated": False})
            group.current_features = group.feature_map(observations)
            group.samples_left -= 1
            potential = np.where(ended, np.float32(0), group.current_features.remaining_information)
            rewards[group_rows] = REWARD_SCALE * (group_rewards + group.weight * (potential - potential_before))
            self._returns[group_rows] += group_rewards
            self._lengths[group_rows] += 1
            dones[group_rows] = ended | (group.samples_left == 0)
            for row in np.flatnonzero(dones[group_rows]).tolist():
                env_row = g * LANES + row
                rows[env_row] |= (info_of_row(group.infos["final_info"], row) if ended[row] else {}) | {
                    "terminal_observation": self.normalizer(group.current_features.values[row]),
                    "TimeLimit.truncated": bool(not ended[row]),
                    "episode": {
                        "r": self._returns[env_row],
                        "l": self._lengths[env_row],
                        "t": perf_counter() - self._start_time,
                    },
                }
                self._returns[env_row], self._lengths[env_row] = 0.0, 0
            if group.samples_left == 0:
                group.envs.close()
                group = self._groups[g] = self._draw_group(self._rngs[g])
            values[group_rows] = group.current_features.values
        return self.normalizer(values), rewards, dones, rows

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """As of `BatchVecEnv`."""
        if hasattr(self._groups[0].envs, attr_name):
            setattr(self._groups[0].envs, attr_name, value)
        super().set_attr(attr_name, value, indices)

    def close(self) -> None:
        """Close the environments."""
        for group in self._groups:
            group.envs.close()

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Do nothing: the constructor's seed holds."""
        return [None] * self.num_envs
