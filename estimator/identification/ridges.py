"""Ridges: where a posterior is no Gaussian, all that the records allow, found by going there.

One settled sine, for example, leaves a line in the space of the coefficients open, over decades: along it all of them
can change together. No Gaussian about one of its points says so, and its curvature there is mostly that of the noise.
So the posterior is walked along each parameter, step by step, with all else refitted, the ratio of the noises too,
until the records object; and leapt along, straight on, to places that a walk does not reach. Every place that was found
is a Gaussian across the ridge, and all of them are a mixture, weighed by their likelihood and by the distance to their
neighbours in the parameter's logarithm: which coefficients a model is written in does not matter. Where two steps
outward cost what a Gaussian promises, and no leap is worth as much as the start, nothing is changed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from estimator.identification.fit import Fits, Fitter
from estimator.identification.problem import Problem
from estimator.parameters import FloatArray
from estimator.physical import physical_slopes, to_physical

#: Standard deviations at which a Gaussian is checked, and within which factor of them the root of what the records lose
#: may be.
_CHECKED, _PARABOLA = 2.0, 1.25

#: What the records lose at the ends of a walk [nats], steps to there at most, and factors of a parameter, either
#: way, beyond which it does not matter what it is.
_ENOUGH, _STEPS, _DECADES = 8.0, 30, 100.0

#: A step is longer after one that cost less, shorter after one that cost more, and taken again where it cost most; all
#: in nats.
_CHEAP, _DEAR, _TOO_MUCH, _LONGER, _SHORTER = 0.5, 1.5, 3.0, 1.7, 0.4

#: Ratios of the noises that are tried beside that of the step before, as factors.
_BESIDE = (0.2, 1.0, 5.0)

#: Leaps either way: some of so many standard deviations, and others in the parameter's logarithm, each so far; a length
#: in standard deviations beyond which there is none.
_NEAR, _LEAPS, _LEAP, _FARTHEST = (6.0, 15.0), 5, 0.5 * np.log(10.0), 1e9

#: Factors of the ratio of the noises that are tried there, and what the records may lose after a few steps [nats].
_LESS, _HOPELESS = (1.0, 0.1, 0.01), 1000.0

#: A ridge of so much of the longest one's extent counts for all parameters.
_LONG = 0.3

#: By how much the noise makes the best place of a ridge better than the true one, about [nats]: half a nat for each
#: coefficient, of which there are six or so.
_ROUGH = 2.5

#: A relative standard deviation below which no other place is looked for, and a probability that is neglected.
_KNOWN, _NEGLIGIBLE = 1e-3, 1e-6

#: A leap speaks against a Gaussian from so many standard deviations on, where it costs less than this part of the
#: parabola.
_AWAY, _PART = 4.0, 0.5

#: Steps of a fit at most; of the check and the first look of a leap, and of all else.
_FEW, _ITERATIONS = 3, 10

#: Times that a step is halved, and the length in standard deviations below which a walk is over.
_HALVINGS, _SHORTEST = 12, 0.02

#: Probability of a standard deviation either way.
ONE = 0.6826894921370859


@dataclass(frozen=True, eq=False)
class Marginal:
    """What is left of a parameter: a mixture of Gaussians along a ridge.

    Attributes:
        mean: (n,) of each, in the rig's units.
        std: (n,)
        weights: (n,) their probabilities.
    """

    mean: FloatArray
    std: FloatArray
    weights: FloatArray

    def quantile(self, probability: float) -> float:
        """What the parameter is below with a probability."""
        from scipy.special import ndtr

        low, high = float((self.mean - 9 * self.std).min()), float((self.mean + 9 * self.std).max())
        for _ in range(200):
            middle = (low + high) / 2
            if self.weights @ ndtr((middle - self.mean) / self.std) < probability:
                low = middle
            else:
                high = middle
        return (low + high) / 2


@dataclass(frozen=True, eq=False)
class Ridges:
    """A posterior that is no Gaussian, as several walks along it see it.

    Attributes:
        marginals: parameter to what each walk left of it.
        middle: number of the hypothesis in the middle.
    """

    marginals: dict[str, list[Marginal]]
    middle: int

    def interval(self, probability: float) -> dict[str, tuple[float, float]]:
        """Parameter to the widest of the central intervals: a walk misses what lies beside it, and none adds."""
        below = 0.5 - probability / 2
        return {
            name: (min(one.quantile(below) for one in several), max(one.quantile(1 - below) for one in several))
            for name, several in self.marginals.items()
        }

    def spreads(self) -> dict[str, float]:
        """Parameter to half of the interval that would be a standard deviation either way of a Gaussian."""
        return {name: (high - low) / 2 for name, (low, high) in self.interval(ONE).items()}


class _Map:
    """From the coefficients of a fit to the parameters of the rig's model, in the rig's units."""

    def __init__(self, problem: Problem) -> None:
        self.model, self.scales, k = problem.rig.model, problem.scales, problem.model.n_coefficients
        none = np.zeros((k, k))
        self._shift = problem.outward(np.zeros(k), none)[0]
        self._turn = np.stack([problem.outward(row, none)[0] - self._shift for row in np.eye(k)], axis=1)

    def values(self, points: FloatArray) -> FloatArray:
        """(n, P) parameters of coefficients (n, K)."""
        return to_physical(self.model, points @ self._turn.T + self._shift, self.scales)

    def slopes(self, points: FloatArray) -> FloatArray:
        """(n, P, K) of the parameters by the coefficients."""
        return physical_slopes(self.model, points @ self._turn.T + self._shift, self.scales) @ self._turn


@dataclass
class _Walk:
    """Walks outward along W parameters side by side.

    Attributes:
        which: (W,) the parameter of each, by number.
        side: (W,) 1 or -1.
        at: what each has reached.
        length: (W,) of the next step, in standard deviations there.
    """

    fitter: Fitter
    mapped: _Map
    which: npt.NDArray[np.intp]
    side: FloatArray
    at: Fits
    length: FloatArray

    def ahead(self, chosen: npt.NDArray[np.intp]) -> tuple[FloatArray, FloatArray]:
        """Of some walks: (n, K) where the next step leads if all is Gaussian, and (n, K) the parameter's slopes."""
        points, which, side = self.at.mean[chosen], self.which[chosen], self.side[chosen]
        rows = np.arange(len(chosen))
        slopes = self.mapped.slopes(points)[rows, which]
        toward = np.einsum("nkl,nl->nk", self.at.cov[chosen], slopes)
        variance = np.einsum("nk,nk->n", slopes, toward)
        unit = side[:, None] * toward / np.sqrt(np.maximum(variance, 1e-300))[:, None]
        now = self.mapped.values(points)[rows, which]
        for _ in range(_HALVINGS):
            ahead = points + self.length[chosen, None] * unit
            # A parameter that is a quotient jumps where what it is divided by changes its sign.
            moved = side * (self.mapped.values(ahead)[rows, which] - now)
            jumps = ~(moved > 0)
            if not jumps.any():
                break
            self.length[chosen[jumps]] /= 2
        return ahead, slopes

    def step(self, chosen: npt.NDArray[np.intp], factors: Sequence[float], iterations: int) -> Fits:
        """Of some walks the best fits where the next step leads, with the noises in the best of some ratios."""
        ahead, slopes = self.ahead(chosen)
        n = len(factors)
        hypotheses = [
            replace(self.at.hypotheses[i], ratio=self.at.hypotheses[i].ratio * factor)
            for i in chosen
            for factor in factors
        ]
        levels = np.repeat(self.at.level[chosen], n)
        fits = self.fitter.fit(
            hypotheses, np.repeat(ahead, n, axis=0), levels, iterations, pinned=np.repeat(slopes, n, axis=0)
        )
        return fits.where(np.arange(len(chosen)) * n + _losses(fits).reshape(-1, n).argmin(axis=1))

    def run(self, lowest: float) -> tuple[Fits, npt.NDArray[np.intp]]:
        """Go until the records lose enough; all that was fitted on the way, and the number of the walk of each."""
        self.length[:] = 1.0
        rows = np.arange(len(self.which))
        first = self.mapped.values(self.at.mean)[rows, self.which]
        steps, walkers, going = list[Fits](), list[npt.NDArray[np.intp]](), rows
        for _ in range(_STEPS):
            found = self.step(going, _BESIDE, _ITERATIONS)
            dearer = _losses(found) - self.at.loss[going]
            taken = dearer < _TOO_MUCH
            kept, length = going[taken], self.length[going]
            numbers = rows.copy()
            numbers[kept] = len(rows) + np.flatnonzero(taken)
            self.at = Fits.joined([self.at, found]).where(numbers)
            steps.append(found.where(taken))
            walkers.append(kept)
            lowest = min(lowest, *self.at.loss)
            factors = np.select([~taken, dearer > _DEAR, dearer < _CHEAP], [_SHORTER, 1 / _LONGER, _LONGER], 1.0)
            self.length[going] = length * factors
            change = np.abs(self.mapped.values(self.at.mean)[rows, self.which] / first)
            far = (change > _DECADES) | (change < 1 / _DECADES)
            over = (self.at.loss - lowest > _ENOUGH) | far | (self.length < _SHORTEST)
            going = going[~over[going]]
            if not len(going):
                break
        return Fits.joined(steps), np.concatenate(walkers)


