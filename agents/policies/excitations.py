"""Excitation signals by name: classical test signals such as PRBS, multisines and chirps, in volts.

`EXCITATIONS` makes a `SignalDraw`, which can be copied and pickled, from an amplitude limit. Every draw is new: band
and levels of a signal are fixed; phase, order or start are random. The sampling rate is 610.35 Hz (δ = 1.6384 ms); an
input is held for a sample. `agents.policies.signals.SignalPolicy` plays them within a track's limits. docs/policies.md
has a table of them with their frequency content.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from duffing_env.plants.silverbox_record import regime_input
from estimator.models.difference_equation import difference
from estimator.rigs.physical_parameters import coefficients_of
from estimator.rigs.silverbox_constants import SILVERBOX_SAMPLING_STEP, SILVERBOX_TWIN
from estimator.support.argument_checks import check_integer
from estimator.support.array_types import FloatArray

SignalDraw = Callable[[np.random.Generator, int], NDArray[np.float64]]

BAND = (10.0, 150.0)
"""Of multisines and chirps [Hz].

The linear resonances of oscillators within ±30 % of the twin lie between 49 and 95 Hz. Below the resonance one answers
with its stiffness, at it with its damping, above it with its mass: a band with room on both sides tells them apart.
"""

PRBS_LEVELS = (-1.0, -0.5, 0.0, 0.5, 1.0)
"""Of ``multilevel-prbs``, in parts of the limit; the small ones show the linear term, the large ones the cubic one."""


def draw_regime(name: str) -> SignalDraw:
    """A stretch of a regime of the Silverbox record, or of its synthesised stand-in.

    The stretch is contiguous and starts anywhere it fits, gaps and quiet beginning included. One longer than the regime
    starts at its first sample and repeats it. See `duffing_env.plants.silverbox_record.regime_input`.
    """
    return partial(_regime, name=name)


def _regime(rng: np.random.Generator, samples: int, name: str) -> NDArray[np.float64]:
    regime = regime_input(name, rng)
    start = rng.integers(max(regime.size - samples, 0), endpoint=True)
    return np.resize(regime[start : start + samples], samples)


def draw_recorded(recorded_input: NDArray[np.float64]) -> SignalDraw:
    """A given input in volts, shape `(samples,)`, from its first sample; repeated if too short."""
    return partial(_recorded, u=recorded_input)


def _recorded(rng: np.random.Generator, samples: int, u: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.resize(u, samples)


def draw_uniform(max_input: float) -> SignalDraw:
    """Independent samples, uniform in ±`max_input` volts."""
    return partial(_uniform, max_input=max_input)


def _uniform(rng: np.random.Generator, samples: int, max_input: float) -> NDArray[np.float64]:
    return rng.uniform(-max_input, max_input, samples)


def draw_gaussian(max_input: float) -> SignalDraw:
    """Independent normal samples of standard deviation `max_input` / 3, clipped at ±`max_input` (1 in 370 is)."""
    return partial(_gaussian, max_input=max_input)


def _gaussian(rng: np.random.Generator, samples: int, max_input: float) -> NDArray[np.float64]:
    return np.clip(rng.normal(0.0, max_input / 3.0, samples), -max_input, max_input)


def draw_prbs(max_input: float, hold: int = 1) -> SignalDraw:
    """A random binary signal: +`max_input` or -`max_input` volts with even odds; see `draw_levels`.

    A coin rather than a shift register: of a maximum length sequence every draw would be the same one, shifted.
    """
    return draw_levels(max_input, hold, levels=(-1.0, 1.0))


def draw_levels(max_input: float, hold: int, levels: tuple[float, ...] = PRBS_LEVELS) -> SignalDraw:
    """A random signal of a few levels, in parts of `max_input` volts, with even odds, each held for `hold` samples.

    Raises:
        ValueError: `hold` is no whole number of at least 1.
    """
    check_integer("hold", hold, 10**9)
    return partial(_levels, max_input=max_input, hold=hold, levels=levels)


def _levels(
    rng: np.random.Generator, samples: int, max_input: float, hold: int, levels: tuple[float, ...]
) -> NDArray[np.float64]:
    values = rng.choice(levels, size=-(-samples // hold))
    return max_input * np.repeat(values, hold)[:samples]


def draw_multisine(max_input: float) -> SignalDraw:
    """Σ_k cos(2π k t / (samples δ) + φ_k) over all k in `BAND`, φ_k uniform on [0, 2π), its peak at `max_input`.

    A draw is one period, so that its power lies on the lines exactly. Its crest factor is about 3.
    """
    return partial(_multisine, max_input=max_input)


def _multisine(rng: np.random.Generator, samples: int, max_input: float) -> NDArray[np.float64]:
    lines = band_lines(samples)
    return _multitone(lines, rng.uniform(0.0, 2.0 * np.pi, lines.size), samples, max_input)


def draw_schroeder(max_input: float) -> SignalDraw:
    """The multisine with the phases of Schroeder (1970), from a random place of its period.

    The n-th of N lines of equal power has φ_n = -π n (n - 1) / N, which makes the sum a sweep through the band, with
    a crest factor of about 1.8: at the same peak it has nearly three times the power of random phases.
    """
    return partial(_schroeder, max_input=max_input)


def _schroeder(rng: np.random.Generator, samples: int, max_input: float) -> NDArray[np.float64]:
    lines = band_lines(samples)
    line = np.arange(1, lines.size + 1)
    period = _multitone(lines, -np.pi * line * (line - 1) / lines.size, samples, max_input)
    return np.roll(period, rng.integers(samples))


def band_lines(samples: int) -> NDArray[np.int64]:
    """The harmonics of 1 / (samples δ) that lie in `BAND`, ascending.

    Raises:
        ValueError: There is none, which is so below 5 samples.
    """
    low, high = (edge * samples * SILVERBOX_SAMPLING_STEP for edge in BAND)
    lines = np.arange(max(1, int(np.ceil(low))), int(np.floor(high)) + 1)
    if lines.size == 0:
        raise ValueError(
            f"samples must be 5 or more for a line between {BAND[0]:.0f} and {BAND[1]:.0f} Hz, but it is {samples}; "
            "draw a longer signal, or one that is not a multisine"
        )
    return lines


def _multitone(lines: NDArray[np.int64], phases: FloatArray, samples: int, peak: float) -> NDArray[np.float64]:
    """Equal cosines at these harmonics, with these phases, scaled to this peak."""
    spectrum = np.zeros(samples // 2 + 1, dtype=np.complex128)
    spectrum[lines] = np.exp(1j * phases)
    volts = np.fft.irfft(spectrum, samples)
    return volts * (peak / np.abs(volts).max())


def draw_chirp(max_input: float, method: str) -> SignalDraw:
    """A sine of amplitude `max_input` that rises through `BAND` once in a draw, its first phase random.

    It rises because a hardening oscillator follows a rising frequency to larger displacements than a falling one.
    `method` is `"linear"` or `"logarithmic"` in time; see `scipy.signal.chirp`.
    """
    return partial(_chirp, max_input=max_input, method=method)


def _chirp(rng: np.random.Generator, samples: int, max_input: float, method: str) -> NDArray[np.float64]:
    from scipy.signal import chirp

    time = SILVERBOX_SAMPLING_STEP * np.arange(samples)
    low, high = BAND
    phase = rng.uniform(0.0, 360.0)
    return max_input * chirp(time, low, samples * SILVERBOX_SAMPLING_STEP, high, method=method, phi=phase)


def draw_square(max_input: float) -> SignalDraw:
    """A square wave of ±`max_input` at the twin's linear `linear_resonance`, its first phase random.

    The resonance rises with the amplitude A, about as sqrt((a + ¾ b A²) / m): an oscillator that is driven at the
    linear one falls out of step as it grows, and beats. To stay in step, the frequency must follow what the
    oscillator does: see ``square-believed`` and ``velocity-sign`` in `agents.policies.feedback`.
    """
    theta1, _, theta3, _ = coefficients_of(difference(), SILVERBOX_TWIN)
    step = float(2.0 * np.pi * SILVERBOX_SAMPLING_STEP * linear_resonance(theta1, theta3))
    return partial(_square, max_input=max_input, step=step)


def _square(rng: np.random.Generator, samples: int, max_input: float, step: float) -> NDArray[np.float64]:
    from scipy.signal import square

    return max_input * square(rng.uniform(0.0, 2.0 * np.pi) + step * np.arange(samples))


def linear_resonance(theta1: FloatArray | np.float64, theta3: FloatArray | np.float64) -> FloatArray:
    """Frequency at which the linear part of Eq. (2) rings [Hz], within `BAND`.

    The poles are the roots of z² - θ1 z - θ3, with the angle arccos(θ1 / (2 sqrt(-θ3))). It is 68.1 Hz for the twin;
    sqrt(a / m) / 2π, without damping and samples, is 67.9 Hz. Where θ3 is not negative, no oscillator is described, and
    the lower edge is given. Both are of one shape, whatever it is.
    """
    modulus = np.sqrt(np.maximum(-np.asarray(theta3), 1e-12))
    angle = np.arccos(np.clip(np.asarray(theta1) / (2.0 * modulus), -1.0, 1.0))
    return np.clip(angle / (2.0 * np.pi * SILVERBOX_SAMPLING_STEP), *BAND)


EXCITATIONS: dict[str, Callable[[float], SignalDraw]] = {
    "silverbox-multisine": lambda max_input: draw_regime("multisine"),
    "silverbox-arrow": lambda max_input: draw_regime("arrow"),
    "uniform": draw_uniform,
    "gaussian": draw_gaussian,
    "prbs": draw_prbs,
    "prbs-2": partial(draw_prbs, hold=2),
    "prbs-4": partial(draw_prbs, hold=4),
    "prbs-8": partial(draw_prbs, hold=8),
    "multilevel-prbs": partial(draw_levels, hold=4),
    "multisine": draw_multisine,
    "schroeder": draw_schroeder,
    "chirp-linear": partial(draw_chirp, method="linear"),
    "chirp-log": partial(draw_chirp, method="logarithmic"),
    "square": draw_square,
}
"""Name of an excitation to what makes its draw from the amplitude limit [V]."""
