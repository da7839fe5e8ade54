"""A run sample by sample: at each tick of the clock, the output is read and the chosen input is applied."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from agents.hardware.clock import Clock
from agents.hardware.env_view import EnvView
from agents.hardware.plant_interface import InputValue
from agents.hardware.recording import Recording, SampleRow
from agents.hardware.run_estimator import RunEstimator
from agents.hardware.safety_session import SafetyStop, Session, StopReason
from agents.policies import Policy
from estimator.support.array_types import FloatArray

#: Largest delay after which a tick is not yet missed [sampling steps].
MAX_TICK_DELAY = 0.1

#: Largest fraction of lost outputs without a warning.
_MAX_LOST_FRACTION = 0.02

_LATE_REMEDY = "play blocks (--block 64), or take a longer step"


#: ``next_input(k, u, y)``: the input of tick k [rig's unit], given the present input u and the last output y.
InputFunction = Callable[[int, InputValue, float], InputValue]


def inputs_from_policy(policy: Policy, env_view: EnvView, run_estimator: RunEstimator) -> InputFunction:
    """Inputs that a policy chooses one tick ahead, from the belief at the time when the input will act."""
    state: Any = None

    def next_input(k: int, u: InputValue, y: float) -> InputValue:
        nonlocal state
        scales, sizes = run_estimator.online.scales, run_estimator.online.scales.input_scales(len(env_view.max_inputs))
        env_view.belief = run_estimator.predict_ahead(u)
        observation = env_view.observation(u / sizes, y / scales.output, k)
        action, state = policy.predict(observation, state, deterministic=True)
        chosen = action.astype(np.float64) * env_view.max_inputs * sizes
        return chosen.item() if len(chosen) == 1 else chosen

    return next_input


def inputs_from_signal(inputs: FloatArray) -> InputFunction:
    """Inputs (T,) of a signal that was designed before the run, in the rig's unit."""
    return lambda k, u, y: float(inputs[k])


