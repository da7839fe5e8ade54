"""Planner of blocks: inputs of several samples at once, chosen on the belief before any of their outputs is observed.

It reads the belief and the model of its environment, and is no function of the observation.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import ndtri

from agents.planning.model_probe import observation_layout
from agents.planning.open_loop.chance_constrained_block import MAX_PLANNED_DRAWS, optimise_block, sampled_systems
from agents.planning.open_loop.initial_guesses import initial_guesses
from agents.planning.open_loop.posterior_samples import (
    MonteCarloSystems,
    draw_from_records,
    noise_as_input,
    required_draws,
)
from agents.policies.efe_planner import EfePlanner
from estimator.support.argument_checks import check_integer
from estimator.support.array_types import FloatArray

#: Moves after a block that are planned with it, so that the next block can continue.
_LOOKAHEAD_MOVES = 9

#: First of these moves that must be safe as well: the next block cannot stop an oscillation sooner.
_SAFE_LOOKAHEAD_MOVES = 3

#: Samples of a block, at most.
_MAX_BLOCK = 4096

#: Least probability that is counted in draws; smaller ones are counted in draws with larger deviations.
_MIN_COUNTED_PROBABILITY = 5e-4


def countable_probability(probability: float) -> tuple[float, float]:
    """A probability that can be counted in draws, and the factor of their deviations.

    An event beyond a number of standard deviations of a Gaussian has the asked probability in the belief if it has the
    returned probability in draws with these deviations:

    >>> countable_probability(0.01)
    (0.01, 1.0)
    >>> bound, spread = countable_probability(2e-5)
    >>> bound, round(spread, 3)
    (0.0005, 1.248)
    """
    if probability >= _MIN_COUNTED_PROBABILITY:
        return probability, 1.0
    return _MIN_COUNTED_PROBABILITY, float(ndtri(probability) / ndtri(_MIN_COUNTED_PROBABILITY))


class BlockPlannerState(NamedTuple):
    """The state of `BlockPlanner.predict` for n environments.

    Attributes:
        plans: (n, block) the blocks.
        n_played: (n,) samples of these that were played.
        samples_left: (n,) samples left in the episodes; where more are left now, another one has begun.
    """

    plans: FloatArray
    n_played: npt.NDArray[np.int64]
    samples_left: npt.NDArray[np.int64]


class BlockPlanner:
    """Planner of a block at a time on the belief and the model of an environment; no function of the observation.

    It minimises expected free energy (`agents.planning.open_loop.chance_constrained_block`), and as `EfePlanner` it
    plays the environment that it was made for.

    Args:
        env: as of `EfePlanner`.
        seed: of the search and of the draws.
        block: samples of a block.
        risk: probability, as believed, that an episode leaves its range. Blocks share half of it equally. Of the other
            half each block takes half of the rest, as the first beliefs are the widest, and the last one takes all.

    Raises:
        ValueError: as `EfePlanner`; for a design or a run, which plan blocks of ``efe``; for a block below 1 or above
            4,096; where the input's energy is limited; or for a model whose process noise acts on another state than
            its input does.
    """

    def __init__(self, env: Any, seed: int = 0, *, block: int = 16, risk: float = 2.5e-4) -> None:
        self._planner = EfePlanner(env, seed, risk=risk)
        check_integer("block", block, _MAX_BLOCK)
        if not hasattr(env, "mixture"):
            raise ValueError(
                f"policy must be 'efe' here, but is 'efe-block-{block}': a design is one block anyway, and a run takes "
                f"efe with --block {block}"
            )
        setup = env.experiment.kernel_params
        if np.isfinite(setup.budget):
            raise ValueError(f"env must have no limit of energy for blocks, but has max_rms={env.experiment.max_rms!r}")
        noise_as_input(self._planner.model_view.model)  # raises where it cannot be simulated
        self._env, self.block, self._risk = env, int(block), risk
        self._limit = float(setup.max_output)

    def predict(
        self,
        observation: npt.ArrayLike,
        state: BlockPlannerState | None = None,
        episode_start: npt.ArrayLike | None = None,
        deterministic: bool = False,
    ) -> tuple[npt.NDArray[np.float32], BlockPlannerState]:
        """The next inputs of the blocks; a new block is planned where one is at its end; as `EfePlanner.predict`."""
        rows, episode_begins = self._planner.checked_rows(observation, state, BlockPlannerState, episode_start)
        records, n, layout = self._env.records, len(rows), observation_layout(self._planner.model_view.model)
        left = np.rint(rows[:, layout.time_left] * self._env.horizon).astype(np.int64)
        if state is None:
            state = BlockPlannerState(np.zeros((n, self.block)), np.zeros(n, dtype=np.int64), left)
        plans, played = state.plans.copy(), state.n_played.copy()
        # After an episode's end its last observation may come once more: no block is planned for it.
        due = episode_begins | (left >= state.samples_left) | (played >= self.block)
        plans[due], played[due] = 0.0, 0
        for i in np.flatnonzero(due & (left > 0)):
            last = self._planner.objective.amplitude * rows[i, layout.last_input]
            plans[i] = self._plan(records[i], int(left[i]), float(last), int(i))
        actions = (plans[np.arange(n), played] / self._planner.objective.amplitude).astype(np.float32)
        return actions.reshape(*np.shape(observation)[:-1], 1), BlockPlannerState(plans, played + 1, left)

    def risk_of_block(self, samples_left: int) -> float:
        """The risk of the block that begins ``samples_left`` samples before the end."""
        n_begun, blocks = (self._env.horizon - samples_left) // self.block, -(-self._env.horizon // self.block)
        return self._risk * (0.5 / blocks + 0.5 ** (min(n_begun + 1, blocks - 1) + 1))

    def _plan(self, record: FloatArray, samples_left: int, previous_input: float, i: int) -> FloatArray:
        """A block (block,), zeros beyond the end of the episode."""
        planner, samples = self._planner, min(self.block, samples_left)
        view, objective = planner.model_view, planner.objective
        n_planned = min(samples_left, samples + _LOOKAHEAD_MOVES * objective.hold_samples)
        rng = np.random.default_rng([planner.seed, i, samples_left])
        (belief,) = self._env.experiment.prior_belief.with_records(record[None])
        max_probability, deviation_scale = countable_probability(self.risk_of_block(samples_left))
        records, weights = self._env.mixture(i)
        draws = draw_from_records(
            view.model, records, weights, rng, required_draws(max_probability, MAX_PLANNED_DRAWS), deviation_scale
        )
        monte_carlo = MonteCarloSystems(view.model, draws, self._limit, rng, degree=view.degree)
        systems = sampled_systems(view, belief, monte_carlo, n_planned, previous_input)
        guesses = initial_guesses(planner.settings, record, n_planned, int(rng.integers(2**63)))
        u, *_ = optimise_block(
            view, systems, monte_carlo, guesses, objective.amplitude, max_probability,
            min(n_planned, samples + _SAFE_LOOKAHEAD_MOVES * objective.hold_samples),
        )  # fmt: skip
        return np.concatenate([u[:samples], np.zeros(self.block - samples)])
