"""The vector environment as `gymnasium.vector.VectorEnv`: many experiments, stepped by one compiled call."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, ClassVar

import gymnasium as gym
import numba
import numpy as np
import numpy.typing as npt
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from duffing_env.batch import Batch, spawn_seeds
from duffing_env.custom_observation_and_reward import CustomFunctions
from duffing_env.env import DuffingEnv
from duffing_env.env_common import (
    ExperimentEnv,
    ReadOnlyOption,
    action_space,
    check_reset_options,
    make_experiment,
    observation_space,
    refuse_concurrent_calls,
)
from duffing_env.experiment_config import MAX_SAMPLES, Experiment
from duffing_env.kernel import RESET_MANUALLY, RESET_NEXT_STEP, RESET_SAME_STEP
from duffing_env.storage.kernel_spec import OUTCOME_ROWS
from estimator.belief import Belief
from estimator.models.named_parameters import Parameters
from estimator.support.argument_checks import MAX_SEED, check_integer, short_repr, to_float_array
from estimator.support.array_types import FloatArray

_RESET_MODES = {
    AutoresetMode.DISABLED: RESET_MANUALLY,
    AutoresetMode.NEXT_STEP: RESET_NEXT_STEP,
    AutoresetMode.SAME_STEP: RESET_SAME_STEP,
}

#: Name of an outcome of a step to its row in a batch's outcomes; the flags come last.
_OUTCOME_INDEX = {name.lower(): place for place, name in enumerate(OUTCOME_ROWS)}
_FIRST_FLAG = _OUTCOME_INDEX["terminated"]

#: Largest number of rows, which take some gigabytes.
MAX_ENVS = 2**20

#: Largest number of observed numbers in all rows together: 1 GiB.
_MAX_OBSERVED_NUMBERS = 2**28

Observations = npt.NDArray[np.float32]
Flags = npt.NDArray[np.bool_]


class DuffingVectorEnv(ExperimentEnv, VectorEnv[Observations, npt.NDArray[np.float32], npt.NDArray[Any]]):
    """Many `DuffingEnv` at once: the same numbers, row by row.

    Row i, reset with seed s, follows a single environment that is reset with ``spawn_seeds(s, num_envs)[i]``, bit for
    bit, whatever the number of rows and threads. A row's random stream continues over its episodes; autoreset does not
    seed it anew. Rows that are being reset are neither integrated nor inferred.

    Args:
        num_envs: number of rows.
        max_episode_steps: number of steps after which an episode is truncated, as by `gymnasium.wrappers.TimeLimit`,
            which `gymnasium.make` puts around a single environment; None or -1: the ``horizon`` alone truncates.
        autoreset_mode: when a finished row starts its next episode: in the step after (``NEXT_STEP``, the default),
            in the same step (``SAME_STEP``: ``info["final_obs"]`` and ``info["final_info"]`` hold the end of the
            last), or by ``reset(options={"reset_mask": mask})`` (``DISABLED``).
        copy: whether returned observations stay as they are; without it the next step overwrites them.
        threads: number of threads that step the rows, at most Numba's; results do not depend on it.
        render_mode: None; only a single environment can be rendered.
        options: options of the single environment.

    Infos are arrays with masks under ``_key``, as `gymnasium.vector.SyncVectorEnv` makes them from single environments:
    ``information_gain`` and ``log_posterior_gain`` [nats] and the flags of every step and reset. A row that finishes
    also has its last ``belief`` and ``truth``. Under ``SAME_STEP`` the infos of its last step are in ``final_info``.

    >>> import gymnasium as gym
    >>> envs = gym.make_vec("duffing_env/Amplitude-v0", num_envs=4, vectorization_mode="vector_entry_point")
    >>> observations, infos = envs.reset(seed=1)
    >>> observations, rewards, terminated, truncated, infos = envs.step(envs.action_space.sample())
    >>> observations.shape, rewards.shape, sorted(infos)[:2]
    ((4, 22), (4,), ['_diverged', '_information_gain'])
    """

    metadata: dict[str, Any] = {"render_modes": [], "autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012
    single_env_class: ClassVar[type[DuffingEnv]] = DuffingEnv

    num_envs = ReadOnlyOption("num_envs", "_num_envs")
    max_episode_steps = ReadOnlyOption("max_episode_steps", "_max_episode_steps")
    autoreset_mode = ReadOnlyOption("autoreset_mode", "_autoreset_mode")
    copy = ReadOnlyOption("copy", "_copy")
    threads = ReadOnlyOption("threads", "_threads")
    render_mode = ReadOnlyOption("render_mode", "_render_mode")
    _render_mode: ClassVar[None] = None

    @classmethod
    def _experiment_class(cls) -> type[Experiment]:
        return cls.single_env_class.experiment_class

    def __init__(
        self,
        num_envs: int = 1,
        *,
        max_episode_steps: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        copy: bool = True,
        threads: int = 1,
        render_mode: str | None = None,
        **options: Any,
    ) -> None:
        check_integer("num_envs", num_envs, MAX_ENVS)
        check_integer("threads", threads, numba.config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]
        limit = None if max_episode_steps == -1 else max_episode_steps
        if limit is not None:
            check_integer("max_episode_steps", limit, MAX_SAMPLES)
        if render_mode is not None:
            raise ValueError(f"render_mode must be None, but is {render_mode!r}; render a single environment")
        try:
            self._autoreset_mode = AutoresetMode(autoreset_mode)
        except ValueError:
            modes = [mode.value for mode in AutoresetMode]
            raise ValueError(f"autoreset_mode must be one of {modes}, but is {autoreset_mode!r}") from None
        self._num_envs, self._threads, self._max_episode_steps = int(num_envs), int(threads), limit
        self.metadata = {**type(self).metadata, "autoreset_mode": self._autoreset_mode}
        self.experiment: Experiment = make_experiment(self.single_env_class.experiment_class, options)
        self.single_observation_space = observation_space(self.experiment)
        n_hypotheses = len(self.experiment.kernel_params.hypothesis_priors)
        n_observed = int(np.prod(self.single_observation_space.shape))
        if num_envs * n_hypotheses > MAX_ENVS or num_envs * n_observed > _MAX_OBSERVED_NUMBERS:
            raise ValueError(
                f"num_envs must leave room for {n_hypotheses or 1} beliefs and {n_observed} observed numbers in each "
                f"of {num_envs} environments, at most {MAX_ENVS} and {_MAX_OBSERVED_NUMBERS} in all; take fewer"
            )
        self.single_action_space = action_space(self.experiment)
        self._action_shape = (self.num_envs, self.experiment.model.n_inputs)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        reset_mode = _RESET_MODES[self._autoreset_mode]
        hold = self.experiment.hold
        max_samples = math.inf if limit is None else float(limit * hold)
        self._batch = Batch(self.experiment, self.num_envs, reset_mode, self._threads, hold, max_samples)
        self._custom = CustomFunctions.for_batch(self._batch)
        self._copy = copy
        self._call_token = [None]
        self._seeded: Flags = np.zeros(self.num_envs, dtype=np.bool_)
        self._finished: Flags = np.ones(self.num_envs, dtype=np.bool_)
        self._all_rows: Flags = np.ones(self.num_envs, dtype=np.bool_)
        self._any_needs_reset = True

    @property
    def truth(self) -> Parameters:
        """The true parameters of the oscillators, a batch of ``num_envs``.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset, which draws them.
        """
        if not self._seeded.any():
            raise ResetNeeded("no systems are drawn yet: call reset() before you ask for the truth")
        return self._batch.truth()

    def belief(self, index: int) -> Belief:
        """The posterior of row ``index`` now."""
        return self._batch.belief(index)

    @refuse_concurrent_calls
    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Start episodes in all rows, or where ``options["reset_mask"]`` (num_envs,) is true.

        Args:
            seed: seed of the batch, from which `spawn_seeds` makes the seeds of the rows; or one seed for each row. In
                rows without a seed the stream of random numbers continues; the first comes from the operating system.
            options: may hold ``reset_mask``, and ``truth``, chosen systems for this episode of the rows: as in the
                single environment, each entry a number or (num_envs,) numbers; or a list of num_envs systems, one for
                each row, with None for a row whose system is drawn.

        Raises:
            ValueError: for another option, an invalid mask or truth, or a wrong number of seeds.
        """
        options = check_reset_options(options, "reset_mask", "truth")
        mask = self._reset_mask(options)
        chosen_truth = self._batch.parse_truth(options["truth"]) if "truth" in options else None
        self._seed(seed, mask)
        self._batch.renew_output_arrays(observations=self._copy)
        self._batch.reset(mask)
        if chosen_truth is not None:
            self._batch.restart_with_truth(mask, chosen_truth)
        self._finished[mask] = False
        needs_reset = self._finished if self._autoreset_mode == AutoresetMode.DISABLED else ~self._seeded
        self._any_needs_reset = bool(needs_reset.any())
        if self._custom is not None:
            self._custom.start_episodes(mask)
        no_outcomes = np.zeros((_FIRST_FLAG, self.num_envs))
        return self._observation_owner.observations, self._step_infos(
            no_outcomes, np.zeros((4, self.num_envs), dtype=np.bool_), mask
        )

    @refuse_concurrent_calls
    def step(
        self, actions: npt.NDArray[np.float32]
    ) -> tuple[Observations, npt.NDArray[np.float64], Flags, Flags, dict[str, Any]]:
        """Apply the inputs of an action to each row, for ``hold`` samples.

        Raises:
            ValueError: if the actions are not finite numbers of shape (num_envs, inputs); nothing has changed then.
            gymnasium.error.ResetNeeded: before the first reset; with ``DISABLED`` also for finished rows.
        """
        if type(actions) is not np.ndarray or actions.dtype.kind != "f":
            actions = to_float_array("actions", actions)  # type: ignore[assignment]
        if actions.shape != self._action_shape:
            raise ValueError(f"actions must have shape {self._action_shape}, but have {actions.shape}; one per row")
        if not math.isfinite(actions.sum()) and not np.isfinite(actions).all():
            row, place = np.argwhere(~np.isfinite(actions))[0].tolist()
            raise ValueError(f"actions must be finite, but row {row} is {actions[row, place]}; pass values in [-1, 1]")
        if actions.dtype != np.float32:
            actions = np.clip(actions, -1.0, 1.0)
        if self._any_needs_reset:
            needs_reset = self._finished if self._autoreset_mode == AutoresetMode.DISABLED else ~self._seeded
            rows = np.flatnonzero(needs_reset).tolist()
            raise ResetNeeded(f"rows {rows} have finished or not begun: reset them with options={{'reset_mask': mask}}")
        self._batch.renew_output_arrays(observations=self._copy)
        custom = self._custom
        if custom is not None:
            custom.before_step()
        self._batch.step(actions)
        outcomes = self._batch.outcomes
        flags = outcomes[_FIRST_FLAG:] != 0.0
        terminated, truncated = flags[0], flags[1]
        finished = terminated | truncated
        any_finished = bool(np.count_nonzero(finished))
        if custom is not None:
            ended = finished if any_finished and self._autoreset_mode == AutoresetMode.SAME_STEP else None
            outcomes[0] += custom.step_rewards(ended)
            custom.observe_step(ended)
        infos = self._infos(outcomes, flags, finished if any_finished else None)
        self._finished = finished
        if self._autoreset_mode == AutoresetMode.DISABLED:
            self._any_needs_reset = any_finished
        return self._observation_owner.observations, outcomes[0], terminated, truncated, infos

    @property
    def memory(self) -> dict[str, npt.NDArray[Any]]:
        """The state from which the next step continues, by name: the arrays themselves, until the next step or reset.

        To continue its episodes in another environment with the same options, reset that one and copy these arrays into
        its own.
        """
        return self._batch.memory | ({} if self._custom is None else self._custom.memory)

    def _reset_mask(self, options: dict[str, Any]) -> Flags:
        if "reset_mask" not in options:
            return self._all_rows
        mask = options["reset_mask"]
        fits = isinstance(mask, np.ndarray) and mask.shape == (self.num_envs,) and mask.dtype == np.bool_
        if not (fits and mask.any()):
            raise ValueError(
                f"reset_mask must be a bool array of shape {(self.num_envs,)} with a true entry, but is "
                f"{short_repr(mask)}"
            )
        return mask

    def _seed(self, seed: int | Sequence[int | None] | None, mask: Flags) -> None:
        """Start the rows' streams of random numbers, each from its own ``np_random``."""
        seeds: Sequence[int | None] = [None] * self.num_envs
        if isinstance(seed, int | np.integer):
            check_integer("seed", seed, MAX_SEED, 0)
            seeds = spawn_seeds(int(seed), self.num_envs)
        elif seed is not None:
            is_list = isinstance(seed, Sequence | np.ndarray) and not isinstance(seed, str | bytes)
            seeds = list(seed) if is_list and getattr(seed, "shape", None) != () else []
            if len(seeds) != self.num_envs:
                raise ValueError(
                    f"seed must be a whole number or {self.num_envs} of them, one for each row, but is "
                    f"{short_repr(seed)}"
                )
            for row, each in enumerate(seeds):
                if each is not None:
                    check_integer(f"seed[{row}]", each, MAX_SEED, 0)
        # Nothing below can fail.
        if isinstance(seed, int | np.integer):
            super().reset(seed=int(seed))
        for row in np.flatnonzero(mask).tolist():
            row_seed = seeds[row]
            if row_seed is not None or not self._seeded[row]:
                generator, _ = gym.utils.seeding.np_random(None if row_seed is None else int(row_seed))
                self._batch.seed(row, generator)
        self._seeded |= mask

    def _infos(self, outcomes: FloatArray, flags: npt.NDArray[np.bool_], finished: Flags | None) -> dict[str, Any]:
        """The infos of a step, and of the rows that finished in it, if any."""
        infos = self._step_infos(outcomes, flags, self._all_rows)
        if finished is None:
            return infos
        if self._autoreset_mode != AutoresetMode.SAME_STEP:
            return infos | self._final_beliefs_and_truths(finished)
        final_infos = self._step_infos(outcomes.copy(), flags.copy(), finished)
        for name in (*self.single_env_class._info_gains, *self.single_env_class._info_flags):
            final_infos[name][~finished] = 0
            infos[name][finished] = 0
        final_observations = np.full(self.num_envs, None, dtype=object)
        for row in np.flatnonzero(finished):
            final_observations[row] = self._observation_owner.final_observations[row].copy()
        return infos | {
            "final_obs": final_observations,
            "_final_obs": finished.copy(),
            "final_info": final_infos | self._final_beliefs_and_truths(finished),
            "_final_info": finished.copy(),
        }

    def _step_infos(self, outcomes: FloatArray, flags: npt.NDArray[np.bool_], mask: Flags) -> dict[str, Any]:
        infos: dict[str, Any] = {}
        for name in self.single_env_class._info_gains:
            infos[name], infos[f"_{name}"] = outcomes[_OUTCOME_INDEX[name]], mask.copy()
        for name in self.single_env_class._info_flags:
            infos[name], infos[f"_{name}"] = flags[_OUTCOME_INDEX[name] - _FIRST_FLAG], mask.copy()
        return infos

    def _final_beliefs_and_truths(self, finished: Flags) -> dict[str, Any]:
        """The last beliefs and truths of the finished rows."""
        same_step = self._autoreset_mode == AutoresetMode.SAME_STEP
        beliefs, truths = np.full((2, self.num_envs), None, dtype=object)
        rows = np.flatnonzero(finished)
        beliefs[rows] = self._batch.beliefs(rows, final=same_step)
        # One by one: NumPy would take an object that has a length for a row.
        truths[rows] = np.fromiter(self._batch.truths(rows, final=same_step), dtype=object, count=len(rows))
        return {"belief": beliefs, "_belief": finished.copy(), "truth": truths, "_truth": finished.copy()}
