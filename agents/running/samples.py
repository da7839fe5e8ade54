"""A run sample by sample: the clock ticks, and what was decided in time is applied at the tick."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from agents.policies import Policy
from agents.running.clock import Clock
from agents.running.follower import Follower
from agents.running.observed import Observed
from agents.running.recording import Recording
from agents.running.session import Session, Tripped
from estimator.parameters import FloatArray

#: A tick that is met later than this, in parts of the sampling step, is missed.
TOLERANCE = 0.1

#: More lost outputs than this, in parts of all, are worth a warning.
_MANY = 0.02

_REMEDY = "play blocks (--block 64), or take a longer step"


#: ``choose(k, u, y)``: the input of tick k, in the rig's unit, after an input u in force and the output y.
Chooser = Callable[[int, float, float], float]


def asking(policy: Policy, observed: Observed, follower: Follower) -> Chooser:
    """Asks a policy, which sees the belief that its input will meet, one tick ahead."""
    state: Any = None

    def choose(k: int, u: float, y: float) -> float:
        nonlocal state
        scales = follower.estimator.scales
        observed.belief = follower.ahead(u)
        seen = observed.observation(u / scales.input, y / scales.output, k)
        action, state = policy.predict(seen, state, deterministic=True)
        return float(action[0]) * observed.max_input * scales.input

    return choose


def playing(inputs: FloatArray) -> Chooser:
    """Plays inputs (T,) that were designed before, in the rig's unit."""
    return lambda k, u, y: float(inputs[k])


class Ticker:
    """Takes the samples of a run.

    At a tick the output is read, and the input that was decided before is applied at once. In the time until the next
    tick the estimator is told, and the next input decided. A tick that passes meanwhile is missed: the input stays, the
    output is not read, the row is marked late, and the estimator is told just that. An output that came late is kept
    beside the others, and not used. Where an input came to act late, its sample has the mean of what was applied.

    Attributes:
        tick: the next one.
        late: ticks that were missed, or whose output or input was late.
        lost: outputs that came too late, or that nobody was there to read.
    """

    def __init__(self, session: Session, follower: Follower, recording: Recording, clock: Clock, step: float) -> None:
        self._session, self._follower, self._recording = session, follower, recording
        self._clock, self._step = clock, step
        self._begin = clock.now()
        self.tick = self.late = self.lost = 0
        self._lost_in_a_row = 0
        self._took = 0.0, 0.0
        self._in_force = self._last_mean = 0.0
        self._last = math.nan

    def listen(self, samples: int) -> None:
        """Take samples without input; the plant may be disarmed.

        Raises:
            Tripped: if none of them came in time.
        """
        for _ in range(samples):
            self._miss(late=True)
            self._clock.wait(self._due)
            self._sample(0.0, apply=False)
        self._check_time(samples)

    def skip(self) -> None:
        """Nobody looked for a while: the ticks that have passed are missing, and none of them is late."""
        while self._miss(late=False):  # the estimator, too, takes its time to hear of it
            pass

    def play(self, choose: Chooser, samples: int, told: Callable[[int], None]) -> None:
        """Play so many ticks, missed ones included; then the input is zero, and its last response is read.

        ``told`` is called with the number of ticks after each.
        """
        asked = choose(0, self._in_force, self._last)
        self.skip()
        start = self.tick
        while (k := self.tick - start) <= samples:
            if self._miss(late=True):
                continue
            self._clock.wait(self._due)
            if self._clock.now() > self._due + TOLERANCE * self._step:
                continue  # woken too late: `_miss` takes it
            self._sample(asked if k < samples else 0.0)
            told(min(self.tick - start, samples))
            if self.tick - start < samples:
                asked = choose(self.tick - start, self._last_mean, self._last)

    @property
    def warning(self) -> str:
        """What speaks against a run that was complete; empty where nothing does."""
        if self.lost <= _MANY * self.tick:
            return ""
        return f"{self.lost} of {self.tick} outputs came too late to be used: intervals may be too narrow; {_REMEDY}"

    @property
    def _due(self) -> float:
        """When the next tick is."""
        return self._begin + self.tick * self._step

    def _miss(self, late: bool) -> bool:
        """Take the ticks that were missed; whether there were any."""
        behind = (self._clock.now() - self._due) / self._step - TOLERANCE
        if behind <= 0:
            return False
        missed = math.ceil(behind)
        self._take([self._in_force] * missed, [math.nan] * missed, None, late, missed if late else 0)
        return True

    def _sample(self, asked: float, apply: bool = True) -> None:
        """Read, and apply; find out when that was."""
        due, now = self._due, self._clock.now
        begun = now()
        y = self._session.read()
        read = now()
        applied = self._session.apply(asked) if apply else 0.0
        done = now()
        self._took = read - begun, done - read
        at = (begun + read) / 2
        in_time = at <= due + TOLERANCE * self._step
        before = self._in_force
        # What of the tick, which is when the output was read, had passed when the input changed.
        passed = ((read + done) / 2 - (at if in_time else due)) / self._step if apply else 0.0
        whole, part = divmod(max(0.0, passed), 1.0)
        self._in_force = applied
        self._take(
            [before] * int(whole) + [(1.0 - part) * applied + part * before],
            [y if in_time else math.nan] + [math.nan] * int(whole),
            asked,
            not in_time or passed > TOLERANCE,
            int(whole) + (not in_time),
            y,
        )

    def _take(
        self, u: list[float], y: list[float], asked: float | None, late: bool, lost: int, read: float | None = None
    ) -> None:
        """Ticks with the mean inputs of their samples, and their outputs: write them down, judge them, learn from them.

        What is late is so in all of them, and the lost outputs are the last of them; what was read at the first is not
        among its outputs where it came too late.
        """
        count, clock = len(u), self._clock.now() - self._begin
        places = range(self.tick, self.tick + count)
        rows = [[k, k * self._step, u[i], y[i], asked, 0, int(late), clock, None] for i, k in enumerate(places)]
        if lost == count:
            rows[0][-1] = read
        self._recording.add(rows)
        if late:
            self.late += count
            self._recording.note("late", tick=self.tick, ticks=count)
        self.lost += lost
        self._lost_in_a_row = self._lost_in_a_row + lost if lost == count else lost
        if read is not None:
            self._session.check(np.array([read]))
        self._follower.take([self._last_mean, *u[:-1]], y)
        self._last_mean, self._last = u[-1], y[-1] if count > 1 or read is None else read
        self.tick += count
        if self._session.stale:
            self._check_time(self._session.stale)

    def _check_time(self, most: int) -> None:
        """Refuse to go on where so many outputs in a row were lost."""
        if self._lost_in_a_row >= most:
            read, apply = (f"{1e3 * seconds:.4g} ms" for seconds in self._took)
            raise Tripped(
                "late",
                f"{self._lost_in_a_row} outputs in a row came too late: read() took {read} and apply() {apply} of a "
                f"step of {1e3 * self._step:.4g} ms; {_REMEDY}",
            )
