"""A simulated plant of a rig, to try a run without hardware: Eq. (1), integrated independently of the engine."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from agents.hardware.clock import Clock, RealClock
from estimator.models.duffing import DERIVATIVE_ORDER_OF_SENSOR
from estimator.rigs.rig import Rig
from estimator.rigs.units import MAGNITUDE_BOUNDS
from estimator.support.argument_checks import MAX_SEED, check_integer, check_number, short_repr
from estimator.support.array_types import FloatArray

#: Runge-Kutta steps in a sampling step.
_RK4_SUBSTEPS = 8

#: Longest pause that is integrated [samples]; the rest of a longer one is left out.
_MAX_SAMPLES_INTEGRATED = 2_000

#: The same before any input was applied [samples]: more would take longer than the sampling step of a fast rig.
_MAX_SAMPLES_AT_REST = 20

#: Standard deviation of a noise that the rig does not give, as a fraction of the input's limit or the output's range.
_DEFAULT_NOISE_RATIO = 1e-4

#: Longest pause between two blocks, whose length is drawn [samples].
_MAX_SAMPLES_BETWEEN_BLOCKS = 200


class SimulatedPlant:
    """An oscillator that follows the clock, or plays blocks at once.

    Its parameters are the middle of the rig's guess, and its noises are the channels' noises; where the rig gives none,
    1e-4 of the limit and of the range. It has a watchdog, as an instrument does: after the watchdog's time of silence
    its input is zero.

    Time begins with the first call, because a run loads, compiles and plans between the constructor and this call.
    Before any input was applied, a pause of more than 20 samples between two calls counts as 20 samples; later a pause
    of more than 2,000 counts as 2,000. So no call takes long because of a pause before the run.

    Args:
        rig: with a guess where ``truth`` is None.
        truth: m, c, a and b in the rig's units, in place of the middle of the guess.
        seed: of the noises.
        clock: the machine's clock where it is None.

    Raises:
        ValueError: for a rig without a guess where there is no truth, a rig with a delay, a truth that is not m, c, a
            and b, or a seed that is no whole number.
    """

    has_watchdog = True

    def __init__(
        self, rig: Rig, truth: Mapping[str, float] | None = None, seed: int = 0, clock: Clock | None = None
    ) -> None:
        if truth is None and rig.guess is None:
            raise ValueError(
                "rig must have a guess of m, c, a and b to be simulated, but has none; add one, or "
                "truth = { m = ..., c = ..., a = ..., b = ... } to its table [instrument]"
            )
        if truth is not None:
            check_true_parameters(truth)
        check_integer("seed", seed, MAX_SEED, 0)
        if rig.delay != 0:
            raise ValueError(f"rig must have a delay of 0 to be simulated here, but has {rig.delay}; set it to 0")
        self.truth = dict(truth) if truth is not None else {k: sum(v) / 2 for k, v in (rig.guess or {}).items()}
        self.rig, self.clock = rig, RealClock() if clock is None else clock
        channels = ((rig.only_input, rig.only_input.limit), (rig.output, rig.output.range))
        self._noise_stds = [
            _DEFAULT_NOISE_RATIO * (limit or 0.0) if channel.noise is None else channel.noise
            for channel, limit in channels
        ]
        self._rng = np.random.default_rng(seed)
        self._x = self._v = self._u = self._process_noise_force = 0.0
        self._armed, self._watchdog, self._has_been_driven = False, math.inf, False
        self._last_call_time = self._integrated_until = math.nan  # until the first call

    @property
    def applied(self) -> float:
        """The input now, also where the watchdog zeroed it."""
        self._integrate_to_now()
        return self._u

    def arm(self, watchdog: float | None) -> None:
        """Let inputs through."""
        self._register_call()
        self._armed, self._watchdog = True, math.inf if watchdog is None else watchdog

    def apply(self, u: float) -> float:
        """Apply an input from now on; 0 where the plant is disarmed."""
        self._register_call()
        self._u = self._clamp_input(u)
        return self._u

    def read(self) -> float:
        """The output now, with noise."""
        self._register_call()
        return self._sensor_output()

    def play(self, u: FloatArray) -> tuple[npt.ArrayLike, npt.ArrayLike]:
        """Play inputs at once, after a pause whose length is drawn; the clock stands still."""
        self._register_call()
        self._u = 0.0
        self._integrate(int(self._rng.integers(_MAX_SAMPLES_BETWEEN_BLOCKS)))
        applied, outputs = np.zeros(len(u)), np.zeros(len(u))
        for k, value in enumerate(u.tolist()):
            outputs[k] = self._sensor_output()
            applied[k] = self._u = self._clamp_input(value)
            self._integrate(1.0)
        self._u = 0.0
        # The time on the clock that this took was the block.
        self._last_call_time = self._integrated_until = self.clock.now()
        return applied, outputs

    def zero(self) -> None:
        """Bring the input to zero."""
        self._register_call()
        self._u = 0.0

    def disarm(self) -> None:
        """Bring the input to zero, and let no input through any more."""
        self.zero()
        self._armed = False

    def _clamp_input(self, u: float) -> float:
        limit = self.rig.only_input.limit or math.inf
        applied = min(max(u, -limit), limit) if self._armed else 0.0
        self._has_been_driven |= applied != 0.0
        return applied

    def _register_call(self) -> None:
        self._integrate_to_now()
        self._last_call_time = self.clock.now()

    def _integrate_to_now(self) -> None:
        """Integrate up to the time on the clock; the watchdog may zero the input on the way."""
        now = self.clock.now()
        if math.isnan(self._integrated_until):
            self._last_call_time = self._integrated_until = now
        watchdog_time = self._last_call_time + self._watchdog
        if now > watchdog_time and self._armed:
            self._integrate_until(watchdog_time)
            self._u, self._armed = 0.0, False
        self._integrate_until(now)

    def _integrate_until(self, time: float) -> None:
        longest = float(_MAX_SAMPLES_INTEGRATED if self._has_been_driven else _MAX_SAMPLES_AT_REST)
        self._integrate(min((time - self._integrated_until) / self.rig.step, longest))
        self._integrated_until = time

    def _sensor_output(self) -> float:
        order = DERIVATIVE_ORDER_OF_SENSOR[self.rig.output.kind]
        value = (self._x, self._v, self._acceleration(self._x, self._v))[order]
        return value + self.rig.output.offset + self._noise_stds[1] * self._rng.standard_normal()

    def _integrate(self, samples: float) -> None:
        """Integrate by the classical Runge-Kutta method, with a new force noise in every sample."""
        while samples > 1e-9:
            part = min(samples, 1.0)
            self._process_noise_force = self._noise_stds[0] * self._rng.standard_normal()
            h = part * self.rig.step / _RK4_SUBSTEPS
            for _ in range(_RK4_SUBSTEPS):
                self._rk4_step(h)
            samples -= part

    def _rk4_step(self, h: float) -> None:
        x, v = self._x, self._v
        a1 = self._acceleration(x, v)
        a2 = self._acceleration(x + h / 2 * v, v + h / 2 * a1)
        a3 = self._acceleration(x + h / 2 * v + h * h / 4 * a1, v + h / 2 * a2)
        a4 = self._acceleration(x + h * v + h * h / 2 * a2, v + h * a3)
        self._x = x + h * v + h * h / 6 * (a1 + a2 + a3)
        self._v = v + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)

    def _acceleration(self, x: float, v: float) -> float:
        m, c, a, b = (self.truth[name] for name in "mcab")
        force = self._u - self.rig.only_input.offset + self._process_noise_force
        return (force - c * v - a * x - b * x * x * x) / m


def check_true_parameters(truth: object) -> None:
    """Refuse true parameters that are not m, c, a and b.

    Raises:
        ValueError: naming the parameter.
    """
    if not isinstance(truth, Mapping) or set(truth) != set("mcab"):
        raise ValueError(f"truth must give m, c, a and b, but is {short_repr(truth)}")
    for name in "mcab":
        smallest = MAGNITUDE_BOUNDS[0] if name == "m" else -MAGNITUDE_BOUNDS[1]
        check_number(f"truth of {name}", truth[name], smallest, MAGNITUDE_BOUNDS[1])


def plant(rig: Rig, seed: int = 0, truth: Mapping[str, float] | None = None, **instrument: object) -> SimulatedPlant:
    """The factory of ``--plant agents.hardware.simulated_plant:plant``; [instrument] may hold seed and truth."""
    return SimulatedPlant(rig, truth, seed)
