"""The search: from nothing, or a guess, to the coefficients and noises that the records leave."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from estimator.identification.fitting.profile_likelihood import RidgePosterior, profile_posterior
from estimator.identification.fitting.weak_form import input_effect_rms, random_starts, weak_form_starts
from estimator.identification.likelihood.identification_problem import IdentificationProblem
from estimator.identification.likelihood.initial_states import find_initial_states
from estimator.identification.likelihood.laplace_fit import (
    CoefficientPrior,
    FitHypothesis,
    LaplaceFits,
    LaplaceFitter,
    with_noise_ratios,
)
from estimator.inference.noise_grid import neg_log_half_cauchy
from estimator.rigs.physical_parameters import coefficients_of
from estimator.rigs.rig_prior import rig_prior
from estimator.support.array_types import FloatArray
from estimator.support.progress import ProgressCallback

#: Standard deviation of the gain where no input tells it, and it is 1 by the scales.
_KNOWN_GAIN_STD = 1e-6

#: Without a guess a coefficient is believed to be about 0, within so many of its natural sizes.
_WIDE_PRIOR_FACTOR = 30.0

#: Where the search for the noises begins: σ_w/σ_v in parts of the squared angular frequency, which is what moves the
#: output as much as it disturbs it. It is open to either side.
_INITIAL_NOISE_RATIOS = np.geomspace(1e-2, 1e2, 5)

#: Periods of each record in the first fits.
_FIRST_PERIODS = 25

#: Fewest samples of each record in the first fits.
_MIN_FIRST_SAMPLES = 1024

#: Most samples of each record in the first fits.
_MAX_FIRST_SAMPLES = 4096

#: The equation is tested with so many periods, where these are more samples.
_WEAK_FORM_PERIODS = 40

#: Steps of it, after which so many of its hypotheses are kept.
_FIRST_SEARCH_STAGES = ((3, 8), (10, 1))

#: Disturbance of a good result, as a fraction of the input, at most; above it other starts are drawn.
_MAX_GOOD_DISTURBANCE = 0.05

#: Rounds of random starts, at most.
_MAX_RESTARTS = 3

#: Random starts in a round.
_N_RANDOM_STARTS = 192

#: Periods in the first segments that random starts are fitted to.
_SEGMENT_PERIODS = 4

#: Samples in the first segments, at least.
_MIN_SEGMENT_SAMPLES = 128

#: Factor by which segments grow from round to round.
_SEGMENT_GROWTH = 4

#: Steps of a fit from a random start.
_RESTART_FIT_STEPS = 8

#: Results that are kept of random starts, of segments, and of all records.
_N_KEPT_STARTS = (48, 12, 3)

#: Nats by which the free energies of results that are the same differ at most.
_SAME_OPTIMUM_NATS = 5.0

#: Steps of a fit to all records, from what the first look found and from where it began, of which the best is kept.
_CONFIRMING_FIT_STEPS = 3

#: Ratios in a grid.
_RATIO_GRID_POINTS = 8

#: Standard deviations of the log ratio that the last grid reaches, either way.
_GRID_REACH_STDS = 3.0

#: Free energy by which the ends of a grid are worse than its best, at least [nats].
_MIN_EDGE_NATS = 2.0

#: Smallest ratio, in units of the squared angular frequency.
_MIN_NOISE_RATIO = 1e-5

#: Largest ratio, in the same units.
_MAX_NOISE_RATIO = 1e4

#: Runge-Kutta steps per sample; the fewest with a small error are taken. The method has order 4, and the most are enough
#: for motions of a third of a period per sample.
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


@dataclass(frozen=True, eq=False)
class SearchResult:
    """What a search left.

    Attributes:
        fits: hypotheses about the noises that share the records, interpolation, delay and terms.
        weights: (H,) their probabilities.
        fitter: that made them.
        has_failed: whether they explain the records badly, and no other start leads to them.
        ridges: along which the posterior lies where it is no Gaussian; the hypotheses are then also about the
            coefficients.
    """

    fits: LaplaceFits
    weights: FloatArray
    fitter: LaplaceFitter
    has_failed: bool = False
    ridges: RidgePosterior | None = None

    @property
    def mean(self) -> FloatArray:
        """(K,) of the mixture; along a ridge its middle, because a mean may be beside all that is possible."""
        return np.asarray(self.weights @ self.fits.mean) if self.ridges is None else self.fits.mean[self._best_index]

    @property
    def cov(self) -> FloatArray:
        """(K, K) of the mixture, about `mean`."""
        away = self.fits.mean - self.mean
        return np.asarray(np.tensordot(self.weights, self.fits.cov, 1) + (away.T * self.weights) @ away)

    @property
    def best(self) -> FitHypothesis:
        """The most probable hypothesis; along a ridge that in the middle."""
        return self.fits.hypotheses[self._best_index]

    @property
    def initial_states(self) -> FloatArray:
        """(records, 2) displacement and velocity a sample before each record."""
        assert self.best.initial_states is not None
        return self.best.initial_states

    @property
    def sensor_std(self) -> float:
        """σ_v of that hypothesis."""
        return float(self.fits.sensor_std[self._best_index])

    @property
    def _best_index(self) -> int:
        return int(np.argmax(self.weights)) if self.ridges is None else self.ridges.median_index

    @property
    def relative_disturbance(self) -> float:
        """σ_w of the most probable hypothesis, in parts of what the inputs do."""
        return self.best.noise_ratio * self.sensor_std / max(input_effect_rms(self.fitter.problem, self.mean), 1e-300)

    @property
    def noises(self) -> tuple[FloatArray, FloatArray]:
        """(H,) σ_w and σ_v of the hypotheses."""
        ratios = np.array([h.noise_ratio for h in self.fits.hypotheses])
        return ratios * self.fits.sensor_std, self.fits.sensor_std


def coefficient_prior(problem: IdentificationProblem) -> CoefficientPrior:
    """What the rig's guess says of the coefficients; next to nothing where there is none."""
    if problem.rig.guess is None:
        natural = problem.natural_coefficient_sizes()
        names = list(problem.model.coefficients)
        means, stds = np.zeros(len(names)), np.array([_WIDE_PRIOR_FACTOR * natural[name] for name in names])
        if problem.is_free_decay:
            means[names.index("gain")], stds[names.index("gain")] = 1.0, _KNOWN_GAIN_STD
        return CoefficientPrior(means, np.diag(stds**-2))
    guess = rig_prior(problem.rig, problem.scales)
    return CoefficientPrior.of(*problem.moments_about_origin(guess.coefficients_mean, guess.coefficients_cov))


