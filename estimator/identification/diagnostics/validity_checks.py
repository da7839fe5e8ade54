"""Checks of an identification: what would make its intervals wrong, and can be seen in the records."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from estimator.belief import Belief
from estimator.identification.data.record_reader import Record, standardised_innovations
from estimator.identification.data.sensor_faults import undo_high_pass
from estimator.identification.diagnostics.guess_checks import (
    check_guess,
    fit_without_guess,
    guess_conflict_findings,
    is_shifted_by_guess,
)
from estimator.identification.diagnostics.input_path_checks import MIN_EVIDENCE, best_free_energies, check_input_path
from estimator.identification.diagnostics.spring_equilibrium import find_equilibrium
from estimator.identification.diagnostics.trigger_offset import find_trigger_offset
from estimator.identification.fitting.multistart_search import SearchResult
from estimator.identification.fitting.profile_likelihood import ONE_STD_PROBABILITY, RidgePosterior
from estimator.identification.identification_result import CheckFinding
from estimator.identification.likelihood.identification_problem import (
    OPTIONAL_TERMS,
    TARGET_PARAMETERS,
    IdentificationProblem,
    mask_unexplained_outputs,
)
from estimator.identification.likelihood.laplace_fit import LaplaceFitter
from estimator.rigs.physical_parameters import propagate_to_physical
from estimator.rigs.rig import Channel, Rig
from estimator.support.array_types import FloatArray

#: Probability of a false alarm of a test of the residuals.
_FALSE_ALARM_PROBABILITY = 1e-4

#: Largest disturbance of the force that passes, as a fraction of the input's root mean square.
_MAX_DISTURBANCE_TO_INPUT = 0.02

#: The same as a fraction of the input's limit, for weak inputs.
_MAX_DISTURBANCE_TO_LIMIT = 0.005

#: The same in multiples of the disturbance that the rig states.
_MAX_DISTURBANCE_TO_STATED = 3.0

#: Standard deviations by which the disturbance is larger than that for sure: with a probability of 95 %, about.
_STDS_FOR_95_PERCENT = 1.645

#: Largest relative standard deviation of an identified parameter.
_MAX_RELATIVE_STD = 1 / 3

#: Where the posterior is no Gaussian, largest width of the central 68 % interval, as a fraction of its outer end: a
#: factor of five between the ends.
_MAX_RELATIVE_WIDTH = 0.8

#: The same after one settled sine, along whose ridge a walk may end at a gap.
_MAX_RELATIVE_WIDTH_OF_SINE = 0.02

#: Largest deviation of an input from a sine, relative to the input.
_SINE_TOLERANCE = 0.01

#: Largest cubic force, in parts of the linear one, of a spring that is called linear.
_MAX_LINEAR_CUBIC_FRACTION = 0.05

#: Standard deviations below zero that are far.
_MAX_STDS_BELOW_ZERO = 5.0

#: Smallest errors of the forecasts, in parts of the output, that are judged: smaller ones are those of the integration,
#: and all that is left of a simulated record without noise.
_MIN_JUDGED_ERROR = 1e-6

#: Corners of a high-pass in the output's channel that are tried, in parts of the mean frequency.
_HIGH_PASS_CORNERS = (0.002, 0.005, 0.01, 0.02, 0.05)

#: Smallest deviation of a gross outlier, in 99 % quantiles of the deviations.
_OUTLIER_TO_QUANTILE = 10.0

#: The same in deviations of its two neighbours.
_OUTLIER_TO_NEIGHBOURS = 5.0

#: An input is at rest below this fraction of its largest value.
_RESTING_INPUT_FRACTION = 0.02

#: Impacts act during less than this fraction of the samples.
_MAX_IMPACT_DUTY = 0.1

#: Samples in an impact up to which its impulse is uncertain.
_MAX_IMPACT_SAMPLES = 5

#: Samples in an impact that the message recommends.
_SUFFICIENT_IMPACT_SAMPLES = 10

#: Samples in a period below which the sampling is too slow.
MIN_SAMPLES_PER_PERIOD = 5.0

#: Samples in a period that the message recommends.
RECOMMENDED_SAMPLES_PER_PERIOD = 6

_TERM_DESCRIPTIONS = {
    "cubic_damping": "a damping that grows with the cube of the velocity",
    "quintic": "a stiffness of fifth order",
    "dry_friction": "dry friction, a force against the motion that is the same at every speed",
}


def run_all_checks(
    problem: IdentificationProblem,
    search_result: SearchResult,
    ridges: RidgePosterior | None,
    belief: Belief,
    parameters: dict[str, tuple[float, float]],
    disturbance: tuple[float, float],
    records: Sequence[Record],
    forecasts: Sequence[FloatArray],
) -> tuple[CheckFinding, ...]:
    """All checks.

    Args:
        problem: the records, scaled.
        search_result: the result of the search.
        ridges: along which the posterior lies where it is no Gaussian.
        belief: the posterior.
        parameters: their means and standard deviations, in the rig's units.
        disturbance: of the force, as a standard deviation in the unit of the input; its mean and standard deviation.
        records: as they were read.
        forecasts: of their outputs.
    """
    if problem.is_free_decay:  # nothing is known of an input, and m is 1
        return (
            *_check_records(problem, records),
            *_check_missing_terms(problem, search_result),
            *_check_identifiability(problem, search_result, None, parameters),
            *_check_residuals(problem, records, forecasts),
        )
    guess, record_findings, has_noise = (
        problem.rig.guess,
        _check_records(problem, records),
        _expected_forecast_error(records, forecasts) > _MIN_JUDGED_ERROR,
    )
    input_path_findings = check_input_path(problem, search_result) if has_noise else []
    if not input_path_findings and (search_result.has_failed or _check_process_noise(problem, disturbance)):
        input_path_findings = _check_trigger_offset(problem)
    if search_result.has_failed and not input_path_findings:  # the other checks would blame the equation
        return (*record_findings, _search_failed_finding(search_result))
    fit_findings = [
        *(input_path_findings or (_check_missing_terms(problem, search_result) if has_noise else [])),
        *_check_process_noise(problem, disturbance),
        *_check_signs(parameters),
        *_check_asymmetry(problem, belief),
        *_check_input_lag(problem, parameters),
        *_check_identifiability(problem, search_result, ridges, parameters),
        *([] if guess is None else check_guess(guess, parameters, problem.rig.output.kind)),
        *(_check_residuals(problem, records, forecasts) if has_noise else []),
    ]
    if guess is not None and fit_findings:
        alone, gain = fit_without_guess(problem, search_result)
        if gain > MIN_EVIDENCE and is_shifted_by_guess(
            guess, parameters, alone
        ):  # the other checks judge a fit that it spoilt
            kind = problem.rig.output.kind
            return (
                *record_findings,
                *_check_signs(alone),
                *guess_conflict_findings(guess, parameters, alone, gain, kind),
            )
    return (*record_findings, *fit_findings)


def _expected_forecast_error(records: Sequence[Record], forecasts: Sequence[FloatArray]) -> float:
    """Errors to be expected of the forecasts, in parts of the outputs' deviation."""
    variances = np.concatenate(
        [forecast[np.isfinite(one.y), 1] for one, forecast in zip(records, forecasts, strict=True)]
    )
    outputs = np.concatenate([one.y for one in records])
    return float(np.sqrt(np.nanmedian(variances)) / np.nanstd(outputs))


