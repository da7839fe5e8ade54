"""A safety session with a plant: arming, input clamps, safety stops, and a zero input at every exit."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from contextlib import suppress
from enum import StrEnum
from types import TracebackType
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from agents.hardware.plant_interface import HardwarePlant, InputValue
from agents.hardware.recording import EventLog
from agents.interruption import InterruptHandler
from duffing_env.tracks.external_plant_env import as_number
from estimator.rigs.rig import Rig
from estimator.support.argument_checks import short_repr
from estimator.support.array_types import FloatArray

Value = TypeVar("Value")

#: Fraction by which an applied input may exceed the limit, because converters round.
_INPUT_TOLERANCE = 0.01


class StopReason(StrEnum):
    """Why a run was stopped for safety."""

    RANGE = "range"
    """The output left its range."""
    STALE = "stale"
    """There was no new output."""
    LATE = "late"
    """No output came in time."""
    INPUT = "input"
    """The plant applied more than the limit."""
    PLANT = "plant"
    """The plant raised an exception, or returned a value of the wrong type or shape."""
    DESIGN = "design"
    """No input is safe."""


class SafetyStop(RuntimeError):
    """A run was stopped for safety; ``reason`` says why."""

    def __init__(self, reason: StopReason, message: str) -> None:
        super().__init__(message)
        self.reason = reason


class Session:
    """The only access of a run to its plant. It is entered disarmed, and left with the input at zero.

    Args:
        plant: of the rig.
        rig: with a limit of each input and a range of the output.
        log_event: called at each event.
        watchdog: seconds of silence after which the plant zeroes its input by itself; None: it has no watchdog.
        max_stale: number of outputs in a row, missing, late or equal to the one before, that stops the run; 0: none.

    Attributes:
        no_input: the input that is zero: 0.0, or an array of zeros for several inputs.
        zeroing_error: after the exit, what failed of zeroing and disarming, which is printed on stderr, too; empty
            where nothing failed.

    Raises:
        ValueError: as of `check_safety_settings`.
    """

    def __init__(
        self, plant: HardwarePlant, rig: Rig, log_event: EventLog, watchdog: float | None, max_stale: int = 32
    ) -> None:
        check_safety_settings(rig, plant, watchdog)
        self.plant, self.watchdog, self.max_stale = plant, watchdog, max_stale
        limits = [float(channel.limit or 0.0) for channel in rig.inputs.values()]
        self.input_limit: InputValue = limits[0] if len(limits) == 1 else np.array(limits)
        self.no_input: InputValue = 0.0 if len(limits) == 1 else np.zeros(len(limits))
        self.output_range = float(rig.output.range or 0.0)
        self.is_armed, self.zeroing_error = False, ""
        self._log_event, self._last_output, self._consecutive_stale = log_event, math.nan, 0
        self._interrupt_handler = InterruptHandler()

    def __enter__(self) -> Session:
        self._interrupt_handler.__enter__()
        return self

    def __exit__(
        self, error_type: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._interrupt_handler.ignore_signals()
        try:
            failures = self._zero_and_disarm()
            if failures:
                remedy = "the watchdog has to" if self.watchdog is not None else "NOBODY DID: switch it off by hand"
                self.zeroing_error = f"the input could not be zeroed at the end: {'; '.join(failures)}; {remedy}"
                # Printed before anything is written: a person has to know, whatever else fails.
                with suppress(OSError):
                    print(f"duffing-env: {self.zeroing_error}", file=sys.stderr, flush=True)
            self._log_disarmed(failures)
            if failures:
                self._log_event("zero failed", message=self.zeroing_error)
        finally:
            self._interrupt_handler.__exit__()

    def arm(self) -> None:
        """Let inputs through."""
        self._interrupt_handler.raise_if_interrupted()
        self.is_armed = True  # also where the call fails half way
        self._call_plant("arm", self.plant.arm, self.watchdog)
        self._log_event("armed", watchdog=self.watchdog)

    def disarm(self) -> list[str]:
        """Zero the input and disarm, both also where one fails; returns the failures."""
        failures = self._zero_and_disarm()
        self._log_disarmed(failures)
        return failures

    def _zero_and_disarm(self) -> list[str]:
        failures = []
        for name in ("zero", "disarm"):
            try:
                getattr(self.plant, name)()
            except Exception as error:
                failures.append(f"{name} failed: {type(error).__name__}: {error}")
        return failures

    def _log_disarmed(self, failures: list[str]) -> None:
        if self.is_armed:
            self._log_event("disarmed", input_zeroed=not failures)
        self.is_armed = False

    def clamp(self, u: npt.ArrayLike) -> FloatArray:
        """Clamp an input, or several samples of it, to the limit; of several inputs each to its own.

        Raises:
            ValueError: for an input that is not finite, or not a number for each input.
        """
        if not np.isfinite(u).all():
            raise ValueError(f"input must be finite, but is {u!r:.80}; the policy is broken")
        if np.ndim(self.input_limit) and np.shape(u)[-1:] != np.shape(self.input_limit):
            raise ValueError(
                f"input must be {np.size(self.input_limit)} numbers, one for each input, but is {u!r:.80}; the policy "
                "is broken"
            )
        clamped: FloatArray = np.clip(u, -self.input_limit, self.input_limit)
        return clamped

    def apply(self, u: InputValue) -> InputValue:
        """Apply an input, clamped; returns the input that the plant applied. Several inputs are arrays (inputs,).

        Raises:
            SafetyStop: if the plant applied more than the limit, raised an exception, or returned no number for each
                input.
        """
        self._interrupt_handler.raise_if_interrupted()
        clamped = self.clamp(u)
        applied: InputValue
        if clamped.ndim:
            answer = self._call_plant("apply", self.plant.apply, clamped)
            try:
                applied = np.array(answer, dtype=np.float64)
            except (TypeError, ValueError):
                applied = np.empty(0)
            if applied.shape != clamped.shape:
                raise SafetyStop(
                    StopReason.PLANT, f"apply must give {len(clamped)} numbers, but gave {short_repr(answer)}"
                )
        else:
            applied = self._call_for_number("apply", float(clamped))
        self._check_applied(np.array([applied]))
        return applied

    def read(self) -> float:
        """The output, not yet checked (`check_outputs`); NaN where it is missing.

        Raises:
            SafetyStop: if the plant raised an exception, or returned no number.
        """
        self._interrupt_handler.raise_if_interrupted()
        return self._call_for_number("read")

    def play(self, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Arm, play inputs (N,), disarm; returns applied inputs (N,) and outputs (N,), not yet checked.

        Raises:
            SafetyStop: if the plant applied more than the limit, raised an exception, or returned anything but two
                arrays (N,).
        """
        clamped = np.array(self.clamp(u), dtype=np.float64)
        self.arm()
        answer = self._call_plant("play", self.plant.play, clamped)
        failures = self.disarm()
        if failures:
            raise SafetyStop(StopReason.PLANT, f"the input could not be zeroed after a block: {'; '.join(failures)}")
        requirement = f"play must give two arrays of {clamped.shape}, inputs as applied and outputs, but gave"
        try:
            applied, y = (np.array(one, dtype=np.float64) for one in answer)
        except (TypeError, ValueError):
            raise SafetyStop(StopReason.PLANT, f"{requirement} {short_repr(answer)}") from None
        if applied.shape != clamped.shape or y.shape != clamped.shape:
            raise SafetyStop(StopReason.PLANT, f"{requirement} {applied.shape}, {y.shape}")
        self._check_applied(applied)
        return applied, y

    def check_outputs(self, outputs: FloatArray) -> None:
        """Check outputs (N,), after they were recorded.

        Raises:
            SafetyStop: if an output left the range, or too many in a row were missing or equal to the one before.
        """
        if (np.abs(outputs) > self.output_range).any():
            worst = outputs[np.nanargmax(np.abs(outputs))]
            raise SafetyStop(
                StopReason.RANGE, f"the output was {worst:.6g}, beyond its range of ±{self.output_range:.6g}"
            )
        for y in outputs.tolist():
            is_stale = not math.isfinite(y) or y == self._last_output
            self._consecutive_stale = self._consecutive_stale + 1 if is_stale else 0
            self._last_output = y if math.isfinite(y) else self._last_output
            if self.max_stale and self._consecutive_stale >= self.max_stale:
                again = "" if math.isnan(self._last_output) else f", or {self._last_output:.6g} again"
                raise SafetyStop(StopReason.STALE, f"{self._consecutive_stale} outputs in a row were missing{again}")

    def _check_applied(self, applied: FloatArray) -> None:
        """Check inputs (N,), or (N, inputs) of several."""
        is_within = np.abs(applied) <= self.input_limit * (1 + _INPUT_TOLERANCE)
        if not is_within.all():
            worst = np.abs(np.where(is_within, 0.0, applied)).max()
            limit = np.broadcast_to(self.input_limit, applied.shape)[~is_within].flat[0]
            raise SafetyStop(StopReason.INPUT, f"the plant applied {worst:.6g}, beyond ±{limit:.6g}")

    def _call_for_number(self, name: str, *arguments: Any) -> float:
        answer = self._call_plant(name, getattr(self.plant, name), *arguments)
        try:
            return as_number(name, answer)
        except TypeError as error:
            raise SafetyStop(StopReason.PLANT, str(error)) from None

    def _call_plant(self, name: str, command: Callable[..., Value], *arguments: Any) -> Value:
        try:
            return command(*arguments)
        except Exception as error:
            raise SafetyStop(StopReason.PLANT, f"{name} failed: {type(error).__name__}: {error}") from error


def check_safety_settings(rig: Rig, plant: HardwarePlant, watchdog: float | None) -> None:
    """Refuse a rig or a plant with which no session is safe.

    Raises:
        ValueError: for a rig without limit or range, or a watchdog time for a plant without watchdog.
    """
    inputs = [(channel, "limit", "input") for channel in rig.inputs.values()]
    for channel, name, side in (*inputs, (rig.output, "range", "output")):
        if getattr(channel, name) is None:
            raise ValueError(f"rig must have a {name} of the {side} for a run, but has none; add {side}.{name}")
    if watchdog is not None and not plant.has_watchdog:
        raise ValueError(
            "plant must have a watchdog, which zeroes its input when this program is gone, but has none: give it "
            "one, or run without (no_watchdog) where a person watches"
        )
