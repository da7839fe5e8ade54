"""Checks of the rig's guess, against the identified parameters and against a fit without the guess."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from estimator.identification.diagnostics.check_finding import CheckFinding
from estimator.identification.fitting.multistart_search import search_coefficients
from estimator.identification.fitting.search_result import SearchResult
from estimator.identification.likelihood.laplace_fit import LaplaceFitter
from estimator.identification.likelihood.scaled_records import ScaledRecords
from estimator.rigs.rig_prior import STDS_PER_90_PERCENT, belief_from_moments

#: Parameter to mean and standard deviation, in the rig's units.
ParameterMoments = Mapping[str, tuple[float, float]]

#: Parameter to its central 90 % interval.
GuessIntervals = Mapping[str, tuple[float, float]]

#: Standard deviations from the guess above which a parameter is reported.
_MAX_STDS_FROM_GUESS = 5.0

#: Relative shift of a parameter by the guess that is reported.
_MAX_RELATIVE_SHIFT = 0.01

#: |log factor| from which a wrong step or scale is reported: nearer to a factor of 2, either way, than to 1.
_MIN_LOG_FACTOR = 0.5 * np.log(2)

#: Number of parameters to the 99 % quantile of chi square.
_CHI_SQUARE_1_PERCENT = {2: 9.21, 3: 11.34, 4: 13.28}


@dataclass(frozen=True)
class _ScaleError:
    """A setting that may be wrong by a factor.

    Attributes:
        check_name: name of the finding.
        message: message with a field for the factor.
        exponents: parameter to the power of the factor that corrects it; the first parameter gives the factor.
    """

    check_name: str
    message: str
    exponents: Mapping[str, int]


_STEP_MESSAGE = " would agree with the guess if the sampling step were about {:.2g} times the rig's"

#: Kind of the output to the effect of a wrong sampling step, which keeps the scale of the measured derivative alone.
_STEP_ERRORS = {
    "displacement": _ScaleError("step", "m and c" + _STEP_MESSAGE, {"m": 2, "c": 1}),
    "velocity": _ScaleError("step", "m, a and b" + _STEP_MESSAGE, {"m": 1, "a": -1, "b": -3}),
    "acceleration": _ScaleError("step", "c, a and b" + _STEP_MESSAGE, {"a": -2, "b": -6, "c": -1}),
}

_CALIBRATION_ERRORS = (
    _ScaleError(
        "guess",
        "m, c, a and b would agree with the guess if the input were about {:.2g} times as large as recorded; check its "
        "unit and calibration, and the guess",
        {"m": 1, "c": 1, "a": 1, "b": 1},
    ),
    _ScaleError(
        "guess",
        "m, c, a and b would agree with the guess if the output were about {:.2g} times as large as recorded; check "
        "its unit and calibration, and the guess",
        {"m": -1, "c": -1, "a": -1, "b": -3},
    ),
)


def check_guess(guess: GuessIntervals, parameters: ParameterMoments, sensor_kind: str) -> list[CheckFinding]:
    """Findings where parameters are far from the guess, with the scale error that explains most of it.

    A negative mass has a finding of its own (`estimator.identification.diagnostics.equation_checks.check_signs`).

    Args:
        guess: the guess of the rig.
        parameters: the identified parameters.
        sensor_kind: kind of the output.
    """
    if parameters["m"][0] <= 0:
        return []
    squared_deviations, warnings = _squared_deviations(guess, parameters), list[CheckFinding]()
    far = [name for name, squared in squared_deviations.items() if squared > _MAX_STDS_FROM_GUESS**2]
    if far:
        message = f"{', '.join(far)}: far outside of the rig's guess; check the units, or the guess"
        warnings = [CheckFinding("guess", message)]
    least = sum(squared_deviations.values()) / 2
    for scale_error in (_STEP_ERRORS[sensor_kind], *_CALIBRATION_ERRORS):
        first = next(iter(scale_error.exponents))
        ratio = sum(guess[first]) / 2 / parameters[first][0]
        if ratio <= 0:
            continue
        factor = float(ratio ** (1 / scale_error.exponents[first]))
        rescaled = {name: _scaled(parameters[name], factor ** scale_error.exponents.get(name, 0)) for name in guess}
        remaining = sum(_squared_deviations(guess, rescaled).values())
        unlikely = (
            sum(squared_deviations[name] for name in scale_error.exponents)
            > _CHI_SQUARE_1_PERCENT[len(scale_error.exponents)]
        )
        if abs(np.log(factor)) > _MIN_LOG_FACTOR and unlikely and remaining < least:
            least, warnings = remaining, [CheckFinding(scale_error.check_name, scale_error.message.format(factor))]
    return warnings


def _squared_deviations(guess: GuessIntervals, parameters: ParameterMoments) -> dict[str, float]:
    """Parameter to its squared distance from the guess, in variances of both."""
    guess_stds = {name: (high - low) / 2 / STDS_PER_90_PERCENT for name, (low, high) in guess.items()}
    return {
        name: float((parameters[name][0] - sum(guess[name]) / 2) ** 2 / (spread**2 + parameters[name][1] ** 2))
        for name, spread in guess_stds.items()
    }


def _scaled(parameter: tuple[float, float], factor: float) -> tuple[float, float]:
    return parameter[0] * factor, parameter[1] * factor


def fit_without_guess(problem: ScaledRecords, search_result: SearchResult) -> tuple[ParameterMoments, float]:
    """Fit the parameters without the guess, and compare the evidence.

    Both fits are judged without the guess, which would hold one of them for improbable.

    Returns:
        The parameters, and the nats by which the records are more probable with them; no parameters and 0 where the
        records do not suffice without a guess.
    """
    try:
        result_without_guess = search_coefficients(
            replace(problem, rig=replace(problem.rig, guess=None)), lambda share, at="": None
        )
    except ValueError:  # the records do not suffice without a guess
        return {}, 0.0
    flat_prior_fitter = LaplaceFitter(search_result.fitter.problem, result_without_guess.fitter.prior)
    free_energy_with_guess = flat_prior_fitter.fit(
        [search_result.best], search_result.mean, search_result.sensor_std, iterations=0
    ).free_energy[0]
    moments = belief_from_moments(
        problem.rig, problem.scales, *problem.moments_about_zero(result_without_guess.mean, result_without_guess.cov)
    ).parameters()
    return {name: (mean, std) for name, (mean, std, _) in moments.items()}, float(
        free_energy_with_guess - result_without_guess.fits.free_energy.min()
    )


def is_shifted_by_guess(
    guess: GuessIntervals, parameters: ParameterMoments, parameters_without_guess: ParameterMoments
) -> bool:
    """Whether the records without the guess give another value of a guessed parameter."""
    return any(
        abs(parameters_without_guess[name][0] - parameters[name][0])
        > _MAX_RELATIVE_SHIFT * abs(parameters_without_guess[name][0])
        for name in guess
    )


def guess_conflict_findings(
    guess: GuessIntervals,
    parameters: ParameterMoments,
    parameters_without_guess: ParameterMoments,
    gain: float,
    sensor_kind: str,
) -> list[CheckFinding]:
    """Findings where the guess biases the fit.

    Args:
        guess: the guess of the rig.
        parameters: the parameters with the guess.
        parameters_without_guess: the parameters without it.
        gain: nats by which the records are more probable without it.
        sensor_kind: kind of the output.
    """
    values = ", ".join(
        f"{name} = {parameters_without_guess[name][0]:.4g} and not {parameters[name][0]:.4g}" for name in guess
    )
    conflict = f"the guess biases the fit: by {gain:.0f} nats the records speak for {values}"
    causes = check_guess(guess, parameters_without_guess, sensor_kind) or [
        CheckFinding("guess", "check the units of guess and columns, or leave out the guess")
    ]
    return [CheckFinding(one.name, f"{conflict}; {one.message}") for one in causes]