def _check_records(problem: IdentificationProblem, records: Sequence[Record]) -> list[CheckFinding]:
    rig = problem.rig
    warnings = [*_check_outliers(rig.output, records), *_check_short_impacts(rig, records)]
    n_clipped = sum(one.n_clipped for one in records)
    if n_clipped:
        message = f"{n_clipped} outputs stand at a stop and were taken as missing; widen the range, or drive it less"
        warnings.append(CheckFinding("clipped", message))
    warnings += _check_stale_outputs(records)
    largest_input = max(np.abs(one.u).max() for one in records)
    largest_output = max(np.nanmax(np.abs(one.y)) for one in records)
    source, sink = rig.input, rig.output
    if source.limit and largest_input > source.limit * (1 + 1e-6):
        message = (
            f"inputs of {largest_input:.3g} {source.unit} exceed the rig's limit of {source.limit:g} {source.unit}"
        )
        warnings.append(CheckFinding("limit", message))
    if sink.range and largest_output > sink.range * (1 + 1e-6):
        message = f"outputs of {largest_output:.3g} {sink.unit} leave the rig's range of {sink.range:g} {sink.unit}"
        warnings.append(CheckFinding("range", message))
    if 2 * np.pi / problem.mean_frequency < MIN_SAMPLES_PER_PERIOD:
        message = f"there are {2 * np.pi / problem.mean_frequency:.1f} samples in a period; sample faster, {RECOMMENDED_SAMPLES_PER_PERIOD} at least"
        warnings.append(CheckFinding("sampling_too_slow", message))
    return warnings


