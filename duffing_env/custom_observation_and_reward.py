"""Custom observations and rewards: user functions of the beliefs, and observations of history or of the truth.

They run in NumPy, for all environments at once, on the blocks of the kernel. Single and vector environments call them
once a step, whatever number of samples an action is held for.
"""

from __future__ import annotations

from collections import namedtuple
from functools import cache
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from duffing_env.batch import Batch
from duffing_env.belief_arrays import OBSERVATION_BOUND, Beliefs
from duffing_env.experiment_config import Experiment
from duffing_env.storage.kernel_spec import observation_bounds
from estimator.support.array_types import FloatArray

Flags: TypeAlias = npt.NDArray[np.bool_]


def experiment_observation_bounds(experiment: Experiment) -> FloatArray:
    """(entries, 2) bounds of an experiment's observation."""
    model, observation = experiment.model, experiment.observation
    posterior = list(observation_bounds(model).values())
    if observation == "posterior":
        bounds = posterior
    elif observation == "privileged":
        bounds = posterior + [(-OBSERVATION_BOUND, OBSERVATION_BOUND)] * model.n_coefficients
    elif observation == "history":
        history_bounds = posterior[-2 - model.n_inputs - model.n_outputs : -2]
        bounds = history_bounds * experiment.history + posterior[-2:]
    else:
        bounds = [(-OBSERVATION_BOUND, OBSERVATION_BOUND)] * _evaluate_observation(
            observation, experiment.prior_belief.record[None], experiment
        ).shape[1]
    return np.array(bounds)


def _evaluate_observation(function: Any, records: FloatArray, experiment: Experiment) -> FloatArray:
    observed = np.asarray(function(Beliefs(experiment.model, records, experiment.scales)), dtype=np.float64)
    if observed.ndim != 2 or len(observed) != len(records) or not observed.shape[1] or not np.isfinite(observed).all():
        raise ValueError(
            f"observation must give finite numbers of shape (n, entries) for the beliefs of n environments, but gave "
            f"{observed!r:.200} for {len(records)}"
        )
    return observed


class BeliefRow(NamedTuple):
    """One belief of `Beliefs`, for a compiled reward: the same attributes without the first axis."""

    mean: FloatArray
    cov: FloatArray
    coefficients_mean: FloatArray
    coefficients_cov: FloatArray
    noises: FloatArray

    @classmethod
    def columns(cls, beliefs: Beliefs) -> tuple[FloatArray, ...]:
        """The arrays of all beliefs, in the order of the fields."""
        return tuple(np.ascontiguousarray(getattr(beliefs, name)) for name in cls._fields)


@cache
def _compile_reward_loop(function: Any, parameters: tuple[str, ...]) -> Any:
    """``loop(before, after, u, y, truth, paid)``: a reward that the user compiled, called for each environment."""
    import numba

    fields = range(len(BeliefRow._fields))
    row = {who: ", ".join(f"{who}[{k}][i]" for k in fields) for who in ("before", "after")}
    truth = ", ".join(f"truth[i, {k}]" for k in range(len(parameters)))
    loop_source = "def loop(before, after, u, y, truth, paid):\n    for i in range(len(paid)):\n"
    loop_source += f"        one, other = BeliefRow({row['before']}), BeliefRow({row['after']})\n"
    loop_source += f"        paid[i] = function(one, other, u[i], y[i], {f'Truth({truth})' if parameters else None})\n"
    namespace: dict[str, Any] = {"BeliefRow": BeliefRow, "Truth": namedtuple("Truth", parameters), "function": function}
    exec(loop_source, namespace)
    return numba.njit(namespace["loop"])


