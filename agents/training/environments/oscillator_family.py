"""A random family of dimensionless oscillators, on which one policy for all of them is trained and evaluated.

Time is in samples, the input in units of its limit, and the displacement in units of its limit X. A draw is a rig with
the options of ``Rig-v0``: the environment then draws oscillators from the rig's guess.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

#: Name of the family, in place of a track.
FAMILY = "family"

#: Samples from which the normaliser of the features is fitted: about the geometric mean of `EPISODE_SAMPLES_RANGE`.
TYPICAL_SAMPLES = 256

#: Kind of stiffness to its probability.
STIFFNESS_PROBABILITIES = {"hardening": 0.5, "softening": 0.25, "double-well": 0.25}

# The following ranges are log-uniform.

#: Period of small motions [samples].
PERIOD_RANGE = (6.0, 60.0)

#: Damping ratio.
DAMPING_RANGE = (0.002, 0.3)

#: b X²/a of a hardening spring.
HARDENING_RANGE = (0.1, 5.0)

#: -b X²/a of a softening spring, whose force must not fall within X.
SOFTENING_RANGE = (0.05, 0.3)

#: Position of the wells of a double-well oscillator [X].
WELL_RANGE = (0.3, 0.7)

#: Limit of the input, divided by the static force that holds the oscillator at X.
DRIVE_RANGE = (0.02, 1.0)

#: Standard deviation σ_v of the sensor's noise [range of the output].
SENSOR_NOISE_RANGE = (1e-4, 1e-2)

#: Process noise σ_w divided by σ_v.
NOISE_RATIO_RANGE = (0.1, 10.0)

#: Half width of the guess, relative.
GUESS_HALF_WIDTH_RANGE = (0.1, 0.6)

#: Length of an episode [samples].
EPISODE_SAMPLES_RANGE = (64, 1024)

#: Largest RMS of the input, where its energy is limited [limit of the input].
RMS_RANGE = (0.1, 0.5)

#: Kind of sensor to its probability.
SENSOR_PROBABILITIES = {"displacement": 0.7, "velocity": 0.3}

#: Probability that the energy of the input is limited.
LIMITED_ENERGY_PROBABILITY = 0.25

#: Probability that the noises are known.
KNOWN_NOISES_PROBABILITY = 0.25

#: Largest RMS displacement by process noise alone [X].
MAX_NOISE_DISPLACEMENT = 0.15


class FamilyMember(NamedTuple):
    """An oscillator of the family.

    Attributes:
        stiffness: a key of `STIFFNESS_PROBABILITIES`.
        period: of small motions [samples].
        damping: damping ratio.
        drive: the input's limit divided by the static force at X.
        options: of ``Rig-v0``.
    """

    stiffness: str
    period: float
    damping: float
    drive: float
    options: dict[str, Any]


def draw_oscillator(rng: np.random.Generator) -> FamilyMember:
    """Draw an oscillator of the family.

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
    # Linear and cubic stiffness, and the stiffness of small motions, up to a common factor.
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
    # RMS displacement by white noise alone, at the end of the episode or in equilibrium with damping.
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
