"""Records of the rigs: what a user's instrument would write, the rig file, and what the record could tell at best.

That is the Cramér-Rao bound of m, c, a and b from one record, the noises known and the state at its start unknown. The
sensitivities of the outputs, taken along the path that the oscillator went, are whitened by the Kalman filter of the
linearised motion. What the noises' dependence on the parameters would add is left out: it does not grow as noises
shrink.
"""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit

from benchmarks.rigs.catalogue import PARAMETERS, SAMPLES, Bench
from benchmarks.rigs.simulator import KINDS, FloatArray, paths, sensor, simulate

GUESS_SPREAD = 0.3
#: Recorded samples that are cut at either end of what a filter has gone over.
_MARGIN = 100
_STREAMS = {"input": 0, "noise": 1, "guess": 2, "fault": 3}


@dataclass(frozen=True)
class Record:
    """What is recorded of a rig, and the path that it went.

    Attributes:
        bench: of which rig.
        u, y: (T,) as recorded.
        states: (N, 2) x and x' at each sample of the integration.
        force, slope: (N - 1,) what acted.
        ends: (N,) accelerations; see `simulate`.
    """

    bench: Bench
    u: FloatArray
    y: FloatArray
    states: FloatArray
    force: FloatArray
    slope: FloatArray
    ends: FloatArray

    @cached_property
    def deviations(self) -> FloatArray:
        """(4,) Cramér-Rao bound of m, c, a and b, relative; a sensor's offset is unknown where there is one.

        Of a rig that decimates, that of the record before its filter.
        """
        bench = self.bench
        step = bench.step / bench.decimate
        moved = paths(bench.parameters, self.force, self.slope, self.states[:-1], step, bench.scale)
        by_state, by_force = sensor(bench.kind, bench.parameters, self.states)
        direct = np.zeros((len(self.states), 5 if bench.offset else 4))
        direct[:, 4:] = 1.0
        if bench.kind == "acceleration":
            m, c, a, b = bench.truth
            x, v = self.states.T
            direct[:, :4] = -np.stack([self.ends, c * v / m, a * x / m, b * x**3 / m], axis=1)
            by_force[0] = 0.0
        found = information(
            moved, by_state, by_force, direct, bench.process_noise**2, bench.sensor_noise**2, bench.scale
        )
        return deviations(found)


@njit(cache=True)
def information(moved, by_state, by_force, direct, process, sensor, spread):  # type: ignore[no-untyped-def]
    """Fisher information of P unknowns, of which the four parameters come first.

    Args:
        moved: (T, 7, 2) of `simulator.paths`.
        by_state: (T + 1, 2) derivatives of the outputs by the state.
        by_force: (T + 1,) by the process noise that acted before.
        direct: (T + 1, P) by the unknowns, at a given state.
        process: variance of the force held over a sample.
        sensor: variance of the sensor's noise.
        spread: (2,) standard deviations of the state at the start.
    """
    unknowns = direct.shape[1]
    found = np.zeros((unknowns, unknowns))
    paths = np.zeros((2, unknowns))
    P = np.diag(spread**2)
    for k in range(len(by_state)):
        h = by_state[k]
        added = np.zeros(2)
        variance = sensor
        if k > 0:
            through = moved[k - 1, :2].T.copy()
            paths = through @ paths
            paths[:, :4] += moved[k - 1, 3:].T
            P = through @ P @ through.T + process * np.outer(moved[k - 1, 2], moved[k - 1, 2])
            added = process * by_force[k] * moved[k - 1, 2]
            variance += 2 * (h @ added) + process * by_force[k] ** 2
        cross = P @ h + added
        variance += h @ P @ h
        news = h @ paths + direct[k]
        found += np.outer(news, news) / variance
        paths -= np.outer(cross, news) / variance
        P = P - np.outer(cross, cross) / variance
        P = 0.5 * (P + P.T)
    return found


def deviations(found: FloatArray) -> FloatArray:
    """(4,) least standard deviations of m, c, a and b, relative to each; the other unknowns are marginalised."""
    scale = np.sqrt(np.diag(found))
    if not (scale > 0).all():
        return np.full(4, np.inf)
    variances = np.diag(np.linalg.pinv(found / np.outer(scale, scale), hermitian=True, rcond=1e-13))
    return np.asarray(np.sqrt(variances)[:4] / scale[:4])


