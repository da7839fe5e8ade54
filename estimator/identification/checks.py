"""Checks of an identification: what would make its intervals wrong, and can be seen in the records."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from estimator.belief import Belief
from estimator.identification.alternatives import EVIDENCE, energies, of_input
from estimator.identification.fit import Fitter
from estimator.identification.guesses import astray, leads_astray, of_guess, without_guess
from estimator.identification.offsets import offset_of
from estimator.identification.problem import EXTRA, JUDGED, Problem, explicable
from estimator.identification.records import Record, residuals
from estimator.identification.rest import at_rest
from estimator.identification.result import Finding
from estimator.identification.ridges import ONE, Ridges
from estimator.identification.search import Found
from estimator.identification.sensors import unfiltered
from estimator.parameters import FloatArray
from estimator.physical import propagate
from estimator.rig import Channel, Rig

#: Probability of a false alarm of a test of the residuals.
_ALARM = 1e-4

#: Largest disturbance of the force in parts of the input, in parts of its limit, which is there however weak an input
#: is, and in parts of what the rig says of it.
_DISTURBANCE, _REST, _BEYOND = 0.02, 0.005, 3.0

#: Standard deviations by which the disturbance is larger than that for sure: with a probability of 95 %, about.
_SURE = 1.645

#: Largest relative standard deviation of a parameter that is called identified. Where the posterior is no Gaussian, the
#: largest width of its central 68 % in parts of the outer end: a factor of five between the ends.
_VAGUE, _SPAN = 1 / 3, 0.8

#: The same after one settled sine, along whose ridge a walk ends where it may go on beyond a gap; and by how much the
#: inputs may differ from a sine, in parts of themselves.
_SPAN_OF_SINE, _SINE = 0.02, 0.01

#: Largest cubic force, in parts of the linear one, of a spring that is called linear.
_LINEAR = 0.05

#: Standard deviations below zero that are far.
_FAR = 5.0

#: Smallest errors of the forecasts, in parts of the output, that are judged: smaller ones are those of the integration,
#: and all that is left of a simulated record without noise.
_FINEST = 1e-6

#: Corners of a high-pass in the output's channel that are tried, in parts of the mean frequency.
_CORNERS = (0.002, 0.005, 0.01, 0.02, 0.05)

#: How far off a gross outlier is: in parts of what 99 % of all are off, and of those beside it.
_GROSS, _ALONE = 10.0, 5.0

#: An input rests within so much of its largest. Blows are inputs that act for less than so much of the time; so few
#: samples see them badly, and so many well.
_QUIET, _SELDOM, _BRIEF, _SEEN = 0.02, 0.1, 5, 10

#: Fewest samples in a period that pass without a word, and as many as are asked for where there are fewer.
SLOWEST, ENOUGH = 5.0, 6

_TERMS = {
    "cubic_damping": "a damping that grows with the cube of the velocity",
    "quintic": "a stiffness of fifth order",
    "dry_friction": "dry friction, a force against the motion that is the same at every speed",
}


def examine(
    problem: Problem,
    found: Found,
    ridges: Ridges | None,
    belief: Belief,
    parameters: dict[str, tuple[float, float]],
    disturbance: tuple[float, float],
    records: Sequence[Record],
    forecasts: Sequence[FloatArray],
) -> tuple[Finding, ...]:
    """All checks.

    Args:
        problem: the records, scaled.
        found: the result of the search.
        ridges: along which the posterior lies where it is no Gaussian.
        belief: the posterior.
        parameters: their means and standard deviations, in the rig's units.
        disturbance: of the force, as a standard deviation in the unit of the input; its mean and standard deviation.
        records: as they were read.
        forecasts: of their outputs.
    """
    if problem.is_free:  # nothing is known of an input, and m is 1
        return (
            *_of_records(problem, records),
            *_of_terms(problem, found),
            *_of_parameters(problem, found, None, parameters),
            *_of_residuals(problem, records, forecasts),
        )
    guess, of_records, noisy = problem.rig.guess, _of_records(problem, records), _error(records, forecasts) > _FINEST
    ways = of_input(problem, found) if noisy else []
    if not ways and (found.is_lost or _of_noise(problem, disturbance)):
        ways = _of_offset(problem)
    if found.is_lost and not ways:  # the other checks would blame the equation
        return (*of_records, _lost(found))
    of_fit = [
        *(ways or (_of_terms(problem, found) if noisy else [])),
        *_of_noise(problem, disturbance),
        *_of_signs(parameters),
        *_of_rest(problem, belief),
        *_of_lag(problem, parameters),
        *_of_parameters(problem, found, ridges, parameters),
        *([] if guess is None else of_guess(guess, parameters, problem.rig.output.kind)),
        *(_of_residuals(problem, records, forecasts) if noisy else []),
    ]
    if guess is not None and of_fit:
        alone, gain = without_guess(problem, found)
        if gain > EVIDENCE and leads_astray(guess, parameters, alone):  # the other checks judge a fit that it spoilt
            kind = problem.rig.output.kind
            return (*of_records, *_of_signs(alone), *astray(guess, parameters, alone, gain, kind))
    return (*of_records, *of_fit)


def _error(records: Sequence[Record], forecasts: Sequence[FloatArray]) -> float:
    """Errors to be expected of the forecasts, in parts of the outputs' deviation."""
    variances = np.concatenate(
        [forecast[np.isfinite(one.y), 1] for one, forecast in zip(records, forecasts, strict=True)]
    )
    outputs = np.concatenate([one.y for one in records])
    return float(np.sqrt(np.nanmedian(variances)) / np.nanstd(outputs))


