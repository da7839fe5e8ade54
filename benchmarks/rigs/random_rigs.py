"""`identify` without a guess on random rigs, and on records in difficult situations.

The rigs have a hardening, a softening or a two-well spring, a sensor of displacement, velocity or acceleration, a
binary input or a sweep, and the noises and converters of instruments. The other classes are records that leave
parameters open or begin at rest: one settled sine, two of them, hammer blows, and two wells alone.

The same seed gives the same record on every machine and in every version.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from agents import console_output
from benchmarks.rigs.bench_catalogue import PARAMETERS
from benchmarks.rigs.calibration import INTERVAL_PROBABILITY, compare_to_truth, run_in_processes
from benchmarks.rigs.dop853_simulator import SENSOR_KINDS, FloatArray, simulate
from estimator.rigs.channel import Channel
from estimator.rigs.rig import Rig

#: Springs of the random rigs.
SPRINGS = ("hardening", "softening", "wells")

#: Kind of an output to its SI unit.
UNIT_OF_KIND = {"displacement": "m", "velocity": "m/s", "acceleration": "m/s²"}

#: Samples of a record of a random rig.
N_SAMPLES = 4000

#: Samples of a record of a settled sine.
N_SINE_SAMPLES = 4000

#: Largest error of each parameter in a right result, in stated standard deviations.
MAX_RIGHT_STDS = 4.0

#: Standard deviation of the sensor noise in the other classes, relative to the output.
SENSOR_NOISE_FRACTION = 0.002


@dataclass(frozen=True)
class RandomRig:
    """A rig and its records.

    Attributes:
        truth: true m, c, a and b, in SI units.
        rig: the rig as a user describes it, without a guess.
        records: pairs of inputs (T,) and outputs (T,).
        description: the rig in words.
    """

    truth: tuple[float, float, float, float]
    rig: Rig
    records: tuple[tuple[FloatArray, FloatArray], ...]
    description: str = ""


@dataclass(frozen=True)
class IdentificationOutcome:
    """The result of `identify` on a random rig.

    Attributes:
        error: (4,) relative errors of m, c, a and b.
        z: (4,) errors in stated standard deviations.
        inside: (4,) whether the 90 % intervals hold the truth.
        warnings: names of the warnings.
        open: parameters that are named as not identified.
        seconds: run time [s].
        failure: message of an exception; empty without one.
    """

    error: list[float]
    z: list[float]
    inside: list[bool]
    warnings: list[str] = field(default_factory=list)
    open: list[str] = field(default_factory=list)
    seconds: float = 0.0
    failure: str = ""

    @property
    def is_right(self) -> bool:
        """Whether all four are within `MAX_RIGHT_STDS` standard deviations."""
        return not self.failure and max(map(abs, self.z)) <= MAX_RIGHT_STDS


def _seeded_rng(class_name: str, seed: int) -> np.random.Generator:
    """Random numbers of a class and a seed."""
    return np.random.default_rng([seed, *class_name.encode()])


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """A random number that is uniform in the logarithm."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _quantise(values: FloatArray, bits: int) -> FloatArray:
    """Values quantised by a converter whose range is 1.2 times the largest value."""
    step = 2.4 * np.abs(values).max() / 2**bits
    return np.asarray(step * np.round(values / step))


def _rest_displacement(truth: Sequence[float]) -> float:
    """Displacement at rest: of two wells, the right one."""
    return math.sqrt(-truth[2] / truth[3]) if truth[2] < 0 else 0.0


def _simulate_output(truth: tuple[float, float, float, float], u: FloatArray, w: FloatArray, step: float, kind: str,
            linear: bool = False, start: tuple[float, float] | None = None) -> FloatArray:  # fmt: skip
    """Outputs (T,) for inputs (T,), held or linear, and held disturbances (T,).

    Raises:
        OverflowError: where the oscillator escapes.
    """
    size = max(np.abs(u).max() / max(abs(truth[2]), 1e-12), 1e-9)
    slope = np.diff(u) / step if linear else np.zeros(len(u) - 1)
    states, ends = simulate(
        np.array([*truth, 0.0]), u[:-1] + w[:-1], slope, np.array(start or (_rest_displacement(truth), 0.0)), step,
        np.array([size, size / step]),
    )  # fmt: skip
    return np.asarray(ends if kind == "acceleration" else states[:, SENSOR_KINDS.index(kind)])