def profiled(fits: Fits, best: int, fitter: Fitter, names: Sequence[str]) -> tuple[Fits, FloatArray, Ridges] | None:
    """The posterior along the ridges of some parameters; None where it is one Gaussian.

    Args:
        fits: of hypotheses about the noises.
        best: the number of the best.
        fitter: that made them.
        names: of parameters of the rig's model.

    Returns:
        Fits along the ridge that changes most, their probabilities, and what is left of the parameters.
    """
    mapped = _Map(fitter.problem)
    numbers = np.array([list(mapped.model.physical).index(name) for name in names])
    start = fits.where(np.array([best]))
    beyond, surprising = _leaps(fitter, mapped, start, numbers)
    which, side = np.repeat(numbers, 2), np.tile([1.0, -1.0], len(numbers))
    everything = np.arange(len(which))
    walk = _Walk(fitter, mapped, which, side, start.where(np.zeros_like(everything)), np.full(len(which), _CHECKED))
    if not surprising and _is_gaussian(walk, walk.step(everything, (1.0,), _FEW)):
        return None
    walked, walkers = walk.run(min(float(one.loss.min()) for one in (start, *beyond.values())))
    ridges = {}
    for number in numbers.tolist():
        parts = [start, walked.where(which[walkers] == number), *([beyond[number]] if number in beyond else [])]
        ridges[number] = _Ridge.of(mapped, number, numbers, Fits.joined(parts))
    along = max(ridges.values(), key=lambda ridge: ridge.extent)
    long = [ridge for ridge in ridges.values() if ridge.extent > _LONG * along.extent]
    marginals = {
        name: [Marginal(one.values[:, i], one.stds[:, i], one.weights) for one in dict.fromkeys((*long, ridges[i]))]
        for name, i in zip(names, numbers.tolist(), strict=True)
    }
    alive = along.weights > _NEGLIGIBLE
    weights = along.weights[alive] / along.weights[alive].sum()
    middle = int(np.searchsorted(np.cumsum(weights), 0.5))
    return along.fits.where(alive), weights, Ridges(marginals, middle)


