"""A batch of experiments: the arrays that the kernel steps, for single and vector environments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from duffing_env.experiment_config import Experiment
from duffing_env.kernel import RESET_ONLY, compile_kernel
from duffing_env.kernel_stages.noise_filter_bank import interleave_width, member_row_count, n_member_blocks
from duffing_env.numba_threads import numba_thread_context
from duffing_env.storage.array_pool import ArrayPool
from duffing_env.storage.kernel_spec import (
    OUTCOME_ROWS,
    applied_row,
    block_layout,
    noise_std_rows,
    observation_bounds,
    pack_params,
    parameter_names,
)
from duffing_env.storage.random_streams import new_stream_words
from estimator.belief import Belief, record_size
from estimator.compilation.simd import LANES
from estimator.models.named_parameters import Parameters
from estimator.support.array_types import FloatArray

_OUTCOME_NAMES = tuple(name.lower() for name in OUTCOME_ROWS)

#: Attributes that are views of others.
_FLAT_VIEWS = ("_flat_actions", "_flat_blocks", "_flat_ended")


class Batch:
    """n experiments of one kind, stepped together.

    Args:
        experiment: the fixed options of the experiments.
        size: number n of experiments; memory is laid out for a multiple of `LANES`.
        reset_mode: `duffing_env.kernel.RESET_MANUALLY`, ``RESET_NEXT_STEP`` or ``RESET_SAME_STEP``.
        threads: number of threads that step the blocks; results do not depend on it.
        hold: largest number of samples in a step: an environment stops where its episode ends.
        max_samples: samples after which episodes are truncated.

    Attributes:
        observations: (n, entries) float32, overwritten by every step, unless `renew_output_arrays` is called before.
        final_observations: the same, for environments that were reset within the step; always overwritten.
        outcomes: (len(OUTCOME_ROWS), n), overwritten like the observations.
    """

    def __init__(
        self,
        experiment: Experiment,
        size: int,
        reset_mode: int,
        threads: int = 1,
        hold: int = 1,
        max_samples: float = np.inf,
    ) -> None:
        self.experiment = experiment
        self.size = size
        self._reset_mode = reset_mode
        self._threads = threads
        self._spec = experiment.kernel_spec
        self._kernel = compile_kernel(self._spec)
        self._row_of = block_layout(self._spec)
        self._params = experiment.kernel_params._replace(
            hold=hold, max_samples=max_samples, interleaved_envs=interleave_width(size)
        )
        self._packed_params = pack_params(self._params)
        self._prior = experiment.prior_belief
        model, draws_noises = experiment.truth_model, experiment.kernel_params.noise_range > 1
        self._truth_rows = {name: f"PARAM_{name}" for name in parameter_names(model)} | (
            noise_std_rows(model) if draws_noises else {}
        )
        self._truth_scales = np.array([physical_unit_factor(experiment, name) for name in self._truth_rows])
        n_rows, n_observation = max(self._row_of.values()) + 1, len(observation_bounds(experiment.model))
        # A copy: Numba types a read-only array differently, and would compile the step anew.
        self._replayed_record = np.array(experiment.replayed_record)
        n_blocks = -(-size // LANES)
        padded = n_blocks * LANES
        self._blocks = np.zeros((n_blocks, n_rows, LANES))
        n_members = n_member_blocks(size, len(self._params.hypothesis_priors))
        self._members = np.zeros((n_members, member_row_count(self._spec) * LANES))
        self._ended = np.zeros_like(self._blocks)
        self._workspace = np.zeros((threads, 2 * n_rows * LANES))
        self._actions = np.zeros((padded, experiment.model.n_inputs), dtype=np.float32)
        self._flatten()
        self._applied_rows = [applied_row(name) for name in experiment.model.inputs]
        self._observation_pool = ArrayPool((padded, n_observation), np.float32)
        self._outcome_pool = ArrayPool((len(OUTCOME_ROWS), padded), np.float64)
        self.renew_output_arrays()
        self._final_observations = np.zeros_like(self._observations)
        self.final_observations = self._final_observations[:size]
        # Lanes beyond the last environment run as well: a reset keeps their numbers finite.
        self._mask = np.ones(padded, dtype=np.bool_)
        self._reset_masked()
        self._mask[size:] = False

    def seed(self, index: int, generator: np.random.Generator) -> None:
        """Start environment ``index``'s stream of random numbers from its ``np_random``."""
        block, lane = divmod(index, LANES)
        first = self._row_of["SFC64_a"]
        self._blocks[block, first : first + 4, lane] = new_stream_words(generator, self.experiment.branch)

    def reset(self, mask: npt.NDArray[np.bool_]) -> None:
        """Start episodes where ``mask`` (n,) is true."""
        self._mask[: self.size] = mask
        self._reset_masked()

    def _reset_masked(self) -> None:
        self._run_kernel(RESET_ONLY)

    def parse_truth(self, truth: Any) -> FloatArray:
        """The truth of ``reset(options={"truth": ...})`` as (size, quantities) internal numbers, NaN where drawn.

        Raises:
            ValueError: for an invalid truth, with the name of the parameter.
        """
        if not isinstance(truth, list | tuple):
            return self._parse_one_truth(truth, "truth", self.size)
        if len(truth) != self.size:
            raise ValueError(f"truth must be one for all environments, or {self.size} of them, but is {len(truth)}")
        chosen = np.full((self.size, len(self._truth_rows)), np.nan)
        for row, each in enumerate(truth):
            if each is not None:
                chosen[row] = self._parse_one_truth(each, f"truth[{row}]", 1)[0]
        return chosen

    def _parse_one_truth(self, truth: Any, label: str, size: int) -> FloatArray:
        """(size, quantities) internal numbers of one truth, for ``size`` environments."""
        experiment = self.experiment
        names, parameters = list(self._truth_rows), list(parameter_names(experiment.truth_model))
        if experiment.plant is None:
            raise ValueError(f"{label} cannot be chosen here: no plant is simulated; leave it out")
        if not isinstance(truth, Mapping) or set(truth) not in (set(names), set(parameters)):
            noises = f", or these and {names[len(parameters) :]}" if len(names) > len(parameters) else ""
            raise ValueError(f"{label} must give the parameters {parameters}{noises}, but is {truth!r:.300}")
        chosen = np.full((size, len(names)), np.nan)
        for k, name in enumerate(names[: len(truth)]):
            value = truth[name]
            try:
                chosen[:, k] = value
            except (TypeError, ValueError):
                raise ValueError(
                    f"{label}[{name!r}] must be a number, or {size} of them, but is {value!r:.200}"
                ) from None
            if not np.isfinite(chosen[:, k]).all():
                raise ValueError(f"{label}[{name!r}] must be finite, but is {value!r:.200}")
            if (name == "m" or k >= len(parameters)) and not (chosen[:, k] > 0).all():
                raise ValueError(f"{label}[{name!r}] must be positive, but is {value!r:.200}")
        return chosen / self._truth_scales

    def restart_with_truth(self, mask: npt.NDArray[np.bool_], truth: FloatArray) -> None:
        """Restart the episodes of ``mask``, which were just reset, with chosen plants and the same noise.

        NaN in ``truth`` keeps the drawn numbers: of a whole row, or of its standard deviations.
        """
        params, n = self._params, len(parameter_names(self.experiment.truth_model))
        kept_rows = [place for name, place in self._row_of.items() if name.startswith(("SFC64_", "JUMP_"))]
        noise_rows_kept = [self._row_of[row] for row in noise_std_rows(self.experiment.truth_model).values()]
        for row in np.flatnonzero(mask & np.isfinite(truth[:, 0])).tolist():
            b, lane = divmod(row, LANES)
            kept_values, stds = self._blocks[b, kept_rows, lane], self._blocks[b, noise_rows_kept, lane]
            if np.isfinite(truth[row]).all() and truth.shape[1] > n:
                stds = truth[row, n:]
            row_params = params._replace(
                nominal_parameters=truth[row, :n], parameter_stds=np.zeros(n), spread=0.0,
                process_noise=stds[0], measurement_noise=stds[1:], noise_range=1.0,
            )  # fmt: skip
            self._mask[: self.size] = np.arange(self.size) == row
            self._run_kernel(RESET_ONLY, pack_params(row_params), (b, b + 1))
            self._blocks[b, kept_rows, lane] = kept_values

    def renew_output_arrays(self, *, observations: bool = True) -> None:
        """Let the next step write into other arrays, so that referenced arrays of the last step stay as they are.

        Args:
            observations: whether to renew the observations, besides the outcomes.
        """
        self._outcomes = self._outcome_pool.acquire()
        self.outcomes = self._outcomes[:, : self.size]
        if observations:
            self._observations = self._observation_pool.acquire()
            self.observations = self._observations[: self.size]

    def step(self, actions: npt.ArrayLike) -> None:
        """Apply actions (n, inputs) for a step, in parts of the largest inputs; float32, clipped to [-1, 1]."""
        self._actions[: self.size] = actions
        self._run_kernel(self._reset_mode)

    def _run_kernel(
        self, reset_mode: int, packed_params: FloatArray | None = None, blocks: tuple[int, int] | None = None
    ) -> None:
        arguments = (
            self._flat_actions, self._packed_params if packed_params is None else packed_params, self._replayed_record,
            reset_mode, self._mask, self._observations, self._outcomes, self._final_observations, self._flat_ended,
        )  # fmt: skip
        if blocks is not None:
            self._kernel.step(*blocks, self._flat_blocks, self._members, self._workspace[0], *arguments)
        elif self._threads > 1 and (thread_context := numba_thread_context(self._threads)) is not None:
            with thread_context:
                self._kernel.step_parallel(self._flat_blocks, self._members, self._workspace, *arguments)
        else:
            self._kernel.step(0, len(self._blocks), self._flat_blocks, self._members, self._workspace[0], *arguments)

    @property
    def memory(self) -> dict[str, npt.NDArray[Any]]:
        """The state from which the next step continues, and the last observations: the arrays themselves."""
        return {"blocks": self._blocks, "members": self._members, "observations": self._observations}

    def set_measured_sample(self, u: npt.ArrayLike, y: float) -> None:
        """Set inputs (inputs,) and output of the next step, in an experiment that replays a record of one sample."""
        self._replayed_record[:-1, 0], self._replayed_record[-1, 0] = u, y

    def outcome(self, index: int) -> dict[str, float]:
        """The outcome of the last step for one environment, by names in lower case."""
        return dict(zip(_OUTCOME_NAMES, self._outcomes[:, index].tolist(), strict=True))

    def row_values(self, name: str) -> FloatArray:
        """(n,) current values of a row; a copy."""
        return self._blocks[:, self._row_of[name]].flatten()[: self.size]

    def applied_inputs(self, ended: npt.NDArray[np.bool_] | None = None) -> FloatArray:
        """(n, inputs) the inputs that were applied in the last sample; ``ended`` as for `row_matrix`."""
        return self.row_matrix(self._applied_rows, ended)

    def records(self, ended: npt.NDArray[np.bool_] | None = None) -> FloatArray:
        """(n, size) the beliefs now, as flat records (`estimator.Belief`); a copy. ``ended`` as for `row_matrix`."""
        return self._gather_rows(slice(record_size(self.experiment.model)), ended)

    def row_matrix(self, names: Sequence[str], ended: npt.NDArray[np.bool_] | None = None) -> FloatArray:
        """(n, k) values of some rows; a copy.

        Args:
            names: names of the k rows.
            ended: (n,) environments whose values are taken from the end of their last episode, if any.
        """
        return self._gather_rows([self._row_of[name] for name in names], ended)

    def _gather_rows(self, row_numbers: slice | list[int], ended: npt.NDArray[np.bool_] | None) -> FloatArray:
        found = self._blocks[:, row_numbers].swapaxes(1, 2).reshape(len(self._blocks) * LANES, -1)[: self.size]
        if ended is not None:
            last = self._ended[:, row_numbers].swapaxes(1, 2).reshape(len(self._blocks) * LANES, -1)[: self.size]
            found = np.where(ended[:, None], last, found)
        # A single block would give a view in another memory order, for which Numba would compile a kernel anew.
        return np.array(found, order="C")

    def mixture(self, index: int) -> tuple[FloatArray, FloatArray]:
        """Records (m, size) and weights (m,) of environment ``index``: of its filter bank, or of its one belief."""
        count = len(self._params.hypothesis_priors)
        if not count:
            return self.records()[index : index + 1], np.ones(1)
        (block, lane), n = divmod(index, LANES), self._params.interleaved_envs
        slots = block * n_member_blocks(n, count) * LANES + np.arange(count) * n + lane
        rows = self._members.reshape(len(self._members), -1, LANES).swapaxes(1, 2)
        members = rows[slots // LANES, slots % LANES]
        return members[:, :-2].copy(), members[:, -2].copy()

    def belief(self, index: int) -> Belief:
        """The belief of environment ``index``."""
        return self.beliefs(np.array([index]))[0]

    def beliefs(self, indices: npt.NDArray[np.intp], *, final: bool = False) -> list[Belief]:
        """The beliefs of some environments: now, or with ``final`` at the end of their last episodes."""
        records = self._gather_adjacent_rows(indices, 0, record_size(self.experiment.model), final=final)
        records.flags.writeable = False
        return self._prior.with_records(records)

    def truth(self, ended: npt.NDArray[np.bool_] | None = None) -> Parameters:
        """The true plants, a batch of n, with the standard deviations of their noises where these are drawn.

        Where a record is replayed, the truth is the twin of its circuit. ``ended`` as for `row_matrix`.
        """
        values = self._truth_scales[:, None] * self.row_matrix(list(self._truth_rows.values()), ended).T
        return Parameters(zip(self._truth_rows, values, strict=True))

    def truth_of(self, index: int) -> Parameters:
        """The true plant of environment ``index``."""
        return self.truths(np.array([index]))[0]

    def truths(self, indices: npt.NDArray[np.intp], *, final: bool = False) -> list[Parameters]:
        """The true plants of some environments: now, or with ``final`` at the end of their last episodes."""
        first = self._row_of[next(iter(self._truth_rows.values()))]
        rows = (
            self._truth_scales * self._gather_adjacent_rows(indices, first, len(self._truth_rows), final=final)
        ).tolist()
        return [Parameters(zip(self._truth_rows, values, strict=True)) for values in rows]

    def _gather_adjacent_rows(
        self, indices: npt.NDArray[np.intp], first: int, count: int, *, final: bool
    ) -> FloatArray:
        """(k, count) adjacent rows of some environments, now or at the end of their last episodes; a copy."""
        stored = self._ended if final else self._blocks
        blocks, lanes = np.divmod(indices, LANES)
        found: FloatArray = stored[blocks[:, None], first + np.arange(count), lanes[:, None]]
        return found

    def _flatten(self) -> None:
        """Make the views that the kernel takes."""
        self._flat_actions = self._actions.reshape(-1)
        self._flat_blocks = self._blocks.reshape(len(self._blocks), -1)
        self._flat_ended = self._ended.reshape(len(self._ended), -1)

    def __getstate__(self) -> dict[str, Any]:
        """The state without views, so that copies and pickles share no memory through them."""
        state = self.__dict__.copy()
        for view in ("observations", "final_observations", "outcomes", *_FLAT_VIEWS, "_kernel"):
            del state[view]
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._kernel = compile_kernel(self._spec)
        self._flatten()
        self.observations = self._observations[: self.size]
        self.final_observations = self._final_observations[: self.size]
        self.outcomes = self._outcomes[:, : self.size]


def physical_unit_factor(experiment: Experiment, name: str) -> float:
    """Factor from the internal to the physical unit of a true parameter, or of a noise in the first sensor."""
    scales, model = experiment.scales, experiment.truth_model
    if name in model.dimensions:
        return scales.factor(model.dimensions[name])
    return 1.0 if name in parameter_names(model) else scales.output


def spawn_seeds(seed: int | None, count: int) -> list[int]:
    """Seeds of a batch's environments; the i-th seed does not depend on ``count``.

    A single environment that is reset with the i-th of them follows row i of a batch that is reset with ``seed``.
    """
    children = np.random.SeedSequence(seed).spawn(count)
    return [int(child.generate_state(1, np.uint64)[0]) for child in children]
