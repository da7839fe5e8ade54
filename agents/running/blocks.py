"""A run block by block: for rigs that are too fast for a program, and play tables.

A *design* chooses a whole block, without seeing its outputs.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Protocol

import numpy as np

from agents.planner.blocks import best_block, drafts, systems_of
from agents.planner.futures import Futures
from agents.planner.policy import Planner
from agents.policies import Policy
from agents.policies.signals import SignalPolicy
from agents.running.clock import Clock
from agents.running.follower import Follower
from agents.running.observed import Observed
from agents.running.recording import Recording
from agents.running.session import Session, Tripped
from estimator.parameters import FloatArray

#: Inputs (samples,) in the belief's scale, the share of what was wanted that they are, the probability of leaving.
Block = tuple[FloatArray, float, float]


class Design(Protocol):
    """What chooses blocks."""

    def block(self, samples: int, futures: Futures, bound: float) -> Block:
        """Inputs on the belief as it is observed, of which fewer futures than the bound leave the limit."""
        ...


class SignalDesign:
    """Blocks of a signal, one after the other, each as large as it is safe."""

    def __init__(self, policy: SignalPolicy, observed: Observed) -> None:
        self._policy, self._observed = policy, observed
        self._state: Any = None

    def block(self, samples: int, futures: Futures, bound: float) -> Block:
        """The next samples of the signal."""
        u, blind = np.empty(samples), np.zeros(1)
        for k in range(samples):
            action, self._state = self._policy.predict(blind, self._state)
            u[k] = self._observed.max_input * action[0]
        share, probability = futures.share(u, bound)
        return share * u, share, probability


class PlannedDesign:
    """Blocks that are planned for systems that are drawn from the belief (`agents.planner.blocks`)."""

    def __init__(self, planner: Planner, observed: Observed) -> None:
        self._planner, self._observed, self._rng = planner, observed, np.random.default_rng(planner.seed)

    def block(self, samples: int, futures: Futures, bound: float) -> Block:
        """The best block; it is planned as if it were the last."""
        planner, belief = self._planner, self._observed.belief
        systems = systems_of(planner.view, belief, futures, samples)
        begun = drafts(planner, belief.record, samples, int(self._rng.integers(2**63)))
        return best_block(planner.view, systems, futures, begun, planner.terms.amplitude, bound)


def design_of(policy: Policy, observed: Observed) -> Design:
    """How blocks of a policy are designed.

    Raises:
        ValueError: for a policy that answers to every sample.
    """
    if isinstance(policy, SignalPolicy):
        return SignalDesign(policy, observed)
    if isinstance(policy, Planner):
        return PlannedDesign(policy, observed)
    raise ValueError(
        f"policy must be a signal or the planner efe to be played in blocks, but is a {type(policy).__name__}, which "
        "answers to every sample; choose another, or run sample by sample"
    )


def designed(
    design: Design, follower: Follower, observed: Observed, samples: int, bound: float, rng: np.random.Generator,
    note: Callable[..., None],
) -> FloatArray:  # fmt: skip
    """A block in the rig's unit that leaves the range with less than the bound, on what a run believes now.

    ``note`` is told share and probability.

    Raises:
        Tripped: if the belief says that even without input the output leaves its range with more than the bound.
    """
    estimator, observed.belief = follower.estimator, follower.belief
    futures = Futures(estimator.model, follower.drawn(rng), observed.experiment.max_output, rng, follower.delay)
    u, share, probability = design.block(samples, futures, bound)
    note("design", share=share, probability=probability)
    if share == 0.0 and probability >= bound:
        raise Tripped(
            "design",
            f"even without input the output would leave its range with probability {probability:.2g}, and at most "
            f"{bound:.2g} is allowed; give a narrower guess or a wider range",
        )
    return np.clip(u, -observed.max_input, observed.max_input) * estimator.scales.input


class Blocks:
    """Designs blocks on the belief, plays them, reads back, and updates.

    Between two blocks the input is zero for a time that nobody knows. The first block is silent: it tells where the rig
    stands. A block leaves the output's range with less than the ``bound``, in systems that ``rng`` draws of the belief.
    """

    def __init__(
        self, session: Session, follower: Follower, observed: Observed, recording: Recording, clock: Clock, step: float,
        bound: float, rng: np.random.Generator,
    ) -> None:  # fmt: skip
        self._session, self._follower, self._observed, self._recording = session, follower, observed, recording
        self._clock, self._step, self._bound, self._rng = clock, step, bound, rng
        self._begin = clock.now()
        self._block = self._rows = 0

    def listen(self, samples: int) -> None:
        """Play a silent block."""
        self._play(np.zeros(samples))

    def play(self, design: Design, samples: int, block: int, told: Callable[[int], None]) -> None:
        """Play so many samples, in blocks of which the last may be shorter.

        ``told`` is called with the number of samples after each.

        Raises:
            Tripped: as `designed`.
        """
        done = 0
        while done < samples:
            count = min(block, samples - done)
            told_of = partial(self._recording.note, block=self._block)
            self._play(designed(design, self._follower, self._observed, count, self._bound, self._rng, told_of))
            done += count
            told(done)

    def _play(self, u: FloatArray) -> None:
        applied, y = self._session.play(u)
        now = self._clock.now() - self._begin
        rows = [
            (self._rows + k, (self._rows + k) * self._step, applied[k], y[k], u[k], self._block, 0, now, None)
            for k in range(len(u))
        ]
        pause = (self._rows + len(u), (self._rows + len(u)) * self._step, None, None, None, self._block, 0, now, None)
        self._recording.add([[float(v) if isinstance(v, np.floating) else v for v in row] for row in [*rows, pause]])
        self._rows += len(u) + 1
        self._block += 1
        self._session.check(y)
        self._follower.take_block(applied, y)
        self._follower.pause(float(applied[-1]))