def _check_stale_outputs(records: Sequence[Record]) -> list[CheckFinding]:
    """Whether outputs stood still while the oscillator moved."""
    warnings = []
    bursts, count = sum(one.n_bursts for one in records), sum(one.n_stale for one in records if one.n_bursts)
    if bursts:
        message = (
            f"{count} outputs in {bursts} bursts stand still while the oscillator moves, as where a sensor loses its "
            f"signal; they were taken as missing"
        )
        warnings.append(CheckFinding("dropouts", message))
    repeats = max(one.samples_per_value for one in records)
    if repeats > 1:
        message = (
            f"each output stands {repeats} times, as where a slow sensor is sampled faster than it measures; the first "
            f"was kept, and the others taken as missing: sample as fast as it measures, for its delay is unknown"
        )
        warnings.append(CheckFinding("repeated", message))
    return warnings


def _check_short_impacts(rig: Rig, records: Sequence[Record]) -> list[CheckFinding]:
    """Whether the input is blows of so few samples that their impulse is uncertain; not steps that a converter held."""
    lengths, is_held, acting_samples = list[int](), list[bool](), 0
    largest = max(float(np.abs(one.u - np.median(one.u)).max()) for one in records)
    for one in records:
        u = one.u - np.median(one.u)
        is_acting = np.concatenate([[False], np.abs(u) > _RESTING_INPUT_FRACTION * largest, [False]])
        acting_samples += int(is_acting.sum())
        for begin, end in np.flatnonzero(is_acting[1:] != is_acting[:-1]).reshape(-1, 2):
            lengths.append(int(end - begin))
            is_held.append(
                rig.interpolation == "zero_order" and float(np.ptp(u[begin:end])) < _RESTING_INPUT_FRACTION * largest
            )
    if (
        not lengths
        or all(is_held)
        or np.median(lengths) > _MAX_IMPACT_SAMPLES
        or acting_samples > _MAX_IMPACT_DUTY * sum(len(one.u) for one in records)
    ):
        return []
    message = (
        f"the input is blows that {np.median(lengths):.0f} samples see: their impulse, and with it m, c, a and b "
        "alike, is known to some percent only, whatever the intervals say; sample faster, "
        f"{_SUFFICIENT_IMPACT_SAMPLES} times in a blow at least"
    )
    return [CheckFinding("short_blows", message)]


def _search_failed_finding(search_result: SearchResult) -> CheckFinding:
    message = (
        f"the search may have failed: what it found leaves a disturbance of {100 * search_result.relative_disturbance:.2g} % of the "
        "input, and no two of its starts led to the same; m, c, a and b may be anything. Add a guess to the rig, or "
        "identify from several records, of small motions too"
    )
    return CheckFinding("search_failed", message)


