"""Records as instruments write them: a file for each, and the correct answer.

Each kind is a function that simulates a record by a method of its own, and writes it as its instrument would.
"""

from __future__ import annotations

import io
import re
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.commands.rig_file_builder import rig_text_from_record
from estimator import Result, Rig, identify

Floats = NDArray[np.float64]

#: Names of columns that need no more words.
SI = ("time [s]", "force [N]", "displacement [m]")
LIGHT, HEAVY = (0.35, 0.8, 1800.0, 3e7), (0.9, 1.3, 7200.0, 9e7)


@dataclass(frozen=True)
class Made:
    """A user's files and commands.

    Attributes:
        files: name to content, in the order in which they are given.
        truth: m, c, a and b in SI units; in V and m for a coil.
        init: further arguments of `agents.commands.rig_file_builder.rig_text_from_record`.
        interpolation: that the user writes into the rig.
        delay: the same.
    """

    files: dict[str, bytes]
    truth: tuple[float, ...]
    init: dict[str, Any] = field(default_factory=dict)
    interpolation: str = "zero_order"
    delay: float = 0


@dataclass(frozen=True)
class Case:
    """A kind of record with numbers.

    Attributes:
        kind: name of the function that makes it.
        numbers: arguments of the function.
        answer: ``right``, which is all of m, c, a and b within four deviations and no warning; or the name of one.
        then: the same after the rig was changed as the checks advise; where it is empty that is no part of the case.
        seed: of inputs and noise.
    """

    kind: str
    numbers: dict[str, Any]
    answer: str
    then: str = ""
    seed: int = 0

    def make(self) -> Made:
        """The record."""
        return KINDS[self.kind](np.random.default_rng([self.seed, *self.kind.encode()]), **self.numbers)

    def __str__(self) -> str:
        numbers = ", ".join(_label(*one) for one in self.numbers.items())
        return self.kind.replace("_", " ") + (numbers and f": {numbers}")

    def check(self, folder: Path) -> None:
        """Assert that the answer is right; ``folder`` is for the files."""
        answers = list(islice(answered(self.make(), folder), 4 if self.then else 1))
        for expected, (verdict, result) in (
            (self.answer, answers[0]),
            *([(self.then, answers[-1])] if self.then else []),
        ):
            names = [warning.name for warning in result.warnings]
            assert verdict == "right" and not names if expected == "right" else expected in names, (verdict, names)


def _label(name: str, value: Any) -> str:
    """An argument in a few words."""
    match name:
        case "names":
            return ", ".join(value)
        case "truth":
            return f"m {value[0]:g} kg"
        case _:
            return f"{name} {value:g}" if isinstance(value, float) else f"{name} {value}"


def answered(made: Made, folder: Path) -> Iterator[tuple[str, Result]]:
    """Verdict and result of `identify` at first, and after each change of the rig that it advises.

    The verdict is ``right``, ``named`` or ``silent``.
    """
    paths = [folder / name for name in made.files]
    for path in paths:
        path.write_bytes(made.files[path.name])
    described, _ = rig_text_from_record(paths[0], **made.init)
    rig: Rig | None = replace(
        Rig.from_dict(tomllib.loads(described)), interpolation=made.interpolation, delay=made.delay
    )
    while rig is not None:
        result = identify(rig, paths)
        truth = dict(zip("mcab", made.truth, strict=True))
        if result.is_free_decay:
            truth = {f"{name}/m": truth[name] / truth["m"] for name in "cab"}
        off = [abs(result.parameters[p][0] - value) / result.parameters[p][1] for p, value in truth.items()]
        yield "right" if np.nanmax(off) <= 4.0 else "named" if result.warnings else "silent", result
        rig = advised(rig, result)


def whole(written: str) -> float:
    """A delay as a rig takes it."""
    value = float(written)
    return int(value) if value.is_integer() else value