def _of_records(problem: Problem, records: Sequence[Record]) -> list[Finding]:
    rig = problem.rig
    warnings = [*_of_outliers(rig.output, records), *_of_blows(rig, records)]
    stops = sum(one.clipped for one in records)
    if stops:
        message = f"{stops} outputs stand at a stop and were taken as missing; widen the range, or drive it less"
        warnings.append(Finding("clipped", message))
    warnings += _of_stale(records)
    largest = max(np.abs(one.u).max() for one in records)
    widest = max(np.nanmax(np.abs(one.y)) for one in records)
    source, sink = rig.input, rig.output
    if source.limit and largest > source.limit * (1 + 1e-6):
        message = f"inputs of {largest:.3g} {source.unit} exceed the rig's limit of {source.limit:g} {source.unit}"
        warnings.append(Finding("limit", message))
    if sink.range and widest > sink.range * (1 + 1e-6):
        message = f"outputs of {widest:.3g} {sink.unit} leave the rig's range of {sink.range:g} {sink.unit}"
        warnings.append(Finding("range", message))
    if 2 * np.pi / problem.frequency < SLOWEST:
        message = f"there are {2 * np.pi / problem.frequency:.1f} samples in a period; sample faster, {ENOUGH} at least"
        warnings.append(Finding("sampling_too_slow", message))
    return warnings


def _of_stale(records: Sequence[Record]) -> list[Finding]:
    """Whether outputs stood still while the oscillator moved."""
    warnings = []
    bursts, count = sum(one.bursts for one in records), sum(one.stale for one in records if one.bursts)
    if bursts:
        message = (
            f"{count} outputs in {bursts} bursts stand still while the oscillator moves, as where a sensor loses its "
            f"signal; they were taken as missing"
        )
        warnings.append(Finding("dropouts", message))
    repeats = max(one.repeats for one in records)
    if repeats > 1:
        message = (
            f"each output stands {repeats} times, as where a slow sensor is sampled faster than it measures; the first "
            f"was kept, and the others taken as missing: sample as fast as it measures, for its delay is unknown"
        )
        warnings.append(Finding("repeated", message))
    return warnings


