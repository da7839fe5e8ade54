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

from estimator.identification.likelihood.identification_problem import IdentificationProblem
from estimator.identification.likelihood.laplace_fit import LaplaceFits, LaplaceFitter
from estimator.rigs.physical_parameters import physical_jacobian, to_physical
from estimator.support.array_types import FloatArray

#: Standard deviations from the mode at which the posterior is compared with a Gaussian.
_GAUSSIAN_CHECK_STDS = 2.0

#: Factor between the root of the loss there and the Gaussian's, either way, at most.
_GAUSSIAN_CHECK_FACTOR = 1.25

#: Loss at which a walk ends [nats].
_MAX_LOSS = 8.0

#: Steps of a walk, at most.
_MAX_WALK_STEPS = 30

#: Factor of the parameter, either way, at which a walk ends.
_MAX_PARAMETER_FACTOR = 100.0

#: Loss below which the next step is longer [nats].
_LOW_STEP_LOSS = 0.5

#: Loss above which the next step is shorter [nats].
_HIGH_STEP_LOSS = 1.5

#: Loss above which a step is rejected and repeated [nats].
_MAX_STEP_LOSS = 3.0

#: Factor of a longer step.
_STEP_GROWTH = 1.7

#: Factor of a repeated step.
_STEP_SHRINKAGE = 0.4

#: Ratios of the noises that are tried beside that of the step before, as factors.
_WALK_RATIO_FACTORS = (0.2, 1.0, 5.0)

#: Lengths of the short leaps [standard deviations].
_LEAP_STDS = (6.0, 15.0)

#: Number of leaps in the parameter's logarithm, either way.
_N_LOG_LEAPS = 5

#: Length of each in the logarithm.
_LOG_LEAP_LENGTH = 0.5 * np.log(10.0)

#: Longest leap [standard deviations].
_MAX_LEAP_STDS = 1e9

#: Factors of the noise ratio that are tried after a leap.
_LEAP_RATIO_FACTORS = (1.0, 0.1, 0.01)

#: Loss after the first steps above which a leap is dropped [nats].
_MAX_SCREENING_LOSS = 1000.0

#: A ridge of so much of the longest one's extent counts for all parameters.
_MIN_RELATIVE_EXTENT = 0.3

#: By how much the noise makes the best place of a ridge better than the true one, about [nats]: half a nat for each
#: coefficient, of which there are six or so.
_NOISE_LOSS_ALLOWANCE = 2.5

#: Relative standard deviation below which a parameter has no leaps.
_MIN_RELATIVE_STD = 1e-3

#: Probability of a place of a ridge that is left out.
_NEGLIGIBLE_PROBABILITY = 1e-6

#: Length from which a leap speaks against a Gaussian [standard deviations].
_SURPRISING_LEAP_STDS = 4.0

#: Its loss as a fraction of the Gaussian's, at most.
_SURPRISING_LOSS_FRACTION = 0.5

#: Steps of a fit in the Gaussian check and in the screening of leaps.
_SCREENING_ITERATIONS = 3

#: Steps of every other fit along a ridge.
_FIT_ITERATIONS = 10

#: Times that a step is halved where the parameter jumps, at most.
_MAX_HALVINGS = 12

#: Length of a step below which a walk ends [standard deviations].
_MIN_STEP_STDS = 0.02

#: Probability of a standard deviation either way.
ONE_STD_PROBABILITY = 0.6826894921370859


@dataclass(frozen=True, eq=False)
class MixtureMarginal:
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
class RidgePosterior:
    """A posterior that is no Gaussian, as several walks along it see it.

    Attributes:
        marginals: parameter to what each walk left of it.
        median_index: number of the hypothesis in the middle.
    """

    marginals: dict[str, list[MixtureMarginal]]
    median_index: int

    def interval(self, probability: float) -> dict[str, tuple[float, float]]:
        """Parameter to the widest of the central intervals: a walk misses what lies beside it, and none adds."""
        below = 0.5 - probability / 2
        return {
            name: (min(one.quantile(below) for one in several), max(one.quantile(1 - below) for one in several))
            for name, several in self.marginals.items()
        }

    def half_widths(self) -> dict[str, float]:
        """Parameter to half of the interval that would be a standard deviation either way of a Gaussian."""
        return {name: (high - low) / 2 for name, (low, high) in self.interval(ONE_STD_PROBABILITY).items()}


