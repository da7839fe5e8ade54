"""Walks along the ridge of a posterior: outward along each parameter, with all other coefficients refitted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from estimator.identification.likelihood.fit_hypothesis import LaplaceFits
from estimator.identification.likelihood.laplace_fit import LaplaceFitter
from estimator.identification.likelihood.scaled_records import ScaledRecords
from estimator.rigs.physical_parameters import physical_jacobian, to_physical
from estimator.support.array_types import FloatArray

#: Standard deviations from the mode at which the posterior is compared with a Gaussian.
GAUSSIAN_CHECK_STDS = 2.0

#: Factor between the root of the loss there and the Gaussian's, either way, at most.
_GAUSSIAN_CHECK_FACTOR = 1.25

#: Loss at which a walk ends [nats].
MAX_LOSS = 8.0

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

#: Factors of the noise ratio that are tried at each step.
_WALK_RATIO_FACTORS = (0.2, 5.0)

#: Free energy above the fit at the ratio of the step before, above which the fit at another ratio ends [nats]. It
#: allows for the covariance, which counts in a free energy but not in a loss.
_MAX_RATIO_NATS = 10.0

#: Steps of a fit in the Gaussian check and in the screening of leaps.
SCREENING_ITERATIONS = 3

#: Steps of every other fit along a ridge.
FIT_ITERATIONS = 10

#: Times that a step is halved where the parameter jumps, at most.
_MAX_HALVINGS = 12

#: Length of a step below which a walk ends [standard deviations].
_MIN_STEP_STDS = 0.02


class ParameterMap:
    """The map from the coefficients of a fit to the parameters of the rig's model, in the rig's units."""

    def __init__(self, problem: ScaledRecords) -> None:
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
        """(n, P, K) derivatives of the parameters by the coefficients."""
        return physical_jacobian(self.model, points @ self._rotation.T + self._offset, self.scales) @ self._rotation


@dataclass
class RidgeWalk:
    """W walks outward, each along a parameter.

    Attributes:
        fitter: fitter of the records.
        parameter_map: from coefficients to parameters.
        parameter_index: (W,) index of the parameter of each walk.
        direction: (W,) 1 or -1.
        current: the fit that each walk has reached.
        step_length: (W,) length of the next step, in standard deviations at the current fit.
    """

    fitter: LaplaceFitter
    parameter_map: ParameterMap
    parameter_index: npt.NDArray[np.intp]
    direction: FloatArray
    current: LaplaceFits
    step_length: FloatArray

    def predict_step(self, walks: npt.NDArray[np.intp]) -> tuple[FloatArray, FloatArray]:
        """The next coefficients (n, K) of some walks by the Gaussian, and the gradients (n, K) of their parameters."""
        points, which, side = self.current.mean[walks], self.parameter_index[walks], self.direction[walks]
        rows = np.arange(len(walks))
        slopes = self.parameter_map.slopes(points)[rows, which]
        cov_slope = np.einsum("nkl,nl->nk", self.current.cov[walks], slopes)
        variance = np.einsum("nk,nk->n", slopes, cov_slope)
        unit = side[:, None] * cov_slope / np.sqrt(np.maximum(variance, 1e-300))[:, None]
        now = self.parameter_map.values(points)[rows, which]
        for _ in range(_MAX_HALVINGS):
            ahead = points + self.step_length[walks, None] * unit
            # A parameter that is a quotient jumps where its denominator changes sign.
            change = side * (self.parameter_map.values(ahead)[rows, which] - now)
            jumps = ~(change > 0)
            if not jumps.any():
                break
            self.step_length[walks[jumps]] /= 2
        return ahead, slopes

    def fit_step(self, walks: npt.NDArray[np.intp], ratio_factors: Sequence[float], iterations: int) -> LaplaceFits:
        """The fits of some walks after the next step, at the noise ratio so far or at a better one.

        Args:
            walks: indices of the walks.
            ratio_factors: factors of the other noise ratios that are tried.
            iterations: steps of a fit, at most.
        """
        ahead, slopes = self.predict_step(walks)
        hypotheses = [self.current.hypotheses[i] for i in walks]
        fits = self.fitter.fit(hypotheses, ahead, self.current.sensor_std[walks], iterations, fixed_directions=slopes)
        if not ratio_factors:
            return fits
        n = len(ratio_factors)
        others = self.fitter.fit(
            [replace(one, noise_ratio=one.noise_ratio * factor) for one in hypotheses for factor in ratio_factors],
            np.repeat(fits.mean, n, axis=0),
            np.repeat(fits.sensor_std, n),
            iterations,
            give_up_above=np.repeat(fits.free_energy + _MAX_RATIO_NATS, n),
            fixed_directions=np.repeat(slopes, n, axis=0),
        )
        tried = np.column_stack([finite_losses(fits), finite_losses(others).reshape(-1, n)]).argmin(axis=1)
        rows = np.arange(len(walks))
        chosen = np.where(tried == 0, rows, len(rows) + rows * n + tried - 1)
        return LaplaceFits.concatenated([fits, others]).select(chosen)

    def walk_outward(self, lowest_loss: float) -> tuple[LaplaceFits, npt.NDArray[np.intp]]:
        """Walk until the loss is large; all fits on the way, and the index of the walk of each."""
        self.step_length[:] = 1.0
        rows = np.arange(len(self.parameter_index))
        first = self.parameter_map.values(self.current.mean)[rows, self.parameter_index]
        steps, walkers, active = list[LaplaceFits](), list[npt.NDArray[np.intp]](), rows
        for _ in range(_MAX_WALK_STEPS):
            found = self.fit_step(active, _WALK_RATIO_FACTORS, FIT_ITERATIONS)
            loss_increase = finite_losses(found) - self.current.loss[active]
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
                (self.current.loss - lowest_loss > MAX_LOSS) | is_irrelevant | (self.step_length < _MIN_STEP_STDS)
            )
            active = active[~is_finished[active]]
            if not len(active):
                break
        return LaplaceFits.concatenated(steps), np.concatenate(walkers)


def finite_losses(fits: LaplaceFits) -> FloatArray:
    """(H,) losses; inf where a fit diverged."""
    return np.where(np.isfinite(fits.free_energy), fits.loss, np.inf)


def is_gaussian(walk: RidgeWalk, found: LaplaceFits) -> bool:
    """Whether the loss of the found fits agrees with a Gaussian about the current fits of a walk."""
    rows = np.arange(len(walk.parameter_index))
    now, there = (walk.parameter_map.values(fits.mean)[rows, walk.parameter_index] for fits in (walk.current, found))
    slopes = walk.parameter_map.slopes(walk.current.mean)[rows, walk.parameter_index]
    std = np.sqrt(np.einsum("nk,nkl,nl->n", slopes, walk.current.cov, slopes))
    root = np.sqrt(2 * np.maximum(found.loss - walk.current.loss, 0.0))
    with np.errstate(all="ignore"):
        apart = np.abs(np.log(root / (np.abs(there - now) / std)))
    return bool((apart < np.log(_GAUSSIAN_CHECK_FACTOR)).all())
