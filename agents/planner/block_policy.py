"""The planner in blocks reads its environment's belief and model, and is no function of the observation.

It decides on a whole block of inputs at once, and sees their outputs when all were played.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import ndtri

from agents.planner.blocks import MOST_PLANNED, best_block, drafts, systems_of
from agents.planner.futures import Futures, drawn_from_records, draws_for, force_of_noise
from agents.planner.motion import places
from agents.planner.policy import Planner
from estimator.checks import whole
from estimator.parameters import FloatArray

#: Moves after a block that are planned with it, so that it ends where the next can go on.
_AFTER = 9

#: Of these, those that must be safe, too: what a block has begun the next one can stop only then.
_MOMENTUM = 3

#: Samples of a block, at most.
_MOST = 4096

#: The least probability that is counted in draws. A smaller one is that of draws with larger deviations.
_COUNTED = 5e-4


def counted(probability: float) -> tuple[float, float]:
    """A probability that can be counted in draws, and by how much these must deviate more than believed.

    What is beyond so many standard deviations of a Gaussian is as probable in the belief as asked, if it has the
    probability that is returned in these draws:

    >>> counted(0.01)
    (0.01, 1.0)
    >>> bound, spread = counted(2e-5)
    >>> bound, round(spread, 3)
    (0.0005, 1.248)
    """
    if probability >= _COUNTED:
        return probability, 1.0
    return _COUNTED, float(ndtri(probability) / ndtri(_COUNTED))


class BlockState(NamedTuple):
    """What `BlockPlanner.predict` goes on from, of n environments.

    Attributes:
        plans: (n, block) the blocks.
        played: (n,) samples of these that were played.
        left: (n,) samples that were left of the episodes; where more are left now, another one has begun.
    """

    plans: FloatArray
    played: npt.NDArray[np.int64]
    left: npt.NDArray[np.int64]


class BlockPlanner:
    """Planning a block at a time on an environment's belief and model; it is no function of the observation.

    It minimises expected free energy (`agents.planner.blocks`), in the environment that it was made for, as `Planner`.

    Args:
        env: as of `agents.planner.policy.Planner`.
        seed: of the search, and of the systems that are drawn.
        block: samples of a block.
        risk: probability, as believed, that an episode leaves its range. Blocks share half of it equally. Of the other
            half each takes half of what is left, for the first ones know least, and the last one all.

    Raises:
        ValueError: as `Planner`; for a design or a run, which plan blocks of ``efe``; for a block below 1 or above
            4,096; where the input's energy is limited; or for a model whose process noise acts on another state than
            its input does.
    """

    def __init__(self, env: Any, seed: int = 0, *, block: int = 16, risk: float = 2.5e-4) -> None:
        self._planner = Planner(env, seed, risk=risk)
        whole("block", block, _MOST)
        if not hasattr(env, "mixture"):
            raise ValueError(
                f"policy must be 'efe' here, but is 'efe-block-{block}': a design is one block anyway, and a run takes "
                f"efe with --block {block}"
            )
        setup = env.experiment.kernel_params
        if np.isfinite(setup.budget):
            raise ValueError(f"env must have no limit of energy for blocks, but has max_rms={env.experiment.max_rms!r}")
        force_of_noise(self._planner.view.model)  # refuses what cannot be simulated
        self._env, self.block, self._risk = env, int(block), risk
        self._limit = float(setup.max_output)

    def predict(
        self,
        observation: npt.ArrayLike,
        state: BlockState | None = None,
        episode_start: npt.ArrayLike | None = None,
        deterministic: bool = False,
    ) -> tuple[npt.NDArray[np.float32], BlockState]:
        """The next inputs of the blocks, which are planned where one is at its end; as `Planner.predict`."""
        rows, begun = self._planner.asked(observation, state, BlockState, episode_start)
        records, n, at = self._env.records, len(rows), places(self._planner.view.model)
        left = np.rint(rows[:, at.time_left] * self._env.horizon).astype(np.int64)
        if state is None:
            state = BlockState(np.zeros((n, self.block)), np.zeros(n, dtype=np.int64), left)
        plans, played = state.plans.copy(), state.played.copy()
        # An episode that is over is shown once more where the next step only begins the next one: no block goes there.
        due = begun | (left >= state.left) | (played >= self.block)
        plans[due], played[due] = 0.0, 0
        for i in np.flatnonzero(due & (left > 0)):
            last = self._planner.terms.amplitude * rows[i, at.last_input]
            plans[i] = self._plan(records[i], int(left[i]), float(last), int(i))
        actions = (plans[np.arange(n), played] / self._planner.terms.amplitude).astype(np.float32)
        return actions.reshape(*np.shape(observation)[:-1], 1), BlockState(plans, played + 1, left)

    def bound(self, left: int) -> float:
        """The part of the risk that the block takes which begins so many samples before the end."""
        begun, blocks = (self._env.horizon - left) // self.block, -(-self._env.horizon // self.block)
        return self._risk * (0.5 / blocks + 0.5 ** (min(begun + 1, blocks - 1) + 1))

    def _plan(self, record: FloatArray, left: int, last: float, i: int) -> FloatArray:
        """A block (block,), zeros beyond the end of the episode."""
        planner, samples = self._planner, min(self.block, left)
        view, terms = planner.view, planner.terms
        seen = min(left, samples + _AFTER * terms.pace)
        rng = np.random.default_rng([planner.seed, i, left])
        (belief,) = self._env.experiment.prior_belief.with_records(record[None])
        bound, spread = counted(self.bound(left))
        records, weights = self._env.mixture(i)
        drawn = drawn_from_records(view.model, records, weights, rng, draws_for(bound, MOST_PLANNED), spread)
        futures = Futures(view.model, drawn, self._limit, rng, degree=view.degree)
        systems = systems_of(view, belief, futures, seen, last)
        u, *_ = best_block(
            view, systems, futures, drafts(planner, record, seen, int(rng.integers(2**63))), terms.amplitude, bound,
            min(seen, samples + _MOMENTUM * terms.pace),
        )  # fmt: skip
        return np.concatenate([u[:samples], np.zeros(self.block - samples)])