def generator(bench: Bench, seed: int, stream: str) -> np.random.Generator:
    """Random numbers of a rig and a seed; faults and noises leave the others' as they are."""
    return np.random.default_rng([seed, _STREAMS[stream], *bench.name.encode()])


def record(bench: Bench, seed: int, samples: int = SAMPLES, late: int = 0, interpolation: str = "zero_order") -> Record:
    """Simulate a record from rest.

    Args:
        bench: the rig.
        seed: of input and noises.
        samples: recorded.
        late: samples by which the input acts later than is recorded.
        interpolation: as it is: ``zero_order``, or ``linear``.
    """
    margin = _MARGIN if bench.decimate > 1 else 0
    u = bench.excitation(generator(bench, seed, "input"), samples + 2 * margin)
    rng = generator(bench, seed, "noise")
    w, noise = bench.process_noise * rng.standard_normal(len(u) - 1), bench.sensor_noise * rng.standard_normal(len(u))
    step = bench.step / bench.decimate
    acting = np.r_[np.zeros(late), u[: len(u) - late]]
    slope = np.diff(acting) / step if interpolation == "linear" else np.zeros(len(u) - 1)
    force = acting[:-1] + w
    states, ends = simulate(bench.parameters, force, slope, np.array([bench.rest, 0.0]), step, bench.scale)
    place = KINDS.index(bench.kind)
    y = (ends if place == 2 else states[:, place]) + bench.offset + noise
    if np.abs(y).max() > bench.output_range:
        raise OverflowError(f"rig {bench.name} leaves its range: {np.abs(y).max():.3g} of {bench.output_range}")
    kept = slice(margin, margin + samples)
    if bench.decimate > 1:  # an input that is held stands, at the instant of a sample, between the last value and this
        u = (np.r_[u[0], u[:-1]] + u) / 2
    return Record(
        bench, decimated(u, bench.decimate)[kept], decimated(y, bench.decimate)[kept], states, force, slope, ends
    )


def decimated(series: FloatArray, by: int) -> FloatArray:
    """Every ``by``-th sample, behind a long anti-alias filter without delay: for inputs and outputs alike.

    The page of the beam says why.
    """
    if by == 1:
        return series
    from scipy.signal import firwin, resample_poly

    return np.asarray(
        resample_poly(series, 1, by, window=firwin(2 * _MARGIN * by + 1, 1 / by, window=("kaiser", 12.0)))
    )


def guess(bench: Bench, seed: int) -> dict[str, tuple[float, float]]:
    """Intervals of ±30 % about guesses that are off by up to ±30 %."""
    off = 1 + generator(bench, seed, "guess").uniform(-GUESS_SPREAD, GUESS_SPREAD, len(PARAMETERS))
    centers = dict(zip(PARAMETERS, (np.array(bench.truth) * off).tolist(), strict=True))
    return {name: tuple(sorted((0.7 * center, 1.3 * center))) for name, center in centers.items()}  # type: ignore[misc]


def write_record(path: Path, u: FloatArray, y: FloatArray) -> None:
    """A CSV file with a header and 10 digits."""
    np.savetxt(path, np.column_stack([u, y]), fmt="%.10g", delimiter=",", header="u,y", comments="")


def write_rig(path: Path, bench: Bench, intervals: dict[str, tuple[float, float]] | None, **changed: Any) -> None:
    """The rig file, as a user would write it; ``changed`` replaces step or interpolation."""
    settings: dict[str, Any] = {"step": bench.step, "interpolation": bench.interpolation, "delay": 0} | changed
    lines = [f"{name} = {value!r}" for name, value in settings.items()]
    lines += ["", "[input]", f'unit = "{bench.units[0]}"', f"limit = {bench.limit!r}"]
    lines += ["", "[output]", f'unit = "{bench.units[1]}"', f'kind = "{bench.kind}"', f"range = {bench.output_range!r}"]
    if intervals is not None:
        lines += ["", "[guess]", *(f"{name} = [{low!r}, {high!r}]" for name, (low, high) in intervals.items())]
    path.write_text("\n".join(lines).replace("'", '"') + "\n", encoding="utf-8")