def search_coefficients(problem: IdentificationProblem, on_progress: ProgressCallback) -> SearchResult:
    """Find the coefficients and the noises, for the rig's own interpolation and delay.

    Args:
        problem: the records.
        on_progress: is told the share that is done, by experience, and what is being done.

    Raises:
        ValueError: where no start leads anywhere.
    """
    coarse_substeps = next(n for n in _SUBSTEP_CHOICES if problem.mean_frequency / n < _MAX_SUBSTEP_ANGLE)
    fitter = LaplaceFitter(replace(problem, substeps=coarse_substeps), coefficient_prior(problem))
    on_progress(0.0, "looking for a start")
    first_fits = _fit_first_starts(fitter)
    if not len(first_fits.mean):
        raise ValueError(
            "records must be of an oscillator that Eq. (1) can follow, and show what the input does for a few periods, "
            "but every start ran away; check units, columns and the sampling step, or add a guess to the rig"
        )
    on_progress(0.3, "fitting coefficients and noises")
    result = _settle_best_start(fitter, first_fits)
    if problem.rig.guess is None and not problem.is_free_decay and result.relative_disturbance > _MAX_GOOD_DISTURBANCE:
        on_progress(0.6, "looking for another start")
        result = _restart_and_settle(fitter, result)
    return result


def _restart_and_settle(fitter: LaplaceFitter, first_result: SearchResult) -> SearchResult:
    """The best of what was found and of what other starts lead to.

    Where these come to the same it is not the start that is wrong, and none is sought after one that is not poor.
    """
    energy = lambda end: float(end.fits.free_energy.min())  # noqa: E731
    results = [first_result]
    for seed in range(_MAX_RESTARTS):
        random_fits = _fit_random_starts(fitter, seed)
        for k in range(len(random_fits.mean)):
            with suppress(ValueError):  # it ran away
                results.append(_settle_best_start(fitter, random_fits.select(np.array([k]))))
            results.sort(key=energy)
            is_same_optimum = len(results) > 1 and energy(results[1]) < energy(results[0]) + _SAME_OPTIMUM_NATS
            if is_same_optimum or results[0].relative_disturbance < _MAX_GOOD_DISTURBANCE:
                return results[0]
    return replace(results[0], has_failed=True)


def _settle_best_start(fitter: LaplaceFitter, start_fits: LaplaceFits) -> SearchResult:
    """What the best of some fits comes to, with as many steps of integration and the motions that it needs."""
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


