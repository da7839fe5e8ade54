"""The records of an identification, as the engine takes them: scaled, with all ways that the input may have gone."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from estimator.identification.timing import laid
from estimator.inputs import feed
from estimator.models.duffing import DIMENSIONS, KINDS, duffing
from estimator.models.model import Model
from estimator.parameters import FloatArray
from estimator.rig import INTERPOLATIONS, Channel, Rig
from estimator.units import Scales

#: Samples by which the input may be later than the rig says: a check looks for it.
LATEST = 3

#: Parameters that an identification is for; the others are what a channel adds.
JUDGED = tuple(DIMENSIONS)

#: Terms that an equation may have beside those of Eq. (1) and the offsets: checks look for them.
EXTRA = ("cubic_damping", "quintic", "dry_friction")


#: Speed below which dry friction fades, in parts of the usual one.
_CREEP = 0.05

#: Samples of a gap that is bridged before it is known how long a period is.
_BRIDGED = 16

#: Inputs of a piece are few where they have less than so much of the power of the strongest, and all of them where they
#: have more than so much.
_FEW_INPUTS, _ALL_INPUTS = 0.25, 0.98


class Samples(NamedTuple):
    """Records as a filter takes them; a shorter one ends with NaN.

    Attributes:
        inputs: (records, N, rows) what acts over each sample.
        outputs: (records, N, 1) at its end.
        spans: (records, N) its length in sampling steps; None where all are one step.
        places: of each record, (T,) the sample that ends with each of its outputs.
    """

    inputs: FloatArray
    outputs: FloatArray
    spans: FloatArray | None
    places: tuple[npt.NDArray[np.intp], ...]


@dataclass(frozen=True, eq=False)
class Problem:
    """Records to identify a rig from.

    Attributes:
        rig: as it was given.
        scales: that the records are in.
        u: inputs of each record, in parts of their scale.
        y: outputs of each record, in parts of theirs, counted from the origin, NaN where one is missing.
        origin: where outputs are counted from, in parts of their scale: about their middle, where that is far from 0.
        substeps: steps of integration a sample.
        terms: of the equation, beside those of Eq. (1) and the offsets; some of `EXTRA`.
        times: of the samples of each record, in sampling steps from its first on; None where these are one step apart.
        loudness: of each record, the noises in parts of what they are on the whole; None where they are alike.
    """

    rig: Rig
    scales: Scales
    u: tuple[FloatArray, ...]
    y: tuple[FloatArray, ...]
    origin: float = 0.0
    substeps: int = 2
    terms: tuple[str, ...] = ()
    times: tuple[FloatArray, ...] | None = None
    loudness: FloatArray | None = None

    @cached_property
    def model(self) -> Model:
        """The rig's own, with the terms."""
        more: dict[str, Any] = dict.fromkeys(self.terms, True)
        model = duffing(offsets=True, sensor=self.rig.output.kind, **more)
        return replace(model, substeps=self.substeps)

    @property
    def believed(self) -> Model:
        """The rig's own, of which the belief is; integrated as `model` is, where that is finer."""
        own = self.rig.model
        return replace(own, substeps=self.substeps) if self.substeps > own.substeps else own

    @property
    def samples(self) -> int:
        """Outputs that were seen."""
        return int(sum(np.isfinite(y).sum() for y in self.y))

    @property
    def lag(self) -> float:
        """Time constant of the input's lag, in sampling steps, as the rig says."""
        return (self.rig.input.lag or 0.0) / self.rig.step

    def loud(self, noises: FloatArray) -> FloatArray:
        """(series, 2) variances of both noises in every record, of those on the whole (n, 2): record after record."""
        parts = np.ones(len(self.u)) if self.loudness is None else self.loudness
        return (noises[:, None] * parts[:, None] ** 2).reshape(-1, noises.shape[1])

    def samples_of(self, interpolation: str, delay: float, lag: float = 0.0) -> Samples:
        """The records, if the input went so; every sample is one step long where that is enough."""
        rows = 1 + max(INTERPOLATIONS[name] for name in ("linear", self.rig.interpolation, interpolation))
        if self.times is None and delay == int(delay) and not lag:
            # A record's first output comes before its first input acts, however the input goes.
            rig = replace(self.rig, interpolation=interpolation, delay=int(delay), input=Channel())
            inputs = _stacked([driven(self.model, rig, u) for u in self.u], rows)
            places = tuple(np.arange(len(y)) for y in self.y)
            return Samples(inputs, _stacked([y[:, None] for y in self.y], 1), None, places)
        found = [
            laid(times, u, y, interpolation, delay, lag)
            for times, u, y in zip(self.counted, self.u, self.y, strict=True)
        ]
        rows = max(rows, *(one.inputs.shape[1] for one in found))
        spans = _stacked([one.spans[:, None] for one in found], 1)[:, :, 0]
        return Samples(
            _stacked([one.inputs for one in found], rows),
            _stacked([one.outputs[:, None] for one in found], 1),
            spans,
            tuple(one.places for one in found),
        )

    @property
    def counted(self) -> tuple[FloatArray, ...]:
        """Times of the samples of each record, in sampling steps."""
        return self.times or tuple(np.arange(len(u), dtype=np.float64) for u in self.u)

    def evened(self) -> Problem:
        """The same with outputs and inputs in between, one step apart: enough to find a start."""
        if self.times is None:
            return self
        u, y = [], []
        for times, inputs, outputs in zip(self.counted, self.u, self.y, strict=True):
            at, seen = np.arange(int(times[-1]) + 1.0), np.isfinite(outputs)
            u.append(inputs[np.clip(np.searchsorted(times, at, side="right") - 1, 0, None)])
            y.append(np.interp(at, times[seen], outputs[seen]))
        return replace(self, u=tuple(u), y=tuple(y), times=None)

    def inward(self, mean: FloatArray, cov: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Moments (K,) and (K, K) of the model's coefficients, where outputs are counted from the origin."""
        return _recounted(self.model, mean, cov, self.origin)

    def outward(self, mean: FloatArray, cov: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The moments of which `inward` makes these."""
        return _recounted(self.model, mean, cov, -self.origin)

    def shortened(self, samples: int) -> Problem:
        """The same with the first samples of each record only."""
        return self.cut([(record, 0) for record in range(len(self.u))], samples)

    def cut(self, pieces: Sequence[tuple[int, int]], samples: int) -> Problem:
        """The same with pieces of records in their place, each of so many samples at most.

        Args:
            pieces: the number of a record, and the sample that the piece begins with.
            samples: of each.
        """
        u, y, times = [], [], []
        for record, begin in pieces:
            inside = slice(begin, begin + samples)
            u.append(self.u[record][inside])
            y.append(explicable(self.y[record][inside], self.rig, LATEST) if begin else self.y[record][inside])
            times.append(self.counted[record][inside])
        evenly = None if self.times is None else tuple(one - one[0] for one in times)
        return replace(self, u=tuple(u), y=tuple(y), times=evenly)

    def driven_from(self, samples: int) -> list[tuple[int, int]]:
        """Of each record, its number and the sample that a piece of so many begins with, which shows what an input did.

        It is the first, unless the input is far stronger elsewhere: the last piece that holds the strongest inputs, and
        some of what was before them.
        """
        pieces = []
        for record, (u, y) in enumerate(zip(self.u, self.y, strict=True)):
            power = _sliding((u - u.mean()) ** 2, samples) * _sliding(np.isfinite(y).astype(float), samples)
            begin = 0
            if power[0] < _FEW_INPUTS * power.max():
                begin = max(0, int(np.flatnonzero(power > _ALL_INPUTS * power.max())[-1]) - samples // 8)
            pieces.append((record, begin))
        return pieces

    def liveliest(self, samples: int) -> tuple[int, int]:
        """The number of a record, and the sample that a piece of so many begins with, of the largest outputs."""
        powers = [_sliding(np.nan_to_num(y) ** 2, samples) for y in self.y]
        record = int(np.argmax([power.max() for power in powers]))
        return record, int(powers[record].argmax())

    @cached_property
    def is_free(self) -> bool:
        """Whether no input acts: then m is no matter of the records, and counts as 1 in the unit of the scales."""
        return not any(u.any() for u in self.u)

    @cached_property
    def size(self) -> float:
        """Root mean square of the outputs about their mean."""
        seen = np.concatenate([y[np.isfinite(y)] for y in self.y])
        return float(max(seen.std(), 1e-12))

    @cached_property
    def strength(self) -> float:
        """Root mean square of the inputs."""
        return float(max(np.sqrt(np.mean(np.concatenate(self.u) ** 2)), 1e-12))

    @cached_property
    def frequency(self) -> float:
        """Where the outputs have their power: the mean angular frequency [rad per sample], robust to white noise."""
        power = total = 0.0
        for y in self.evened().y:
            whole = bridged(y, _BRIDGED)
            whole = np.where(np.isfinite(whole), whole, np.nanmean(y))
            spectrum = np.abs(np.fft.rfft(whole - whole.mean())) ** 2
            floor = 2 * np.median(spectrum)
            spectrum = np.where(spectrum > 20 * floor, spectrum, 0.0)
            power += float(spectrum.sum())
            total += float(spectrum @ np.linspace(0, np.pi, len(spectrum)))
        return float(np.clip(total / power if power > 0 else 0.1, 2e-3, 2.5))

    @cached_property
    def displacement(self) -> float:
        """Root mean square of the displacement inside, as far as the frequency tells."""
        return self.size / self.frequency ** KINDS[self.rig.output.kind]

    @cached_property
    def largest(self) -> FloatArray:
        """(2,) the largest displacement and velocity of a sample, as far as the frequency tells."""
        x = max(float(np.nanmax(np.abs(y))) for y in self.y) / self.frequency ** KINDS[self.rig.output.kind]
        return np.array([x, x * max(self.frequency, 0.1)])

    @property
    def start(self) -> FloatArray:
        """(2, 2) covariance of the state before a record: it may begin in any motion."""
        return np.diag((3 * self.largest) ** 2)

    def natural(self) -> dict[str, float]:
        """Sizes of the coefficients at which each term is as large as the others."""
        w, x = self.frequency, self.displacement
        sizes = {
            "stiffness": w**2,
            "cubic": w**2 / x**2,
            "damping": w,
            "gain": 1.0 if self.is_free else w**2 * x / self.strength,
        }
        sizes |= {"force": w**2 * x, "output_offset": self.size}
        return sizes | {"cubic_damping": w / (w * x) ** 2, "quintic": w**2 / x**4, "friction": w**2 * x}

    def prior_of_term(self, term: str) -> list[tuple[float, float]]:
        """Mean and standard deviation of each coefficient that a term of `EXTRA` brings."""
        if term != "dry_friction":
            return [(0.0, self.natural()[term])]
        # The speed below which friction fades is no matter of the records: a small part of the usual speed.
        creep = _CREEP * self.frequency * self.displacement
        return [(0.0, self.natural()["friction"]), (creep, 0.01 * creep)]


def bridged(y: FloatArray, longest: float) -> FloatArray:
    """Outputs (T,) with straight lines through gaps of no more than so many samples.

    Example:
        >>> bridged(np.array([0.0, np.nan, 2.0, np.nan, np.nan, 5.0, np.nan]), 1)
        array([ 0.,  1.,  2., nan, nan,  5., nan])
    """
    seen = np.flatnonzero(np.isfinite(y))
    filled = y.copy()
    gaps = np.diff(seen) - 1
    for gap in np.flatnonzero((gaps > 0) & (gaps <= longest)):
        before, after = seen[gap], seen[gap + 1]
        filled[before : after + 1] = np.linspace(y[before], y[after], after - before + 1)
    return filled


def _sliding(values: FloatArray, samples: int) -> FloatArray:
    """Sums of pieces of so many values, one for each place where a piece may begin."""
    sums = np.concatenate([[0.0], np.cumsum(values)])
    samples = min(samples, len(values))
    return np.asarray(sums[samples:] - sums[: len(sums) - samples])


def explicable(y: FloatArray, rig: Rig, later: int = 0) -> FloatArray:
    """Outputs (T,) of a record, NaN where inputs acted that came before it and that nobody recorded.

    What these had done before the first output that is left does not count: the oscillator may be in any motion.

    Args:
        y: outputs.
        rig: whose they are.
        later: samples by which the input may be later than the rig says.
    """
    # An accelerometer shows the force itself, not only what it did.
    moved = max(0, math.ceil(rig.delay)) + later + (KINDS[rig.output.kind] == 2)
    left = y.copy()
    left[: min(moved, len(y) - 1)] = np.nan
    return left


def driven(model: Model, rig: Rig, u: FloatArray) -> FloatArray:
    """(T, rows) what a model takes over the sample before each output; after the last input it stays the same."""
    way = feed(model, rig)
    if way.at_once:
        return way.pieces(u)
    window = way.stencil.shape[1]
    lag = -1 if way.waits else way.past - (window - 1)
    places = np.arange(len(u))[:, None] - lag - (window - 1) + np.arange(window)
    acting = u[np.clip(places, 0, len(u) - 1)]
    if not way.fills:
        acting = np.where(places < 0, 0.0, acting)
    return np.asarray(acting @ way.stencil.T)


def _recounted(model: Model, mean: FloatArray, cov: FloatArray, origin: float) -> tuple[FloatArray, FloatArray]:
    """Moments where outputs are counted from another origin, of a displacement: z'' = force - stiffness z + ..."""
    turned, offset = np.eye(len(mean)), np.zeros(len(mean))
    names = list(model.coefficients)
    turned[names.index("force"), names.index("stiffness")] = -origin
    offset[names.index("output_offset")] = -origin
    moved = turned @ cov @ turned.T
    # An inverse of what is nearly singular, such as what few samples tell, is symmetric to fewer digits than it has.
    return turned @ mean + offset, (moved + moved.T) / 2


def _stacked(series: list[FloatArray], columns: int) -> FloatArray:
    """(n, T, columns) of n series: columns that one lacks are 0, and a shorter one ends with NaN."""
    stacked = np.full((len(series), max(map(len, series)), columns), np.nan)
    for row, one in zip(stacked, series, strict=True):
        row[: len(one)] = 0.0
        row[: len(one), : one.shape[1]] = one
    return stacked
