"""Checks of the rig's guess: beside what was found, and beside what the records say without it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from estimator.identification.fit import Fitter
from estimator.identification.problem import Problem
from estimator.identification.result import Finding
from estimator.identification.search import Found, search
from estimator.rig_prior import HALF_WIDTH, about

#: Parameter to mean and standard deviation, in the rig's units.
Parameters = Mapping[str, tuple[float, float]]

#: Parameter to its central 90 % interval.
Guess = Mapping[str, tuple[float, float]]

#: Standard deviations from the guess that are far.
_FAR = 5.0

#: A guess leads astray where it moves a parameter by more than this part of it.
_ASTRAY = 0.01

#: A wrong step or scale is looked for that is nearer to a factor of 2, either way, than to 1, where the guess of the
#: parameters that it changes has less than 1 % of a chance: chi square is larger, of so many of them.
_FACTOR, _UNLIKELY = 0.5 * np.log(2), {2: 9.21, 3: 11.34, 4: 13.28}


@dataclass(frozen=True)
class _Slip:
    """A number that may be wrong by a factor.

    Attributes:
        check: its name.
        message: with a place for the factor.
        powers: parameter to the power of the factor that would mend it; the first one tells the factor.
    """

    check: str
    message: str
    powers: Mapping[str, int]


_STEP = " would be those of the guess if the sampling step were about {:.2g} times the rig's"

#: Kind of the output to what a wrong sampling step does: what the sensor shows keeps its scale, and not what is
#: integrated or differentiated of it.
_OF_STEP = {
    "displacement": _Slip("step", "m and c" + _STEP, {"m": 2, "c": 1}),
    "velocity": _Slip("step", "m, a and b" + _STEP, {"m": 1, "a": -1, "b": -3}),
    "acceleration": _Slip("step", "c, a and b" + _STEP, {"a": -2, "b": -6, "c": -1}),
}

_SLIPS = (
    _Slip(
        "guess",
        "m, c, a and b would be those of the guess if the input were about {:.2g} times what is recorded; check its "
        "unit and calibration, and those of the guess",
        {"m": 1, "c": 1, "a": 1, "b": 1},
    ),
    _Slip(
        "guess",
        "m, c, a and b would be those of the guess if the output were about {:.2g} times what is recorded; check its "
        "unit and calibration, and those of the guess",
        {"m": -1, "c": -1, "a": -1, "b": -3},
    ),
)


def of_guess(guess: Guess, parameters: Parameters, kind: str) -> list[Finding]:
    """Whether parameters are far from the guess, and what explains most of it; a negative mass is no matter of it.

    Args:
        guess: of the rig.
        parameters: that were found.
        kind: of the output.
    """
    if parameters["m"][0] <= 0:
        return []
    off, warnings = _surprise(guess, parameters), list[Finding]()
    far = [name for name, squared in off.items() if squared > _FAR**2]
    if far:
        message = f"{', '.join(far)}: far outside of what the rig's guess says; check units, or the guess"
        warnings = [Finding("guess", message)]
    least = sum(off.values()) / 2
    for slip in (_OF_STEP[kind], *_SLIPS):
        first = next(iter(slip.powers))
        ratio = sum(guess[first]) / 2 / parameters[first][0]
        if ratio <= 0:
            continue
        factor = float(ratio ** (1 / slip.powers[first]))
        mended = {name: _times(parameters[name], factor ** slip.powers.get(name, 0)) for name in guess}
        left = sum(_surprise(guess, mended).values())
        unlikely = sum(off[name] for name in slip.powers) > _UNLIKELY[len(slip.powers)]
        if abs(np.log(factor)) > _FACTOR and unlikely and left < least:
            least, warnings = left, [Finding(slip.check, slip.message.format(factor))]
    return warnings


def _surprise(guess: Guess, parameters: Parameters) -> dict[str, float]:
    """Squared standard deviations between what is guessed of parameters and what was found."""
    spreads = {name: (high - low) / 2 / HALF_WIDTH for name, (low, high) in guess.items()}
    return {
        name: float((parameters[name][0] - sum(guess[name]) / 2) ** 2 / (spread**2 + parameters[name][1] ** 2))
        for name, spread in spreads.items()
    }


def _times(parameter: tuple[float, float], factor: float) -> tuple[float, float]:
    return parameter[0] * factor, parameter[1] * factor


def without_guess(problem: Problem, found: Found) -> tuple[Parameters, float]:
    """The parameters that the records alone give, and the nats by which the records are more probable with them.

    Both fits are judged as if nothing were guessed, so that it does not count how improbable the guess holds them.
    """
    try:
        alone = search(replace(problem, rig=replace(problem.rig, guess=None)), lambda share, at="": None)
    except ValueError:  # the records tell too little without a guess
        return {}, 0.0
    judge = Fitter(found.fitter.problem, alone.fitter.prior)
    own = judge.fit([found.best], found.mean, found.level, iterations=0).free_energy[0]
    told = about(problem.rig, problem.scales, *problem.outward(alone.mean, alone.cov)).parameters()
    return {name: (mean, std) for name, (mean, std, _) in told.items()}, float(own - alone.fits.free_energy.min())


def leads_astray(guess: Guess, parameters: Parameters, alone: Parameters) -> bool:
    """Whether the records alone say something else that matters."""
    return any(abs(alone[name][0] - parameters[name][0]) > _ASTRAY * abs(alone[name][0]) for name in guess)


def astray(guess: Guess, parameters: Parameters, alone: Parameters, gain: float, kind: str) -> list[Finding]:
    """That the guess has led the fit astray: by so many nats the records are more probable with what they say alone."""
    values = ", ".join(f"{name} = {alone[name][0]:.4g} and not {parameters[name][0]:.4g}" for name in guess)
    led = f"the guess leads the fit astray: by {gain:.0f} nats the records speak for {values}"
    why = of_guess(guess, alone, kind) or [
        Finding("guess", "check the units of guess and columns, or leave out the guess")
    ]
    return [Finding(one.name, f"{led}; {one.message}") for one in why]
