"""The search: from nothing, or a guess, to the coefficients and noises that the records leave."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from estimator.identification.fit import Fits, Fitter, Hypothesis, Prior, with_ratios
from estimator.identification.problem import EXTRA, Problem
from estimator.identification.start import starts
from estimator.parameters import FloatArray
from estimator.physical import coefficients_of
from estimator.rig_prior import rig_prior

#: Without a guess a coefficient is believed to be about 0, within so many of its natural sizes.
_WIDE = 30.0

#: Where the search for the noises begins: σ_w/σ_v in parts of the squared angular frequency, which is what moves the
#: output as much as it disturbs it. It is open to either side.
_RATIOS = np.geomspace(1e-2, 1e2, 5)

#: The first look takes this many samples of a record, and so many steps; the grid of ratios has so many points.
_SHORT, _LOOK, _GRID = 4096, 10, 11

#: Ratios that are looked at lie within these bounds, in the same parts.
_LOWEST, _HIGHEST = 1e-5, 1e4

#: Steps of integration a sample where the model's own are too few, and the error that these may have, in standard
#: deviations: their error is of order 4, so that these are enough for motions of a third of a period a sample.
_FINE, _TOLERABLE = 32, 0.1


@dataclass(frozen=True, eq=False)
class Found:
    """What a search left.

    Attributes:
        fits: hypotheses about the noises that share the records, interpolation, delay and terms.
        weights: (H,) their probabilities.
        fitter: that made them.
    """

    fits: Fits
    weights: FloatArray
    fitter: Fitter

    @property
    def mean(self) -> FloatArray:
        """(K,) of the mixture."""
        return np.asarray(self.weights @ self.fits.mean)

    @property
    def cov(self) -> FloatArray:
        """(K, K) of the mixture."""
        away = self.fits.mean - self.mean
        return np.asarray(np.tensordot(self.weights, self.fits.cov, 1) + (away.T * self.weights) @ away)

    @property
    def best(self) -> Hypothesis:
        """The most probable hypothesis."""
        return self.fits.hypotheses[self.fits.best]

    @property
    def level(self) -> float:
        """σ_v of the most probable hypothesis."""
        return float(self.fits.level[self.fits.best])

    @property
    def noises(self) -> tuple[FloatArray, FloatArray]:
        """(H,) σ_w and σ_v of the hypotheses."""
        ratios = np.array([h.ratio for h in self.fits.hypotheses])
        return ratios * self.fits.level, self.fits.level


def prior_of(problem: Problem) -> Prior:
    """What the rig's guess says of the coefficients; next to nothing where there is none."""
    names, natural = list(problem.model.coefficients), problem.natural()
    mean = np.zeros(len(names))
    cov = np.diag([(_WIDE * natural[name]) ** 2 for name in names])
    for name in EXTRA:
        place = names.index(name)
        cov[place, place] = natural[name] ** 2
    if problem.rig.guess is not None:
        believed = rig_prior(problem.rig, problem.scales)
        known = [names.index(name) for name in believed.names]
        mean[known] = believed.coefficients_mean
        cov[np.ix_(known, known)] = believed.coefficients_cov
    scale = np.sqrt(np.diag(cov))
    return Prior(mean, np.linalg.inv(cov / np.outer(scale, scale)) / np.outer(scale, scale))


