"""The vector environment as Stable-Baselines3's `VecEnv`."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium.vector import AutoresetMode, VectorEnv

from duffing_env.env_common import ReadOnlyOption, check_reset_options
from duffing_env.vector_env import DuffingVectorEnv
from estimator.models.named_parameters import Parameters
from estimator.support.optional_dependencies import require_packages

require_packages("stable_baselines3")
from stable_baselines3.common.vec_env import VecEnv  # noqa: E402
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn  # noqa: E402

_TRUNCATED = "TimeLimit.truncated"


class BatchVecEnv(VecEnv):
    """A `VecEnv` that is one batch: a result of a method of the batch applies to every row."""

    def __init__(self, *arguments: Any) -> None:
        #: Attributes of a caller's own, by name and row.
        self._row_attributes: dict[str, dict[int, Any]] = {}
        super().__init__(*arguments)

    @property
    def _batch(self) -> Any:
        """What has the attributes and methods."""
        return self

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """An attribute of every row asked for: what `set_attr` gave it, or what all have alike."""
        rows, given = self._row_indices(indices), self._row_attributes.get(attr_name, {})
        if rows and all(row in given for row in rows):
            return [given[row] for row in rows]
        return self._shared_attribute(attr_name, rows)

    def _shared_attribute(self, name: str, rows: list[int]) -> list[Any]:
        return [getattr(self._batch, name)] * len(rows)

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Give rows an attribute of a caller's own, or set one that all have alike.

        Raises:
            AttributeError: for an option of the environments, or what else cannot be set.
        """
        for owner in (self._batch, self):
            if hasattr(owner, attr_name):
                setattr(owner, attr_name, value)
                return
        self._row_attributes.setdefault(attr_name, {}).update(dict.fromkeys(self._row_indices(indices), value))

    def env_method(self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any) -> list[Any]:
        """Call a method once; its result stands for every row asked for."""
        return [getattr(self._batch, method_name)(*args, **kwargs)] * len(self._row_indices(indices))

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        """No row is wrapped; their episodes are monitored here."""
        from stable_baselines3.common.monitor import Monitor

        return [wrapper_class is Monitor] * len(self._row_indices(indices))

    def _row_indices(self, indices: VecEnvIndices) -> list[int]:
        return list(self._get_indices(indices))