def advised(rig: Rig, result: Result) -> Rig | None:
    """The rig with the interpolation and delay that a warning names; None where no warning names one."""
    for warning in result.warnings:
        if found := re.search(r"'(\w+)' with delay (\S+?)(?:, and a lag of (\S+) s)?, by", warning.message):
            lag = float(found[3]) if found[3] else None
            return replace(rig, interpolation=found[1], delay=whole(found[2]), input=replace(rig.input, lag=lag))
        if found := re.search(r"write delay = (\S+) into the rig", warning.message):
            return replace(rig, delay=whole(found[1]))
    return None


def moved(
    truth: tuple[float, ...], forces: Floats, times: Floats, start: float = 0.0, quadratic: float = 0.0,
    friction: float = 0.0,
) -> tuple[Floats, Floats]:  # fmt: skip
    """Displacements and velocities (T,) by Runge and Kutta's method, from a displacement ``start`` at rest.

    Args:
        truth: m, c, a and b.
        forces: (T - 1, 2 n + 1) at the ends and middles of n steps between two times.
        times: (T,) [s].
        start: displacement [m].
        quadratic: stiffness [N/m²].
        friction: the dry one [N].
    """
    m, c, a, b = truth
    states = [(start, 0.0)]
    x, v = states[0]

    def acceleration(x: float, v: float, force: float) -> float:
        rubbing = friction * np.tanh(v / 5e-4) if friction else 0.0
        return (force - rubbing - c * v - x * (a + x * (quadratic + b * x))) / m

    for row, step in zip(forces.tolist(), np.diff(times).tolist(), strict=True):
        h = 2 * step / (len(row) - 1)
        for k in range(0, len(row) - 1, 2):
            before, middle, after = row[k : k + 3]
            a1 = acceleration(x, v, before)
            v2 = v + h / 2 * a1
            a2 = acceleration(x + h / 2 * v, v2, middle)
            v3 = v + h / 2 * a2
            a3 = acceleration(x + h / 2 * v2, v3, middle)
            v4 = v + h * a3
            a4 = acceleration(x + h * v3, v4, after)
            x, v = x + h / 6 * (v + 2 * v2 + 2 * v3 + v4), v + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
        states.append((x, v))
    found = np.array(states)
    return found[:, 0], found[:, 1]


def grid(times: Floats, steps: int) -> Floats:
    """(T - 1, 2 steps + 1) times of the forces for `moved`."""
    return times[:-1, None] + np.diff(times)[:, None] * np.linspace(0.0, 1.0, 2 * steps + 1)


def held(u: Floats, steps: int) -> Floats:
    """Forces for `moved` of a converter that holds them."""
    return np.repeat(u[:-1, None], 2 * steps + 1, axis=1)