def _leaps(fitter: Fitter, mapped: _Map, start: Fits, numbers: npt.NDArray[np.intp]) -> tuple[dict[int, Fits], bool]:
    """Parameter to fits straight on from the start that are worth about as much, and whether a Gaussian has none there.

    They are tried with fewer noises first, and in a few steps: most are hopeless.
    """
    begin, values, slopes = start.mean[0], mapped.values(start.mean)[0], mapped.slopes(start.mean)[0]
    leaps = list[tuple[int, float, FloatArray]]()
    for number in numbers.tolist():
        toward = start.cov[0] @ slopes[number]
        std = float(np.sqrt(slopes[number] @ toward))
        if not std > _KNOWN * abs(values[number]):
            continue
        first, unit = np.arcsinh(values[number] / std), toward / std
        for side in (1.0, -1.0):
            near = [values[number] + side * far * std for far in _NEAR]
            for target in [*near, *(std * np.sinh(first + side * _LEAP * np.arange(1, _LEAPS + 1)))]:
                length = _reached(mapped, number, begin, side * unit, side, float(target))
                leaps.append((number, length, begin + side * length * unit))
    if not leaps:
        return {}, False
    owners, lengths, points = (np.array(part) for part in zip(*leaps, strict=True))
    pins = mapped.slopes(points)[np.arange(len(points)), owners]
    for factors, iterations, allowed in ((_LESS[1:2], _FEW, _HOPELESS), (_LESS, _ITERATIONS, _ENOUGH)):
        n, count = len(factors), len(points)
        ratios = start.hypotheses[0].ratio * np.tile(factors, count)
        hypotheses = [replace(start.hypotheses[0], ratio=float(ratio)) for ratio in ratios]
        begins, pinned = np.repeat(points, n, axis=0), np.repeat(pins, n, axis=0)
        fits = fitter.fit(hypotheses, begins, start.level[0], iterations, pinned=pinned)
        found = fits.where(np.arange(count) * n + _losses(fits).reshape(count, n).argmin(axis=1))
        kept = _losses(found) < start.loss[0] + allowed
        found = found.where(kept)
        points, pins, owners, lengths = points[kept], pins[kept], owners[kept], lengths[kept]
        if not len(points):
            return {}, False
    promised = np.where(lengths > _AWAY, 0.5 * lengths**2, 0.0)
    surprising = bool((found.loss - start.loss[0] < _PART * promised).any())
    return {number: found.where(owners == number) for number in np.unique(owners).tolist()}, surprising