class _ParameterMap:
    """From the coefficients of a fit to the parameters of the rig's model, in the rig's units."""

    def __init__(self, problem: IdentificationProblem) -> None:
        self.model, self.scales, k = problem.rig.model, problem.scales, problem.model.n_coefficients
        none = np.zeros((k, k))
        self._offset = problem.moments_about_zero(np.zeros(k), none)[0]
        self._rotation = np.stack(
            [problem.moments_about_zero(row, none)[0] - self._offset for row in np.eye(k)], axis=1
        )

    def values(self, points: FloatArray) -> FloatArray:
        """(n, P) parameters of coefficients (n, K)."""
        return to_physical(self.model, points @ self._rotation.T + self._offset, self.scales)

    def slopes(self, points: FloatArray) -> FloatArray:
        """(n, P, K) of the parameters by the coefficients."""
        return physical_jacobian(self.model, points @ self._rotation.T + self._offset, self.scales) @ self._rotation


@dataclass
class _RidgeWalk:
    """Walks outward along W parameters side by side.

    Attributes:
        parameter_index: (W,) the parameter of each, by number.
        direction: (W,) 1 or -1.
        current: what each has reached.
        step_length: (W,) of the next step, in standard deviations there.
    """

    fitter: LaplaceFitter
    parameter_map: _ParameterMap
    parameter_index: npt.NDArray[np.intp]
    direction: FloatArray
    current: LaplaceFits
    step_length: FloatArray

    def predict_step(self, walks: npt.NDArray[np.intp]) -> tuple[FloatArray, FloatArray]:
        """Of some walks: (n, K) where the next step leads if all is Gaussian, and (n, K) the parameter's slopes."""
        points, which, side = self.current.mean[walks], self.parameter_index[walks], self.direction[walks]
        rows = np.arange(len(walks))
        slopes = self.parameter_map.slopes(points)[rows, which]
        cov_slope = np.einsum("nkl,nl->nk", self.current.cov[walks], slopes)
        variance = np.einsum("nk,nk->n", slopes, cov_slope)
        unit = side[:, None] * cov_slope / np.sqrt(np.maximum(variance, 1e-300))[:, None]
        now = self.parameter_map.values(points)[rows, which]
        for _ in range(_MAX_HALVINGS):
            ahead = points + self.step_length[walks, None] * unit
            # A parameter that is a quotient jumps where what it is divided by changes its sign.
            change = side * (self.parameter_map.values(ahead)[rows, which] - now)
            jumps = ~(change > 0)
            if not jumps.any():
                break
            self.step_length[walks[jumps]] /= 2
        return ahead, slopes

    def fit_step(self, walks: npt.NDArray[np.intp], ratio_factors: Sequence[float], iterations: int) -> LaplaceFits:
        """Of some walks the best fits where the next step leads, with the noises in the best of some ratios."""
        ahead, slopes = self.predict_step(walks)
        n = len(ratio_factors)
        hypotheses = [
            replace(self.current.hypotheses[i], noise_ratio=self.current.hypotheses[i].noise_ratio * factor)
            for i in walks
            for factor in ratio_factors
        ]
        levels = np.repeat(self.current.sensor_std[walks], n)
        fits = self.fitter.fit(
            hypotheses, np.repeat(ahead, n, axis=0), levels, iterations, fixed_directions=np.repeat(slopes, n, axis=0)
        )
        return fits.select(np.arange(len(walks)) * n + _finite_losses(fits).reshape(-1, n).argmin(axis=1))

    def walk_outward(self, lowest_loss: float) -> tuple[LaplaceFits, npt.NDArray[np.intp]]:
        """Go until the records lose enough; all that was fitted on the way, and the number of the walk of each."""
        self.step_length[:] = 1.0
        rows = np.arange(len(self.parameter_index))
        first = self.parameter_map.values(self.current.mean)[rows, self.parameter_index]
        steps, walkers, active = list[LaplaceFits](), list[npt.NDArray[np.intp]](), rows
        for _ in range(_MAX_WALK_STEPS):
            found = self.fit_step(active, _WALK_RATIO_FACTORS, _FIT_ITERATIONS)
            loss_increase = _finite_losses(found) - self.current.loss[active]
            is_accepted = loss_increase < _MAX_STEP_LOSS
            kept, length = active[is_accepted], self.step_length[active]
            numbers = rows.copy()
            numbers[kept] = len(rows) + np.flatnonzero(is_accepted)
            self.current = LaplaceFits.concatenated([self.current, found]).select(numbers)
            steps.append(found.select(is_accepted))
            walkers.append(kept)
            lowest_loss = min(lowest_loss, *self.current.loss)
            factors = np.select(
                [~is_accepted, loss_increase > _HIGH_STEP_LOSS, loss_increase < _LOW_STEP_LOSS],
                [_STEP_SHRINKAGE, 1 / _STEP_GROWTH, _STEP_GROWTH],
                1.0,
            )
            self.step_length[active] = length * factors
            change = np.abs(self.parameter_map.values(self.current.mean)[rows, self.parameter_index] / first)
            is_irrelevant = (change > _MAX_PARAMETER_FACTOR) | (change < 1 / _MAX_PARAMETER_FACTOR)
            is_finished = (
                (self.current.loss - lowest_loss > _MAX_LOSS) | is_irrelevant | (self.step_length < _MIN_STEP_STDS)
            )
            active = active[~is_finished[active]]
            if not len(active):
                break
        return LaplaceFits.concatenated(steps), np.concatenate(walkers)


