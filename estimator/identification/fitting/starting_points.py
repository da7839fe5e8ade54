"""Starting points of the search: fits from weak-form starts, from a guess, and from random starts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from estimator.identification.fitting.weak_form import random_starts, weak_form_starts
from estimator.identification.likelihood.fit_hypothesis import FitHypothesis, LaplaceFits, with_noise_ratios
from estimator.identification.likelihood.initial_states import find_initial_states
from estimator.identification.likelihood.laplace_fit import LaplaceFitter
from estimator.identification.likelihood.scaled_records import ScaledRecords
from estimator.rigs.physical_parameters import coefficients_of
from estimator.support.array_types import FloatArray

#: Noise ratios σ_w/σ_v of the first fits, in units of the squared angular frequency, at which process noise and sensor
#: noise have the same effect on the output. Later grids may go beyond.
_INITIAL_NOISE_RATIOS = np.geomspace(1e-2, 1e2, 5)

#: Periods of each record in the first fits.
_FIRST_PERIODS = 25

#: Fewest samples of each record in the first fits.
_MIN_FIRST_SAMPLES = 1024

#: Most samples of each record in the first fits.
_MAX_FIRST_SAMPLES = 4096

#: Periods of each record in the weak form, at least.
_WEAK_FORM_PERIODS = 40

#: Stages of the first fits: steps, and number of fits that are kept.
_FIRST_SEARCH_STAGES = ((3, 8), (10, 1))

#: Random starts on each segment where there is no other start.
_N_RANDOM_STARTS = 192

#: Periods in the first segments that random starts are fitted to.
_SEGMENT_PERIODS = 4

#: Samples in the first segments, at least.
_MIN_SEGMENT_SAMPLES = 128

#: Factor by which segments grow from round to round.
_SEGMENT_GROWTH = 4

#: Steps of a fit from a random start.
_RESTART_FIT_STEPS = 8

#: Random starts for each that is kept after the first segments, and after longer ones.
_STARTS_PER_KEPT = (4, 16)

#: Steps of the fits to all records that confirm a start.
_CONFIRMING_FIT_STEPS = 3


def fit_first_starts(fitter: LaplaceFitter) -> LaplaceFits:
    """The best fit over all starts and noise ratios; no fit where all diverge."""
    problem = fitter.problem
    period = 2 * np.pi / problem.mean_frequency
    samples = int(np.clip(_FIRST_PERIODS * period, _MIN_FIRST_SAMPLES, _MAX_FIRST_SAMPLES))
    short_fitter = fitter.for_problem(problem.with_segments(problem.most_driven_segments(samples), samples))
    samples = int(max(_WEAK_FORM_PERIODS * period, _MAX_FIRST_SAMPLES))
    candidates = weak_form_starts(problem.with_segments(problem.most_driven_segments(samples), samples))
    if problem.rig.guess is not None:
        middle = {name: (low + high) / 2 for name, (low, high) in problem.rig.guess.items()}
        middle |= {"u0": problem.rig.only_input.offset, "y0": problem.rig.output.offset}
        guessed = coefficients_of(problem.model, middle, problem.scales)
        candidates.append(problem.moments_about_origin(guessed, np.zeros((len(guessed),) * 2))[0])
    if not candidates:
        return _fit_many_random_starts(fitter)
    ratios = first_noise_ratios(problem)
    base = FitHypothesis(problem.rig.interpolation, problem.rig.delay, float(ratios[len(ratios) // 2]), lag=problem.lag)
    sensor_std = np.array(0.1 * problem.output_rms)
    initial_states = find_initial_states(short_fitter.problem, base, np.array(candidates), float(sensor_std))
    moving = [replace(base, initial_states=begin) for begin in initial_states]
    resting = [base] * len(candidates) + moving
    points = np.repeat(np.array([*candidates, *candidates]), len(_INITIAL_NOISE_RATIOS), axis=0)
    hypotheses = [h for one in resting for h in with_noise_ratios(one, ratios)]
    for steps, kept in _FIRST_SEARCH_STAGES:
        fits = short_fitter.fit(hypotheses, points, sensor_std, steps).lowest_free_energy(kept)
        hypotheses, points, sensor_std = list(fits.hypotheses), fits.mean, fits.sensor_std
    if short_fitter.problem.n_observed_outputs < problem.n_observed_outputs and np.isfinite(fits.free_energy).any():
        # The first periods may leave a coefficient open: all records decide.
        points = np.array([*fits.mean, *candidates])
        fits = fitter.fit(
            list(fits.hypotheses) * len(points), points, fits.sensor_std[0], _CONFIRMING_FIT_STEPS
        ).lowest_free_energy(1)
    return fits if np.isfinite(fits.free_energy).any() else _fit_many_random_starts(fitter)


def _fit_many_random_starts(fitter: LaplaceFitter) -> LaplaceFits:
    """The best fit from many random starts."""
    rounds = [fit_random_starts(fitter, _N_RANDOM_STARTS, seed) for seed in range(2)]
    return LaplaceFits.concatenated(rounds).lowest_free_energy(1)


def fit_random_starts(fitter: LaplaceFitter, count: int, seed: int) -> LaplaceFits:
    """The best fit from random starts, fitted to growing segments of the records; no fit where all diverge.

    Args:
        fitter: fitter of the records.
        count: number of starts.
        seed: of the starts. An even one begins where the input acts, an odd one where the outputs are largest.
    """
    problem = fitter.problem
    ratios = first_noise_ratios(problem)
    base = FitHypothesis(problem.rig.interpolation, problem.rig.delay, float(ratios[2]), lag=problem.lag)
    samples = max(_MIN_SEGMENT_SAMPLES, round(_SEGMENT_PERIODS * 2 * np.pi / problem.mean_frequency))
    segment = problem.largest_output_segment(samples) if seed % 2 else problem.most_driven_segments(samples)[0]
    points = np.array(random_starts(problem, count, seed))
    shape, levels = (count, *np.diag(points[0]).shape), np.full(count, 0.1 * problem.output_rms)
    fits = LaplaceFits((base,) * count, points, np.zeros(shape), levels, *np.zeros((2, count)))
    n_first, n_later = (count // part for part in _STARTS_PER_KEPT)
    shortened = fitter.for_problem(problem.with_segments([segment], samples))
    fits = refit_from_initial_states(shortened, fits, ratios[[1, 3]], n_first)
    while samples < max(map(len, problem.u)):
        shortened = fitter.for_problem(problem.with_segments([segment], samples))
        fits = refit_from_initial_states(shortened, fits, ratios, n_later)
        samples *= _SEGMENT_GROWTH
    return refit_from_initial_states(fitter, fits, ratios, 1)


def refit_from_initial_states(fitter: LaplaceFitter, fits: LaplaceFits, ratios: FloatArray, n_kept: int) -> LaplaceFits:
    """The best ``n_kept`` of further fits from earlier ones, with new initial states and the best of several ratios."""
    if not len(fits.mean):
        return fits
    base = replace(fits.hypotheses[0], initial_states=None)
    initial_states = find_initial_states(fitter.problem, base, fits.mean, float(np.median(fits.sensor_std)))
    hypotheses = [
        one for begin in initial_states for one in with_noise_ratios(replace(base, initial_states=begin), ratios)
    ]
    points, levels = np.repeat(fits.mean, len(ratios), axis=0), np.repeat(fits.sensor_std, len(ratios))
    tried = fitter.fit(hypotheses, points, levels, _RESTART_FIT_STEPS)
    of_each = tried.free_energy.reshape(-1, len(ratios)).argmin(axis=1)
    return _distinct_optima(tried.select(len(ratios) * np.arange(len(of_each)) + of_each), n_kept)


def first_noise_ratios(problem: ScaledRecords) -> FloatArray:
    """(5,) noise ratios of first fits."""
    return np.asarray(_INITIAL_NOISE_RATIOS * problem.mean_frequency ** (2 - problem.scales.order))


def _distinct_optima(fits: LaplaceFits, max_count: int) -> LaplaceFits:
    """The best ``max_count`` fits with different optima."""
    finite = fits.select(np.isfinite(fits.free_energy))
    return finite.select(np.unique(np.round(finite.free_energy), return_index=True)[1][:max_count])