def _check_outliers(channel: Channel, records: Sequence[Record]) -> list[CheckFinding]:
    """Outputs that are far off alone, which spoil the fit that the other checks judge.

    Not of accelerations, which answer an impulse at once.
    """
    if channel.kind == "acceleration":
        return []
    outputs = np.concatenate([one.y for one in records])
    middle = np.nanmedian(outputs)
    quantile_99 = float(np.nanquantile(np.abs(outputs - middle), 0.99))
    outliers = []
    for one in records:
        deviations = np.nan_to_num(np.abs(one.y - middle))
        neighbours = np.maximum(np.append(deviations[1:], 0.0), np.append(0.0, deviations[:-1]))
        outliers += [
            (deviations[k], k, one)
            for k in np.flatnonzero(
                deviations > np.maximum(_OUTLIER_TO_QUANTILE * quantile_99, _OUTLIER_TO_NEIGHBOURS * neighbours)
            )
        ]
    if not outliers or quantile_99 == 0:
        return []
    _, k, one = max(outliers, key=lambda place: float(place[0]))
    many = "1 output stands" if len(outliers) == 1 else f"{len(outliers)} outputs stand"
    message = (
        f"{many} alone, far off all others: sample {k} of {one.name} is {one.y[k]:.3g} "
        f"{channel.unit}, and 99 % are within {quantile_99:.3g} {channel.unit} of the middle; make them missing, and "
        "identify again, before anything else is looked at"
    )
    return [CheckFinding("outliers", message)]


def _check_trigger_offset(problem: IdentificationProblem) -> list[CheckFinding]:
    """Whether the channels were triggered far apart."""
    delay_samples = find_trigger_offset(problem)
    if delay_samples is None:
        return []
    delay = problem.rig.delay + delay_samples
    what = (
        f"the output answers {delay_samples} samples after the input; write delay = {delay:g} into the rig"
        if delay_samples > 0
        else f"the output answers {-delay_samples} samples before the input; cut {-delay_samples} samples from the start of the inputs"
    )
    return [CheckFinding("delay", f"{what}, and identify again: the channels were triggered apart")]


def _check_missing_terms(problem: IdentificationProblem, search_result: SearchResult) -> list[CheckFinding]:
    """Further terms of the equation, and a high-pass of the sensor, by their evidence."""
    baseline, gains = float(search_result.fits.free_energy.min()), []
    for name in OPTIONAL_TERMS:
        prior = search_result.fitter.prior.extended(problem.term_prior(name))
        fitter = LaplaceFitter(replace(problem, optional_terms=(name,)), prior)
        gains.append(float(baseline - best_free_energies(fitter, [search_result.best], search_result, baseline)[0]))
    if max(gains) <= MIN_EVIDENCE:
        return []
    filtered = [
        replace(problem, y=tuple(undo_high_pass(y, part * problem.mean_frequency) for y in problem.y))
        for part in _HIGH_PASS_CORNERS
    ]
    high_pass_gains = [
        float(
            baseline
            - best_free_energies(search_result.fitter.for_problem(one), [search_result.best], search_result, baseline)[
                0
            ]
        )
        for one in filtered
    ]
    if max(high_pass_gains) > max(gains):
        corner = (
            _HIGH_PASS_CORNERS[int(np.argmax(high_pass_gains))]
            * problem.mean_frequency
            / (2 * np.pi * problem.rig.step)
        )
        message = (
            f"the records speak for a high-pass of some {corner:.2g} Hz in the output's channel, by "
            f"{max(high_pass_gains):.0f} nats, as an IEPE sensor or AC coupling has; c is wrong by it: couple the sensor by "
            f"DC, or take one that reaches lower, because the same filter on the input does not help where the spring "
            f"is not linear"
        )
        return [CheckFinding("high_pass", message)]
    term = OPTIONAL_TERMS[int(np.argmax(gains))]
    message = (
        f"the records speak for {_TERM_DESCRIPTIONS[term]}, by {max(gains):.0f} nats; m, c, a and b alone do not hold"
    )
    return [CheckFinding(term, message)]


