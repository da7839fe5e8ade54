"""The search: from nothing, or a guess, to the coefficients and noises that the records leave."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from estimator.ensemble import half_cauchy
from estimator.identification.fit import Fits, Fitter, Hypothesis, Prior, with_ratios
from estimator.identification.motions import motions
from estimator.identification.problem import Problem
from estimator.identification.ridges import Ridges, profiled
from estimator.identification.start import effect, scattered, starts
from estimator.parameters import FloatArray
from estimator.physical import coefficients_of
from estimator.progress import Tell
from estimator.rig_prior import rig_prior

#: Standard deviation of the gain where no input tells it, and it is 1 by the scales.
_KNOWN = 1e-6

#: Without a guess a coefficient is believed to be about 0, within so many of its natural sizes.
_WIDE = 30.0

#: Where the search for the noises begins: σ_w/σ_v in parts of the squared angular frequency, which is what moves the
#: output as much as it disturbs it. It is open to either side.
_RATIOS = np.geomspace(1e-2, 1e2, 5)

#: The first look takes so many periods of a record, and at least and at most so many samples.
_PERIODS, _SHORTEST, _LONGEST = 25, 1024, 4096

#: The equation is tested with so many periods, where these are more samples.
_MANY_PERIODS = 40

#: Steps of it, after which so many of its hypotheses are kept.
_LOOK = ((3, 8), (10, 1))

#: Where the disturbance is more than so much of the input, so many times so many starts are drawn. They are fitted to
#: pieces of so many periods, and of so many samples at least, which grow by a factor until they are all.
_POOR, _TRIES, _DRAWS, _PIECE, _LEAST, _LONGER = 0.05, 3, 192, 4, 128, 4

#: Steps of each of these fits; how many results are kept of what was drawn, of pieces, and of all records.
_STEPS, _KEPT = 8, (48, 12, 3)

#: Nats by which the free energies of results that are the same differ at most.
_SAME = 5.0

#: Steps of a fit to all records, from what the first look found and from where it began, of which the best is kept.
_FEW = 3

#: Ratios of a grid, how many standard deviations it is to reach either way in the end, and by how many nats its ends
#: must be worse than its best.
_GRID, _REACH, _EDGE = 8, 3.0, 2.0

#: Ratios that are looked at lie within these bounds, in the same parts.
_LOWEST, _HIGHEST = 1e-5, 1e4

#: Steps of integration a sample, of which the fewest are taken whose error is small, in standard deviations. It is of
#: order 4, so that the most are enough for motions of a third of a period a sample. Before a fit
#: it is known only that a step should turn the motion by no more than an angle.
_SUBSTEPS, _TOLERABLE, _ANGLE = (2, 4, 8, 16, 32), 0.02, 0.25

#: Fits at most, each with the steps of integration and the motions that the one before asks for; and the change of the
#: free energy by other motions that asks for one more [nats].
_ROUNDS, _SMALL = 6, 0.1

#: Noises of a record are other than was thought where they differ by so much in the logarithm, and so many standard
#: deviations.
_LOUDER, _SURELY = 0.05, 6.0


@dataclass(frozen=True, eq=False)
class Found:
    """What a search left.

    Attributes:
        fits: hypotheses about the noises that share the records, interpolation, delay and terms.
        weights: (H,) their probabilities.
        fitter: that made them.
        is_lost: whether they explain the records badly, and no other start leads to them.
        ridges: along which the posterior lies where it is no Gaussian; the hypotheses are then also about the
            coefficients.
    """

    fits: Fits
    weights: FloatArray
    fitter: Fitter
    is_lost: bool = False
    ridges: Ridges | None = None

    @property
    def mean(self) -> FloatArray:
        """(K,) of the mixture; along a ridge its middle, because a mean may be beside all that is possible."""
        return np.asarray(self.weights @ self.fits.mean) if self.ridges is None else self.fits.mean[self._chosen]

    @property
    def cov(self) -> FloatArray:
        """(K, K) of the mixture, about `mean`."""
        away = self.fits.mean - self.mean
        return np.asarray(np.tensordot(self.weights, self.fits.cov, 1) + (away.T * self.weights) @ away)

    @property
    def best(self) -> Hypothesis:
        """The most probable hypothesis; along a ridge that in the middle."""
        return self.fits.hypotheses[self._chosen]

    @property
    def motions(self) -> FloatArray:
        """(records, 2) displacement and velocity a sample before each record."""
        assert self.best.motions is not None
        return self.best.motions

    @property
    def level(self) -> float:
        """σ_v of that hypothesis."""
        return float(self.fits.level[self._chosen])

    @property
    def _chosen(self) -> int:
        return int(np.argmax(self.weights)) if self.ridges is None else self.ridges.middle

    @property
    def disturbance(self) -> float:
        """σ_w of the most probable hypothesis, in parts of what the inputs do."""
        return self.best.ratio * self.level / max(effect(self.fitter.problem, self.mean), 1e-300)

    @property
    def noises(self) -> tuple[FloatArray, FloatArray]:
        """(H,) σ_w and σ_v of the hypotheses."""
        ratios = np.array([h.ratio for h in self.fits.hypotheses])
        return ratios * self.fits.level, self.fits.level


def prior_of(problem: Problem) -> Prior:
    """What the rig's guess says of the coefficients; next to nothing where there is none."""
    if problem.rig.guess is None:
        natural = problem.natural()
        names = list(problem.model.coefficients)
        means, stds = np.zeros(len(names)), np.array([_WIDE * natural[name] for name in names])
        if problem.is_free:
            means[names.index("gain")], stds[names.index("gain")] = 1.0, _KNOWN
        return Prior(means, np.diag(stds**-2))
    guess = rig_prior(problem.rig, problem.scales)
    return Prior.of(*problem.inward(guess.coefficients_mean, guess.coefficients_cov))