def profile_posterior(
    fits: LaplaceFits, best_index: int, fitter: LaplaceFitter, names: Sequence[str]
) -> tuple[LaplaceFits, FloatArray, RidgePosterior] | None:
    """The posterior along the ridges of some parameters; None where it is one Gaussian.

    Args:
        fits: of hypotheses about the noises.
        best_index: the number of the best.
        fitter: that made them.
        names: of parameters of the rig's model.

    Returns:
        Fits along the ridge that changes most, their probabilities, and what is left of the parameters.
    """
    parameter_map = _ParameterMap(fitter.problem)
    parameter_indices = np.array([list(parameter_map.model.physical).index(name) for name in names])
    start = fits.select(np.array([best_index]))
    leap_fits, is_surprising = _fit_leaps(fitter, parameter_map, start, parameter_indices)
    which, side = np.repeat(parameter_indices, 2), np.tile([1.0, -1.0], len(parameter_indices))
    all_walks = np.arange(len(which))
    walk = _RidgeWalk(
        fitter,
        parameter_map,
        which,
        side,
        start.select(np.zeros_like(all_walks)),
        np.full(len(which), _GAUSSIAN_CHECK_STDS),
    )
    if not is_surprising and _is_gaussian(walk, walk.fit_step(all_walks, (1.0,), _SCREENING_ITERATIONS)):
        return None
    walked, walkers = walk.walk_outward(min(float(one.loss.min()) for one in (start, *leap_fits.values())))
    ridges = {}
    for number in parameter_indices.tolist():
        parts = [start, walked.select(which[walkers] == number), *([leap_fits[number]] if number in leap_fits else [])]
        ridges[number] = _ParameterRidge.of(parameter_map, number, parameter_indices, LaplaceFits.concatenated(parts))
    longest = max(ridges.values(), key=lambda ridge: ridge.extent)
    long_ridges = [ridge for ridge in ridges.values() if ridge.extent > _MIN_RELATIVE_EXTENT * longest.extent]
    marginals = {
        name: [
            MixtureMarginal(one.values[:, i], one.stds[:, i], one.weights)
            for one in dict.fromkeys((*long_ridges, ridges[i]))
        ]
        for name, i in zip(names, parameter_indices.tolist(), strict=True)
    }
    alive = longest.weights > _NEGLIGIBLE_PROBABILITY
    weights = longest.weights[alive] / longest.weights[alive].sum()
    middle = int(np.searchsorted(np.cumsum(weights), 0.5))
    return longest.fits.select(alive), weights, RidgePosterior(marginals, middle)


