"""Multistart search for the most probable coefficients and noises, from the records and an optional guess."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from estimator.identification.fitting.noise_ratio_fit import fit_noise_ratio
from estimator.identification.fitting.profile_likelihood import profile_posterior
from estimator.identification.fitting.search_result import SearchResult
from estimator.identification.fitting.starting_points import (
    first_noise_ratios,
    fit_first_starts,
    fit_random_starts,
    refit_from_initial_states,
)
from estimator.identification.likelihood.fit_hypothesis import CoefficientPrior, LaplaceFits
from estimator.identification.likelihood.initial_states import find_initial_states
from estimator.identification.likelihood.laplace_fit import LaplaceFitter
from estimator.identification.likelihood.scaled_records import ScaledRecords
from estimator.rigs.rig_prior import rig_prior
from estimator.support.array_types import FloatArray
from estimator.support.progress import ProgressCallback

#: Standard deviation of the gain of a free decay, which is 1 by the scales.
_KNOWN_GAIN_STD = 1e-6

#: Standard deviation of a coefficient without a guess, in natural sizes; its mean is 0.
_WIDE_PRIOR_FACTOR = 30.0

#: Disturbance of a good result, as a fraction of the input, at most; above it other starts are drawn.
_MAX_GOOD_DISTURBANCE = 0.05

#: Random starts in a round. Rounds are small, because few starts are often enough.
_STARTS_PER_ROUND = 48

#: Rounds of random starts, at most.
_MAX_ROUNDS = 24

#: Rounds after which a start that leads to the best result again ends the search.
_ROUNDS_BEFORE_AGREEMENT = 8

#: Difference of the free energies of equal optima, at most [nats].
_SAME_OPTIMUM_NATS = 5.0

#: Runge-Kutta steps of order 4 per sample, of which the fewest with a small error are taken; the most are enough for
#: motions of a third of a period per sample.
_SUBSTEP_CHOICES = (2, 4, 8, 16, 32)

#: Largest error of the integration, in standard deviations of stiffness and damping.
_MAX_INTEGRATION_ERROR = 0.02

#: Largest phase of the motion per step, before any fit [rad].
_MAX_SUBSTEP_ANGLE = 0.25

#: Fits with new substeps, initial states and noises of the records, at most.
_MAX_SETTLING_ROUNDS = 6

#: Change of the free energy by new initial states that asks for one more fit [nats].
_MIN_STATE_CHANGE_NATS = 0.1

#: Change of the log noise of a record that asks for one more fit.
_MIN_LOG_NOISE_CHANGE = 0.05

#: The same change in standard deviations.
_MIN_NOISE_CHANGE_STDS = 6.0


def coefficient_prior(problem: ScaledRecords) -> CoefficientPrior:
    """The prior of the coefficients: the rig's guess, or a wide one without a guess."""
    if problem.rig.guess is None:
        natural = problem.natural_coefficient_sizes()
        names = list(problem.model.coefficients)
        means, stds = np.zeros(len(names)), np.array([_WIDE_PRIOR_FACTOR * natural[name] for name in names])
        if problem.is_free_decay:
            means[names.index("gain")], stds[names.index("gain")] = 1.0, _KNOWN_GAIN_STD
        return CoefficientPrior(means, np.diag(stds**-2))
    guess = rig_prior(problem.rig, problem.scales)
    return CoefficientPrior.of(*problem.moments_about_origin(guess.coefficients_mean, guess.coefficients_cov))


def search_coefficients(problem: ScaledRecords, on_progress: ProgressCallback) -> SearchResult:
    """Find the coefficients and the noises, for the rig's interpolation and delay.

    Args:
        problem: the records.
        on_progress: receives the approximate share that is done, and the current step.

    Raises:
        ValueError: where the fits from all starts diverge.
    """
    coarse_substeps = next(n for n in _SUBSTEP_CHOICES if problem.mean_frequency / n < _MAX_SUBSTEP_ANGLE)
    fitter = LaplaceFitter(replace(problem, substeps=coarse_substeps), coefficient_prior(problem))
    on_progress(0.0, "looking for a start")
    first_fits = fit_first_starts(fitter)
    if not len(first_fits.mean):
        raise ValueError(
            "records must be of an oscillator that Eq. (1) can follow, with a few periods of response to the input, "
            "but every start diverged; check units, columns and the sampling step, or add a guess to the rig"
        )
    on_progress(0.3, "fitting coefficients and noises")
    result = _settle_best_start(fitter, first_fits)
    if problem.rig.guess is None and not problem.is_free_decay and result.relative_disturbance > _MAX_GOOD_DISTURBANCE:
        on_progress(0.6, "looking for another start")
        result = _restart_and_settle(fitter, result)
    return result


