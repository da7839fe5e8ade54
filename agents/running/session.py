"""A session with a plant: arming, clamps, trips, and an input that is zero at every exit."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from contextlib import suppress
from types import TracebackType
from typing import Any, TypeVar

import numpy as np

from agents.running.plant import Plant
from agents.stopping import Stopper
from duffing_env.tracks.rig_plant_env import as_number
from estimator.checks import shown
from estimator.parameters import FloatArray
from estimator.rig import Rig

Value = TypeVar("Value")

#: What an applied input may lie beyond the limit, relative: converters round.
_ROUNDING = 0.01


class Tripped(RuntimeError):
    """The run was ended for safety.

    Attributes:
        reason: ``range`` (the output left its range), ``stale`` (no new output), ``late`` (none in time), ``input``
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
        note: is told what happens: ``note(event, **details)``.
        watchdog: seconds of silence after which the plant zeroes its input by itself; None: without.
        stale: outputs in a row that are missing, late, or the very same number, which trip; 0: never.

    Attributes:
        failure: after it was left: what of zeroing and disarming failed, which stderr is told, too; empty if nothing.

    Raises:
        ValueError: as `check_session`.
    """

    def __init__(
        self, plant: Plant, rig: Rig, note: Callable[..., None], watchdog: float | None, stale: int = 32
    ) -> None:
        check_session(rig, plant, watchdog)
        self.plant, self.watchdog, self.stale = plant, watchdog, stale
        self.limit, self.range = float(rig.input.limit or 0.0), float(rig.output.range or 0.0)
        self.is_armed, self.failure = False, ""
        self._note, self._last, self._same = note, math.nan, 0
        self._stopper = Stopper()

    def __enter__(self) -> Session:
        self._stopper.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stopper.ignore()
        try:
            failures = self._bring_to_zero()
            if failures:
                told = "the watchdog has to" if self.watchdog is not None else "NOBODY DID: switch it off by hand"
                self.failure = f"the input could not be zeroed at the end: {'; '.join(failures)}; {told}"
                # Before anything is written: whatever else fails, a person has to know.
                with suppress(OSError):
                    print(f"duffing-env: {self.failure}", file=sys.stderr, flush=True)
            self._note_disarmed(failures)
            if failures:
                self._note("zero failed", message=self.failure)
        finally:
            self._stopper.__exit__()

    def arm(self) -> None:
        """Let inputs through."""
        self._stopper.check()
        self.is_armed = True  # also where it fails half way
        self._do("arm", self.plant.arm, self.watchdog)
        self._note("armed", watchdog=self.watchdog)

    def disarm(self) -> list[str]:
        """Zero the input and disarm, whatever fails of it; returns what did."""
        failures = self._bring_to_zero()
        self._note_disarmed(failures)
        return failures

    def _bring_to_zero(self) -> list[str]:
        failures = []
        for name in ("zero", "disarm"):
            try:
                getattr(self.plant, name)()
            except Exception as error:
                failures.append(f"{name} failed: {type(error).__name__}: {error}")
        return failures

    def _note_disarmed(self, failures: list[str]) -> None:
        if self.is_armed:
            self._note("disarmed", input_zeroed=not failures)
        self.is_armed = False

    def clamped(self, u: Any) -> Any:
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
        self._stopper.check()
        value = float(self.clamped(u))
        applied = self._number("apply", value)
        self._check_applied(np.array([applied]))
        return applied

    def read(self) -> float:
        """The output; NaN where it is missing. `check` judges it.

        Raises:
            Tripped: if the plant raised or gave no number.
        """
        self._stopper.check()
        return self._number("read")

    def play(self, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Arm, play inputs (N,), disarm; returns inputs as applied and outputs, (N,) each. `check` judges them.

        Raises:
            Tripped: if more than the limit was applied, or the plant raised or gave something else.
        """
        asked = np.array(self.clamped(u), dtype=np.float64)
        self.arm()
        told = self._do("play", self.plant.play, asked)
        failures = self.disarm()
        if failures:
            raise Tripped("plant", f"the input could not be zeroed after a block: {'; '.join(failures)}")
        must = f"play must give two arrays of {asked.shape}, inputs as applied and outputs, but gave"
        try:
            applied, y = (np.array(one, dtype=np.float64) for one in told)
        except (TypeError, ValueError):
            raise Tripped("plant", f"{must} {shown(told)}") from None
        if applied.shape != asked.shape or y.shape != asked.shape:
            raise Tripped("plant", f"{must} {applied.shape}, {y.shape}")
        self._check_applied(applied)
        return applied, y

    def check(self, outputs: FloatArray) -> None:
        """Judge outputs (N,), after they were recorded.

        Raises:
            Tripped: if one left the range, or too many in a row told nothing new.
        """
        if (np.abs(outputs) > self.range).any():
            worst = outputs[np.nanargmax(np.abs(outputs))]
            raise Tripped("range", f"the output was {worst:.6g}, beyond its range of ±{self.range:.6g}")
        for y in outputs.tolist():
            self._same = self._same + 1 if not math.isfinite(y) or y == self._last else 0
            self._last = y if math.isfinite(y) else self._last
            if self.stale and self._same >= self.stale:
                again = "" if math.isnan(self._last) else f", or {self._last:.6g} again"
                raise Tripped("stale", f"{self._same} outputs in a row were missing{again}")

    def _check_applied(self, applied: FloatArray) -> None:
        if not (np.abs(applied) <= self.limit * (1 + _ROUNDING)).all():
            raise Tripped("input", f"the plant applied {np.abs(applied).max():.6g}, beyond ±{self.limit:.6g}")

    def _number(self, name: str, *arguments: Any) -> float:
        given = self._do(name, getattr(self.plant, name), *arguments)
        try:
            return as_number(name, given)
        except TypeError as error:
            raise Tripped("plant", str(error)) from None

    def _do(self, name: str, command: Callable[..., Value], *arguments: Any) -> Value:
        try:
            return command(*arguments)
        except Exception as error:
            raise Tripped("plant", f"{name} failed: {type(error).__name__}: {error}") from error


def check_session(rig: Rig, plant: Plant, watchdog: float | None) -> None:
    """Refuse what no session is safe with.

    Raises:
        ValueError: for a rig without limit or range, or a watchdog that the plant has not.
    """
    for channel, name in ((rig.input, "limit"), (rig.output, "range")):
        if getattr(channel, name) is None:
            side = "input" if name == "limit" else "output"
            raise ValueError(f"rig must have a {name} of the {side} for a run, but has none; add {side}.{name}")
    if watchdog is not None and not plant.watches:
        raise ValueError(
            "plant must have a watchdog, which zeroes its input when this program is gone, but has none: give it "
            "one, or run without (no_watchdog) where a person watches"
        )