def _fit_leaps(
    fitter: LaplaceFitter, parameter_map: _ParameterMap, start: LaplaceFits, parameter_indices: npt.NDArray[np.intp]
) -> tuple[dict[int, LaplaceFits], bool]:
    """Parameter to fits straight on from the start that are worth about as much, and whether a Gaussian has none there.

    They are tried with fewer noises first, and in a few steps: most are hopeless.
    """
    begin, values, slopes = start.mean[0], parameter_map.values(start.mean)[0], parameter_map.slopes(start.mean)[0]
    leaps = list[tuple[int, float, FloatArray]]()
    for number in parameter_indices.tolist():
        toward = start.cov[0] @ slopes[number]
        std = float(np.sqrt(slopes[number] @ toward))
        if not std > _MIN_RELATIVE_STD * abs(values[number]):
            continue
        first, unit = np.arcsinh(values[number] / std), toward / std
        for side in (1.0, -1.0):
            near = [values[number] + side * far * std for far in _LEAP_STDS]
            for target in [*near, *(std * np.sinh(first + side * _LOG_LEAP_LENGTH * np.arange(1, _N_LOG_LEAPS + 1)))]:
                length = _length_to_target(parameter_map, number, begin, side * unit, side, float(target))
                leaps.append((number, length, begin + side * length * unit))
    if not leaps:
        return {}, False
    leap_parameters, lengths, points = (np.array(part) for part in zip(*leaps, strict=True))
    gradients = parameter_map.slopes(points)[np.arange(len(points)), leap_parameters]
    for factors, iterations, allowed in (
        (_LEAP_RATIO_FACTORS[1:2], _SCREENING_ITERATIONS, _MAX_SCREENING_LOSS),
        (_LEAP_RATIO_FACTORS, _FIT_ITERATIONS, _MAX_LOSS),
    ):
        n, count = len(factors), len(points)
        ratios = start.hypotheses[0].noise_ratio * np.tile(factors, count)
        hypotheses = [replace(start.hypotheses[0], noise_ratio=float(ratio)) for ratio in ratios]
        begins, pinned = np.repeat(points, n, axis=0), np.repeat(gradients, n, axis=0)
        fits = fitter.fit(hypotheses, begins, start.sensor_std[0], iterations, fixed_directions=pinned)
        found = fits.select(np.arange(count) * n + _finite_losses(fits).reshape(count, n).argmin(axis=1))
        kept = _finite_losses(found) < start.loss[0] + allowed
        found = found.select(kept)
        points, gradients, leap_parameters, lengths = (
            points[kept],
            gradients[kept],
            leap_parameters[kept],
            lengths[kept],
        )
        if not len(points):
            return {}, False
    promised = np.where(lengths > _SURPRISING_LEAP_STDS, 0.5 * lengths**2, 0.0)
    is_surprising = bool((found.loss - start.loss[0] < _SURPRISING_LOSS_FRACTION * promised).any())
    return {
        number: found.select(leap_parameters == number) for number in np.unique(leap_parameters).tolist()
    }, is_surprising


def _finite_losses(fits: LaplaceFits) -> FloatArray:
    """(H,) losses; inf where a fit ran away."""
    return np.where(np.isfinite(fits.free_energy), fits.loss, np.inf)