def _noise_scales_changed(problem: IdentificationProblem, noise_scales: FloatArray) -> bool:
    """Whether the noises of some records are other than was thought, surely and by so much that it matters."""
    before = np.ones(len(noise_scales)) if problem.record_noise_scales is None else problem.record_noise_scales
    n_observed = np.array([np.isfinite(y).sum() for y in problem.y])
    change = np.abs(np.log(np.maximum(noise_scales, 1e-300) / before))
    return bool(
        (
            change > np.maximum(_MIN_LOG_NOISE_CHANGE, _MIN_NOISE_CHANGE_STDS / np.sqrt(2 * np.maximum(n_observed, 1)))
        ).any()
    )


def spread_along_ridge(result: SearchResult, names: Sequence[str]) -> SearchResult:
    """The same, along the ridge on which the posterior of some parameters lies where it is no Gaussian."""
    profile = profile_posterior(result.fits, int(np.argmax(result.weights)), result.fitter, names)
    return result if profile is None else replace(result, fits=profile[0], weights=profile[1], ridges=profile[2])


def _initial_states_changed(result: SearchResult) -> bool:
    """Whether the records begin in motions other than the filter was linear about, and it matters."""
    initial_states = find_initial_states(result.fitter.problem, result.best, result.mean[None], result.sensor_std)
    hypothesis = replace(result.best, initial_states=initial_states[0])
    fits = result.fitter.fit([result.best, hypothesis], result.mean, result.sensor_std, iterations=0)
    before, after = fits.free_energy
    return not np.isclose(before, after, rtol=0.0, atol=_MIN_STATE_CHANGE_NATS)


def _fit_first_starts(fitter: LaplaceFitter) -> LaplaceFits:
    """The best of all starts and ratios of the noises; of none where all ran away."""
    problem = fitter.problem
    period = 2 * np.pi / problem.mean_frequency
    samples = int(np.clip(_FIRST_PERIODS * period, _MIN_FIRST_SAMPLES, _MAX_FIRST_SAMPLES))
    short_fitter = fitter.for_problem(problem.with_segments(problem.most_driven_segments(samples), samples))
    samples = int(max(_WEAK_FORM_PERIODS * period, _MAX_FIRST_SAMPLES))
    candidates = weak_form_starts(problem.with_segments(problem.most_driven_segments(samples), samples))
    if problem.rig.guess is not None:
        middle = {name: (low + high) / 2 for name, (low, high) in problem.rig.guess.items()}
        middle |= {"u0": problem.rig.input.offset, "y0": problem.rig.output.offset}
        guessed = coefficients_of(problem.model, middle, problem.scales)
        candidates.append(problem.moments_about_origin(guessed, np.zeros((len(guessed),) * 2))[0])
    if not candidates:
        return _fit_random_starts(fitter)
    ratios = _INITIAL_NOISE_RATIOS * problem.mean_frequency ** (2 - problem.scales.order)
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
        # The first periods may tell little of a coefficient, which then is anywhere: all records judge.
        points = np.array([*fits.mean, *candidates])
        fits = fitter.fit(
            list(fits.hypotheses) * len(points), points, fits.sensor_std[0], _CONFIRMING_FIT_STEPS
        ).lowest_free_energy(1)
    return fits if np.isfinite(fits.free_energy).any() else _fit_random_starts(fitter)


def _fit_random_starts(fitter: LaplaceFitter, seed: int = 0) -> LaplaceFits:
    """The best that many starts lead to, which are drawn and fitted to pieces of the records that grow."""
    problem = fitter.problem
    ratios = _INITIAL_NOISE_RATIOS * problem.mean_frequency ** (2 - problem.scales.order)
    base = FitHypothesis(problem.rig.interpolation, problem.rig.delay, float(ratios[2]), lag=problem.lag)
    shortest = max(_MIN_SEGMENT_SAMPLES, round(_SEGMENT_PERIODS * 2 * np.pi / problem.mean_frequency))
    points = np.array(random_starts(problem, _N_RANDOM_STARTS, seed))
    shape, levels = (_N_RANDOM_STARTS, *np.diag(points[0]).shape), np.full(_N_RANDOM_STARTS, 0.1 * problem.output_rms)
    random_fits = LaplaceFits(
        (base,) * _N_RANDOM_STARTS, points, np.zeros(shape), levels, *np.zeros((2, _N_RANDOM_STARTS))
    )
    found = []
    for segment in dict.fromkeys(
        [problem.largest_output_segment(shortest), *problem.most_driven_segments(shortest)[:1]]
    ):
        samples, (n_first, n_later, _) = shortest, _N_KEPT_STARTS
        fits = _fit_from_initial_states(
            fitter.for_problem(problem.with_segments([segment], samples)), random_fits, ratios[[1, 3]], n_first
        )
        while samples < max(map(len, problem.u)):
            fits = _fit_from_initial_states(
                fitter.for_problem(problem.with_segments([segment], samples)), fits, ratios, n_later
            )
            samples *= _SEGMENT_GROWTH
        found.append(fits)
    return _fit_from_initial_states(fitter, LaplaceFits.concatenated(found), ratios, _N_KEPT_STARTS[2])


