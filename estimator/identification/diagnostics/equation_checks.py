"""Checks of the equation: missing terms, process noise, signs, an asymmetric spring, lag and trigger offset."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from estimator.belief import Belief
from estimator.identification.data.sensor_faults import undo_high_pass
from estimator.identification.diagnostics.check_finding import CheckFinding
from estimator.identification.diagnostics.input_timing_checks import MIN_EVIDENCE, best_free_energies
from estimator.identification.diagnostics.spring_equilibrium import find_equilibrium
from estimator.identification.diagnostics.trigger_offset import find_trigger_offset
from estimator.identification.fitting.search_result import SearchResult
from estimator.identification.likelihood.laplace_fit import LaplaceFitter
from estimator.identification.likelihood.scaled_records import OPTIONAL_TERMS, ScaledRecords
from estimator.rigs.channel import Channel

#: Largest disturbance of the force that passes, as a fraction of the input's root mean square.
_MAX_DISTURBANCE_TO_INPUT = 0.02

#: The same as a fraction of the input's limit, for weak inputs.
_MAX_DISTURBANCE_TO_LIMIT = 0.005

#: The same in multiples of the disturbance that the rig states.
_MAX_DISTURBANCE_TO_STATED = 3.0

#: Standard deviations of a Gaussian's 95 % quantile.
_STDS_FOR_95_PERCENT = 1.645

#: Standard deviations below zero from which a parameter counts as negative.
_MAX_STDS_BELOW_ZERO = 5.0

#: Corner frequencies of a high-pass in the output's channel, relative to the mean frequency.
_HIGH_PASS_CORNERS = (0.002, 0.005, 0.01, 0.02, 0.05)

_TERM_DESCRIPTIONS = {
    "cubic_damping": "a damping force with the cube of the velocity",
    "quintic": "a quintic stiffness",
    "dry_friction": "dry friction, a force against the motion that does not depend on the speed",
}


def search_failed_finding(search_result: SearchResult) -> CheckFinding:
    """The finding for a search whose best fit leaves a large disturbance, and whose starts do not agree."""
    percents = 100 * search_result.relative_disturbance
    message = (
        f"the search may have failed: its best fit leaves a disturbance of {percents:.2g} % of the input, and no two "
        "starts agree; m, c, a and b may be wrong. Add a guess to the rig, or identify from several records, also of "
        "small motions"
    )
    return CheckFinding("search_failed", message)


def check_trigger_offset(problem: ScaledRecords) -> list[CheckFinding]:
    """A finding where the channels were triggered far apart."""
    delay_samples = find_trigger_offset(problem)
    if delay_samples is None:
        return []
    delay = problem.rig.delay + delay_samples
    if delay_samples > 0:
        what = f"the output responds {delay_samples} samples after the input; write delay = {delay:g} into the rig"
    else:
        what = (
            f"the output responds {-delay_samples} samples before the input; cut {-delay_samples} samples from the "
            "start of the inputs"
        )
    return [CheckFinding("delay", f"{what}, and identify again: the channels were triggered apart")]


def check_missing_terms(problem: ScaledRecords, search_result: SearchResult) -> list[CheckFinding]:
    """A finding for the term of the equation, or the high-pass of the sensor, with the most evidence."""
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
    high_pass_gains = []
    for one in filtered:
        fitter = search_result.fitter.for_problem(one)
        energies = best_free_energies(fitter, [search_result.best], search_result, baseline)
        high_pass_gains.append(float(baseline - energies[0]))
    if max(high_pass_gains) > max(gains):
        relative_corner = _HIGH_PASS_CORNERS[int(np.argmax(high_pass_gains))]
        corner = relative_corner * problem.mean_frequency / (2 * np.pi * problem.rig.step)
        message = (
            f"the records speak for a high-pass of about {corner:.2g} Hz in the output's channel, by "
            f"{max(high_pass_gains):.0f} nats, such as of an IEPE sensor or AC coupling; it makes c wrong. Use DC "
            f"coupling, or a sensor with a lower corner: the same filter on the input does not help with a nonlinear "
            f"spring"
        )
        return [CheckFinding("high_pass", message)]
    term = OPTIONAL_TERMS[int(np.argmax(gains))]
    message = (
        f"the records speak for {_TERM_DESCRIPTIONS[term]}, by {max(gains):.0f} nats; m, c, a and b alone do not hold"
    )
    return [CheckFinding(term, message)]


def disturbance_message(channel: Channel, input_rms: float, disturbance_std: float) -> str:
    """A sentence where the disturbance of the force is larger than usual; else an empty string.

    Args:
        channel: the input.
        input_rms: root mean square of the inputs.
        disturbance_std: standard deviation of the disturbance in every sample, in the unit of the input.
    """
    usual_max = max(_MAX_DISTURBANCE_TO_INPUT * input_rms, _MAX_DISTURBANCE_TO_LIMIT * (channel.limit or 0.0))
    if disturbance_std <= (_MAX_DISTURBANCE_TO_STATED * channel.noise if channel.noise else usual_max):
        return ""
    part = f", {100 * disturbance_std / input_rms:.1f} % of the input" if input_rms else ""
    return f"the force has a disturbance of {disturbance_std:.3g} {channel.unit} in every sample{part}"


def check_process_noise(problem: ScaledRecords, disturbance: tuple[float, float]) -> list[CheckFinding]:
    """A finding where the disturbance of the force, (mean, standard deviation), is surely larger than usual."""
    channel, input_rms, (mean, std) = problem.rig.only_input, problem.input_rms * problem.scales.input, disturbance
    # A disturbance that the sensor's noise hides has a wide interval, whose lower end is small.
    if not disturbance_message(channel, input_rms, mean - _STDS_FOR_95_PERCENT * std):
        return []
    cause = "either the recorded input is noisy, or the equation lacks a term"
    return [CheckFinding("process_noise", f"{disturbance_message(channel, input_rms, mean)}; {cause}")]


def check_asymmetry(problem: ScaledRecords, belief: Belief) -> list[CheckFinding]:
    """A finding where the spring rests away from its inflection, so that a is not its stiffness at rest."""
    equilibrium = find_equilibrium(belief)
    if equilibrium is None or equilibrium.is_symmetric:
        return []
    scales = problem.scales
    stiffness, square = scales.unit((1, -1, 0)), scales.unit((1, -2, 0))
    motion_range = 3 * problem.displacement * scales.displacement
    distance = abs(equilibrium.displacement_from_inflection)
    far = f", {distance / motion_range:.2g} times the range of the motion" if distance > motion_range else ""
    message = (
        f"the spring is not symmetric about rest: at rest its stiffness is "
        f"{_format_with_std(*equilibrium.stiffness)} {stiffness} and its quadratic stiffness "
        f"{_format_with_std(*equilibrium.quadratic)} {square}; a and b hold at its inflection, which is "
        f"{distance:.3g} {scales.unit((0, 1, 0))} away{far}. "
        f"This is a note, and alone leaves the intervals valid: a preload u0 has this effect, as has a quadratic "
        f"spring; use the stiffness at rest for small motions"
    )
    return [CheckFinding("asymmetric", message)]


def check_input_lag(problem: ScaledRecords, parameters: Mapping[str, tuple[float, float]]) -> list[CheckFinding]:
    """A finding where a lag of the input leaves the mass uncertain: a coil's damping lags as its force does."""
    lag, (m, std), (c, _) = problem.rig.only_input.lag, parameters["m"], parameters["c"]
    if lag is None or abs(c) * lag < std:
        return []
    message = (
        f"m may be {abs(c) * lag:.2g} {problem.scales.unit((1, -1, 2))} larger, {100 * abs(c * lag / m):.2g} %: where "
        f"a coil that is driven by a voltage lags, its damping of the motion lags too, which looks like less mass; "
        f"record the current in place of the voltage"
    )
    return [CheckFinding("lag", message)]


def _format_with_std(mean: float, std: float) -> str:
    """A number with its standard deviation, and with as many digits as that allows."""
    digits = max(2, min(12, 2 + int(np.floor(np.log10(max(abs(mean) / max(std, 1e-300), 1.0))))))
    return f"{mean:.{digits}g} ± {std:.2g}"


def check_signs(parameters: Mapping[str, tuple[float, float]]) -> list[CheckFinding]:
    """A finding where m is negative, or c alone: a channel of inverted polarity changes the sign of all four."""
    m, c = parameters["m"], parameters["c"]
    if m[0] < -_MAX_STDS_BELOW_ZERO * m[1]:
        message = "m is negative: the polarity of the sensor or of the input is inverted; change the sign of u or y"
    elif c[0] < -_MAX_STDS_BELOW_ZERO * c[1]:
        message = "c is negative: energy flows in from another source than u, such as a feedback"
    else:
        return []
    return [CheckFinding("sign", message)]
