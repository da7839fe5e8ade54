"""Checks of identifiability: the parameters that the records leave open."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from estimator.identification.diagnostics.check_finding import CheckFinding
from estimator.identification.fitting.ridge_posterior import ONE_STD_PROBABILITY, RidgePosterior
from estimator.identification.fitting.search_result import SearchResult
from estimator.identification.likelihood.scaled_records import TARGET_PARAMETERS, ScaledRecords
from estimator.rigs.physical_parameters import propagate_to_physical
from estimator.support.array_types import FloatArray

#: Largest relative standard deviation of an identified parameter.
_MAX_RELATIVE_STD = 1 / 3

#: Where the posterior is no Gaussian, largest width of the central 68 % interval, as a fraction of its outer end: a
#: factor of five between the ends.
_MAX_RELATIVE_WIDTH = 0.8

#: The same after one settled sine, along whose ridge a walk may end at a gap.
_MAX_RELATIVE_WIDTH_OF_SINE = 0.02

#: Largest deviation of an input from a sine, relative to the input.
_SINE_TOLERANCE = 0.01

#: Largest cubic force of a spring that is called linear, relative to the linear force.
_MAX_LINEAR_CUBIC_FRACTION = 0.05


def check_identifiability(
    problem: ScaledRecords,
    search_result: SearchResult,
    ridges: RidgePosterior | None,
    parameters: dict[str, tuple[float, float]],
) -> list[CheckFinding]:
    """A finding that names the parameters with wide intervals.

    Args:
        problem: the records, scaled.
        search_result: the result of the search.
        ridges: ridges of a posterior that is no Gaussian; None of a Gaussian.
        parameters: parameter to mean and standard deviation, in the rig's units.
    """
    reason = "this input; the records leave more than a third of it open"
    if ridges is None:
        unidentified = [
            name
            for name, deviation in _stds_from_records_alone(problem, search_result).items()
            if deviation > _MAX_RELATIVE_STD
        ]
    else:
        ends, span = ridges.interval(ONE_STD_PROBABILITY), _MAX_RELATIVE_WIDTH
        if _is_single_sine(problem.u):
            reason, span = (
                "one settled sine; add a record of another amplitude or frequency",
                _MAX_RELATIVE_WIDTH_OF_SINE,
            )
        unidentified = [name for name, (low, high) in ends.items() if high - low > span * max(abs(low), abs(high))]
    warnings = []
    if unidentified:
        message = f"{', '.join(unidentified)}: not identified by {reason}"
        if "b" in unidentified and (part := _max_cubic_fraction(problem, parameters)) < _MAX_LINEAR_CUBIC_FRACTION:
            message += f"; the spring is linear to {100 * part:.2g} % within the motion of the records"
        warnings.append(CheckFinding("not_identified", message, tuple(unidentified)))
    return warnings


def _is_single_sine(inputs: Sequence[FloatArray]) -> bool:
    """Whether all inputs (T,) are sines of the same frequency and amplitude."""
    found = []
    for u in inputs:
        centred = u - u.mean()
        zero_crossings = int(np.count_nonzero(centred[1:] * centred[:-1] < 0))
        quarter = max(1, round(len(u) / max(2 * zero_crossings, 1)))
        if zero_crossings < 4 or len(u) < 8 * quarter:
            return False
        # The sum of two values of a sine, a quarter earlier and later, is the value between them times a constant.
        middle, neighbours = centred[quarter:-quarter], centred[2 * quarter :] + centred[: -2 * quarter]
        factor = float(middle @ neighbours / (middle @ middle))
        if np.std(neighbours - factor * middle) > _SINE_TOLERANCE * middle.std():
            return False
        found.append((middle.std(), np.arccos(np.clip(factor / 2, -1.0, 1.0)) / quarter))
    return bool((np.ptp(found, axis=0) < _SINE_TOLERANCE * np.mean(found, axis=0)).all())


def _max_cubic_fraction(problem: ScaledRecords, parameters: Mapping[str, tuple[float, float]]) -> float:
    """The largest cubic force, relative to the linear force, within two standard deviations of b."""
    largest = 3 * problem.displacement * problem.scales.displacement
    (a, _), (b, std) = parameters["a"], parameters["b"]
    return (abs(b) + 2 * std) * largest**2 / abs(a)


def _stds_from_records_alone(problem: ScaledRecords, search_result: SearchResult) -> dict[str, float]:
    """Relative standard deviations of m, c, a and b from the records alone, without the prior."""
    model, mean, cov = problem.rig.model, search_result.mean, search_result.cov
    scale = np.sqrt(np.diag(cov))
    unit = np.outer(scale, scale)
    information = np.linalg.inv(cov / unit) - search_result.fitter.prior.precision * unit
    values, eigenvectors = np.linalg.eigh(information)
    cov_without_prior = (eigenvectors / np.maximum(values, 1e-9)) @ eigenvectors.T * unit
    parameters, spread = propagate_to_physical(model, mean, cov_without_prior)
    deviations = np.sqrt(np.diag(spread)) / np.maximum(np.abs(parameters), 1e-300)
    return {
        name: float(value) for name, value in zip(model.physical, deviations, strict=True) if name in TARGET_PARAMETERS
    }