def levels(rng: np.random.Generator, samples: int, hold: int, size: float = 5.0) -> Floats:
    """(T,) inputs, held for some samples."""
    return np.repeat(rng.uniform(-size, size, -(-samples // hold)), hold)[:samples]


def smooth(rng: np.random.Generator, highest: float, size: float = 2.0) -> Callable[[Floats], Floats]:
    """A sum of sines up to a frequency [Hz]."""
    frequencies, phases = rng.uniform(0.5, highest, 60), rng.uniform(0, 2 * np.pi, 60)
    return lambda t: size * np.sqrt(2 / 60) * sum(
        np.sin(2 * np.pi * f * t + phase) for f, phase in zip(frequencies, phases, strict=True)
    )  # fmt: skip


def noisy(rng: np.random.Generator, y: Floats, part: float = 0.002) -> Floats:
    return y + part * y.std() * rng.standard_normal(len(y))


def frequency(truth: tuple[float, ...]) -> float:
    """Of small oscillations [Hz]."""
    return float(np.sqrt(truth[2] / truth[0]) / (2 * np.pi))


def text(names: tuple[str, ...], *columns: Floats, digits: int = 9, separator: str = ",") -> str:
    rows = [separator.join(f"{value:.{digits}g}" for value in row) for row in zip(*columns, strict=True)]
    return "\n".join([separator.join(names), *rows, ""])


def driven(
    rng: np.random.Generator, truth: tuple[float, ...], samples: int, step: float = 1e-3, **others: float
) -> tuple[Floats, Floats, Floats]:
    """Times, held inputs and noisy displacements."""
    times = step * np.arange(samples)
    u = levels(rng, samples, 8, 5.0 * truth[2] / 1800.0)
    return times, u, noisy(rng, moved(truth, held(u, 3), times, **others)[0])


def settled_sine(rng, part=0.8, size=0.5, truth=LIGHT):
    """One sine, after it settled."""
    step, omega = 1e-3, 2 * np.pi * part * frequency(truth)
    times = step * np.arange(int(20 * truth[0] / truth[1] / step) + 4000)
    phase = rng.uniform(0, 2 * np.pi)
    y = moved(truth, size * np.sin(omega * grid(times, 2) + phase), times)[0][-4000:]
    u = size * np.sin(omega * times[-4000:] + phase)
    return Made({"r.csv": text(SI, times[:4000], u, noisy(rng, y)).encode()}, truth, {}, "linear")


def time_unit(rng, names=("time_ms", "force_N", "disp_mm"), truth=LIGHT):
    """A unit of time, and of displacement, in the names alone."""
    t, u, y = driven(rng, truth, 2000)
    scale = 1e3 if "ms" in names[0] else 1e6
    return Made({"r.csv": text(names, scale * t, u, 1e3 * y if "mm" in names[2] else y).encode()}, truth)


def quadratic(rng, square=3600.0, b=0.0, truth=LIGHT):
    """A spring with a quadratic term."""
    truth = (*truth[:3], b)
    return Made({"r.csv": text(SI, *driven(rng, truth, 6000, quadratic=square)).encode()}, truth)


def hammer(rng, kind="acceleration", rate=1e4, truth=LIGHT):
    """Four blows of 3 ms, without gaps."""
    t = np.arange(int(3 * rate)) / rate
    begins, sizes = np.array([0.06, 0.82, 1.64, 2.22]) + rng.uniform(-0.04, 0.04, 4), rng.uniform(80, 140, 4)

    def blows(at):
        return sum(
            np.where((at > b) & (at < b + 3e-3), size * np.sin(np.pi * (at - b) / 3e-3) ** 2, 0.0)
            for b, size in zip(begins, sizes, strict=True)
        )

    x, v = moved(truth, blows(grid(t, 1)), t)
    m, c, a, b = truth
    y, unit = (v, "m/s") if kind == "velocity" else ((blows(t) - c * v - a * x - b * x**3) / m, "m/s²")
    names = ("time [s]", "force [N]", f"{kind} [{unit}]")
    return Made({"r.csv": text(names, t, blows(t), noisy(rng, y), digits=7).encode()}, truth, {}, "linear")


def short_blows(rng, step=1e-3, lasting=4e-3, truth=LIGHT):
    """Blows that few samples see."""
    t = step * np.arange(3000)
    begins = np.array([0.1, 0.9, 1.7, 2.3]) + rng.uniform(0, step, 4)
    shape = lambda at: sum(  # noqa: E731
        np.where((at > b) & (at < b + lasting), 100 * np.sin(np.pi * (at - b) / lasting) ** 2, 0.0) for b in begins
    )
    y = noisy(rng, moved(truth, shape(grid(t, 8)), t)[0])
    return Made({"r.csv": text(SI, t, shape(t), y).encode()}, truth, {}, "linear")


def smooth_force(rng, step=2e-3, samples=3000, truth=LIGHT):
    """A measured, smooth force, up to 3.5 times the frequency of the oscillator."""
    t, force = step * np.arange(samples), smooth(rng, 3.5 * frequency(truth))
    y = noisy(rng, moved(truth, force(grid(t, 4)), t)[0])
    return Made({"r.csv": text(SI, t, force(t), y).encode()}, truth)


def half_sample(rng, smoothly=False, step=2.19e-3, part=0.5, samples=5998, truth=LIGHT):
    """The output is sampled a part of a step after the input."""
    t = step * np.arange(samples)
    both = np.sort(np.concatenate([t, t + part * step]))
    if smoothly:
        force = smooth(rng, 2.5 * frequency(truth))
        u, forces = force(t), force(grid(both, 2))
    else:
        u = levels(rng, samples, 5)
        forces = held(np.repeat(u, 2), 2)
    y = noisy(rng, moved(truth, forces, both)[0][1::2])
    return Made({"r.csv": text(SI, t, u, y).encode()}, truth, {}, "linear" if smoothly else "zero_order")


def voice_coil(rng, lag=0.5, truth=LIGHT):
    """A coil that a voltage drives, with a lag in samples."""
    step, constant, resistance = 1e-3, 4.0, 3.0
    m, c, a, b = truth
    t, u, n = step * np.arange(6000), levels(rng, 6000, 8), 4

    def change(state: Floats, volt: float) -> Floats:
        x, v, i = state.tolist()
        force, induced = constant * i, volt - resistance * i - constant * v
        return np.array([v, (force - c * v - a * x - b * x**3) / m, induced / (resistance * lag * step)])

    y, state, h = np.zeros(6000), np.zeros(3), step / n
    for k in range(1, 6000):
        for _ in range(n):
            d1 = change(state, u[k - 1])
            d2 = change(state + h / 2 * d1, u[k - 1])
            d3 = change(state + h / 2 * d2, u[k - 1])
            state = state + h / 6 * (d1 + 2 * d2 + 2 * d3 + change(state + h * d3, u[k - 1]))
        y[k] = state[0]
    part = resistance / constant
    seen = (part * m, part * c + constant, part * a, part * b)
    return Made({"r.csv": text(("time [s]", "drive [V]", SI[2]), t, u, noisy(rng, y)).encode()}, seen)


def filtered(rng, corner=0.16, truth=LIGHT):
    """An accelerometer with a high-pass [Hz], as an IEPE sensor has."""
    t, force = 1e-3 * np.arange(4000), smooth(rng, 2.5 * frequency(truth))
    x, v = moved(truth, force(grid(t, 3)), t)
    m, c, a, b = truth
    y = (force(t) - c * v - a * x - b * x**3) / m
    keeps, out = np.exp(-2 * np.pi * corner * 1e-3), y.copy()
    for k in range(1, 4000):
        out[k] = keeps * (out[k - 1] + y[k] - y[k - 1])
    names = (*SI[:2], "acceleration [m/s²]")
    return Made({"r.csv": text(names, t, force(t), noisy(rng, out)).encode()}, truth, {}, "linear")


def base(rng, kind="acc", truth=LIGHT):
    """A base that moves, by two accelerometers: of the mass the absolute acceleration."""
    t, force = 1e-3 * np.arange(2500), smooth(rng, 2.5 * frequency(truth), 30.0)
    m, c, a, b = truth
    x, v = moved((1.0, c / m, a / m, b / m), -force(grid(t, 3)), t)
    y = -(c * v + a * x + b * x**3) / m
    names = ("time [s]", f"input base {kind} [m/s2]", f"{kind} mass [m/s2]")
    init = {"input_column": f"input base {kind}", "output_column": f"{kind} mass"}
    return Made({"r.csv": text(names, t, force(t), noisy(rng, y)).encode()}, (np.nan, *(p / m for p in truth[1:])),
                init, "linear")  # fmt: skip


def dropouts(rng, to="zero", bursts=12, lasting=13, truth=LIGHT):
    """Bursts of zeros, or of the last value."""
    t, u, y = driven(rng, truth, 6000)
    for begin in rng.choice(5800 // 40, bursts, replace=False) * 40 + 100:
        y[begin : begin + lasting] = 0.0 if to == "zero" else y[begin - 1]
    return Made({"r.csv": text(SI, t, u, y).encode()}, truth)


def dry_friction(rng, friction=0.1, truth=LIGHT):
    """Something rubs."""
    return Made({"r.csv": text(SI, *driven(rng, truth, 6000, friction=friction)).encode()}, truth)


def repeated(rng, times=3, truth=LIGHT):
    """Each output stands for some samples."""
    t, force = 1e-3 * np.arange(6000), smooth(rng, 2.5 * frequency(truth))
    y = noisy(rng, moved(truth, force(grid(t, 3)), t)[0])
    return Made({"r.csv": text(SI, t, force(t), y[np.arange(6000) // times * times]).encode()}, truth, {}, "linear")


def free_decay(rng, start=6e-3, truth=LIGHT):
    """Let go, without an input."""
    t = 1e-3 * np.arange(3000)
    y = noisy(rng, moved(truth, np.zeros((2999, 7)), t, start=start)[0])
    return Made({"r.csv": text((SI[0], SI[2]), t, y).encode()}, truth)


def uneven(rng, step=3e-3, jitter=0.15, truth=LIGHT):
    """Right times, which are uneven."""
    t = step * (np.arange(3000) + rng.uniform(-jitter, jitter, 3000))
    u = levels(rng, 3000, 4, 5.0 * truth[2] / 1800.0)
    y = noisy(rng, moved(truth, held(u, 6), t)[0])
    return Made({"r.csv": text(SI, t, u, y).encode()}, truth)


def trigger(rng, late=150, truth=LIGHT):
    """The output is many samples late."""
    t, u, y = driven(rng, truth, 6000)
    return Made({"r.csv": text(SI, t[late:], u[late:], y[:-late]).encode()}, truth)


def two_rates(rng, factor=2, truth=LIGHT):
    """A second record with a longer step."""
    t, u, y = driven(rng, truth, 3000)
    other = 1e-3 * factor * np.arange(1500)
    drive = levels(rng, 1500, 4, 5.0 * truth[2] / 1800.0)
    seen = noisy(rng, moved(truth, held(drive, 3 * factor), other, start=2e-3)[0])
    return Made({"a.csv": text(SI, t, u, y).encode(), "b.csv": text(SI, other, drive, seen).encode()}, truth)


def realisations(rng, runs=3, truth=LIGHT):
    """A MAT file with a column for each run."""
    from scipy.io import savemat

    pairs = [driven(rng, truth, 1000)[1:] for _ in range(runs)]
    file = io.BytesIO()
    savemat(
        file, {name: np.stack(columns, axis=1) for name, columns in zip("uy", zip(*pairs, strict=True), strict=True)}
    )
    return Made({"r.mat": file.getvalue()}, truth, {"step": 1e-3})


def scope(rng, step=1e-3, truth=LIGHT):
    """Lines of metadata before the names."""
    t, u, y = driven(rng, truth, 3000, step)
    head = f"Model,SCOPE\nFirmware Version,1.2\nHorizontal Units,s\nSample Interval,{step}\nRecord Length,3000\n\n"
    init = {"input_column": "CH1", "output_column": "CH2"}
    return Made({"r.csv": (head + text(("TIME", "CH1", "CH2"), t, u, y)).encode()}, truth, init)


def lvm(rng, truth=LIGHT):
    """A file of LabVIEW's."""
    t, u, y = driven(rng, truth, 3000)
    head = "LabVIEW Measurement\t\nWriter_Version\t2\nSeparator\tTab\n***End_of_Header***\t\n"
    head += "Channels\t2\t\nSamples\t3000\t3000\t\n***End_of_Header***\t\n"
    body = text(("X_Value", "Force", "Laser"), t, u, y, separator="\t").replace("\n", "\tComment\n", 1)
    return Made({"r.csv": (head + body).encode()}, truth, {"input_column": "Force", "output_column": "Laser"})


def sep(rng, encoding="utf-8", truth=LIGHT):
    """A spreadsheet's first line, semicolons and decimal commas."""
    body = text(SI, *driven(rng, truth, 2000), separator=";").replace(".", ",")
    return Made({"r.csv": f"sep=;\n{body}".encode(encoding)}, truth)


def iso_time(rng, truth=LIGHT):
    """Dates and times of day."""
    t, u, y = driven(rng, truth, 3000)
    rows = [f"2026-05-01T23:59:{50 + s:09.6f},{a:.9g},{b:.9g}" for s, a, b in zip(t, u, y, strict=True)]
    return Made({"r.csv": "\n".join(["timestamp,force [N],displacement [m]", *rows, ""]).encode()}, truth)


def over_range(rng, step=1e-3, truth=LIGHT):
    """Units below the names, and ∞ where the output is over range, in mV."""
    t, u, y = driven(rng, truth, 3000, step)
    stop = np.quantile(np.abs(y), 1 - 0.015)
    rows = [f"{1e3 * s:.6f},{a:.9g},{'∞' if b > stop else '-∞' if b < -stop else f'{1e3 * b:.9f}'}"
            for s, a, b in zip(t, u, y, strict=True)]  # fmt: skip
    head = ["Time,Channel A,Channel B", "(ms),(V),(mV)", ""]
    return Made(
        {"r.csv": "\n".join([*head, *rows, ""]).encode()},
        truth,
        {"input_column": "Channel A", "output_column": "Channel B"},
    )


KINDS: dict[str, Callable[..., Made]] = {
    one.__name__: one
    for one in (
        settled_sine, time_unit, quadratic, hammer, short_blows, smooth_force, half_sample, voice_coil, filtered, base,
        dropouts, dry_friction, repeated, free_decay, uneven, trigger, two_rates, realisations, scope, lvm, sep,
        iso_time, over_range,
    )
}  # fmt: skip

MS = ("time_ms", "force_N", "disp_mm"), ("Time/ms", "Force/N", "Displacement/mm"), ("time_us", "u", "y")

#: The first of each kind is run by `make test`, all by `make test-research`.
CASES = (
    Case("settled_sine", {"part": 0.5, "size": 0.5}, "not_identified"),
    Case("settled_sine", {"part": 1.3, "size": 1.5}, "not_identified"),
    Case("settled_sine", {"part": 0.7, "size": 0.5}, "not_identified"),
    Case("settled_sine", {"part": 1.15, "size": 0.25}, "not_identified"),
    *(Case("time_unit", {"names": names}, "right") for names in MS),
    Case("quadratic", {"square": 3600.0}, "not_identified"),
    Case("quadratic", {"square": 18000.0}, "asymmetric"),
    Case("quadratic", {"square": 9000.0, "b": 1e6}, "asymmetric"),
    Case("quadratic", {"square": 62069.0, "b": 3e7}, "asymmetric"),
    Case("quadratic", {"square": 15517.2, "b": 3e7}, "asymmetric"),
    Case("hammer", {"kind": "acceleration", "rate": 1e4}, "right"),
    Case("hammer", {"kind": "velocity", "rate": 1e4}, "right"),
    Case("hammer", {"kind": "acceleration", "rate": 8e3}, "right"),
    Case("short_blows", {}, "short_blows"),
    Case("smooth_force", {"step": 2e-3, "samples": 3000}, "interpolation", "right"),
    Case("smooth_force", {"step": 1 / 300, "samples": 1800}, "interpolation", "right"),
    Case("half_sample", {"smoothly": False}, "delay", "right"),
    Case("half_sample", {"smoothly": True}, "interpolation", "right"),
    Case("voice_coil", {}, "lag", "lag"),
    Case("filtered", {}, "high_pass"),
    Case("base", {}, "not_identified"),
    Case("dropouts", {"to": "zero"}, "dropouts"),
    Case("dropouts", {"to": "hold"}, "dropouts"),
    Case("dry_friction", {}, "dry_friction"),
    Case("repeated", {}, "repeated"),
    Case("free_decay", {}, "right"),
    Case("uneven", {}, "right"),
    Case("trigger", {}, "delay", "right"),
    Case("two_rates", {}, "right"),
    Case("realisations", {}, "right"),
    Case("scope", {}, "right"),
    Case("scope", {"step": 8e-4, "truth": HEAVY}, "right"),
    Case("lvm", {}, "right"),
    Case("sep", {}, "right"),
    Case("iso_time", {}, "right"),
    Case("over_range", {}, "clipped"),
    Case("over_range", {"step": 8e-4, "truth": HEAVY}, "clipped"),
)
