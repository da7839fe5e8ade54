"""Leaps along a parameter to modes of the posterior that a walk does not reach."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from estimator.identification.fitting.ridge_walk import (
    FIT_ITERATIONS,
    MAX_LOSS,
    SCREENING_ITERATIONS,
    ParameterMap,
    finite_losses,
)
from estimator.identification.likelihood.fit_hypothesis import LaplaceFits
from estimator.identification.likelihood.laplace_fit import LaplaceFitter
from estimator.support.array_types import FloatArray

#: Lengths of the short leaps [standard deviations].
_LEAP_STDS = (6.0, 15.0)

#: Number of leaps in the parameter's logarithm, either way.
_N_LOG_LEAPS = 5

#: Length of each in the logarithm.
_LOG_LEAP_LENGTH = 0.5 * np.log(10.0)

#: Longest leap [standard deviations].
_MAX_LEAP_STDS = 1e9

#: Bisections of the length of a leap, which reach the rounding error.
_N_BISECTIONS = 50

#: Factors of the noise ratio that are tried after a leap.
_LEAP_RATIO_FACTORS = (1.0, 0.1, 0.01)

#: Loss after the first steps above which a leap is dropped [nats].
_MAX_SCREENING_LOSS = 1000.0

#: Relative standard deviation below which a parameter has no leaps.
_MIN_RELATIVE_STD = 1e-3

#: Length from which a leap speaks against a Gaussian [standard deviations].
_SURPRISING_LEAP_STDS = 4.0

#: Its loss as a fraction of the Gaussian's, at most.
_SURPRISING_LOSS_FRACTION = 0.5


def fit_leaps(
    fitter: LaplaceFitter, parameter_map: ParameterMap, start: LaplaceFits, parameter_indices: npt.NDArray[np.intp]
) -> tuple[dict[int, LaplaceFits], bool]:
    """Fits far from the start, straight along each parameter, that are about as probable as the start.

    All leaps are screened first, at one noise ratio and in a few steps, because most fail.

    Args:
        fitter: fitter of the records.
        parameter_map: from coefficients to parameters.
        start: the fit to leap from.
        parameter_indices: indices of the parameters to leap along.

    Returns:
        Index of a parameter to its fits, and whether they contradict a Gaussian about the start.
    """
    begin, values, slopes = start.mean[0], parameter_map.values(start.mean)[0], parameter_map.slopes(start.mean)[0]
    leaps = list[tuple[int, float, float, FloatArray]]()
    for number in parameter_indices.tolist():
        toward = start.cov[0] @ slopes[number]
        std = float(np.sqrt(slopes[number] @ toward))
        if not std > _MIN_RELATIVE_STD * abs(values[number]):
            continue
        first, unit = np.arcsinh(values[number] / std), toward / std
        for side in (1.0, -1.0):
            short = [values[number] + side * length * std for length in _LEAP_STDS]
            long = std * np.sinh(first + side * _LOG_LEAP_LENGTH * np.arange(1, _N_LOG_LEAPS + 1))
            leaps += [(number, side, target, side * unit) for target in (*short, *long.tolist())]
    if not leaps:
        return {}, False
    leap_parameters, sides, targets, directions = (np.array(part) for part in zip(*leaps, strict=True))
    lengths = _lengths_to_targets(parameter_map, leap_parameters, begin, directions, sides, targets)
    points = begin + lengths[:, None] * directions
    gradients = parameter_map.slopes(points)[np.arange(len(points)), leap_parameters]
    for factors, iterations, allowed in (
        (_LEAP_RATIO_FACTORS[1:2], SCREENING_ITERATIONS, _MAX_SCREENING_LOSS),
        (_LEAP_RATIO_FACTORS, FIT_ITERATIONS, MAX_LOSS),
    ):
        n, count = len(factors), len(points)
        ratios = start.hypotheses[0].noise_ratio * np.tile(factors, count)
        hypotheses = [replace(start.hypotheses[0], noise_ratio=float(ratio)) for ratio in ratios]
        begins, pinned = np.repeat(points, n, axis=0), np.repeat(gradients, n, axis=0)
        fits = fitter.fit(hypotheses, begins, start.sensor_std[0], iterations, fixed_directions=pinned)
        found = fits.select(np.arange(count) * n + finite_losses(fits).reshape(count, n).argmin(axis=1))
        kept = finite_losses(found) < start.loss[0] + allowed
        found = found.select(kept)
        points, gradients = points[kept], gradients[kept]
        leap_parameters, lengths = leap_parameters[kept], lengths[kept]
        if not len(points):
            return {}, False
    predicted = np.where(lengths > _SURPRISING_LEAP_STDS, 0.5 * lengths**2, 0.0)
    is_surprising = bool((found.loss - start.loss[0] < _SURPRISING_LOSS_FRACTION * predicted).any())
    fits_by_parameter = {
        number: found.select(leap_parameters == number) for number in np.unique(leap_parameters).tolist()
    }
    return fits_by_parameter, is_surprising


def _lengths_to_targets(
    parameter_map: ParameterMap,
    parameter_indices: npt.NDArray[np.intp],
    begin: FloatArray,
    directions: FloatArray,
    signs: FloatArray,
    targets: FloatArray,
) -> FloatArray:
    """(n,) lengths along directions at which a parameter reaches its target, or the last before the parameter jumps.

    Args:
        parameter_map: from coefficients to parameters.
        parameter_indices: (n,) index of the parameter of each direction.
        begin: (K,) coefficients at length 0.
        directions: (n, K) change of the coefficients per length.
        signs: (n,) 1 where the target is above the begin, -1 where below.
        targets: (n,) values of the parameters.
    """
    rows = np.arange(len(targets))
    first = parameter_map.values(begin[None])[0, parameter_indices]

    def is_past(lengths: FloatArray) -> npt.NDArray[np.bool_]:
        values = parameter_map.values(begin + lengths[:, None] * directions)[rows, parameter_indices]
        change = signs * (values - first)
        return np.asarray(~((change > 0) & (change < signs * (targets - first))))

    near, far = np.zeros(len(targets)), np.ones(len(targets))
    while (is_short := ~is_past(far) & (far < _MAX_LEAP_STDS)).any():
        far[is_short] *= 2
    for _ in range(_N_BISECTIONS):
        middle = (near + far) / 2
        past = is_past(middle)
        near, far = np.where(past, near, middle), np.where(past, middle, far)
    return near
