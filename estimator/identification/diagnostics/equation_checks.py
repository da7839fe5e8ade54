"""Checks of the equation: missing terms, process noise, signs, asymmetry, lag and trigger offset."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from estimator.belief import Belief
from estimator.identification.data.sensor_faults import undo_high_pass
from estimator.identification.diagnostics.check_finding import CheckFinding
from estimator.identification.diagnostics.input_path_checks import MIN_EVIDENCE, best_free_energies
from estimator.identification.diagnostics.spring_equilibrium import find_equilibrium
from estimator.identification.diagnostics.trigger_offset import find_trigger_offset
from estimator.identification.fitting.search_result import SearchResult
from estimator.identification.likelihood.identification_problem import (
    OPTIONAL_TERMS,
    IdentificationProblem,
)
from estimator.identification.likelihood.laplace_fit import LaplaceFitter
from estimator.rigs.channel import Channel

#: Largest disturbance of the force that passes, as a fraction of the input's root mean square.
_MAX_DISTURBANCE_TO_INPUT = 0.02

#: The same as a fraction of the input's limit, for weak inputs.
_MAX_DISTURBANCE_TO_LIMIT = 0.005

#: The same in multiples of the disturbance that the rig states.
_MAX_DISTURBANCE_TO_STATED = 3.0

#: Standard deviations by which the disturbance is larger than that for sure: with a probability of 95 %, about.
_STDS_FOR_95_PERCENT = 1.645

#: Standard deviations below zero that are far.
_MAX_STDS_BELOW_ZERO = 5.0

#: Corners of a high-pass in the output's channel that are tried, in parts of the mean frequency.
_HIGH_PASS_CORNERS = (0.002, 0.005, 0.01, 0.02, 0.05)

_TERM_DESCRIPTIONS = {
    "cubic_damping": "a damping that grows with the cube of the velocity",
    "quintic": "a stiffness of fifth order",
    "dry_friction": "dry friction, a force against the motion that is the same at every speed",
}


def search_failed_finding(search_result: SearchResult) -> CheckFinding:
    message = (
        f"the search may have failed: what it found leaves a disturbance of {100 * search_result.relative_disturbance:.2g} % of the "
        "input, and no two of its starts led to the same; m, c, a and b may be anything. Add a guess to the rig, or "
        "identify from several records, of small motions too"
    )
    return CheckFinding("search_failed", message)


def check_trigger_offset(problem: IdentificationProblem) -> list[CheckFinding]:
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


def check_missing_terms(problem: IdentificationProblem, search_result: SearchResult) -> list[CheckFinding]:
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


def check_process_noise(problem: IdentificationProblem, disturbance: tuple[float, float]) -> list[CheckFinding]:
    channel, input_rms, (mean, std) = problem.rig.input, problem.input_rms * problem.scales.input, disturbance
    if not disturbance_message(
        channel, input_rms, mean - _STDS_FOR_95_PERCENT * std
    ):  # where the sensor's noise hides it, it may be any
        return []
    because = "either the recorded input is noisy, or the equation lacks something"
    return [CheckFinding("process_noise", f"{disturbance_message(channel, input_rms, mean)}; {because}")]


def check_asymmetry(problem: IdentificationProblem, belief: Belief) -> list[CheckFinding]:
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


def check_input_lag(
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


def check_signs(parameters: Mapping[str, tuple[float, float]]) -> list[CheckFinding]:
    """Whether m is negative, or c without it: a channel that is turned round changes the sign of all four."""
    m, c = parameters["m"], parameters["c"]
    if m[0] < -_MAX_STDS_BELOW_ZERO * m[1]:
        message = "m is negative: the polarity of the sensor or of the input is turned round; change the sign of u or y"
    elif c[0] < -_MAX_STDS_BELOW_ZERO * c[1]:
        message = "c is negative: energy flows in, so that the oscillator is driven by more than u, such as a feedback"
    else:
        return []
    return [CheckFinding("sign", message)]