def _losses(fits: Fits) -> FloatArray:
    """(H,) losses; inf where a fit ran away."""
    return np.where(np.isfinite(fits.free_energy), fits.loss, np.inf)


def _reached(mapped: _Map, number: int, begin: FloatArray, unit: FloatArray, side: float, target: float) -> float:
    """How far along a direction a parameter is at a target, or as near as it comes before it jumps."""
    first = float(mapped.values(begin[None])[0, number])

    def is_past(length: float) -> bool:
        value = float(mapped.values((begin + length * unit)[None])[0, number])
        return not 0 < side * (value - first) < side * (target - first)

    near, far = 0.0, 1.0
    while not is_past(far) and far < _FARTHEST:
        far *= 2
    for _ in range(50):
        middle = (near + far) / 2
        near, far = (near, middle) if is_past(middle) else (middle, far)
    return near


@dataclass(frozen=True, eq=False)
class _Ridge:
    """What is known along the walks and leaps of one parameter, in the order of its values.

    Attributes:
        fits: n of them.
        weights: (n,) their probabilities.
        values: (n, P) all parameters.
        stds: (n, P) what is left of them across the ridge, and between its neighbours.
        extent: by how much parameters change along it, in their logarithms.
    """

    fits: Fits
    weights: FloatArray
    values: FloatArray
    stds: FloatArray
    extent: float

    @classmethod
    def of(cls, mapped: _Map, number: int, numbers: npt.NDArray[np.intp], fits: Fits) -> _Ridge:
        """That of a parameter, one of several."""
        fits = fits.where(np.argsort(mapped.values(fits.mean)[:, number], kind="stable"))
        values, slopes = mapped.values(fits.mean), mapped.slopes(fits.mean)
        cov = slopes @ fits.cov @ np.swapaxes(slopes, 1, 2)
        own = cov[:, number, number]
        across = np.einsum("npp->np", cov) - cov[:, :, number] ** 2 / own[:, None]
        # Before the records a parameter is anywhere within a standard deviation of 0, and in its logarithm beyond.
        places = np.arcsinh(values / np.sqrt(np.einsum("pp->p", cov[np.argmin(fits.loss)])))
        # Along a ridge the noise makes some places better than others: as much speaks against none.
        lost = np.maximum(fits.loss - fits.loss.min() - _ROUGH, 0.0)
        spacing = np.exp(-lost)[:, None] * sum(_gaps(places)) / 2
        weights = spacing[:, number]
        smeared = np.maximum(*_gaps(values)) / np.sqrt(12)
        stds = np.maximum(np.sqrt(np.maximum(across, 0.0) + smeared**2), 1e-300)
        return cls(fits, weights / weights.sum(), values, stds, float(spacing[:, numbers].sum()))


def _gaps(along: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distances to the neighbours before and after, along the first axis; 0 where there is none."""
    gaps = np.abs(np.diff(along, axis=0, prepend=along[:1], append=along[-1:]))
    return gaps[:-1], gaps[1:]


def _is_gaussian(walk: _Walk, found: Fits) -> bool:
    """Whether what the records lose is what a Gaussian says."""
    rows = np.arange(len(walk.which))
    now, there = (walk.mapped.values(fits.mean)[rows, walk.which] for fits in (walk.at, found))
    slopes = walk.mapped.slopes(walk.at.mean)[rows, walk.which]
    std = np.sqrt(np.einsum("nk,nkl,nl->n", slopes, walk.at.cov, slopes))
    root = np.sqrt(2 * np.maximum(found.loss - walk.at.loss, 0.0))
    with np.errstate(all="ignore"):
        apart = np.abs(np.log(root / (np.abs(there - now) / std)))
    return bool((apart < np.log(_PARABOLA)).all())