def search(problem: Problem, tell: Callable[[str], None]) -> Found:
    """Find the coefficients and the noises, for the rig's own interpolation and delay.

    Args:
        problem: the records.
        tell: is told what is being done.

    Raises:
        ValueError: where no start leads anywhere.
    """
    fitter = Fitter(problem, prior_of(problem))
    base = Hypothesis(problem.rig.interpolation, problem.rig.delay)
    unit = problem.frequency**2 / problem.frequency ** _order(problem)
    tell("looking for a start")
    short = fitter.on(problem.shortened(_SHORT)) if len(problem.outputs[0]) > _SHORT else fitter
    candidates = starts(problem.shortened(_SHORT))
    if problem.rig.guess is not None:
        candidates.append(_middle(problem))
    if not candidates:
        raise ValueError(
            f"records must be longer than a few periods to find a start, but have {problem.samples} outputs; add "
            f"samples, or a guess to the rig"
        )
    hypotheses = [h for _ in candidates for h in with_ratios(base, unit * _RATIOS)]
    points = np.repeat(np.array(candidates), len(_RATIOS), axis=0)
    looked = short.fit(hypotheses, points, 0.1 * problem.size, _LOOK)
    if not np.isfinite(looked.free_energy).any():
        raise ValueError(
            "records must be of an oscillator that Eq. (1) can follow, but every start ran away; check units, columns "
            "and the sampling step, or add a guess to the rig"
        )
    tell("fitting coefficients and noises")
    best = looked.best
    found = settle(fitter, looked.hypotheses[best], looked.mean[best], float(looked.level[best]), 30.0)
    if integration_error(found) <= _TOLERABLE:
        return found
    tell("fitting again, in finer steps of integration")
    finer = fitter.on(replace(problem, substeps=_FINE))
    return settle(finer, found.best, found.mean, found.level, 30.0)


def integration_error(found: Found) -> float:
    """What Runge and Kutta's method of order 4 adds to stiffness or damping, in standard deviations.

    In steps of the phase z = ω/n it turns by z⁵/120 too little and loses z⁶/144 of the amplitude.
    """
    problem = found.fitter.problem
    names, n = list(problem.model.coefficients), problem.model.substeps
    mean, std = (dict(zip(names, v, strict=True)) for v in (found.mean, np.sqrt(np.diag(found.cov))))
    square = abs(mean["stiffness"]) + 3 * abs(mean["cubic"]) * problem.displacement**2
    z2 = square / n**2
    return float(max(square * z2**2 / 60 / std["stiffness"], 2 * n * z2**3 / 144 / std["damping"]))


def settle(fitter: Fitter, hypothesis: Hypothesis, start: FloatArray, level: float, reach: float) -> Found:
    """The posterior over coefficients and noises, of one hypothesis about all else.

    A grid of ratios is laid about the best and narrowed, until it is finer than what the records leave open.

    Args:
        fitter: of the records.
        hypothesis: with the ratio to begin at.
        start: (K,) coefficients to begin at.
        level: σ_v to begin with.
        reach: factor of the ratio, either way, that the first grid spans.
    """
    unit = fitter.problem.frequency ** (2 - _order(fitter.problem))
    lowest, highest = _LOWEST * unit, _HIGHEST * unit
    width, middle = np.log(reach), np.log(np.clip(hypothesis.ratio, lowest, highest))
    for _ in range(12):
        logs = np.clip(middle + np.linspace(-width, width, _GRID), np.log(lowest), np.log(highest))
        fits = fitter.fit(with_ratios(hypothesis, np.exp(logs)), start, level)
        if not np.isfinite(fits.free_energy).any():
            raise ValueError("records must keep the fit finite, but it ran away; check units and the sampling step")
        best = fits.best
        start, level, middle = fits.mean[best], float(fits.level[best]), logs[best]
        if best in (0, _GRID - 1) and np.log(lowest) < middle < np.log(highest):
            continue
        weights = np.exp(fits.free_energy[best] - fits.free_energy)
        weights /= weights.sum()
        spread = np.sqrt(weights @ (logs - weights @ logs) ** 2)
        if spread > 1.2 * (logs[-1] - logs[0]) / (_GRID - 1) or width < 0.02:
            break
        width /= 3.0
    alive = weights > 1e-6
    return Found(fits.where(alive), weights[alive] / weights[alive].sum(), fitter)


def _middle(problem: Problem) -> FloatArray:
    """The coefficients of the guess's middle."""
    assert problem.rig.guess is not None
    model = problem.model
    told = {name: (low + high) / 2 for name, (low, high) in problem.rig.guess.items()}
    return coefficients_of(model, {name: told.get(name, 0.0) for name in model.physical}, problem.scales)


def _order(problem: Problem) -> int:
    return problem.scales.order


def at(found: Found | Hypothesis, **changes: object) -> Hypothesis:
    """The best hypothesis with other properties."""
    best = found if isinstance(found, Hypothesis) else found.best
    return replace(best, **changes)  # type: ignore[arg-type]