def _of_blows(rig: Rig, records: Sequence[Record]) -> list[Finding]:
    """Whether the input is blows of so few samples that their impulse is uncertain; not steps that a converter held."""
    lengths, held, acting = list[int](), list[bool](), 0
    largest = max(float(np.abs(one.u - np.median(one.u)).max()) for one in records)
    for one in records:
        u = one.u - np.median(one.u)
        acts = np.concatenate([[False], np.abs(u) > _QUIET * largest, [False]])
        acting += int(acts.sum())
        for begin, end in np.flatnonzero(acts[1:] != acts[:-1]).reshape(-1, 2):
            lengths.append(int(end - begin))
            held.append(rig.interpolation == "zero_order" and float(np.ptp(u[begin:end])) < _QUIET * largest)
    if not lengths or all(held) or np.median(lengths) > _BRIEF or acting > _SELDOM * sum(len(one.u) for one in records):
        return []
    message = (
        f"the input is blows that {np.median(lengths):.0f} samples see: their impulse, and with it m, c, a and b "
        "alike, is known to some percent only, whatever the intervals say; sample faster, "
        f"{_SEEN} times in a blow at least"
    )
    return [Finding("short_blows", message)]


def _lost(found: Found) -> Finding:
    message = (
        f"the search may have failed: what it found leaves a disturbance of {100 * found.disturbance:.2g} % of the "
        "input, and no two of its starts led to the same; m, c, a and b may be anything. Add a guess to the rig, or "
        "identify from several records, of small motions too"
    )
    return Finding("search_failed", message)


def _of_outliers(channel: Channel, records: Sequence[Record]) -> list[Finding]:
    """Outputs that are far off alone, which spoil the fit that the other checks judge.

    Not of accelerations, which answer an impulse at once.
    """
    if channel.kind == "acceleration":
        return []
    outputs = np.concatenate([one.y for one in records])
    middle = np.nanmedian(outputs)
    usual = float(np.nanquantile(np.abs(outputs - middle), 0.99))
    found = []
    for one in records:
        off = np.nan_to_num(np.abs(one.y - middle))
        beside = np.maximum(np.append(off[1:], 0.0), np.append(0.0, off[:-1]))
        found += [(off[k], k, one) for k in np.flatnonzero(off > np.maximum(_GROSS * usual, _ALONE * beside))]
    if not found or usual == 0:
        return []
    _, k, one = max(found, key=lambda place: float(place[0]))
    many = "1 output stands" if len(found) == 1 else f"{len(found)} outputs stand"
    message = (
        f"{many} alone, far off all others: sample {k} of {one.name} is {one.y[k]:.3g} "
        f"{channel.unit}, and 99 % are within {usual:.3g} {channel.unit} of the middle; make them missing, and "
        "identify again, before anything else is looked at"
    )
    return [Finding("outliers", message)]


def _of_offset(problem: Problem) -> list[Finding]:
    """Whether the channels were triggered far apart."""
    later = offset_of(problem)
    if later is None:
        return []
    delay = problem.rig.delay + later
    what = (
        f"the output answers {later} samples after the input; write delay = {delay:g} into the rig"
        if later > 0
        else f"the output answers {-later} samples before the input; cut {-later} samples from the start of the inputs"
    )
    return [Finding("delay", f"{what}, and identify again: the channels were triggered apart")]


def _of_terms(problem: Problem, found: Found) -> list[Finding]:
    """Further terms of the equation, and a high-pass of the sensor, by their evidence."""
    own, gains = float(found.fits.free_energy.min()), []
    for name in EXTRA:
        prior = found.fitter.prior.widened(problem.prior_of_term(name))
        fitter = Fitter(replace(problem, terms=(name,)), prior)
        gains.append(float(own - energies(fitter, [found.best], found, own)[0]))
    if max(gains) <= EVIDENCE:
        return []
    filtered = [
        replace(problem, y=tuple(unfiltered(y, part * problem.frequency) for y in problem.y)) for part in _CORNERS
    ]
    restored = [float(own - energies(found.fitter.on(one), [found.best], found, own)[0]) for one in filtered]
    if max(restored) > max(gains):
        corner = _CORNERS[int(np.argmax(restored))] * problem.frequency / (2 * np.pi * problem.rig.step)
        message = (
            f"the records speak for a high-pass of some {corner:.2g} Hz in the output's channel, by "
            f"{max(restored):.0f} nats, as an IEPE sensor or AC coupling has; c is wrong by it: couple the sensor by "
            f"DC, or take one that reaches lower, because the same filter on the input does not help where the spring "
            f"is not linear"
        )
        return [Finding("high_pass", message)]
    term = EXTRA[int(np.argmax(gains))]
    message = f"the records speak for {_TERMS[term]}, by {max(gains):.0f} nats; m, c, a and b alone do not hold"
    return [Finding(term, message)]