class CustomFunctions:
    """The custom observation and reward of a batch.

    Attributes:
        observations: (n, entries) float32, set by `start_episodes` and `observe_step`.
        final_observations: the same, for the environments that were reset within the step.
    """

    def __init__(self, batch: Batch) -> None:
        experiment = batch.experiment
        self._batch, self._model = batch, experiment.model
        self._observation, self._reward = experiment.observation, experiment.reward
        self._low, self._high = experiment_observation_bounds(experiment).T.astype(np.float32)
        self._n_shown = self._model.n_inputs + self._model.n_outputs
        self._history = np.zeros((batch.size, experiment.history, self._n_shown), dtype=np.float32)
        self._prior, self._inverse_std = (
            experiment.prior_belief.coefficients_mean,
            experiment.kernel_params.prior_inverse_std,
        )
        self._true_rows = [f"TRUE_{c}" for c in self._model.coefficients]
        self._needed_reset = np.zeros(batch.size, dtype=np.bool_)
        self.observations = self.final_observations = np.zeros((batch.size, len(self._low)), dtype=np.float32)

    @staticmethod
    def for_batch(batch: Batch) -> CustomFunctions | None:
        """The custom functions of a batch; None where the kernel computes observation and reward alone."""
        own = batch.experiment.observation != "posterior" or callable(batch.experiment.reward)
        return CustomFunctions(batch) if own else None

    def start_episodes(self, mask: Flags) -> None:
        """Observe the environments of ``mask`` (n,), whose episodes begin."""
        self._history[mask] = 0.0
        self.observations = self._select_observations(self._batch.observations, None)

    @property
    def memory(self) -> dict[str, npt.NDArray[Any]]:
        """As `Batch.memory`."""
        return {"samples": self._history, "shown": self.observations}

    def before_step(self) -> None:
        """Remember the beliefs before a step."""
        self._needed_reset = self._batch.row_values("NEEDS_RESET") != 0.0
        if callable(self._reward):
            self._records_before = self._batch.records()

    def step_rewards(self, ended: Flags | None) -> FloatArray:
        """(n,) rewards of the last step by the user's function; 0 without one.

        Args:
            ended: (n,) environments that were reset within the step, if any.
        """
        batch, n = self._batch, self._batch.size
        if not callable(self._reward):
            return np.zeros(n)
        scales = batch.experiment.scales
        before, after = (
            Beliefs(self._model, records, scales) for records in (self._records_before, batch.records(ended))
        )
        first_sensor = next(iter(batch.experiment.truth_model.outputs))
        u, y = batch.applied_inputs(ended), batch.row_matrix([f"Y_{first_sensor}"], ended)[:, 0]
        u, y = u * scales.input_scales(u.shape[1]), y * scales.output
        u = u[:, 0] if u.shape[1] == 1 else u
        truth = batch.truth(ended) if batch.experiment.knows_truth else None
        if hasattr(self._reward, "py_func"):  # compiled by Numba
            paid = np.empty(n)
            truths_and_inputs = np.column_stack([*(truth or {}).values(), u])
            loop = _compile_reward_loop(self._reward, tuple(truth or ()))
            loop(BeliefRow.columns(before), BeliefRow.columns(after), u.copy(), y.copy(), truths_and_inputs, paid)
        else:
            paid = np.asarray(self._reward(before, after, u, y, truth), dtype=np.float64)
        unpaid = self._needed_reset | (batch.outcomes[-2:] != 0.0).any(axis=0)
        if paid.shape != (n,) or not np.isfinite(paid[~unpaid]).all():
            raise ValueError(f"reward must give {n} finite numbers for {n} environments, but gave {paid!r:.200}")
        return np.where(unpaid, 0.0, paid)

    def observe_step(self, ended: Flags | None) -> None:
        """Observe the environments after a step; ``ended`` as for `step_rewards`."""
        batch, now = self._batch, self._batch.observations
        if ended is not None:
            last = np.where(ended[:, None], batch.final_observations, now)
            self._append_history(last)
            self.final_observations = self._select_observations(last, ended)
            self._history[ended] = 0.0
        else:
            self._append_history(now)
        self._history[self._needed_reset] = 0.0
        self.observations = self._select_observations(now, None)

    def _append_history(self, observations: npt.NDArray[np.float32]) -> None:
        if self._observation == "history":
            self._history = np.roll(self._history, -1, axis=1)
            self._history[:, -1] = observations[:, -2 - self._n_shown : -2]

    def _select_observations(
        self, observations: npt.NDArray[np.float32], ended: Flags | None
    ) -> npt.NDArray[np.float32]:
        if self._observation == "posterior":
            return observations
        if self._observation == "history":
            selected = np.concatenate([self._history.reshape(len(observations), -1), observations[:, -2:]], axis=1)
        elif self._observation == "privileged":
            true = (self._batch.row_matrix(self._true_rows, ended) - self._prior) * self._inverse_std
            selected = np.concatenate([observations, true], axis=1)
        else:
            selected = _evaluate_observation(self._observation, self._batch.records(ended), self._batch.experiment)
            if selected.shape[1] != len(self._low):
                raise ValueError(
                    f"observation must always give the same number of entries, but gave {len(self._low)} at first and "
                    f"{selected.shape[1]} now; keep their number"
                )
        return np.clip(selected, self._low, self._high).astype(np.float32)
