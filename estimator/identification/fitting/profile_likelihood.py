"""Profile likelihood: posteriors that are no Gaussian, followed along their ridges.

One settled sine, for example, leaves a line in the space of the coefficients open, over decades: all coefficients can
change together along it. No Gaussian about one of its points describes it, and the curvature there is mostly due to the
noise. Therefore the posterior is walked along each parameter, step by step, with all other coefficients and the noise
ratio refitted, until the likelihood falls (`estimator.identification.fitting.ridge_walk`). Leaps straight ahead look
for modes that a walk does not reach (`estimator.identification.fitting.ridge_leaps`). Each fit on the way is a Gaussian
across the ridge. The posterior is their mixture, weighted by the likelihood and by the distance to the neighbours in
the logarithm of the parameter, so that the choice of coefficients does not matter. Where two steps outward cost what a
Gaussian predicts, and no leap is as probable as the start, the Gaussian remains.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from estimator.identification.fitting.ridge_leaps import fit_leaps
from estimator.identification.fitting.ridge_posterior import MixtureMarginal, RidgePosterior
from estimator.identification.fitting.ridge_walk import (
    GAUSSIAN_CHECK_STDS,
    SCREENING_ITERATIONS,
    ParameterMap,
    RidgeWalk,
    is_gaussian,
)
from estimator.identification.likelihood.fit_hypothesis import LaplaceFits
from estimator.identification.likelihood.laplace_fit import LaplaceFitter
from estimator.support.array_types import FloatArray

#: Extent of a ridge that counts for all parameters, relative to the longest ridge, at least.
_MIN_RELATIVE_EXTENT = 0.3

#: Loss by which the noise makes the best point of a ridge better than the true one, about [nats]: half a nat for each
#: coefficient, without the one along the ridge.
_NOISE_LOSS_ALLOWANCE = 2.5

#: Probability of a place of a ridge that is left out.
_NEGLIGIBLE_PROBABILITY = 1e-6


def profile_posterior(
    fits: LaplaceFits, best_index: int, fitter: LaplaceFitter, names: Sequence[str]
) -> tuple[LaplaceFits, FloatArray, RidgePosterior] | None:
    """The posterior along the ridges of some parameters; None where it is one Gaussian.

    Args:
        fits: fits at several noise ratios.
        best_index: index of the best.
        fitter: the fitter that made them.
        names: parameters of the rig's model.

    Returns:
        Fits along the longest ridge, their probabilities, and the marginals of the parameters.
    """
    parameter_map = ParameterMap(fitter.problem)
    parameter_indices = np.array([list(parameter_map.model.physical).index(name) for name in names])
    start = fits.select(np.array([best_index]))
    leap_fits, is_surprising = fit_leaps(fitter, parameter_map, start, parameter_indices)
    which, side = np.repeat(parameter_indices, 2), np.tile([1.0, -1.0], len(parameter_indices))
    all_walks = np.arange(len(which))
    walk = RidgeWalk(
        fitter,
        parameter_map,
        which,
        side,
        start.select(np.zeros_like(all_walks)),
        np.full(len(which), GAUSSIAN_CHECK_STDS),
    )
    if not is_surprising and is_gaussian(walk, walk.fit_step(all_walks, (), SCREENING_ITERATIONS)):
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


@dataclass(frozen=True, eq=False)
class _ParameterRidge:
    """The fits along the walks and leaps of one parameter, in the order of its values.

    Attributes:
        fits: the n fits.
        weights: (n,) their probabilities.
        values: (n, P) all parameters.
        stds: (n, P) standard deviations across the ridge and between neighbours.
        extent: change of the parameters along the ridge, in their logarithms.
    """

    fits: LaplaceFits
    weights: FloatArray
    values: FloatArray
    stds: FloatArray
    extent: float

    @classmethod
    def of(
        cls,
        parameter_map: ParameterMap,
        parameter_index: int,
        parameter_indices: npt.NDArray[np.intp],
        fits: LaplaceFits,
    ) -> _ParameterRidge:
        """The ridge of one parameter.

        Args:
            parameter_map: from coefficients to parameters.
            parameter_index: index of the parameter.
            parameter_indices: indices of all parameters with ridges.
            fits: the fits along it, in any order.
        """
        fits = fits.select(np.argsort(parameter_map.values(fits.mean)[:, parameter_index], kind="stable"))
        values, slopes = parameter_map.values(fits.mean), parameter_map.slopes(fits.mean)
        cov = slopes @ fits.cov @ np.swapaxes(slopes, 1, 2)
        own_variance = cov[:, parameter_index, parameter_index]
        across = np.einsum("npp->np", cov) - cov[:, :, parameter_index] ** 2 / own_variance[:, None]
        # The prior of a parameter is flat within a standard deviation of 0, and flat in the logarithm beyond.
        places = np.arcsinh(values / np.sqrt(np.einsum("pp->p", cov[np.argmin(fits.loss)])))
        # Along a ridge the noise alone makes some points better than others: this much does not count.
        excess_loss = np.maximum(fits.loss - fits.loss.min() - _NOISE_LOSS_ALLOWANCE, 0.0)
        spacing = np.exp(-excess_loss)[:, None] * sum(_neighbour_distances(places)) / 2
        weights = spacing[:, parameter_index]
        spacing_std = np.maximum(*_neighbour_distances(values)) / np.sqrt(12)
        stds = np.maximum(np.sqrt(np.maximum(across, 0.0) + spacing_std**2), 1e-300)
        return cls(fits, weights / weights.sum(), values, stds, float(spacing[:, parameter_indices].sum()))


def _neighbour_distances(positions: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distances to the previous and the next position along the first axis; 0 at the ends."""
    gaps = np.abs(np.diff(positions, axis=0, prepend=positions[:1], append=positions[-1:]))
    return gaps[:-1], gaps[1:]
