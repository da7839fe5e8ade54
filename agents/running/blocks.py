"""A run block by block: for rigs that are too fast for a program, and play tables."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from agents.running.clock import Clock
from agents.running.designs import Design, designed
from agents.running.follower import Follower
from agents.running.observed import Observed
from agents.running.recording import Recording
from agents.running.session import Session
from estimator.parameters import FloatArray


class Blocks:
    """Designs blocks on the belief, plays them, reads back, and updates.

    Between two blocks the input is zero for a time that nobody knows. The first block is silent: it tells where the rig
    stands.

    Args:
        session: of the plant.
        follower: of the estimator.
        observed: what designs look at.
        recording: of the rows.
        clock: that tells when a block came back.
        step: of the samples [s].
        bound: of the probability that a block leaves the output's range.
        rng: of the systems that are drawn from the belief.
    """

    def __init__(
        self,
        session: Session,
        follower: Follower,
        observed: Observed,
        recording: Recording,
        clock: Clock,
        step: float,
        bound: float,
        rng: np.random.Generator,
    ) -> None:
        self._session, self._follower, self._observed, self._recording = session, follower, observed, recording
        self._clock, self._step, self._bound, self._rng = clock, step, bound, rng
        self._begin = clock.now()
        self._block = self._rows = 0

    def listen(self, samples: int) -> None:
        """Play a silent block."""
        self._play(np.zeros(samples))

    def play(self, design: Design, samples: int, block: int, told: Callable[[int], None]) -> None:
        """Play so many samples, in blocks.

        Args:
            design: of the blocks.
            samples: in all.
            block: samples of a block; the last may be shorter.
            told: is called with the number of samples after each.

        Raises:
            Tripped: if the belief says that even without input the output leaves its range with more than the bound.
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
