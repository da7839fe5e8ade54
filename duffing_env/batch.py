"""A batch of experiments: the memory that the kernel works on. Both faces of the environment stand on it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from duffing_env.experiment import Experiment
from duffing_env.kernel import compiled
from duffing_env.layout import ENDED, LAYOUT, N_OBSERVATION, N_ROWS, OSCILLATOR, OUTCOME, SETTINGS
from duffing_env.noise import stream_words
from estimator.belief import RecordBelief
from estimator.lanes import LANES
from estimator.parameters import FloatArray, PhysicalParameters
from estimator.record import RECORD, RECORD_SIZE

_OUTCOME = LAYOUT["reward"]


class Batch:
    """n experiments of one kind, stepped together.

    Args:
        experiment: what is fixed about them.
        size: their number n; memory is laid out for a multiple of `LANES`.
        reset_mode: `duffing_env.kernel.RESET_BY_HAND`, ``RESET_NEXT_STEP`` or ``RESET_SAME_STEP``.
        threads: threads that step the blocks; results do not depend on it.
        hold: samples that a step plays, at most: an environment stops where its episode ends.

    Attributes:
        observations: (n, N_OBSERVATION) float32, overwritten by every step.
        final_observations: the same, for what was reset within the step.
    """

    def __init__(self, experiment: Experiment, size: int, reset_mode: int, threads: int = 1, hold: int = 1) -> None:
        self.experiment = experiment
        self.size = size
        self._reset_mode = reset_mode
        self._threads = threads
        self._kind = experiment.plant_kind, experiment.estimator_kind, experiment.reward
        self._settings = experiment.settings
        self._settings[SETTINGS["hold"]] = hold
        # Copies, because read-only arrays are another type to Numba, and would compile the step anew.
        self._prior = experiment.prior_record.copy()
        self._recorded = tuple(series.copy() for series in experiment.recorded)
        n_blocks = -(-size // LANES)
        padded = n_blocks * LANES
        self._blocks = np.zeros((n_blocks, N_ROWS, LANES))
        self._flat_blocks = self._blocks.reshape(n_blocks, -1)
        self._ended = np.zeros((n_blocks, len(ENDED), LANES))
        self._flat_ended = self._ended.reshape(n_blocks, -1)
        self._saved = np.zeros((threads, RECORD_SIZE * LANES))
        self._actions = np.zeros(padded, dtype=np.float32)
        self._observations = np.zeros((padded, N_OBSERVATION), dtype=np.float32)
        self._final_observations = np.zeros_like(self._observations)
        self.observations = self._observations[:size]
        self.final_observations = self._final_observations[:size]
        # Lanes beyond the last environment do the same work as the others, so that none of them runs wild.
        self._mask = np.ones(padded, dtype=np.bool_)
        self._reset()
        self._mask[size:] = False

    def seed(self, index: int, generator: np.random.Generator) -> None:
        """Start environment ``index``'s stream of random numbers from its ``np_random``."""
        block, lane = divmod(index, LANES)
        first = LAYOUT["stream_a"]
        self._blocks[block, first : first + 4, lane] = stream_words(generator)

    def reset(self, mask: npt.NDArray[np.bool_]) -> None:
        """Start episodes where ``mask`` (n,) is true."""
        self._mask[: self.size] = mask
        self._reset()

    def _reset(self) -> None:
        reset = compiled(*self._kind).reset
        reset(self._flat_blocks, self._mask, self._settings, self._prior, self._observations)

    def step(self, actions: npt.ArrayLike) -> None:
        """Apply actions (n,) for a step: in parts of the largest input, clipped to [-1, 1], in float32's range."""
        self._actions[: self.size] = actions
        kernel = compiled(*self._kind)
        step = kernel.step
        if self._threads > 1:
            import numba

            numba.set_num_threads(self._threads)
            step = kernel.step_parallel
        step(
            self._flat_blocks,
            self._saved,
            self._actions,
            self._settings,
            self._prior,
            *self._recorded,
            self._reset_mode,
            self._observations,
            self._final_observations,
            self._flat_ended,
        )

    def measure(self, u: float, y: float) -> None:
        """Let the next step play this input and output [V], of an experiment that replays a record of one sample."""
        recorded_u, recorded_y = self._recorded
        recorded_u[0], recorded_y[0] = u, y

    def outcome(self, index: int) -> dict[str, float]:
        """What the last step left behind for one environment, by its names in `OUTCOME`."""
        block, lane = divmod(index, LANES)
        return dict(zip(OUTCOME, self._blocks[block, _OUTCOME : _OUTCOME + len(OUTCOME), lane].tolist(), strict=True))

    def quantity(self, name: str) -> FloatArray:
        """(n,) current values of a quantity of `LAYOUT`, such as what the last step left behind; a copy."""
        return self._blocks[:, LAYOUT[name]].flatten()[: self.size]

    def records(self) -> FloatArray:
        """(n, RECORD_SIZE) the beliefs now, as flat records (`estimator.record`); a copy."""
        records = self._blocks[:, :RECORD_SIZE].swapaxes(1, 2).reshape(-1, RECORD_SIZE)
        # Of a single block that is a view, in another order, for which a kernel would be compiled once more.
        return np.array(records[: self.size], order="C")

    def belief(self, index: int) -> RecordBelief:
        """The belief of environment ``index``."""
        return self.beliefs(np.array([index]))[0]

    def beliefs(self, indices: npt.NDArray[np.intp], *, final: bool = False) -> list[RecordBelief]:
        """The beliefs of some environments; ``final``: those that their last episodes ended with, if reset since."""
        records = self._quantities(indices, RECORD, final=final)
        records.flags.writeable = False
        return self.experiment.to_belief(records[0]).with_records(records)

    def truth(self) -> PhysicalParameters:
        """The true oscillators, a batch of n; where a record is replayed, the twin of its circuit."""
        return PhysicalParameters(*(self.quantity(name) for name in OSCILLATOR))

    def oscillator(self, index: int) -> PhysicalParameters:
        """The true oscillator of environment ``index``."""
        return self.oscillators(np.array([index]))[0]

    def oscillators(self, indices: npt.NDArray[np.intp], *, final: bool = False) -> list[PhysicalParameters]:
        """The true oscillators of some environments; ``final``: those of their last episodes, if reset since."""
        found = []
        for values in self._quantities(indices, OSCILLATOR, final=final).tolist():
            # Past its checks, which take as long as 200 steps of one of a thousand environments.
            oscillator = object.__new__(PhysicalParameters)
            oscillator.__dict__.update(zip(OSCILLATOR, values, strict=True), tau=np.inf, xi=np.inf)
            found.append(oscillator)
        return found

    def _quantities(self, indices: npt.NDArray[np.intp], names: Sequence[str], *, final: bool) -> FloatArray:
        """(k, len(names)) adjacent rows of some environments, now or at the end of their last episodes; a copy."""
        stored, layout = (self._ended, ENDED) if final else (self._blocks, LAYOUT)
        blocks, lanes = np.divmod(indices, LANES)
        found: FloatArray = stored[blocks[:, None], layout[names[0]] + np.arange(len(names)), lanes[:, None]]
        return found

    def __getstate__(self) -> dict[str, Any]:
        """Copies and pickles must not share memory through the views."""
        state = self.__dict__.copy()
        for view in ("observations", "final_observations", "_flat_blocks", "_flat_ended"):
            del state[view]
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._flat_blocks = self._blocks.reshape(len(self._blocks), -1)
        self._flat_ended = self._ended.reshape(len(self._ended), -1)
        self.observations = self._observations[: self.size]
        self.final_observations = self._final_observations[: self.size]


def spawn_seeds(seed: int | None, count: int) -> list[int]:
    """Seeds of a batch's environments: the i-th does not depend on their number.

    A single environment that is reset with the i-th of them follows row i of a batch that is reset with ``seed``.
    """
    children = np.random.SeedSequence(seed).spawn(count)
    return [int(child.generate_state(1, np.uint64)[0]) for child in children]
