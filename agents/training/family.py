"""A family of oscillators without units: what a policy for all of them is trained on, and judged by.

Time is counted in samples, the input in parts of its limit, and the displacement in parts of its limit X. A draw is a
rig with the options of ``Rig-v0``: the environment then draws oscillators from the rig's guess.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from agents.cli import RIG_TRACK

#: What is trained on it, in the place of a track.
FAMILY = "family"

#: Samples that show how features vary: about the middle of `SAMPLES`, on a logarithmic scale.
TYPICAL = 256

#: Kinds of stiffness, and how often each is drawn.
KINDS = {"hardening": 0.5, "softening": 0.25, "double-well": 0.25}

#: Ranges, log-uniform: samples per period of small motions, damping ratio, b X²/a of a hardening spring, -b X²/a of a
#: softening one (whose force must not fall within X), the wells' place in parts of X, the input limit in parts of the
#: static force that holds the oscillator at X, σ_v in parts of X, σ_w in parts of σ_v, half width of the guess, samples
#: of an episode, and the input's root mean square in parts of its limit where the energy is limited.
PERIOD, DAMPING, HARDENING, SOFTENING, WELLS = (6.0, 60.0), (0.002, 0.3), (0.1, 5.0), (0.05, 0.3), (0.3, 0.7)
DRIVE, SENSOR_NOISE, NOISE_RATIO, GUESS = (0.02, 1.0), (1e-4, 1e-2), (0.1, 10.0), (0.1, 0.6)
SAMPLES, RMS = (64, 1024), (0.1, 0.5)

#: What the sensor shows, and how often.
SENSORS = {"displacement": 0.7, "velocity": 0.3}

#: How often the energy is limited, and how often the noises are known; where process noise alone may move the
#: oscillator to, in parts of X.
FRUGAL, KNOWN, MOST_SHAKEN = 0.25, 0.25, 0.15


class Member(NamedTuple):
    """A draw.

    Attributes:
        kind: of `KINDS`.
        period: samples in a period of small motions.
        damping: ratio.
        drive: the input's limit in parts of the static force at X.
        options: of ``Rig-v0``.
    """

    kind: str
    period: float
    damping: float
    drive: float
    options: dict[str, Any]


def draw_member(rng: np.random.Generator) -> Member:
    """A rig of the family.

    Example:
        >>> import numpy as np
        >>> from agents.training.family import draw_member
        >>> member = draw_member(np.random.default_rng(1))
        >>> sorted(member.options["rig"]["guess"])
        ['a', 'b', 'c', 'm']
    """

    def log_uniform(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    kind = str(rng.choice(list(KINDS), p=list(KINDS.values())))
    period, damping, drive = log_uniform(*PERIOD), log_uniform(*DAMPING), log_uniform(*DRIVE)
    # Linear and cubic stiffness up to a factor, and the stiffness of small motions.
    if kind == "double-well":
        place = log_uniform(*WELLS)
        a, b, small = -1.0, 1.0 / place**2, 2.0
    else:
        a, b, small = 1.0, log_uniform(*HARDENING) if kind == "hardening" else -log_uniform(*SOFTENING), 1.0
    scale = 1.0 / (drive * abs(a + b))
    a, b, small = a * scale, b * scale, small * scale
    omega = 2.0 * np.pi / period
    m = small / omega**2
    c = 2.0 * damping * np.sqrt(small * m)
    width = log_uniform(*GUESS)
    centers = {"m": m, "c": c, "a": a, "b": b}
    guess = {name: tuple(sorted((x * (1.0 - width), x * (1.0 + width)))) for name, x in centers.items()}
    shows = str(rng.choice(list(SENSORS), p=list(SENSORS.values())))
    size = 1.0 if shows == "displacement" else omega
    sensor = log_uniform(*SENSOR_NOISE)
    samples = int(log_uniform(*SAMPLES))
    # What white noise alone shakes the oscillator to, by the end or in balance with damping.
    shaken = np.sqrt(1.5 * min(samples, 0.5 / (damping * omega))) / omega
    process = min(sensor * log_uniform(*NOISE_RATIO), MOST_SHAKEN / shaken)
    rig = {
        "step": 1.0,
        "input": {"unit": "N", "limit": 1.0, "noise": process * m * np.sqrt(3.0)},
        "output": {
            "unit": "m" if shows == "displacement" else "m/s",
            "kind": shows,
            "range": size,
            "noise": sensor * size,
        },
        "guess": guess,
    }
    options: dict[str, Any] = {"rig": rig, "horizon": samples}
    if rng.uniform() < FRUGAL:
        options["max_rms"] = log_uniform(*RMS)
    if rng.uniform() < KNOWN:
        options |= {"noise_range": 1.0, "noise_hypotheses": 1}
    return Member(kind, period, damping, drive, options)


def draw_rig(rng: np.random.Generator) -> tuple[str, dict[str, Any]]:
    """A rig of the family, as `agents.training.mixed_env.Draw`."""
    return RIG_TRACK, draw_member(rng).options