def disturbed(channel: Channel, strength: float, disturbance: float) -> str:
    """Says it where more disturbs the force than is usual; else nothing.

    Args:
        channel: the input.
        strength: of the inputs, as a root mean square.
        disturbance: of the force in every sample, as a standard deviation in the unit of the input.
    """
    usual = max(_DISTURBANCE * strength, _REST * (channel.limit or 0.0))
    if disturbance <= (_BEYOND * channel.noise if channel.noise else usual):
        return ""
    part = f", {100 * disturbance / strength:.1f} % of the input" if strength else ""
    return f"the force is disturbed by {disturbance:.3g} {channel.unit} in every sample{part}"


def _of_noise(problem: Problem, disturbance: tuple[float, float]) -> list[Finding]:
    channel, strength, (mean, std) = problem.rig.input, problem.strength * problem.scales.input, disturbance
    if not disturbed(channel, strength, mean - _SURE * std):  # where the sensor's noise hides it, it may be any
        return []
    because = "either the recorded input is noisy, or the equation lacks something"
    return [Finding("process_noise", f"{disturbed(channel, strength, mean)}; {because}")]


def _of_rest(problem: Problem, belief: Belief) -> list[Finding]:
    """Whether the spring rests beside its inflection, so that a is not its stiffness at rest."""
    rest = at_rest(belief)
    if rest is None or rest.is_symmetric:
        return []
    scales = problem.scales
    stiffness, square = scales.unit((1, -1, 0)), scales.unit((1, -2, 0))
    moved = 3 * problem.displacement * scales.displacement
    far = f", {abs(rest.place) / moved:.2g} times as far as the oscillator moves" if abs(rest.place) > moved else ""
    message = (
        f"the spring is not symmetric about rest: at rest it is {_given(*rest.stiffness)} {stiffness} stiff, with a "
        f"quadratic stiffness of {_given(*rest.quadratic)} {square}; a and b are those of its inflection, which is "
        f"{abs(rest.place):.3g} {scales.unit((0, 1, 0))} away{far}"
    )
    return [Finding("asymmetric", message)]


def _of_lag(problem: Problem, parameters: Mapping[str, tuple[float, float]]) -> list[Finding]:
    """Whether a lag of the input leaves the mass open: a coil's lag is also that of its own damping."""
    lag, (m, std), (c, _) = problem.rig.input.lag, parameters["m"], parameters["c"]
    if lag is None or abs(c) * lag < std:
        return []
    message = (
        f"m may be {abs(c) * lag:.2g} {problem.scales.unit((1, -1, 2))} larger, {100 * abs(c * lag / m):.2g} %: where "
        f"a coil that is driven by a voltage lags, so does the damping by its own motion, which looks like less mass; "
        f"record the current in place of the voltage"
    )
    return [Finding("lag", message)]


def _given(mean: float, std: float) -> str:
    """A number with the digits that its standard deviation leaves."""
    digits = max(2, min(12, 2 + int(np.floor(np.log10(max(abs(mean) / max(std, 1e-300), 1.0))))))
    return f"{mean:.{digits}g} ± {std:.2g}"


def _of_signs(parameters: Mapping[str, tuple[float, float]]) -> list[Finding]:
    """Whether m is negative, or c without it: a channel that is turned round changes the sign of all four."""
    m, c = parameters["m"], parameters["c"]
    if m[0] < -_FAR * m[1]:
        message = "m is negative: the polarity of the sensor or of the input is turned round; change the sign of u or y"
    elif c[0] < -_FAR * c[1]:
        message = "c is negative: energy flows in, so that the oscillator is driven by more than u, such as a feedback"
    else:
        return []
    return [Finding("sign", message)]


