"""A family of oscillators without units: what a policy for all of them is trained on, and judged by.

Time is counted in samples, the input in parts of its limit, and the displacement in parts of its limit X. A draw is a
rig with the options of ``Rig-v0``: the environment then draws oscillators from the rig's guess.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from agents.track_ids import RIG_TRACK

#: What is trained on it, in the place of a track.
FAMILY = "family"

#: Samples that show how features vary: about the middle of `EPISODE_SAMPLES_RANGE`, on a logarithmic scale.
TYPICAL_SAMPLES = 256

#: Kinds of stiffness, and how often each is drawn.
STIFFNESS_PROBABILITIES = {"hardening": 0.5, "softening": 0.25, "double-well": 0.25}

#: Ranges, log-uniform: samples per period of small motions, damping ratio, b X²/a of a hardening spring, -b X²/a of a
#: softening one (whose force must not fall within X), the wells' place in parts of X, the input limit in parts of the
#: static force that holds the oscillator at X, σ_v in parts of X, σ_w in parts of σ_v, half width of the guess, samples
#: of an episode, and the input's root mean square in parts of its limit where the energy is limited.
PERIOD_RANGE, DAMPING_RANGE, HARDENING_RANGE, SOFTENING_RANGE, WELL_RANGE = (
    (6.0, 60.0),
    (0.002, 0.3),
    (0.1, 5.0),
    (0.05, 0.3),
    (0.3, 0.7),
)
DRIVE_RANGE, SENSOR_NOISE_RANGE, NOISE_RATIO_RANGE, GUESS_HALF_WIDTH_RANGE = (
    (0.02, 1.0),
    (1e-4, 1e-2),
    (0.1, 10.0),
    (0.1, 0.6),
)
EPISODE_SAMPLES_RANGE, RMS_RANGE = (64, 1024), (0.1, 0.5)

#: What the sensor shows, and how often.
SENSOR_PROBABILITIES = {"displacement": 0.7, "velocity": 0.3}

#: How often the energy is limited, and how often the noises are known; where process noise alone may move the
#: oscillator to, in parts of X.
LIMITED_ENERGY_PROBABILITY, KNOWN_NOISES_PROBABILITY, MAX_NOISE_DISPLACEMENT = 0.25, 0.25, 0.15


class FamilyMember(NamedTuple):
    """A draw.

    Attributes:
        stiffness: of `STIFFNESS_PROBABILITIES`.
        period: samples in a period of small motions.
        damping: ratio.
        drive: the input's limit in parts of the static force at X.
        options: of ``Rig-v0``.
    """

    stiffness: str
    period: float
    damping: float
    drive: float
    options: dict[str, Any]


def draw_oscillator(rng: np.random.Generator) -> FamilyMember:
    """A rig of the family.

    Example:
        >>> import numpy as np
        >>> from agents.training.environments.oscillator_family import draw_oscillator
        >>> member = draw_oscillator(np.random.default_rng(1))
        >>> sorted(member.options["rig"]["guess"])
        ['a', 'b', 'c', 'm']
    """

    def log_uniform(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    stiffness = str(rng.choice(list(STIFFNESS_PROBABILITIES), p=list(STIFFNESS_PROBABILITIES.values())))
    period, damping, drive = log_uniform(*PERIOD_RANGE), log_uniform(*DAMPING_RANGE), log_uniform(*DRIVE_RANGE)
    # Linear and cubic stiffness up to a factor, and the stiffness of small motions.
    if stiffness == "double-well":
        well = log_uniform(*WELL_RANGE)
        a, b, linearised_stiffness = -1.0, 1.0 / well**2, 2.0
    else:
        a, b, linearised_stiffness = (
            1.0,
            log_uniform(*HARDENING_RANGE) if stiffness == "hardening" else -log_uniform(*SOFTENING_RANGE),
            1.0,
        )
    scale = 1.0 / (drive * abs(a + b))
    a, b, linearised_stiffness = a * scale, b * scale, linearised_stiffness * scale
    omega = 2.0 * np.pi / period
    m = linearised_stiffness / omega**2
    c = 2.0 * damping * np.sqrt(linearised_stiffness * m)
    width = log_uniform(*GUESS_HALF_WIDTH_RANGE)
    centers = {"m": m, "c": c, "a": a, "b": b}
    guess = {name: tuple(sorted((x * (1.0 - width), x * (1.0 + width)))) for name, x in centers.items()}
    sensor_kind = str(rng.choice(list(SENSOR_PROBABILITIES), p=list(SENSOR_PROBABILITIES.values())))
    output_range = 1.0 if sensor_kind == "displacement" else omega
    sensor_noise = log_uniform(*SENSOR_NOISE_RANGE)
    samples = int(log_uniform(*EPISODE_SAMPLES_RANGE))
    # What white noise alone shakes the oscillator to, by the end or in balance with damping.
    noise_displacement = np.sqrt(1.5 * min(samples, 0.5 / (damping * omega))) / omega
    process_noise = min(sensor_noise * log_uniform(*NOISE_RATIO_RANGE), MAX_NOISE_DISPLACEMENT / noise_displacement)
    rig = {
        "step": 1.0,
        "input": {"unit": "N", "limit": 1.0, "noise": process_noise * m * np.sqrt(3.0)},
        "output": {
            "unit": "m" if sensor_kind == "displacement" else "m/s",
            "kind": sensor_kind,
            "range": output_range,
            "noise": sensor_noise * output_range,
        },
        "guess": guess,
    }
    options: dict[str, Any] = {"rig": rig, "horizon": samples}
    if rng.uniform() < LIMITED_ENERGY_PROBABILITY:
        options["max_rms"] = log_uniform(*RMS_RANGE)
    if rng.uniform() < KNOWN_NOISES_PROBABILITY:
        options |= {"noise_range": 1.0, "noise_hypotheses": 1}
    return FamilyMember(stiffness, period, damping, drive, options)


def draw_rig_track(rng: np.random.Generator) -> tuple[str, dict[str, Any]]:
    """A rig of the family, as `agents.training.environments.mixed_vec_env.DrawOptions`."""
    return RIG_TRACK, draw_oscillator(rng).options
