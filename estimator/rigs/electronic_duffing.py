"""Rig of the open-hardware board GhislainRaze/Electronic-Duffing, by the settings of its potentiometers."""

from __future__ import annotations

from dataclasses import replace

from estimator.rigs.rig import Rig
from estimator.support.argument_checks import MIN_MAGNITUDE, check_choice, check_integer, check_number

#: Relative half widths of the guess: capacitors are within 5 %, and the integrators add to the damping.
_GUESS_HALF_WIDTHS = {"m": 0.2, "c": 0.5, "a": 0.2, "b": 0.2}


def electronic_duffing(
    p1: float = 0.1311, p2: float = 0.1923, p3: float = 0.9887, wells: int = 1, kind: str = "displacement"
) -> Rig:
    """The rig of the board.

    Equation (5) of its documentation gives, with the components of table 1, m = 1e-4 s², c = 1e-3 p1 s, a = ±10 p2 and
    b = p3 V⁻², with input and displacement in volts. The guess is ±20 % about these, ±50 % for c.

    Args:
        p1: division ratio of the damping potentiometer, above 0 and at most 1.
        p2: division ratio of the linear stiffness.
        p3: division ratio of the cubic stiffness.
        wells: 1 or 2, by the board's switch.
        kind: recorded output: ``displacement`` in volts, or ``velocity`` in volts per second, which are 1000 for each
            volt at the board's output.

    Raises:
        ValueError: naming an argument that is out of its range.

    Example:
        >>> from estimator.rigs.electronic_duffing import electronic_duffing
        >>> [round(end, 3) for end in electronic_duffing(p2=0.5, wells=2).guess["a"]]
        [-6.0, -4.0]
    """
    for name, ratio in (("p1", p1), ("p2", p2), ("p3", p3)):
        check_number(name, ratio, MIN_MAGNITUDE, 1.0, "give the potentiometer's division ratio")
    check_integer("wells", wells, 2)
    check_choice("kind", kind, ("displacement", "velocity"))
    centers = {"m": 1e-4, "c": 1e-3 * p1, "a": (10 if wells == 1 else -10) * p2, "b": p3}
    ends = {
        name: (center * (1 - _GUESS_HALF_WIDTHS[name]), center * (1 + _GUESS_HALF_WIDTHS[name]))
        for name, center in centers.items()
    }
    base = Rig.shipped("electronic-duffing" if kind == "displacement" else "electronic-duffing-velocity")
    return replace(base, guess={name: (min(pair), max(pair)) for name, pair in ends.items()})