def draw_rig(seed: int, spring: str = "", kind: str = "") -> RandomRig:
    """A random rig with 14 to 100 samples per period, a damping ratio of 0.003 to 0.15, and typical instruments.

    The sensor noise is 0.015 to 2.7 % of the output, the disturbance 0.03 to 2.7 % of the input, and the converter has
    12, 14 or 16 bits.

    Args:
        seed: of the random numbers, and of spring and sensor where these are empty.
        spring: one of `SPRINGS`.
        kind: kind of the output.
    """
    spring, kind = spring or SPRINGS[seed % 3], kind or SENSOR_KINDS[seed // 3 % 3]
    for attempt in range(200):
        rng = _seeded_rng(f"rigs {spring} {kind} {attempt}", seed)
        m, frequency = _log_uniform(rng, 0.02, 20.0), _log_uniform(rng, 2.0, 200.0)
        per_period, zeta = _log_uniform(rng, 14.0, 100.0), _log_uniform(rng, 0.003, 0.15)
        w0, step = 2 * np.pi * frequency, 1 / (frequency * per_period)
        stiffness, size = m * w0**2, _log_uniform(rng, 1e-4, 1e-2)
        # The cubic force relative to the linear force at the size; two wells are one size away from the hill.
        part = rng.uniform(0.1, 0.8)
        a = {"wells": -stiffness / 2}.get(spring, stiffness)
        b = {"hardening": part, "softening": -0.3 * part, "wells": 0.5}[spring] * stiffness / size**2
        truth = (m, 2 * zeta * m * w0, a, b)
        if rng.random() < 0.5:
            shortest, longest = max(2, per_period / 8), per_period / 3 + 3
            hold = int(rng.integers(shortest, longest))  # type: ignore[call-overload]
            shape, u = "binary", np.repeat(rng.choice([-1.0, 1.0], N_SAMPLES // hold + 1), hold)[:N_SAMPLES]
        else:
            times = np.arange(N_SAMPLES) / N_SAMPLES
            low, high = 0.3 * frequency, 2.5 * frequency
            turns = N_SAMPLES * step * (low * times + (high - low) * times**2 / 2)
            shape, u = "sweep", np.sin(2 * np.pi * turns + rng.uniform(0, 2 * np.pi))
        u = u * stiffness * size * {"hardening": 0.6, "softening": 0.15, "wells": 0.5}[spring] * rng.uniform(0.5, 1.5)
        noise, disturbance = _log_uniform(rng, 1.5e-4, 0.027), _log_uniform(rng, 3e-4, 0.027)
        w = disturbance * u.std() * rng.standard_normal(N_SAMPLES)
        bits = int(rng.choice([12, 14, 16]))
        try:
            clean = _simulate_output(truth, u, w, step, kind)
        except OverflowError:
            continue
        moved = _simulate_output(truth, u, w, step, "displacement") if kind != "displacement" else clean
        if (spring == "softening" and np.abs(moved).max() > 0.9 * math.sqrt(-a / b)) or clean.std() == 0:
            continue
        if spring == "wells" and np.count_nonzero(np.diff(np.sign(moved))) < 10:  # it stays in one well
            continue
        y = _quantise(clean + noise * clean.std() * rng.standard_normal(N_SAMPLES), bits)
        rig = Rig(step, input=Channel("N"), output=Channel(UNIT_OF_KIND[kind], kind=kind))
        about = f"{spring} {kind} {shape}, {per_period:.0f} a period, zeta {zeta:.3f}, {bits} bit"
        return RandomRig(truth, rig, ((u, y),), about)
    raise RuntimeError(f"seed must give a rig within 200 attempts, but {seed} does not; take another")


def _draw_oscillator(rng: np.random.Generator) -> tuple[tuple[float, float, float, float], float]:
    """A hardening oscillator near 11 Hz, and its angular frequency."""
    m, w0 = rng.uniform(0.2, 0.6), 2 * np.pi * rng.uniform(8.0, 15.0)
    return (m, 2 * rng.uniform(0.008, 0.03) * m * w0, m * w0**2, _log_uniform(rng, 5e3, 5e4) * m * w0**2), float(w0)


def _settling_sine(truth: tuple[float, ...], w0: float, amplitude: float, part: float, phase: float) -> FloatArray:
    """Inputs of a sine, with 20 time constants of the decay before the last `N_SINE_SAMPLES`."""
    m, c, _, _ = truth
    before = int(20 * m / c / 1e-3)
    times = 1e-3 * (np.arange(before + N_SINE_SAMPLES) - before)
    return np.asarray(amplitude * np.sin(part * w0 * times + phase))


def draw_settled_sines(seed: int, count: int = 1) -> RandomRig:
    """One or two settled sines of moderate amplitude, at 0.5 to 1.3 times the frequency of small oscillations.

    Two sines have the same frequency, and amplitudes that differ by a factor of 2 to 4.
    """
    rng = _seeded_rng("sines", seed)
    truth, w0 = _draw_oscillator(rng)
    part, phase, first = rng.uniform(0.5, 1.3), rng.uniform(0, 2 * np.pi), _log_uniform(rng, 0.1, 0.6)
    rig, records = Rig(1e-3, "linear", input=Channel("N"), output=Channel("m")), []
    for amplitude in (first, first * rng.uniform(2.0, 4.0))[:count]:
        u = _settling_sine(truth, w0, amplitude, part, phase)
        y = _simulate_output(truth, u, np.zeros(len(u)), 1e-3, "displacement", linear=True)[-N_SINE_SAMPLES:]
        records.append((u[-N_SINE_SAMPLES:], y + SENSOR_NOISE_FRACTION * y.std() * rng.standard_normal(N_SINE_SAMPLES)))
    about = f"{part:.2f} f0, {first:.2f} N"
    return RandomRig(truth, rig, tuple(records), about)


def draw_two_sines(seed: int) -> RandomRig:
    """Two settled sines of different amplitudes."""
    return draw_settled_sines(seed, 2)


def draw_hammer_blows(seed: int) -> RandomRig:
    """Four hammer blows of 3 ms in 3 s, measured by vibrometer or accelerometer in turns, at 8 to 16 kHz."""
    rng = _seeded_rng("hammer", seed)
    kind, truth = ("velocity", "acceleration")[seed % 2], _draw_oscillator(rng)[0]
    rate = float(rng.choice([8e3, 1e4, 12.8e3, 16e3]))
    u, times = np.zeros(int(3 * rate)), np.arange(int(3 * rate)) / rate
    for begin in (0.06, 0.82, 1.64, 2.22):
        place = begin + rng.uniform(-0.04, 0.04)
        inside = (times > place) & (times < place + 3e-3)
        u[inside] = rng.uniform(80.0, 140.0) * np.sin(np.pi * (times[inside] - place) / 3e-3) ** 2
    y = _simulate_output(truth, u, np.zeros(len(u)), 1 / rate, kind, linear=True)
    y = y + SENSOR_NOISE_FRACTION * y.std() * rng.standard_normal(len(y))
    rig = Rig(1 / rate, "linear", input=Channel("N"), output=Channel(UNIT_OF_KIND[kind], kind=kind))
    return RandomRig(truth, rig, ((u, y),), f"{kind}, {rate:g} Hz")


#: Class to the function that draws a rig from a seed.
RECORD_CLASSES: dict[str, Callable[[int], RandomRig]] = {
    "rigs": draw_rig,
    "sines": draw_settled_sines,
    "pairs": draw_two_sines,
    "hammer": draw_hammer_blows,
    "wells-velocity": lambda seed: draw_rig(seed, "wells", "velocity"),
    "wells-acceleration": lambda seed: draw_rig(seed, "wells", "acceleration"),
}


def run_trial(task: tuple[str, int]) -> IdentificationOutcome:
    """Draw a rig and identify it; the task is class and seed."""
    from estimator import identify

    name, seed = task
    random_rig = RECORD_CLASSES[name](seed)
    begun = time.perf_counter()
    try:
        result = identify(random_rig.rig, list(random_rig.records))
    except ValueError as failure:
        return IdentificationOutcome([math.inf] * 4, [math.inf] * 4, [False] * 4, failure=str(failure))
    seconds = time.perf_counter() - begun
    truth = np.array(random_rig.truth)
    error, std, inside = compare_to_truth(result.parameters, result.interval(INTERVAL_PROBABILITY), truth)
    unidentified = [w.message.partition(":")[0].split(", ") for w in result.warnings if w.name == "not_identified"]
    names = [warning.name for warning in result.warnings]
    z = np.divide(error * truth, std, out=np.full(4, math.inf), where=std > 0)
    return IdentificationOutcome(
        error.tolist(), z.tolist(), inside.tolist(), names, unidentified[0] if unidentified else [], seconds
    )


def run_trials(classes: Sequence[str], count: int, first: int, workers: int) -> dict[str, list[IdentificationOutcome]]:
    """Class to the outcomes of ``count`` seeds from ``first`` on."""
    tasks = [(name, seed) for name in classes for seed in range(first, first + count)]
    found = run_in_processes(_run_task, tasks, 1, workers, "Identifying")
    return {name: [found[name, seed][0] for seed in range(first, first + count)] for name in classes}


def _run_task(task: tuple[str, int, int]) -> IdentificationOutcome:
    """`run_trial` for `run_in_processes`, which adds a seed."""
    return run_trial(task[:2])


def print_report(found: dict[str, list[IdentificationOutcome]], first: int) -> dict[str, Any]:
    """Print a row for each class, and for each spring and sensor of random rigs; return the rows for the JSON file."""
    rows = dict[str, list[IdentificationOutcome]]()
    for name, answers in found.items():
        rows[name] = answers
        if name == "rigs":
            for seed, answer in enumerate(answers, first):
                rows.setdefault(f"{SPRINGS[seed % 3]} {SENSOR_KINDS[seed // 3 % 3]}", []).append(answer)
    lines, kept = [], {}
    for name, answers in rows.items():
        one = kept[name] = summarise(answers)
        lines.append((
            name, *(str(one[key]) for key in ("records", "right", "refused", "warned", "silent and wrong")),
            f"{one['coverage, silent']:.3f}", ", ".join(f"{100 * e:.2g}" for e in one["median errors"]),
        ))  # fmt: skip
    titles = ("", "n", "right", "refused", "warned", "silent wrong", "cover", "median errors, %")
    console_output.print_texts_and_tables(console_output.format_table(titles, lines, markdown=True))
    return kept


def summarise(answers: Sequence[IdentificationOutcome]) -> dict[str, Any]:
    """Counts, coverage of the 90 % intervals among results without a warning, and median errors."""
    silent = [one for one in answers if not one.warnings and not one.failure]
    # A parameter that is named as not identified is no claim.
    claims = [hit for one in answers if set(one.warnings) <= {"not_identified"} and not one.failure
              for p, hit in zip(PARAMETERS, one.inside, strict=True) if p not in one.open]  # fmt: skip
    return {
        "records": len(answers),
        "right": sum(one.is_right for one in answers),
        "right and silent": sum(one.is_right for one in silent),
        "refused": sum(bool(one.failure) for one in answers),
        "warned": sum(bool(one.warnings) for one in answers),
        "silent and wrong": sum(not one.is_right for one in silent),
        "coverage, silent": float(np.mean([one.inside for one in silent])) if silent else math.nan,
        "coverage, claims": float(np.mean(claims)) if claims else math.nan,
        "c given": sum(not one.failure and "c" not in one.open for one in answers),
        "median errors": np.median(np.abs([one.error for one in answers]), axis=0).tolist(),
        "median seconds": float(np.median([one.seconds for one in answers])),
    }