class DuffingVecEnv(BatchVecEnv):
    """Stable-Baselines3's view of a `DuffingVectorEnv` in mode ``SAME_STEP``.

    A row's info holds what the environment says of the step, such as ``information_gain``, and
    ``TimeLimit.truncated`` (so that a time limit is not taken for a terminal state), as with `DummyVecEnv`; so do
    ``reset_infos`` of a reset. That of a finished row also has the ``belief`` and the ``truth`` it ended with,
    ``terminal_observation`` and ``episode`` (return, length, time), which is what Stable-Baselines3 otherwise needs a
    `VecMonitor` for. All buffers that are handed out are copies.

    ``set_options({"truth": truth})``, or a list of such for each row, chooses the systems of the next reset alone.

    Args:
        env: the id of a registered track; or a vector environment that was made with
            ``autoreset_mode="SameStep"``, wrapped or not, and then without further options.
        num_envs: number of rows; of a given vector environment, its own.
        seed: of the batch; the next reset uses it.
        levels: number of evenly spaced inputs from -1 to 1, of which an action is one, by index, for each of several
            inputs; 0: any input between.
        options: of the environment, and ``threads``.

    Raises:
        ValueError: for an environment that was made otherwise.
    """

    levels = ReadOnlyOption("levels", "_n_levels")

    def __init__(
        self,
        env: str | VectorEnv[Any, Any, Any],
        num_envs: int | None = None,
        seed: int | None = None,
        *,
        levels: int = 0,
        **options: Any,
    ) -> None:
        vector_env: Any = env
        if isinstance(env, str):
            vector_env = gym.make_vec(
                env,
                num_envs=1 if num_envs is None else num_envs,
                vectorization_mode="vector_entry_point",
                autoreset_mode=AutoresetMode.SAME_STEP,
                **options,
            )
        elif options or num_envs not in (None, vector_env.num_envs):
            raise ValueError(f"num_envs and options must be left out for an environment that was made: {env}")
        if (
            not isinstance(vector_env.unwrapped, DuffingVectorEnv)
            or vector_env.unwrapped.autoreset_mode != AutoresetMode.SAME_STEP
        ):
            raise ValueError(
                f"env must be the id of a track, or be made with gym.make_vec(id, num_envs=n, "
                f"vectorization_mode='vector_entry_point', autoreset_mode='SameStep'), but is {env}"
            )
        num_envs = int(vector_env.num_envs)
        self.envs = vector_env
        self.render_mode = None
        self._n_levels = levels
        self._levels = np.linspace(-1.0, 1.0, levels, dtype=np.float32) if levels else None
        action_space: gym.Space[Any] = vector_env.single_action_space
        self._n_inputs = vector_env.unwrapped.experiment.model.n_inputs
        if levels:
            several = self._n_inputs > 1
            action_space = (
                gym.spaces.MultiDiscrete([levels] * self._n_inputs) if several else gym.spaces.Discrete(levels)
            )
        super().__init__(num_envs, vector_env.single_observation_space, action_space)
        self._seed_of_batch = seed
        self._actions = np.zeros((num_envs, self._n_inputs), dtype=np.float32)
        self._returns = np.zeros(num_envs)
        self._lengths = np.zeros(num_envs, dtype=np.int64)
        self._started = time.perf_counter()

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seed the batch at its next reset."""
        self._seed_of_batch = seed
        return [seed] * self.num_envs

    def reset(self) -> VecEnvObs:
        """Start an episode in every row.

        Raises:
            ValueError: for options of `set_options` that a reset does not take; nothing has changed then.
        """
        if len(self._options) != self.num_envs:
            raise ValueError(
                f"options must be a dict, or {self.num_envs} of them, one for each row, but are {len(self._options)}"
            )
        chosen = [check_reset_options(options, "truth").get("truth") for options in self._options]
        options = None if all(truth is None for truth in chosen) else {"truth": chosen}
        observations, infos = self.envs.reset(seed=self._seed_of_batch, options=options)
        self._seed_of_batch = None
        self._reset_options()
        self._returns[:] = 0.0
        self._lengths[:] = 0
        self.reset_infos = infos_by_row(infos, self._step_info_names, self.num_envs)
        return observations

    @property
    def episode_state(self) -> dict[str, npt.NDArray[Any]]:
        """As `DuffingVectorEnv.memory`."""
        return self._batch.memory | {"returns": self._returns, "lengths": self._lengths}

    def restore_episode_state(self, state: dict[str, npt.NDArray[Any]]) -> VecEnvObs:
        """Go on with the episodes of a copy of `episode_state`, and return their observations."""
        observations = self.reset()
        for name, array in self.episode_state.items():
            array[...] = state[name]
        return observations

    def step_async(self, actions: npt.NDArray[Any]) -> None:
        """Take the actions of the next `step_wait`."""
        self._actions = actions if self._levels is None else self._levels[actions].reshape(-1, self._n_inputs)

    def step_wait(self) -> VecEnvStepReturn:
        """Step all rows; rows that finish start their next episode."""
        observations, rewards, terminated, truncated, infos = self.envs.step(self._actions)
        self._returns += rewards
        self._lengths += 1
        dones = terminated | truncated
        rows = infos_by_row(infos, self._step_info_names, self.num_envs, **{_TRUNCATED: False})
        if dones.any():
            elapsed = round(time.perf_counter() - self._started, 6)
            for row in np.flatnonzero(dones).tolist():
                del rows[row][_TRUNCATED]
                self.reset_infos[row] = rows[row]
                rows[row] = info_of_row(infos["final_info"], row) | {
                    "terminal_observation": infos["final_obs"][row],
                    _TRUNCATED: bool(truncated[row] and not terminated[row]),
                    "episode": {"r": float(self._returns[row]), "l": int(self._lengths[row]), "t": elapsed},
                }
            self._returns[dones] = 0.0
            self._lengths[dones] = 0
        return observations, rewards.astype(np.float32), dones, rows

    def close(self) -> None:
        """Close the environments."""
        self.envs.close()

    def _shared_attribute(self, name: str, rows: list[int]) -> list[Any]:
        """Of what the batch has for each row, their parts."""
        if name == "belief":
            return [self._batch.belief(row) for row in rows]
        value = getattr(self.envs if hasattr(self.envs, name) else self._batch, name)
        if isinstance(value, Parameters):
            return [Parameters({name: numbers[row].item() for name, numbers in value.items()}) for row in rows]
        each = isinstance(value, np.ndarray) and value.shape[:1] == (self.num_envs,)
        return [value[row] if each else value for row in rows]

    @property
    def _step_info_names(self) -> tuple[str, ...]:
        """Names of the infos of every step."""
        return (*self._batch.single_env_class._info_gains, *self._batch.single_env_class._info_flags)

    @property
    def _batch(self) -> DuffingVectorEnv:
        batch: DuffingVectorEnv = self.envs.unwrapped
        return batch


def infos_by_row(infos: dict[str, Any], names: Sequence[str], n_rows: int, **others: Any) -> list[dict[str, Any]]:
    """A vector environment's infos, row by row as infos of single environments, and common entries."""
    template = dict.fromkeys(names, 0.0) | {name: False for name in names if infos[name].dtype == np.bool_} | others
    row_infos = [template.copy() for _ in range(n_rows)]
    for name in names:
        if infos[name].any():  # flags seldom are
            for row, value in zip(row_infos, infos[name].tolist(), strict=True):
                row[name] = value
    return row_infos


def info_of_row(infos: dict[str, Any], row: int) -> dict[str, Any]:
    """A vector environment's infos of one row, as a single environment's info."""
    row_info = {
        name: values[row] for name, values in infos.items() if not name.startswith("_") and infos[f"_{name}"][row]
    }
    return {name: value.item() if isinstance(value, np.generic) else value for name, value in row_info.items()}