def _of_parameters(
    problem: Problem, found: Found, ridges: Ridges | None, parameters: dict[str, tuple[float, float]]
) -> list[Finding]:
    by = "this input; the records leave more than a third of it open"
    if ridges is None:
        vague = [name for name, deviation in _told(problem, found).items() if deviation > _VAGUE]
    else:
        ends, span = ridges.interval(ONE), _SPAN
        if _is_one_sine(problem.u):
            by, span = "one settled sine; add a record of another amplitude or frequency", _SPAN_OF_SINE
        vague = [name for name, (low, high) in ends.items() if high - low > span * max(abs(low), abs(high))]
    warnings = []
    if vague:
        message = f"{', '.join(vague)}: not identified by {by}"
        if "b" in vague and (part := _cubic(problem, parameters)) < _LINEAR:
            message += f"; the spring is linear to {100 * part:.2g} %, as far as the oscillator moved"
        warnings.append(Finding("not_identified", message, tuple(vague)))
    return warnings


def _is_one_sine(inputs: Sequence[FloatArray]) -> bool:
    """Whether all inputs (T,) are sines of one frequency and amplitude."""
    found = []
    for u in inputs:
        swing = u - u.mean()
        turns = int(np.count_nonzero(swing[1:] * swing[:-1] < 0))
        quarter = max(1, round(len(u) / max(2 * turns, 1)))
        if turns < 4 or len(u) < 8 * quarter:
            return False
        # Of a sine the sum of two values a quarter earlier and later is that between them, times a constant.
        middle, beside = swing[quarter:-quarter], swing[2 * quarter :] + swing[: -2 * quarter]
        factor = float(middle @ beside / (middle @ middle))
        if np.std(beside - factor * middle) > _SINE * middle.std():
            return False
        found.append((middle.std(), np.arccos(np.clip(factor / 2, -1.0, 1.0)) / quarter))
    return bool((np.ptp(found, axis=0) < _SINE * np.mean(found, axis=0)).all())


def _cubic(problem: Problem, parameters: Mapping[str, tuple[float, float]]) -> float:
    """The largest part of the linear force that the cubic one may have been, within two standard deviations of b."""
    largest = 3 * problem.displacement * problem.scales.displacement
    (a, _), (b, std) = parameters["a"], parameters["b"]
    return (abs(b) + 2 * std) * largest**2 / abs(a)


def _told(problem: Problem, found: Found) -> dict[str, float]:
    """Relative standard deviations that the records alone would leave of m, c, a and b."""
    model, mean, cov = problem.rig.model, found.mean, found.cov
    scale = np.sqrt(np.diag(cov))
    unit = np.outer(scale, scale)
    known = np.linalg.inv(cov / unit) - found.fitter.prior.precision * unit
    values, ways = np.linalg.eigh(known)
    alone = (ways / np.maximum(values, 1e-9)) @ ways.T * unit
    parameters, spread = propagate(model, mean, alone)
    deviations = np.sqrt(np.diag(spread)) / np.maximum(np.abs(parameters), 1e-300)
    return {name: float(value) for name, value in zip(model.physical, deviations, strict=True) if name in JUDGED}


def _of_residuals(problem: Problem, records: Sequence[Record], forecasts: Sequence[FloatArray]) -> list[Finding]:
    """Whether what the forecasts left is white and normal."""
    from statistics import NormalDist

    left = [
        residuals(explicable(one.y, problem.rig), forecast)[4:]
        for one, forecast in zip(records, forecasts, strict=True)
    ]
    values = np.concatenate(left)
    n, warnings = len(values), list[Finding]()
    if n < 100:
        return warnings
    lags, most = 20, 52.386  # chi2.isf(_ALARM, lags): SciPy's statistics take longer to import than records to identify
    products = [sum(float(one[k:] @ one[: len(one) - k]) for one in left if len(one) > k) for k in range(lags + 1)]
    statistic = n * sum((products[k] / products[0]) ** 2 for k in range(1, lags + 1))
    if statistic > most:
        message = (
            "errors of the forecasts can be foreseen: the equation, the way of the input or the noise is not as assumed"
        )
        warnings.append(Finding("residuals_not_white", message))
    centred = (values - values.mean()) / values.std()
    kurtosis = (np.mean(centred**4) - 3) * np.sqrt(n / 24)
    if abs(kurtosis) > 6.0 or np.abs(centred).max() > -NormalDist().inv_cdf(_ALARM / n / 2):
        message = "errors of the forecasts are not normal: there are outliers, or the noise comes and goes"
        warnings.append(Finding("residuals_not_normal", message))
    return warnings
