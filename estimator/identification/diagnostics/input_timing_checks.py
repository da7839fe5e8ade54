"""Checks of the input path, by evidence: another interpolation between samples, another delay, or a lag."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from estimator.identification.diagnostics.check_finding import CheckFinding
from estimator.identification.fitting.search_result import SearchResult
from estimator.identification.likelihood.fit_hypothesis import FitHypothesis
from estimator.identification.likelihood.laplace_fit import LaplaceFitter
from estimator.identification.likelihood.scaled_records import MAX_UNSTATED_DELAY, ScaledRecords
from estimator.models.interpolation import INTERPOLATION_DEGREES
from estimator.rigs.rig import FRACTIONAL_DELAY_INTERPOLATIONS, MAX_DELAY
from estimator.support.array_types import FloatArray

#: Evidence for another hypothesis that is reported, at least [nats].
MIN_EVIDENCE = 7.0

#: Factors of the best noise ratio at which other hypotheses are tried: a wrong hypothesis needs more noise.
_NOISE_RATIO_FACTORS = (1.0, 0.1, 0.01)

#: Delays that are tried, relative to the rig's [samples].
_SMALL_DELAY_SHIFTS = range(-MAX_UNSTATED_DELAY, MAX_UNSTATED_DELAY + 1)

#: Large delays [samples], coarse: the finding leads to the right one when records are identified again.
_LARGE_DELAY_SHIFTS = (5, 8, 12, 16, 20, 25, 30, 40)

#: Fractional delays that are tried first [samples].
_FIRST_DELAY_FRACTIONS = (-0.5, 0.5)

#: Time constants of a lag that are tried first [samples].
_FIRST_LAGS = (0.5, 2.0)
#: Fractional delays about the best hypothesis [samples].
_REFINED_DELAY_FRACTIONS = (-0.5, -0.25, 0.25, 0.5)

#: Time constants of a lag about the best hypothesis [samples].
_REFINED_LAGS = (0.25, 0.5, 1.0, 2.0, 4.0)

#: Decimals of a reported delay [samples]; a lag has one more.
_REPORTED_DIGITS = 2

#: Largest second differences of a smooth input, relative to the input, as root mean squares.
_MAX_ROUGHNESS = 0.7

#: Steps of the fit of another hypothesis, at most.
_MAX_FIT_STEPS = 12

#: Samples of each record on which hypotheses about the input are screened.
_SCREENING_SAMPLES = 1024

#: Free energy by which a hypothesis that is dropped there is worse than the rig's [nats].
_SCREENING_LOSS = 10.0


def check_input_path(problem: ScaledRecords, search_result: SearchResult) -> list[CheckFinding]:
    """A finding where the records speak for another path of the input than the rig states.

    Args:
        problem: the records, scaled.
        search_result: the result of the search.
    """
    rig, baseline = problem.rig, float(search_result.fits.free_energy.min())
    best = search_result.best
    paths = [
        name for name in FRACTIONAL_DELAY_INTERPOLATIONS[:2] if rig.interpolation in FRACTIONAL_DELAY_INTERPOLATIONS
    ] or [rig.interpolation]
    others = [
        replace(best, interpolation=path, delay=rig.delay + shift)
        for path in paths
        for shift in _SMALL_DELAY_SHIFTS
        if (path, shift) != (rig.interpolation, 0)
    ]
    others += [replace(best, delay=rig.delay + shift) for shift in _LARGE_DELAY_SHIFTS]
    # An accelerometer measures a held input directly: sampling just after a switch looks like a fractional delay.
    in_parts = rig.interpolation in FRACTIONAL_DELAY_INTERPOLATIONS and (
        rig.output.kind != "acceleration" or _is_input_smooth(problem)
    )
    if in_parts:
        others += [
            replace(best, interpolation=path, delay=rig.delay + part)
            for path in paths
            for part in _FIRST_DELAY_FRACTIONS
        ]
    if rig.interpolation in FRACTIONAL_DELAY_INTERPOLATIONS:
        smooth = rig.interpolation != "spline" and not best.lag and _is_input_smooth(problem)
        others += [replace(best, interpolation="spline")] if smooth else []
    best_alternative = _best_alternative(problem, search_result, others, baseline)
    if (
        best_alternative is None or best_alternative[1] <= MIN_EVIDENCE
    ) and rig.interpolation in FRACTIONAL_DELAY_INTERPOLATIONS[:2]:
        lagging = [replace(best, lag=best.lag + lag) for lag in _FIRST_LAGS]
        if rig.interpolation == "linear" and not best.lag:  # a linear input resembles a held one with a lag
            lagging += [replace(best, interpolation="zero_order", delay=rig.delay - 1, lag=lag) for lag in _FIRST_LAGS]
        best_alternative = _best_alternative(problem, search_result, lagging, baseline)
    if best_alternative is None or best_alternative[1] <= MIN_EVIDENCE:
        return []
    alternative, gain = best_alternative
    # A delay of several samples is not refined, and a lag delays by one sample at most.
    if in_parts and abs(alternative.delay - rig.delay) <= 1:
        alternative, gain = _refine_delay_and_lag(problem, search_result, alternative, gain, baseline)
    return [_input_path_finding(problem, alternative, gain)]


def _best_alternative(
    problem: ScaledRecords, search_result: SearchResult, hypotheses: Sequence[FitHypothesis], baseline: float
) -> tuple[FitHypothesis, float] | None:
    """The best of some hypotheses and its gain in nats; None where no rig may have any of them."""
    hypotheses = _screen_hypotheses(problem, search_result, [other for other in hypotheses if _is_allowed(other)])
    if not hypotheses:
        return None
    gains = baseline - best_free_energies(search_result.fitter, hypotheses, search_result, baseline)
    return hypotheses[int(np.argmax(gains))], float(gains.max())


def _is_allowed(hypothesis: FitHypothesis) -> bool:
    """Whether a rig may have the hypothesis: only a held input may act up to one sample early."""
    is_integer_delay = hypothesis.delay == int(hypothesis.delay)
    minimum = (-1.0 if hypothesis.interpolation == "zero_order" else 0.0) if is_integer_delay else -0.999
    return minimum <= hypothesis.delay <= MAX_DELAY and hypothesis.lag >= 0.0


def _refine_delay_and_lag(
    problem: ScaledRecords, search_result: SearchResult, hypothesis: FitHypothesis, gain: float, baseline: float
) -> tuple[FitHypothesis, float]:
    """A hypothesis with a fractional delay and a lag, where these are better than whole samples; and its gain."""
    paths = [*FRACTIONAL_DELAY_INTERPOLATIONS[:2], *(["spline"] if _is_input_smooth(problem) else [])]
    middle = float(round(hypothesis.delay))
    others = [
        replace(hypothesis, interpolation=p, delay=middle + d, lag=0.0)
        for p in paths
        for d in (*_REFINED_DELAY_FRACTIONS, 0.0)
    ]
    others += [
        replace(hypothesis, interpolation=p, delay=middle + d, lag=lag)
        for p in FRACTIONAL_DELAY_INTERPOLATIONS[:2] for d in (-1.0, 0.0) for lag in _REFINED_LAGS
    ]  # fmt: skip
    refined = _best_alternative(problem, search_result, others, baseline)
    if refined is None or refined[1] <= gain + MIN_EVIDENCE:
        return hypothesis, gain
    for width in (0.12, 0.06, 0.03):
        incumbent = refined[0]
        neighbours = [replace(incumbent, delay=incumbent.delay + d) for d in (-width, width)]
        if incumbent.lag:
            neighbours += [replace(incumbent, lag=incumbent.lag * (1 + d)) for d in (-2 * width, 2 * width)]
        improved = _best_alternative(problem, search_result, neighbours, baseline)
        if improved is not None and improved[1] > refined[1]:
            refined = improved
    final = replace(
        refined[0], delay=round(refined[0].delay, _REPORTED_DIGITS), lag=round(refined[0].lag, _REPORTED_DIGITS + 1)
    )
    return final, refined[1]


def _is_input_smooth(problem: ScaledRecords) -> bool:
    """Whether inputs change gently from sample to sample, as after a filter or an amplifier."""
    second_differences = np.concatenate([np.diff(u, 2) for u in problem.u])
    first_differences = np.concatenate([np.diff(u) for u in problem.u])
    # An input that is held for several samples does not change between its jumps.
    is_held = np.mean(first_differences == 0.0) > 0.1
    return bool(not is_held and np.sqrt(np.mean(second_differences**2)) < _MAX_ROUGHNESS * problem.input_rms)


def _input_path_finding(problem: ScaledRecords, alternative: FitHypothesis, gain: float) -> CheckFinding:
    rig = problem.rig
    name = "interpolation" if alternative.interpolation != rig.interpolation else "delay"
    lag = f", and a lag of {alternative.lag * rig.step:.3g} s" if alternative.lag else ""
    evidence = (
        f"the records speak for interpolation '{alternative.interpolation}' with delay {alternative.delay:g}{lag}, by "
        f"{gain:.0f} nats ({MIN_EVIDENCE:g} are decisive), and not for '{rig.interpolation}' with delay {rig.delay:g}"
    )
    remedy = f"write these into the rig{', the lag into its [input]' if lag else ''}, and identify again"
    if rig.output.kind == "acceleration" and (rig.interpolation, alternative.interpolation) == ("zero_order", "linear"):
        remedy = (
            f"if y shows the acceleration just after the input switches, write an empty cell in place of y where it "
            f"switches, and keep '{rig.interpolation}'; if the input is not held, {remedy}"
        )
    message = f"{evidence}; {remedy}"
    return CheckFinding("lag" if alternative.lag and name == "delay" else name, message)


def _screen_hypotheses(
    problem: ScaledRecords, search_result: SearchResult, hypotheses: list[FitHypothesis]
) -> list[FitHypothesis]:
    """The hypotheses that fit the first part of the records; all of them, where that is no small part."""
    shortened = problem.truncated(_SCREENING_SAMPLES)
    if shortened.n_observed_outputs > problem.n_observed_outputs / 2 or not hypotheses:
        return hypotheses
    fitter = search_result.fitter.for_problem(shortened)
    baseline = float(best_free_energies(fitter, [search_result.best], search_result, np.inf)[0])
    worse = best_free_energies(fitter, hypotheses, search_result, baseline) - baseline
    return [other for other, nats in zip(hypotheses, worse, strict=True) if nats < _SCREENING_LOSS]


def best_free_energies(
    fitter: LaplaceFitter, hypotheses: Sequence[FitHypothesis], search_result: SearchResult, give_up_above: float
) -> FloatArray:
    """(H,) free energies of other hypotheses, each at the best of several noise ratios.

    Hypotheses with the same polynomial degree are fitted together: a spline takes more arithmetic than a held input,
    and a fractional delay has more samples.

    Args:
        fitter: fitter of the records.
        hypotheses: the H hypotheses.
        search_result: the result of the search, whose coefficients start the fits.
        give_up_above: free energy above which a fit ends.
    """
    result = np.full(len(hypotheses), np.inf)
    groups: dict[tuple[int, bool], list[int]] = {}
    for k, one in enumerate(hypotheses):
        degree = INTERPOLATION_DEGREES["spline" if one.lag else one.interpolation]
        groups.setdefault((max(degree, 1), one.delay == int(one.delay)), []).append(k)
    start = np.append(search_result.mean, fitter.prior.mean[len(search_result.mean) :])
    for group in groups.values():
        variants = [
            replace(hypotheses[k], noise_ratio=hypotheses[k].noise_ratio * part)
            for k in group
            for part in _NOISE_RATIO_FACTORS
        ]
        fits = fitter.fit(variants, start, search_result.sensor_std, _MAX_FIT_STEPS, give_up_above=give_up_above)
        result[group] = fits.free_energy.reshape(-1, len(_NOISE_RATIO_FACTORS)).min(axis=1)
    return result