def search(problem: Problem, tell: Tell) -> Found:
    """Find the coefficients and the noises, for the rig's own interpolation and delay.

    Args:
        problem: the records.
        tell: is told the share that is done, by experience, and what is being done.

    Raises:
        ValueError: where no start leads anywhere.
    """
    coarse = next(n for n in _SUBSTEPS if problem.frequency / n < _ANGLE)
    fitter = Fitter(replace(problem, substeps=coarse), prior_of(problem))
    tell(0.0, "looking for a start")
    looked = _look(fitter)
    if not len(looked.mean):
        raise ValueError(
            "records must be of an oscillator that Eq. (1) can follow, and show what the input does for a few periods, "
            "but every start ran away; check units, columns and the sampling step, or add a guess to the rig"
        )
    tell(0.3, "fitting coefficients and noises")
    found = _settled(fitter, looked)
    if problem.rig.guess is None and not problem.is_free and found.disturbance > _POOR:
        tell(0.6, "looking for another start")
        found = _settled_again(fitter, found)
    return found


def _settled_again(fitter: Fitter, found: Found) -> Found:
    """The best of what was found and of what other starts lead to.

    Where these come to the same it is not the start that is wrong, and none is sought after one that is not poor.
    """
    energy = lambda end: float(end.fits.free_energy.min())  # noqa: E731
    ends = [found]
    for seed in range(_TRIES):
        others = _look_again(fitter, seed)
        for k in range(len(others.mean)):
            with suppress(ValueError):  # it ran away
                ends.append(_settled(fitter, others.where(np.array([k]))))
            ends.sort(key=energy)
            same = len(ends) > 1 and energy(ends[1]) < energy(ends[0]) + _SAME
            if same or ends[0].disturbance < _POOR:
                return ends[0]
    return replace(ends[0], is_lost=True)


def _settled(fitter: Fitter, looked: Fits) -> Found:
    """What the best of some fits comes to, with as many steps of integration and the motions that it needs."""
    problem, hypothesis = fitter.problem, looked.hypotheses[0]
    start, level, reach = looked.mean[0], float(looked.level[0]), 30.0
    substeps = enough_substeps(problem, start, looked.cov[0])
    for _ in range(_ROUNDS):
        problem = replace(problem, substeps=substeps)
        hypothesis = replace(hypothesis, motions=motions(problem, hypothesis, start[None], level)[0])
        found = settle(fitter.on(problem), hypothesis, start, level, reach)
        start, level, hypothesis, reach = found.mean, found.level, found.best, 2.0
        substeps = max(substeps, enough_substeps(problem, start, found.cov))
        loudness = found.fitter.loudness(found.best, start, level)
        if substeps == problem.substeps and not _louder(problem, loudness) and not _begins_otherwise(found):
            break
        if _louder(problem, loudness):
            problem = replace(problem, loudness=loudness)
    return found


def _louder(problem: Problem, loudness: FloatArray) -> bool:
    """Whether the noises of some records are other than was thought, surely and by so much that it matters."""
    before = np.ones(len(loudness)) if problem.loudness is None else problem.loudness
    seen = np.array([np.isfinite(y).sum() for y in problem.y])
    change = np.abs(np.log(np.maximum(loudness, 1e-300) / before))
    return bool((change > np.maximum(_LOUDER, _SURELY / np.sqrt(2 * np.maximum(seen, 1)))).any())


def spread(found: Found, names: Sequence[str]) -> Found:
    """The same, along the ridge on which the posterior of some parameters lies where it is no Gaussian."""
    along = profiled(found.fits, int(np.argmax(found.weights)), found.fitter, names)
    return found if along is None else replace(found, fits=along[0], weights=along[1], ridges=along[2])