def _restart_and_settle(fitter: LaplaceFitter, first_result: SearchResult) -> SearchResult:
    """The best of a poor result and of results from random starts.

    A result that is not poor ends the search. After some rounds, so does a start that leads to the best result again:
    then the start is not the fault. Only fits that are better than the best result's are settled.
    """
    energy = lambda end: float(end.fits.free_energy.min())  # noqa: E731
    best, bar, is_found_again = first_result, _comparable_free_energy(fitter, first_result), False
    for seed in range(_MAX_ROUNDS):
        fits = fit_random_starts(fitter, _STARTS_PER_ROUND, seed)
        found = float(fits.free_energy[0]) if len(fits.mean) else np.inf
        is_found_again |= abs(found - bar) < _SAME_OPTIMUM_NATS
        if found < bar - _SAME_OPTIMUM_NATS:
            with suppress(ValueError):  # it diverged
                result = _settle_best_start(fitter, fits)
                if energy(result) < energy(best):
                    best, bar, is_found_again = result, found, False
        is_poor = best.relative_disturbance > _MAX_GOOD_DISTURBANCE
        if not is_poor or (is_found_again and seed + 1 >= _ROUNDS_BEFORE_AGREEMENT):
            return best
    return replace(best, has_failed=True)


def _comparable_free_energy(fitter: LaplaceFitter, result: SearchResult) -> float:
    """The free energy of a result at the noise ratios and initial states of fits from random starts."""
    fits = refit_from_initial_states(fitter, result.fits.lowest_free_energy(1), first_noise_ratios(fitter.problem), 1)
    return float(fits.free_energy[0]) if len(fits.mean) else np.inf


def _settle_best_start(fitter: LaplaceFitter, start_fits: LaplaceFits) -> SearchResult:
    """The result from the first of some fits, with the substeps, initial states and record noises that it needs."""
    problem, hypothesis = fitter.problem, start_fits.hypotheses[0]
    start, sensor_std, reach = start_fits.mean[0], float(start_fits.sensor_std[0]), 30.0
    substeps = required_substeps(problem, start, start_fits.cov[0])
    for _ in range(_MAX_SETTLING_ROUNDS):
        problem = replace(problem, substeps=substeps)
        hypothesis = replace(
            hypothesis, initial_states=find_initial_states(problem, hypothesis, start[None], sensor_std)[0]
        )
        result = fit_noise_ratio(fitter.for_problem(problem), hypothesis, start, sensor_std, reach)
        start, sensor_std, hypothesis, reach = result.mean, result.sensor_std, result.best, 2.0
        substeps = max(substeps, required_substeps(problem, start, result.cov))
        noise_scales = result.fitter.record_noise_scales(result.best, start, sensor_std)
        if (
            substeps == problem.substeps
            and not _noise_scales_changed(problem, noise_scales)
            and not _initial_states_changed(result)
        ):
            break
        if _noise_scales_changed(problem, noise_scales):
            problem = replace(problem, record_noise_scales=noise_scales)
    return result


def _noise_scales_changed(problem: ScaledRecords, noise_scales: FloatArray) -> bool:
    """Whether the noises of some records differ from the assumed ones, significantly and by enough to matter."""
    before = np.ones(len(noise_scales)) if problem.record_noise_scales is None else problem.record_noise_scales
    n_observed = np.array([np.isfinite(y).sum() for y in problem.y])
    change = np.abs(np.log(np.maximum(noise_scales, 1e-300) / before))
    return bool(
        (
            change > np.maximum(_MIN_LOG_NOISE_CHANGE, _MIN_NOISE_CHANGE_STDS / np.sqrt(2 * np.maximum(n_observed, 1)))
        ).any()
    )


def spread_along_ridge(result: SearchResult, names: Sequence[str]) -> SearchResult:
    """The result along the ridge of the posterior of some parameters; unchanged where the posterior is a Gaussian."""
    profile = profile_posterior(result.fits, int(np.argmax(result.weights)), result.fitter, names)
    if profile is None:
        return result
    fits, weights, ridges = profile
    return replace(result, fits=fits, weights=weights, ridges=ridges)


def _initial_states_changed(result: SearchResult) -> bool:
    """Whether new initial states of the records change the free energy."""
    initial_states = find_initial_states(result.fitter.problem, result.best, result.mean[None], result.sensor_std)
    hypothesis = replace(result.best, initial_states=initial_states[0])
    fits = result.fitter.fit([result.best, hypothesis], result.mean, result.sensor_std, iterations=0)
    before, after = fits.free_energy
    return not np.isclose(before, after, rtol=0.0, atol=_MIN_STATE_CHANGE_NATS)


def required_substeps(problem: ScaledRecords, mean: FloatArray, cov: FloatArray) -> int:
    """The fewest substeps with a tolerable integration error, for coefficients (K,) with a covariance (K, K).

    In a step of the phase z = ω/n, the Runge-Kutta method of order 4 turns by z⁵/120 too little and loses z⁶/144 of
    the amplitude. The effect on stiffness and damping is compared with their standard deviations.
    """
    names = list(problem.model.coefficients)
    coefficients, std = (dict(zip(names, v, strict=True)) for v in (mean, np.sqrt(np.diag(cov))))
    square = abs(coefficients["stiffness"]) + 3 * abs(coefficients["cubic"]) * problem.displacement**2
    for n in _SUBSTEP_CHOICES:
        z2 = square / n**2
        error = max(square * z2**2 / 60 / std["stiffness"], 2 * n * z2**3 / 144 / std["damping"])
        if error <= _MAX_INTEGRATION_ERROR:
            break
    return n
