"""A run sample by sample: the clock ticks, and what was decided in time is applied at the tick."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from agents.hardware.clock import Clock
from agents.hardware.env_view import EnvView
from agents.hardware.recording import Recording
from agents.hardware.run_estimator import RunEstimator
from agents.hardware.safety_session import SafetyStop, Session
from agents.policies import Policy
from estimator.support.array_types import FloatArray

#: A tick that is met later than this, in parts of the sampling step, is missed.
MAX_TICK_DELAY = 0.1

#: More lost outputs than this, in parts of all, are worth a warning.
_MAX_LOST_FRACTION = 0.02

_LATE_REMEDY = "play blocks (--block 64), or take a longer step"


#: ``next_input(k, u, y)``: the input of tick k, in the rig's unit, after an input u in force and the output y.
InputFunction = Callable[[int, float, float], float]


def inputs_from_policy(policy: Policy, env_view: EnvView, run_estimator: RunEstimator) -> InputFunction:
    """Asks a policy, which sees the belief that its input will meet, one tick ahead."""
    state: Any = None

    def next_input(k: int, u: float, y: float) -> float:
        nonlocal state
        scales = run_estimator.online.scales
        env_view.belief = run_estimator.predict_ahead(u)
        observation = env_view.observation(u / scales.input, y / scales.output, k)
        action, state = policy.predict(observation, state, deterministic=True)
        return float(action[0]) * env_view.max_input * scales.input

    return next_input


def inputs_from_signal(inputs: FloatArray) -> InputFunction:
    """Plays inputs (T,) that were designed before, in the rig's unit."""
    return lambda k, u, y: float(inputs[k])


class SampleLoop:
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

    def __init__(
        self, session: Session, run_estimator: RunEstimator, recording: Recording, clock: Clock, step: float
    ) -> None:
        self._session, self._run_estimator, self._recording = session, run_estimator, recording
        self._clock, self._step = clock, step
        self._start_time = clock.now()
        self.tick = self.late = self.lost = 0
        self._consecutive_lost = 0
        self._call_durations = 0.0, 0.0
        self._applied_input = self._last_mean_input = 0.0
        self._last_output = math.nan

    def listen(self, samples: int) -> None:
        """Take samples without input; the plant may be disarmed.

        Raises:
            Tripped: if none of them came in time.
        """
        for _ in range(samples):
            self._take_missed_ticks(late=True)
            self._clock.wait(self._next_tick_time)
            self._take_sample(0.0, apply=False)
        self._check_lost_outputs(samples)

    def skip_elapsed_ticks(self) -> None:
        """Nobody looked for a while: the ticks that have passed are missing, and none of them is late."""
        while self._take_missed_ticks(late=False):  # the estimator, too, takes its time to hear of it
            pass

    def play(self, next_input: InputFunction, samples: int, on_progress: Callable[[int], None]) -> None:
        """Play so many ticks, missed ones included; then the input is zero, and its last response is read.

        ``on_progress`` is called with the number of ticks after each.
        """
        commanded = next_input(0, self._applied_input, self._last_output)
        self.skip_elapsed_ticks()
        start = self.tick
        while (k := self.tick - start) <= samples:
            if self._take_missed_ticks(late=True):
                continue
            self._clock.wait(self._next_tick_time)
            if self._clock.now() > self._next_tick_time + MAX_TICK_DELAY * self._step:
                continue  # woken too late: `_take_missed_ticks` takes it
            self._take_sample(commanded if k < samples else 0.0)
            on_progress(min(self.tick - start, samples))
            if self.tick - start < samples:
                commanded = next_input(self.tick - start, self._last_mean_input, self._last_output)

    @property
    def warning(self) -> str:
        """What speaks against a run that was complete; empty where nothing does."""
        if self.lost <= _MAX_LOST_FRACTION * self.tick:
            return ""
        return (
            f"{self.lost} of {self.tick} outputs came too late to be used: intervals may be too narrow; {_LATE_REMEDY}"
        )

    @property
    def _next_tick_time(self) -> float:
        """When the next tick is."""
        return self._start_time + self.tick * self._step

    def _take_missed_ticks(self, late: bool) -> bool:
        """Take the ticks that were missed; whether there were any."""
        behind = (self._clock.now() - self._next_tick_time) / self._step - MAX_TICK_DELAY
        if behind <= 0:
            return False
        missed = math.ceil(behind)
        self._record_and_update([self._applied_input] * missed, [math.nan] * missed, None, late, missed if late else 0)
        return True

    def _take_sample(self, commanded: float, apply: bool = True) -> None:
        """Read, and apply; find out when that was."""
        due, now = self._next_tick_time, self._clock.now
        read_start = now()
        y = self._session.read()
        read_end = now()
        applied = self._session.apply(commanded) if apply else 0.0
        apply_end = now()
        self._call_durations = read_end - read_start, apply_end - read_end
        read_time = (read_start + read_end) / 2
        in_time = read_time <= due + MAX_TICK_DELAY * self._step
        previous_input = self._applied_input
        # What of the tick, which is when the output was read, had passed when the input changed.
        elapsed_steps = ((read_end + apply_end) / 2 - (read_time if in_time else due)) / self._step if apply else 0.0
        full_steps, remainder = divmod(max(0.0, elapsed_steps), 1.0)
        self._applied_input = applied
        self._record_and_update(
            [previous_input] * int(full_steps) + [(1.0 - remainder) * applied + remainder * previous_input],
            [y if in_time else math.nan] + [math.nan] * int(full_steps),
            commanded,
            not in_time or elapsed_steps > MAX_TICK_DELAY,
            int(full_steps) + (not in_time),
            y,
        )

    def _record_and_update(
        self,
        u: list[float],
        y: list[float],
        commanded: float | None,
        late: bool,
        lost: int,
        read_output: float | None = None,
    ) -> None:
        """Ticks with the mean inputs of their samples, and their outputs: write them down, judge them, learn from them.

        What is late is so in all of them, and the lost outputs are the last of them; what was read at the first is not
        among its outputs where it came too late.
        """
        count, clock = len(u), self._clock.now() - self._start_time
        ticks = range(self.tick, self.tick + count)
        rows = [[k, k * self._step, u[i], y[i], commanded, 0, int(late), clock, None] for i, k in enumerate(ticks)]
        if lost == count:
            rows[0][-1] = read_output
        self._recording.write_rows(rows)
        if late:
            self.late += count
            self._recording.log_event("late", tick=self.tick, ticks=count)
        self.lost += lost
        self._consecutive_lost = self._consecutive_lost + lost if lost == count else lost
        if read_output is not None:
            self._session.check(np.array([read_output]))
        self._run_estimator.update([self._last_mean_input, *u[:-1]], y)
        self._last_mean_input, self._last_output = u[-1], y[-1] if count > 1 or read_output is None else read_output
        self.tick += count
        if self._session.stale:
            self._check_lost_outputs(self._session.stale)

    def _check_lost_outputs(self, limit: int) -> None:
        """Refuse to go on where so many outputs in a row were lost."""
        if self._consecutive_lost >= limit:
            read, apply = (f"{1e3 * seconds:.4g} ms" for seconds in self._call_durations)
            raise SafetyStop(
                "late",
                f"{self._consecutive_lost} outputs in a row came too late: read() took {read} and apply() {apply} of a "
                f"step of {1e3 * self._step:.4g} ms; {_LATE_REMEDY}",
            )