def disturbance_message(channel: Channel, input_rms: float, disturbance_std: float) -> str:
    """Says it where more disturbs the force than is usual; else nothing.

    Args:
        channel: the input.
        input_rms: of the inputs, as a root mean square.
        disturbance_std: of the force in every sample, as a standard deviation in the unit of the input.
    """
    usual_max = max(_MAX_DISTURBANCE_TO_INPUT * input_rms, _MAX_DISTURBANCE_TO_LIMIT * (channel.limit or 0.0))
    if disturbance_std <= (_MAX_DISTURBANCE_TO_STATED * channel.noise if channel.noise else usual_max):
        return ""
    part = f", {100 * disturbance_std / input_rms:.1f} % of the input" if input_rms else ""
    return f"the force is disturbed by {disturbance_std:.3g} {channel.unit} in every sample{part}"


def _check_process_noise(problem: IdentificationProblem, disturbance: tuple[float, float]) -> list[CheckFinding]:
    channel, input_rms, (mean, std) = problem.rig.input, problem.input_rms * problem.scales.input, disturbance
    if not disturbance_message(
        channel, input_rms, mean - _STDS_FOR_95_PERCENT * std
    ):  # where the sensor's noise hides it, it may be any
        return []
    because = "either the recorded input is noisy, or the equation lacks something"
    return [CheckFinding("process_noise", f"{disturbance_message(channel, input_rms, mean)}; {because}")]


def _check_asymmetry(problem: IdentificationProblem, belief: Belief) -> list[CheckFinding]:
    """Whether the spring rests beside its inflection, so that a is not its stiffness at rest."""
    equilibrium = find_equilibrium(belief)
    if equilibrium is None or equilibrium.is_symmetric:
        return []
    scales = problem.scales
    stiffness, square = scales.unit((1, -1, 0)), scales.unit((1, -2, 0))
    motion_range = 3 * problem.displacement * scales.displacement
    far = (
        f", {abs(equilibrium.displacement_from_inflection) / motion_range:.2g} times as far as the oscillator moves"
        if abs(equilibrium.displacement_from_inflection) > motion_range
        else ""
    )
    message = (
        f"the spring is not symmetric about rest: at rest it is {_format_with_std(*equilibrium.stiffness)} {stiffness} stiff, with a "
        f"quadratic stiffness of {_format_with_std(*equilibrium.quadratic)} {square}; a and b are those of its inflection, which is "
        f"{abs(equilibrium.displacement_from_inflection):.3g} {scales.unit((0, 1, 0))} away{far}"
    )
    return [CheckFinding("asymmetric", message)]


def _check_input_lag(
    problem: IdentificationProblem, parameters: Mapping[str, tuple[float, float]]
) -> list[CheckFinding]:
    """Whether a lag of the input leaves the mass open: a coil's lag is also that of its own damping."""
    lag, (m, std), (c, _) = problem.rig.input.lag, parameters["m"], parameters["c"]
    if lag is None or abs(c) * lag < std:
        return []
    message = (
        f"m may be {abs(c) * lag:.2g} {problem.scales.unit((1, -1, 2))} larger, {100 * abs(c * lag / m):.2g} %: where "
        f"a coil that is driven by a voltage lags, so does the damping by its own motion, which looks like less mass; "
        f"record the current in place of the voltage"
    )
    return [CheckFinding("lag", message)]


def _format_with_std(mean: float, std: float) -> str:
    """A number with the digits that its standard deviation leaves."""
    digits = max(2, min(12, 2 + int(np.floor(np.log10(max(abs(mean) / max(std, 1e-300), 1.0))))))
    return f"{mean:.{digits}g} ± {std:.2g}"


def _check_signs(parameters: Mapping[str, tuple[float, float]]) -> list[CheckFinding]:
    """Whether m is negative, or c without it: a channel that is turned round changes the sign of all four."""
    m, c = parameters["m"], parameters["c"]
    if m[0] < -_MAX_STDS_BELOW_ZERO * m[1]:
        message = "m is negative: the polarity of the sensor or of the input is turned round; change the sign of u or y"
    elif c[0] < -_MAX_STDS_BELOW_ZERO * c[1]:
        message = "c is negative: energy flows in, so that the oscillator is driven by more than u, such as a feedback"
    else:
        return []
    return [CheckFinding("sign", message)]


