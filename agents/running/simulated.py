"""A simulated plant of a rig, to try a run without hardware: Eq. (1), integrated here, and not by the engine."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from agents.running.clock import Clock, RealClock
from estimator.checks import MOST_SEED, number, shown, whole
from estimator.models.duffing import KINDS
from estimator.parameters import FloatArray
from estimator.rig import Rig
from estimator.units import SIZES

#: Runge-Kutta steps of a sampling step.
_STEPS = 8

#: Longest stretch that is integrated, in samples: of a longer pause the rest is left out.
_PAUSE = 2_000

#: The same as long as nothing has driven it: to catch up with more takes longer than the step of a fast rig.
_REST = 20

#: A noise that the rig does not give, in parts of the input's limit or the output's range.
_NOISE = 1e-4

#: Between two blocks an unknown time passes; here up to so many samples.
_GAP = 200


class SimulatedPlant:
    """An oscillator that follows the clock, or plays blocks at once.

    Its parameters are the middle of the rig's guess, its noises those of the channels; where the rig gives none, a
    ten-thousandth of the limit and of the range. It watches as an instrument does: silence of the watchdog's time
    brings its input to zero.

    Time begins with its first call, and not when it is made: a run loads, compiles and plans in between. Until an input
    drives it, it rests but for its noises, and a pause of more than 20 samples between two calls counts as one of 20;
    later one of more than 2,000 as one of 2,000. So no call takes long because of what went by before the run.

    Args:
        rig: with a guess, or ``truth``.
        truth: m, c, a and b in the rig's units, in place of the middle of the guess.
        seed: of the noises.
        clock: the machine's where it is None.

    Raises:
        ValueError: for a rig without a guess where no truth is given, or with a delay; for a truth that is not m, c, a
            and b, or a seed that is no whole number.
    """

    watches = True

    def __init__(
        self, rig: Rig, truth: Mapping[str, float] | None = None, seed: int = 0, clock: Clock | None = None
    ) -> None:
        if truth is None and rig.guess is None:
            raise ValueError(
                "rig must have a guess of m, c, a and b to be simulated, but has none; add one, or "
                "truth = { m = ..., c = ..., a = ..., b = ... } to its table [instrument]"
            )
        if truth is not None:
            check_truth(truth)
        whole("seed", seed, MOST_SEED, 0)
        if rig.delay != 0:
            raise ValueError(f"rig must have a delay of 0 to be simulated here, but has {rig.delay}; set it to 0")
        self.truth = dict(truth) if truth is not None else {k: sum(v) / 2 for k, v in (rig.guess or {}).items()}
        self.rig, self.clock = rig, RealClock() if clock is None else clock
        widest = ((rig.input, rig.input.limit), (rig.output, rig.output.range))
        self._noises = [_NOISE * (most or 0.0) if one.noise is None else one.noise for one, most in widest]
        self._rng = np.random.default_rng(seed)
        self._x = self._v = self._u = self._force = 0.0
        self._armed, self._watchdog, self._driven = False, math.inf, False
        self._heard = self._moved = math.nan  # until the first call

    @property
    def applied(self) -> float:
        """The input now, whoever brought it there."""
        self._move_to_now()
        return self._u

    def arm(self, watchdog: float | None) -> None:
        """Let inputs through."""
        self._hear()
        self._armed, self._watchdog = True, math.inf if watchdog is None else watchdog

    def apply(self, u: float) -> float:
        """An input from now on; 0 where the plant is disarmed."""
        self._hear()
        self._u = self._let_through(u)
        return self._u

    def read(self) -> float:
        """The output now, with noise."""
        self._hear()
        return self._shown()

    def play(self, u: FloatArray) -> tuple[npt.ArrayLike, npt.ArrayLike]:
        """Play inputs at once, after a pause of an unknown length; the clock stands still."""
        self._hear()
        self._u = 0.0
        self._move(int(self._rng.integers(_GAP)))
        applied, outputs = np.zeros(len(u)), np.zeros(len(u))
        for k, value in enumerate(u.tolist()):
            outputs[k] = self._shown()
            applied[k] = self._u = self._let_through(value)
            self._move(1.0)
        self._u = 0.0
        self._heard = self._moved = self.clock.now()  # what passed on the clock meanwhile was the block
        return applied, outputs

    def zero(self) -> None:
        """The input to zero."""
        self._hear()
        self._u = 0.0

    def disarm(self) -> None:
        """The input to zero, and no other after it."""
        self.zero()
        self._armed = False

    def _let_through(self, u: float) -> float:
        limit = self.rig.input.limit or math.inf
        applied = min(max(u, -limit), limit) if self._armed else 0.0
        self._driven |= applied != 0.0
        return applied

    def _hear(self) -> None:
        self._move_to_now()
        self._heard = self.clock.now()

    def _move_to_now(self) -> None:
        """Follow the clock; the watchdog bites on the way."""
        now = self.clock.now()
        if math.isnan(self._moved):
            self._heard = self._moved = now
        bite = self._heard + self._watchdog
        if now > bite and self._armed:
            self._catch_up(bite)
            self._u, self._armed = 0.0, False
        self._catch_up(now)

    def _catch_up(self, time: float) -> None:
        self._move(min((time - self._moved) / self.rig.step, float(_PAUSE if self._driven else _REST)))
        self._moved = time

    def _shown(self) -> float:
        order = KINDS[self.rig.output.kind]
        value = (self._x, self._v, self._acceleration(self._x, self._v))[order]
        return value + self.rig.output.offset + self._noises[1] * self._rng.standard_normal()

    def _move(self, samples: float) -> None:
        """Runge and Kutta's method, with a force noise that is new for every sample."""
        while samples > 1e-9:
            part = min(samples, 1.0)
            self._force = self._noises[0] * self._rng.standard_normal()
            h = part * self.rig.step / _STEPS
            for _ in range(_STEPS):
                self._runge_kutta(h)
            samples -= part

    def _runge_kutta(self, h: float) -> None:
        x, v = self._x, self._v
        a1 = self._acceleration(x, v)
        a2 = self._acceleration(x + h / 2 * v, v + h / 2 * a1)
        a3 = self._acceleration(x + h / 2 * v + h * h / 4 * a1, v + h / 2 * a2)
        a4 = self._acceleration(x + h * v + h * h / 2 * a2, v + h * a3)
        self._x = x + h * v + h * h / 6 * (a1 + a2 + a3)
        self._v = v + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)

    def _acceleration(self, x: float, v: float) -> float:
        m, c, a, b = (self.truth[name] for name in "mcab")
        force = self._u - self.rig.input.offset + self._force
        return (force - c * v - a * x - b * x * x * x) / m


def check_truth(truth: object) -> None:
    """Refuse what are not m, c, a and b."""
    if not isinstance(truth, Mapping) or set(truth) != set("mcab"):
        raise ValueError(f"truth must give m, c, a and b, but is {shown(truth)}")
    for name in "mcab":
        number(f"truth of {name}", truth[name], SIZES[0] if name == "m" else -SIZES[1], SIZES[1])


def plant(rig: Rig, seed: int = 0, truth: Mapping[str, float] | None = None, **instrument: object) -> SimulatedPlant:
    """For ``--plant agents.running.simulated:plant``; seed and truth may stand in the rig file's table [instrument]."""
    return SimulatedPlant(rig, truth, seed)