def _fit_from_initial_states(fitter: LaplaceFitter, fits: LaplaceFits, ratios: FloatArray, n_kept: int) -> LaplaceFits:
    """The best of fits from where others came to, of records that begin in motion, each at the best of the ratios."""
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


def _distinct_optima(fits: LaplaceFits, max_count: int) -> LaplaceFits:
    """The best of those that did not come to the same."""
    finite = fits.select(np.isfinite(fits.free_energy))
    return finite.select(np.unique(np.round(finite.free_energy), return_index=True)[1][:max_count])


def required_substeps(problem: IdentificationProblem, mean: FloatArray, cov: FloatArray) -> int:
    """The fewest steps of integration whose error is tolerable, for coefficients (K,) with a covariance (K, K).

    In steps of the phase z = ω/n Runge and Kutta's method of order 4 turns by z⁵/120 too little and loses z⁶/144 of the
    amplitude: what this adds to stiffness and damping is compared with their standard deviations.
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


def fit_noise_ratio(
    fitter: LaplaceFitter,
    hypothesis: FitHypothesis,
    initial_coefficients: FloatArray,
    sensor_std: float,
    ratio_reach: float,
) -> SearchResult:
    """The posterior over coefficients and noises, of one hypothesis about all else.

    A grid of ratios is laid about the best and narrowed, until it is finer than what the records leave open. Where they
    do not tell σ_w from 0, or σ_v, the prior decides: half a Cauchy density of the ratio (Gelman 2006), about the one
    that moves the output as much as it disturbs it. One even in the logarithm would hold that one of the noises is 0.

    Args:
        fitter: of the records.
        hypothesis: with the ratio to begin at.
        initial_coefficients: (K,) coefficients to begin at.
        sensor_std: σ_v to begin with.
        ratio_reach: factor of the ratio, either way, that the first grid spans.
    """
    unit = fitter.problem.mean_frequency ** (2 - fitter.problem.scales.order)
    bounds = np.log([_MIN_NOISE_RATIO * unit, _MAX_NOISE_RATIO * unit])
    width, middle = np.log(ratio_reach), np.log(hypothesis.noise_ratio)
    for _ in range(12):
        logs = np.clip(middle + np.linspace(-width, width, _RATIO_GRID_POINTS), *bounds)
        fits = fitter.fit(with_noise_ratios(hypothesis, np.exp(logs)), initial_coefficients, sensor_std)
        if not np.isfinite(fits.free_energy).any():
            raise ValueError(
                "records must keep the fit finite, but it ran away; check units and the sampling step, and give a "
                "simulated record some noise, of 1e-8 of its size at least"
            )
        log_ratios_from_unit = logs - np.log(unit)
        energies = fits.free_energy + neg_log_half_cauchy(log_ratios_from_unit)
        best = int(np.argmin(energies))
        initial_coefficients, sensor_std = fits.mean[best], float(fits.sensor_std[best])
        excess_energies = energies - energies[best]
        weights = np.exp(-excess_energies) / np.exp(-excess_energies).sum()
        middle, std = _parabola_moments(logs, excess_energies, best)
        if (excess_energies[[0, -1]] < _MIN_EDGE_NATS)[logs[[0, -1]] != bounds].any():
            width *= 1.5
            continue
        spread = np.sqrt(weights @ (logs - weights @ logs) ** 2)
        if spread > 0.8 * (logs[-1] - logs[0]) / (_RATIO_GRID_POINTS - 1) or width < 0.02:
            break
        width = np.clip(_GRID_REACH_STDS * std, width / 40, width / 2)
    has_weight = weights > 1e-6
    return SearchResult(fits.select(has_weight), weights[has_weight] / weights[has_weight].sum(), fitter)


def _parabola_moments(places: FloatArray, energies: FloatArray, best: int) -> tuple[float, float]:
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