def _check_identifiability(
    problem: IdentificationProblem,
    search_result: SearchResult,
    ridges: RidgePosterior | None,
    parameters: dict[str, tuple[float, float]],
) -> list[CheckFinding]:
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
            message += f"; the spring is linear to {100 * part:.2g} %, as far as the oscillator moved"
        warnings.append(CheckFinding("not_identified", message, tuple(unidentified)))
    return warnings


def _is_single_sine(inputs: Sequence[FloatArray]) -> bool:
    """Whether all inputs (T,) are sines of one frequency and amplitude."""
    found = []
    for u in inputs:
        centred = u - u.mean()
        zero_crossings = int(np.count_nonzero(centred[1:] * centred[:-1] < 0))
        quarter = max(1, round(len(u) / max(2 * zero_crossings, 1)))
        if zero_crossings < 4 or len(u) < 8 * quarter:
            return False
        # Of a sine the sum of two values a quarter earlier and later is that between them, times a constant.
        middle, neighbours = centred[quarter:-quarter], centred[2 * quarter :] + centred[: -2 * quarter]
        factor = float(middle @ neighbours / (middle @ middle))
        if np.std(neighbours - factor * middle) > _SINE_TOLERANCE * middle.std():
            return False
        found.append((middle.std(), np.arccos(np.clip(factor / 2, -1.0, 1.0)) / quarter))
    return bool((np.ptp(found, axis=0) < _SINE_TOLERANCE * np.mean(found, axis=0)).all())


def _max_cubic_fraction(problem: IdentificationProblem, parameters: Mapping[str, tuple[float, float]]) -> float:
    """The largest part of the linear force that the cubic one may have been, within two standard deviations of b."""
    largest = 3 * problem.displacement * problem.scales.displacement
    (a, _), (b, std) = parameters["a"], parameters["b"]
    return (abs(b) + 2 * std) * largest**2 / abs(a)


def _stds_from_records_alone(problem: IdentificationProblem, search_result: SearchResult) -> dict[str, float]:
    """Relative standard deviations that the records alone would leave of m, c, a and b."""
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


def _check_residuals(
    problem: IdentificationProblem, records: Sequence[Record], forecasts: Sequence[FloatArray]
) -> list[CheckFinding]:
    """Whether what the forecasts left is white and normal."""
    from statistics import NormalDist

    residuals_of_records = [
        standardised_innovations(mask_unexplained_outputs(one.y, problem.rig), forecast)[4:]
        for one, forecast in zip(records, forecasts, strict=True)
    ]
    values = np.concatenate(residuals_of_records)
    n, warnings = len(values), list[CheckFinding]()
    if n < 100:
        return warnings
    lags, most = 20, 52.386  # chi2.isf(_ALARM, lags): SciPy's statistics take longer to import than records to identify
    products = [
        sum(float(one[k:] @ one[: len(one) - k]) for one in residuals_of_records if len(one) > k)
        for k in range(lags + 1)
    ]
    statistic = n * sum((products[k] / products[0]) ** 2 for k in range(1, lags + 1))
    if statistic > most:
        message = (
            "errors of the forecasts can be foreseen: the equation, the way of the input or the noise is not as assumed"
        )
        warnings.append(CheckFinding("residuals_not_white", message))
    centred = (values - values.mean()) / values.std()
    kurtosis = (np.mean(centred**4) - 3) * np.sqrt(n / 24)
    if abs(kurtosis) > 6.0 or np.abs(centred).max() > -NormalDist().inv_cdf(_FALSE_ALARM_PROBABILITY / n / 2):
        message = "errors of the forecasts are not normal: there are outliers, or the noise comes and goes"
        warnings.append(CheckFinding("residuals_not_normal", message))
    return warnings