def _begins_otherwise(found: Found) -> bool:
    """Whether the records begin in motions other than the filter was linear about, and it matters."""
    begins = motions(found.fitter.problem, found.best, found.mean[None], found.level)
    hypothesis = replace(found.best, motions=begins[0])
    fits = found.fitter.fit([found.best, hypothesis], found.mean, found.level, iterations=0)
    before, after = fits.free_energy
    return not np.isclose(before, after, rtol=0.0, atol=_SMALL)


def _look(fitter: Fitter) -> Fits:
    """The best of all starts and ratios of the noises; of none where all ran away."""
    problem = fitter.problem
    period = 2 * np.pi / problem.frequency
    samples = int(np.clip(_PERIODS * period, _SHORTEST, _LONGEST))
    short = fitter.on(problem.cut(problem.driven_from(samples), samples))
    samples = int(max(_MANY_PERIODS * period, _LONGEST))
    candidates = starts(problem.cut(problem.driven_from(samples), samples))
    if problem.rig.guess is not None:
        middle = {name: (low + high) / 2 for name, (low, high) in problem.rig.guess.items()}
        middle |= {"u0": problem.rig.input.offset, "y0": problem.rig.output.offset}
        guessed = coefficients_of(problem.model, middle, problem.scales)
        candidates.append(problem.inward(guessed, np.zeros((len(guessed),) * 2))[0])
    if not candidates:
        return _look_again(fitter)
    ratios = _RATIOS * problem.frequency ** (2 - problem.scales.order)
    base = Hypothesis(problem.rig.interpolation, problem.rig.delay, float(ratios[len(ratios) // 2]), lag=problem.lag)
    level = np.array(0.1 * problem.size)
    begins = motions(short.problem, base, np.array(candidates), float(level))
    moving = [replace(base, motions=begin) for begin in begins]
    begun = [base] * len(candidates) + moving
    points = np.repeat(np.array([*candidates, *candidates]), len(_RATIOS), axis=0)
    hypotheses = [h for one in begun for h in with_ratios(one, ratios)]
    for steps, kept in _LOOK:
        fits = short.fit(hypotheses, points, level, steps).best(kept)
        hypotheses, points, level = list(fits.hypotheses), fits.mean, fits.level
    if short.problem.samples < problem.samples and np.isfinite(fits.free_energy).any():
        # The first periods may tell little of a coefficient, which then is anywhere: all records judge.
        points = np.array([*fits.mean, *candidates])
        fits = fitter.fit(list(fits.hypotheses) * len(points), points, fits.level[0], _FEW).best(1)
    return fits if np.isfinite(fits.free_energy).any() else _look_again(fitter)


def _look_again(fitter: Fitter, seed: int = 0) -> Fits:
    """The best that many starts lead to, which are drawn and fitted to pieces of the records that grow."""
    problem = fitter.problem
    ratios = _RATIOS * problem.frequency ** (2 - problem.scales.order)
    base = Hypothesis(problem.rig.interpolation, problem.rig.delay, float(ratios[2]), lag=problem.lag)
    shortest = max(_LEAST, round(_PIECE * 2 * np.pi / problem.frequency))
    points = np.array(scattered(problem, _DRAWS, seed))
    shape, levels = (_DRAWS, *np.diag(points[0]).shape), np.full(_DRAWS, 0.1 * problem.size)
    drawn = Fits((base,) * _DRAWS, points, np.zeros(shape), levels, *np.zeros((2, _DRAWS)))
    found = []
    for piece in dict.fromkeys([problem.liveliest(shortest), *problem.driven_from(shortest)[:1]]):
        samples, (many, few, _) = shortest, _KEPT
        fits = _moving(fitter.on(problem.cut([piece], samples)), drawn, ratios[[1, 3]], many)
        while samples < max(map(len, problem.u)):
            fits = _moving(fitter.on(problem.cut([piece], samples)), fits, ratios, few)
            samples *= _LONGER
        found.append(fits)
    names = ("mean", "cov", "level", "free_energy", "loss")
    both = (np.concatenate([getattr(fits, name) for fits in found]) for name in names)
    return _moving(fitter, Fits(tuple(h for fits in found for h in fits.hypotheses), *both), ratios, _KEPT[2])


def _moving(fitter: Fitter, fits: Fits, ratios: FloatArray, kept: int) -> Fits:
    """The best of fits from where others came to, of records that begin in motion, each at the best of the ratios."""
    if not len(fits.mean):
        return fits
    base = replace(fits.hypotheses[0], motions=None)
    begins = motions(fitter.problem, base, fits.mean, float(np.median(fits.level)))
    hypotheses = [one for begin in begins for one in with_ratios(replace(base, motions=begin), ratios)]
    points, levels = np.repeat(fits.mean, len(ratios), axis=0), np.repeat(fits.level, len(ratios))
    tried = fitter.fit(hypotheses, points, levels, _STEPS)
    of_each = tried.free_energy.reshape(-1, len(ratios)).argmin(axis=1)
    return _apart(tried.where(len(ratios) * np.arange(len(of_each)) + of_each), kept)


def _apart(fits: Fits, count: int) -> Fits:
    """The best of those that did not come to the same."""
    finite = fits.where(np.isfinite(fits.free_energy))
    return finite.where(np.unique(np.round(finite.free_energy), return_index=True)[1][:count])


def enough_substeps(problem: Problem, mean: FloatArray, cov: FloatArray) -> int:
    """The fewest steps of integration whose error is tolerable, for coefficients (K,) with a covariance (K, K).

    In steps of the phase z = ω/n Runge and Kutta's method of order 4 turns by z⁵/120 too little and loses z⁶/144 of the
    amplitude: what this adds to stiffness and damping is compared with their standard deviations.
    """
    names = list(problem.model.coefficients)
    known, std = (dict(zip(names, v, strict=True)) for v in (mean, np.sqrt(np.diag(cov))))
    square = abs(known["stiffness"]) + 3 * abs(known["cubic"]) * problem.displacement**2
    for n in _SUBSTEPS:
        z2 = square / n**2
        error = max(square * z2**2 / 60 / std["stiffness"], 2 * n * z2**3 / 144 / std["damping"])
        if error <= _TOLERABLE:
            break
    return n


def settle(fitter: Fitter, hypothesis: Hypothesis, start: FloatArray, level: float, reach: float) -> Found:
    """The posterior over coefficients and noises, of one hypothesis about all else.

    A grid of ratios is laid about the best and narrowed, until it is finer than what the records leave open. Where they
    do not tell σ_w from 0, or σ_v, the prior decides: half a Cauchy density of the ratio (Gelman 2006), about the one
    that moves the output as much as it disturbs it. One even in the logarithm would hold that one of the noises is 0.

    Args:
        fitter: of the records.
        hypothesis: with the ratio to begin at.
        start: (K,) coefficients to begin at.
        level: σ_v to begin with.
        reach: factor of the ratio, either way, that the first grid spans.
    """
    unit = fitter.problem.frequency ** (2 - fitter.problem.scales.order)
    bounds = np.log([_LOWEST * unit, _HIGHEST * unit])
    width, middle = np.log(reach), np.log(hypothesis.ratio)
    for _ in range(12):
        logs = np.clip(middle + np.linspace(-width, width, _GRID), *bounds)
        fits = fitter.fit(with_ratios(hypothesis, np.exp(logs)), start, level)
        if not np.isfinite(fits.free_energy).any():
            raise ValueError(
                "records must keep the fit finite, but it ran away; check units and the sampling step, and give a "
                "simulated record some noise, of 1e-8 of its size at least"
            )
        away = logs - np.log(unit)
        energies = fits.free_energy + half_cauchy(away)
        best = int(np.argmin(energies))
        start, level = fits.mean[best], float(fits.level[best])
        worse = energies - energies[best]
        weights = np.exp(-worse) / np.exp(-worse).sum()
        middle, std = _vertex(logs, worse, best)
        if (worse[[0, -1]] < _EDGE)[logs[[0, -1]] != bounds].any():
            width *= 1.5
            continue
        spread = np.sqrt(weights @ (logs - weights @ logs) ** 2)
        if spread > 0.8 * (logs[-1] - logs[0]) / (_GRID - 1) or width < 0.02:
            break
        width = np.clip(_REACH * std, width / 40, width / 2)
    alive = weights > 1e-6
    return Found(fits.where(alive), weights[alive] / weights[alive].sum(), fitter)


def _vertex(places: FloatArray, energies: FloatArray, best: int) -> tuple[float, float]:
    """Mean and standard deviation of what has the free energies of the parabola through the best and its neighbours."""
    if not 0 < best < len(places) - 1:
        return float(places[best]), np.inf
    left, right = places[best] - places[best - 1], places[best + 1] - places[best]
    if not left > 0 < right:
        return float(places[best]), np.inf
    before, after = (energies[best] - energies[best - 1]) / left, (energies[best + 1] - energies[best]) / right
    curvature = 2 * (after - before) / (left + right)
    if not 0 < curvature < np.inf:
        return float(places[best]), np.inf
    slope = (before * right + after * left) / (left + right)
    return float(places[best] - slope / curvature), float(1 / np.sqrt(curvature))
