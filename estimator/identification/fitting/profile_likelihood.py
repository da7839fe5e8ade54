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

#: A ridge of so much of the longest one's extent counts for all parameters.
_MIN_RELATIVE_EXTENT = 0.3

#: By how much the noise makes the best place of a ridge better than the true one, about [nats]: half a nat for each
#: coefficient, of which there are six or so.
_NOISE_LOSS_ALLOWANCE = 2.5

#: Probability of a place of a ridge that is left out.
_NEGLIGIBLE_PROBABILITY = 1e-6


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
    if not is_surprising and is_gaussian(walk, walk.fit_step(all_walks, (1.0,), SCREENING_ITERATIONS)):
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
        parameter_map: ParameterMap,
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