def _length_to_target(
    parameter_map: _ParameterMap,
    parameter_index: int,
    begin: FloatArray,
    direction_vector: FloatArray,
    sign: float,
    target: float,
) -> float:
    """How far along a direction a parameter is at a target, or as near as it comes before it jumps."""
    first = float(parameter_map.values(begin[None])[0, parameter_index])

    def is_past(length: float) -> bool:
        value = float(parameter_map.values((begin + length * direction_vector)[None])[0, parameter_index])
        return not 0 < sign * (value - first) < sign * (target - first)

    near, far = 0.0, 1.0
    while not is_past(far) and far < _MAX_LEAP_STDS:
        far *= 2
    for _ in range(50):
        middle = (near + far) / 2
        near, far = (near, middle) if is_past(middle) else (middle, far)
    return near


@dataclass(frozen=True, eq=False)
class _ParameterRidge:
    """What is known along the walks and leaps of one parameter, in the order of its values.

    Attributes:
        fits: n of them.
        weights: (n,) their probabilities.
        values: (n, P) all parameters.
        stds: (n, P) what is left of them across the ridge, and between its neighbours.
        extent: by how much parameters change along it, in their logarithms.
    """

    fits: LaplaceFits
    weights: FloatArray
    values: FloatArray
    stds: FloatArray
    extent: float

    @classmethod
    def of(
        cls,
        parameter_map: _ParameterMap,
        parameter_index: int,
        parameter_indices: npt.NDArray[np.intp],
        fits: LaplaceFits,
    ) -> _ParameterRidge:
        """That of a parameter, one of several."""
        fits = fits.select(np.argsort(parameter_map.values(fits.mean)[:, parameter_index], kind="stable"))
        values, slopes = parameter_map.values(fits.mean), parameter_map.slopes(fits.mean)
        cov = slopes @ fits.cov @ np.swapaxes(slopes, 1, 2)
        own_variance = cov[:, parameter_index, parameter_index]
        across = np.einsum("npp->np", cov) - cov[:, :, parameter_index] ** 2 / own_variance[:, None]
        # Before the records a parameter is anywhere within a standard deviation of 0, and in its logarithm beyond.
        places = np.arcsinh(values / np.sqrt(np.einsum("pp->p", cov[np.argmin(fits.loss)])))
        # Along a ridge the noise makes some places better than others: as much speaks against none.
        excess_loss = np.maximum(fits.loss - fits.loss.min() - _NOISE_LOSS_ALLOWANCE, 0.0)
        spacing = np.exp(-excess_loss)[:, None] * sum(_neighbour_distances(places)) / 2
        weights = spacing[:, parameter_index]
        spacing_std = np.maximum(*_neighbour_distances(values)) / np.sqrt(12)
        stds = np.maximum(np.sqrt(np.maximum(across, 0.0) + spacing_std**2), 1e-300)
        return cls(fits, weights / weights.sum(), values, stds, float(spacing[:, parameter_indices].sum()))


def _neighbour_distances(positions: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distances to the neighbours before and after, along the first axis; 0 where there is none."""
    gaps = np.abs(np.diff(positions, axis=0, prepend=positions[:1], append=positions[-1:]))
    return gaps[:-1], gaps[1:]


def _is_gaussian(walk: _RidgeWalk, found: LaplaceFits) -> bool:
    """Whether what the records lose is what a Gaussian says."""
    rows = np.arange(len(walk.parameter_index))
    now, there = (walk.parameter_map.values(fits.mean)[rows, walk.parameter_index] for fits in (walk.current, found))
    slopes = walk.parameter_map.slopes(walk.current.mean)[rows, walk.parameter_index]
    std = np.sqrt(np.einsum("nk,nkl,nl->n", slopes, walk.current.cov, slopes))
    root = np.sqrt(2 * np.maximum(found.loss - walk.current.loss, 0.0))
    with np.errstate(all="ignore"):
        apart = np.abs(np.log(root / (np.abs(there - now) / std)))
    return bool((apart < np.log(_GAUSSIAN_CHECK_FACTOR)).all())
