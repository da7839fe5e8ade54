"""A session with a plant: arming, clamps, trips, and an input that is zero at every exit."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from contextlib import suppress
from types import TracebackType
from typing import Any, TypeVar

import numpy as np

from agents.hardware.plant_interface import HardwarePlant
from agents.interruption import InterruptHandler
from duffing_env.tracks.rig_plant_env import as_number
from estimator.rigs.rig import Rig
from estimator.support.argument_checks import short_repr
from estimator.support.array_types import FloatArray

Value = TypeVar("Value")

#: What an applied input may lie beyond the limit, relative: converters round.
_INPUT_TOLERANCE = 0.01


class SafetyStop(RuntimeError):
    """The run was ended for safety.

    Attributes:
        reason: ``range`` (the output left its range), ``max_stale`` (no new output), ``late`` (none in time), ``input``
            (the plant applied more than the limit), ``plant`` (it raised an exception, or gave something else than it
            must), ``design`` (no input is safe).
    """

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason


class Session:
    """Everything that goes to a plant goes through here. Entered disarmed; left with the input at zero.

    Args:
        plant: of the rig.
        rig: with a limit of the input and a range of the output.
        log_event: is told what happens: ``log_event(event, **details)``.
        watchdog: seconds of silence after which the plant zeroes its input by itself; None: without.
        max_stale: outputs in a row that are missing, late, or the very same number, which trip; 0: never.

    Attributes:
        failure: after it was left: what of zeroing and disarming failed, which stderr is told, too; empty if nothing.

    Raises:
        ValueError: as `check_safety_settings`.
    """

    def __init__(
        self,
        plant: HardwarePlant,
        rig: Rig,
        log_event: Callable[..., None],
        watchdog: float | None,
        max_stale: int = 32,
    ) -> None:
        check_safety_settings(rig, plant, watchdog)
        self.plant, self.watchdog, self.stale = plant, watchdog, max_stale
        self.limit, self.range = float(rig.input.limit or 0.0), float(rig.output.range or 0.0)
        self.is_armed, self.failure = False, ""
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
                self.failure = f"the input could not be zeroed at the end: {'; '.join(failures)}; {remedy}"
                # Before anything is written: whatever else fails, a person has to know.
                with suppress(OSError):
                    print(f"duffing-env: {self.failure}", file=sys.stderr, flush=True)
            self._log_disarmed(failures)
            if failures:
                self._log_event("zero failed", message=self.failure)
        finally:
            self._interrupt_handler.__exit__()

    def arm(self) -> None:
        """Let inputs through."""
        self._interrupt_handler.check()
        self.is_armed = True  # also where it fails half way
        self._call_plant("arm", self.plant.arm, self.watchdog)
        self._log_event("armed", watchdog=self.watchdog)

    def disarm(self) -> list[str]:
        """Zero the input and disarm, whatever fails of it; returns what did."""
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

    def clamp(self, u: Any) -> Any:
        """What of an input, or of several, is within the limit.

        Raises:
            ValueError: for one that is not finite.
        """
        if not np.isfinite(u).all():
            raise ValueError(f"input must be finite, but is {u!r:.80}; the policy is broken")
        return np.clip(u, -self.limit, self.limit)

    def apply(self, u: float) -> float:
        """Apply an input, clamped; returns what was applied.

        Raises:
            Tripped: if more than the limit was applied, or the plant raised or gave no number.
        """
        self._interrupt_handler.check()
        value = float(self.clamp(u))
        applied = self._call_for_number("apply", value)
        self._check_applied(np.array([applied]))
        return applied

    def read(self) -> float:
        """The output; NaN where it is missing. `check` judges it.

        Raises:
            Tripped: if the plant raised or gave no number.
        """
        self._interrupt_handler.check()
        return self._call_for_number("read")

    def play(self, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Arm, play inputs (N,), disarm; returns inputs as applied and outputs, (N,) each. `check` judges them.

        Raises:
            Tripped: if more than the limit was applied, or the plant raised or gave something else.
        """
        clamped = np.array(self.clamp(u), dtype=np.float64)
        self.arm()
        answer = self._call_plant("play", self.plant.play, clamped)
        failures = self.disarm()
        if failures:
            raise SafetyStop("plant", f"the input could not be zeroed after a block: {'; '.join(failures)}")
        requirement = f"play must give two arrays of {clamped.shape}, inputs as applied and outputs, but gave"
        try:
            applied, y = (np.array(one, dtype=np.float64) for one in answer)
        except (TypeError, ValueError):
            raise SafetyStop("plant", f"{requirement} {short_repr(answer)}") from None
        if applied.shape != clamped.shape or y.shape != clamped.shape:
            raise SafetyStop("plant", f"{requirement} {applied.shape}, {y.shape}")
        self._check_applied(applied)
        return applied, y

    def check(self, outputs: FloatArray) -> None:
        """Judge outputs (N,), after they were recorded.

        Raises:
            Tripped: if one left the range, or too many in a row told nothing new.
        """
        if (np.abs(outputs) > self.range).any():
            worst = outputs[np.nanargmax(np.abs(outputs))]
            raise SafetyStop("range", f"the output was {worst:.6g}, beyond its range of ±{self.range:.6g}")
        for y in outputs.tolist():
            self._consecutive_stale = (
                self._consecutive_stale + 1 if not math.isfinite(y) or y == self._last_output else 0
            )
            self._last_output = y if math.isfinite(y) else self._last_output
            if self.stale and self._consecutive_stale >= self.stale:
                again = "" if math.isnan(self._last_output) else f", or {self._last_output:.6g} again"
                raise SafetyStop("stale", f"{self._consecutive_stale} outputs in a row were missing{again}")

    def _check_applied(self, applied: FloatArray) -> None:
        if not (np.abs(applied) <= self.limit * (1 + _INPUT_TOLERANCE)).all():
            raise SafetyStop("input", f"the plant applied {np.abs(applied).max():.6g}, beyond ±{self.limit:.6g}")

    def _call_for_number(self, name: str, *arguments: Any) -> float:
        answer = self._call_plant(name, getattr(self.plant, name), *arguments)
        try:
            return as_number(name, answer)
        except TypeError as error:
            raise SafetyStop("plant", str(error)) from None

    def _call_plant(self, name: str, command: Callable[..., Value], *arguments: Any) -> Value:
        try:
            return command(*arguments)
        except Exception as error:
            raise SafetyStop("plant", f"{name} failed: {type(error).__name__}: {error}") from error


def check_safety_settings(rig: Rig, plant: HardwarePlant, watchdog: float | None) -> None:
    """Refuse what no session is safe with.

    Raises:
        ValueError: for a rig without limit or range, or a watchdog that the plant has not.
    """
    for channel, name in ((rig.input, "limit"), (rig.output, "range")):
        if getattr(channel, name) is None:
            side = "input" if name == "limit" else "output"
            raise ValueError(f"rig must have a {name} of the {side} for a run, but has none; add {side}.{name}")
    if watchdog is not None and not plant.has_watchdog:
        raise ValueError(
            "plant must have a watchdog, which zeroes its input when this program is gone, but has none: give it "
            "one, or run without (no_watchdog) where a person watches"
        )