class SampleLoop:
    """The loop of a run by samples.

    At a tick the output is read, and the input that was chosen before is applied at once. Until the next tick the
    estimator is updated, and the next input is chosen. Several inputs are applied together, as an array. A tick that
    passes meanwhile is missed: the input stays, no output is read, the row is marked late, and the estimator is updated
    by a missing output. A late output is recorded in a column of its own, and not used. Where an input acted late, its
    sample has the mean of the applied input.

    Attributes:
        tick: number of the next tick.
        late_ticks: number of ticks that were missed, or whose output or input was late.
        lost_outputs: number of outputs that came too late, or were not read.
    """

    def __init__(
        self, session: Session, run_estimator: RunEstimator, recording: Recording, clock: Clock, step: float
    ) -> None:
        self._session, self._run_estimator, self._recording = session, run_estimator, recording
        self._clock, self._step = clock, step
        self._start_time = clock.now()
        self.tick = self.late_ticks = self.lost_outputs = 0
        self._consecutive_lost = 0
        self._call_durations = 0.0, 0.0
        self._applied_input = self._last_mean_input = session.no_input
        self._last_output = math.nan

    def listen(self, samples: int) -> None:
        """Take samples without input; the plant may be disarmed.

        Raises:
            SafetyStop: if no output came in time.
        """
        for _ in range(samples):
            self._take_missed_ticks(late=True)
            self._clock.wait(self._next_tick_time)
            self._take_sample(self._session.no_input, apply=False)
        self._check_lost_outputs(samples)

    def skip_elapsed_ticks(self) -> None:
        """Take the ticks that have passed as missing, but not late."""
        while self._take_missed_ticks(late=False):  # ticks may pass while the estimator is updated
            pass

    def play(self, next_input: InputFunction, samples: int, on_progress: Callable[[int], None]) -> None:
        """Play inputs, then zero the input and read the response to the last one.

        Args:
            next_input: chooses the inputs.
            samples: number of ticks, missed ones included.
            on_progress: called with the number of ticks after each.
        """
        commanded = next_input(0, self._applied_input, self._last_output)
        self.skip_elapsed_ticks()
        start = self.tick
        while (k := self.tick - start) <= samples:
            if self._take_missed_ticks(late=True):
                continue
            self._clock.wait(self._next_tick_time)
            if self._clock.now() > self._next_tick_time + MAX_TICK_DELAY * self._step:
                continue  # woken too late: this tick is a missed one
            self._take_sample(commanded if k < samples else self._session.no_input)
            on_progress(min(self.tick - start, samples))
            if self.tick - start < samples:
                commanded = next_input(self.tick - start, self._last_mean_input, self._last_output)

    @property
    def warning(self) -> str:
        """A warning where many outputs were lost, else an empty text."""
        if self.lost_outputs <= _MAX_LOST_FRACTION * self.tick:
            return ""
        lost = f"{self.lost_outputs} of {self.tick} outputs came too late to be used"
        return f"{lost}: intervals may be too narrow; {_LATE_REMEDY}"

    @property
    def _next_tick_time(self) -> float:
        """Time of the next tick [s]."""
        return self._start_time + self.tick * self._step

    def _take_missed_ticks(self, late: bool) -> bool:
        """Take the ticks that were missed; returns whether there were any."""
        behind = (self._clock.now() - self._next_tick_time) / self._step - MAX_TICK_DELAY
        if behind <= 0:
            return False
        missed = math.ceil(behind)
        lost = missed if late else 0
        self._record_and_update([self._applied_input] * missed, [math.nan] * missed, None, late, lost)
        return True

    def _take_sample(self, commanded: InputValue, apply: bool = True) -> None:
        """Read the output and apply the input, and measure when both happened."""
        due, now = self._next_tick_time, self._clock.now
        read_start = now()
        y = self._session.read()
        read_end = now()
        applied = self._session.apply(commanded) if apply else self._session.no_input
        apply_end = now()
        self._call_durations = read_end - read_start, apply_end - read_end
        read_time = (read_start + read_end) / 2
        in_time = read_time <= due + MAX_TICK_DELAY * self._step
        previous_input = self._applied_input
        # Time from the tick, which is when the output was read, to the change of the input [sampling steps].
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
        u: list[InputValue],
        y: list[float],
        commanded: InputValue | None,
        late: bool,
        lost: int,
        read_output: float | None = None,
    ) -> None:
        """Record ticks, check the output that was read, and update the estimator.

        Args:
            u: mean input of each tick.
            y: output of each tick, NaN where it is missing or late.
            commanded: the input that was chosen.
            late: whether the ticks are late.
            lost: number of lost outputs, the last ones of ``y``.
            read_output: the output that was read at the first tick, also where it is late and not in ``y``.
        """
        count, clock = len(u), self._clock.now() - self._start_time
        ticks = range(self.tick, self.tick + count)
        rows = [SampleRow(k, k * self._step, u[i], y[i], commanded, 0, int(late), clock) for i, k in enumerate(ticks)]
        if lost == count:
            rows[0] = rows[0]._replace(late_output=read_output)
        self._recording.write_rows(rows)
        if late:
            self.late_ticks += count
            self._recording.log_event("late", tick=self.tick, ticks=count)
        self.lost_outputs += lost
        self._consecutive_lost = self._consecutive_lost + lost if lost == count else lost
        if read_output is not None:
            self._session.check_outputs(np.array([read_output]))
        self._run_estimator.update(np.array([self._last_mean_input, *u[:-1]]), y)
        self._last_mean_input, self._last_output = u[-1], y[-1] if count > 1 or read_output is None else read_output
        self.tick += count
        if self._session.max_stale:
            self._check_lost_outputs(self._session.max_stale)

    def _check_lost_outputs(self, limit: int) -> None:
        """Stop where ``limit`` outputs in a row were lost."""
        if self._consecutive_lost >= limit:
            read, apply = (f"{1e3 * seconds:.4g} ms" for seconds in self._call_durations)
            raise SafetyStop(
                StopReason.LATE,
                f"{self._consecutive_lost} outputs in a row came too late: read() took {read} and apply() {apply} of a "
                f"step of {1e3 * self._step:.4g} ms; {_LATE_REMEDY}",
            )
