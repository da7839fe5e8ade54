"""Units and scales: between the world of a rig and the numbers near one that compiled code works with.

Inside, time is counted in samples, the input in parts of its scale U, and the displacement in parts of X. A sensor of
displacement, velocity or acceleration (``order`` 0, 1, 2) has the scale S = X / step**order: its number inside is per
sample, or per sample squared.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass

from estimator.checks import number
from estimator.parameters import SAMPLING_STEP

#: Powers of the input's unit, the displacement's unit and the second.
Dimension = tuple[int, int, int]

#: Smallest and largest size of anything, in its unit: products of several stay within what numbers can hold.
SIZES = 1e-30, 1e30

#: Units of SI, which prefixes scale; and others, with what each is in SI.
_BASES, _PREFIXES = "N|V|A|Pa|m", {"n": 1e-9, "u": 1e-6, "m": 1e-3, "c": 1e-2, "d": 0.1, "": 1.0, "k": 1e3, "M": 1e6}
_OTHERS = {"in": (0.0254, "m"), "ft": (0.3048, "m"), "deg": (math.pi / 180, "rad"), "°": (math.pi / 180, "rad")}
_WHOLE = {"g": (9.80665, "m/s²"), "lb": (4.4482216152605, "N"), "lbf": (4.4482216152605, "N")}
_WHOLE |= {"mps": (1.0, "m/s"), "mps2": (1.0, "m/s²")}
_SUFFIXES = {"": "", "/s": "/s", "/s2": "/s²", "/s/s": "/s²", "m": " m", "/V": "/V"}

#: Units that only one kind of output has.
_KINDS = {"displacement": r"[mµμun]?m|cm|in", "velocity": r"[^/]+/s", "acceleration": r".+/s(²|\^?2|/s)|m?g"}

SUPERSCRIPTS = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")
_DIGITS = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻", "0123456789-")
_ATOM = re.compile(r"([^\s·/\d⁰¹²³⁴⁵⁶⁷⁸⁹⁻^-]+)(?:\^?(-?\d+))?")


def kind_of(unit: str) -> str | None:
    """The kind of output that alone has a unit; None for one that tells none, such as V."""
    return next((kind for kind, units in _KINDS.items() if re.fullmatch(units, unit)), None)


def plain(unit: str) -> str:
    """A unit in one way of writing."""
    for written, usual in (("µ", "u"), ("μ", "u"), ("²", "2"), ("^", ""), ("·", " "), ("*", " ")):
        unit = unit.replace(written, usual)
    return unit.replace(" ", "")


def coherent(unit: str) -> tuple[float, str]:
    """A unit as a factor and the unit of SI that it is a part or a multiple of; 1 and itself where it is none such.

    Example:
        >>> [coherent(unit) for unit in ("mm", "µm/s", "N", "m/s^2", "counts")]
        [(0.001, 'm'), (1e-06, 'm/s'), (1.0, 'N'), (1.0, 'm/s²'), (1.0, 'counts')]
    """
    bare = plain(unit)
    if bare in _WHOLE:
        return _WHOLE[bare]
    found = re.fullmatch(rf"(?:([{''.join(_PREFIXES)}]?)({_BASES})|({'|'.join(_OTHERS)}))(.*)", bare)
    if found is None or found[4] not in _SUFFIXES:
        return 1.0, unit
    factor, base = _OTHERS[found[3]] if found[3] else (_PREFIXES[found[1]], found[2])
    return factor, base + _SUFFIXES[found[4]]


def conversion(of: str, to: str) -> float | None:
    """By what numbers in one unit are multiplied to be in another; None where these are of different quantities.

    Example:
        >>> conversion("mm", "m"), conversion("in", "in"), conversion("m", "mm"), conversion("mm", "V")
        (0.001, 1.0, 1000.0, None)
    """
    (factor, base), (other, own) = coherent(of), coherent(to)
    return factor / other if plain(base) == plain(own) else None


@dataclass(frozen=True)
class Scales:
    """What one inside is worth outside.

    Attributes:
        step: sampling step [s].
        input: scale U of the input, in its unit.
        output: scale S of the sensor, in its unit.
        order: time derivative of the displacement that the sensor shows: 0, 1 or 2.
        input_unit: such as ``"N"``.
        output_unit: such as ``"m"``, or ``"m/s"`` for a velocity.

    Example:
        >>> from estimator.units import Scales
        >>> scales = Scales(step=1e-3, input=20.0, output=0.03, input_unit="N", output_unit="m")
        >>> scales.unit((1, -1, 2)), scales.unit((1, -3, 0)), scales.unit((1, -1, 1))
        ('kg', 'N/m³', 'N s/m')
    """

    step: float = SAMPLING_STEP
    input: float = 1.0
    output: float = 1.0
    order: int = 0
    input_unit: str = "V"
    output_unit: str = "V"

    def __post_init__(self) -> None:
        number("step", self.step, *SIZES, "give the seconds between samples")
        for name in ("input", "output"):
            number(name, getattr(self, name), *SIZES)

    @property
    def displacement(self) -> float:
        """Scale X of the displacement."""
        return float(self.output * self.step**self.order)

    def factor(self, dimension: Dimension) -> float:
        """What one inside is worth, of a quantity whose time is in seconds already."""
        return float(self.input ** dimension[0] * self.displacement ** dimension[1])

    def unit(self, dimension: Dimension) -> str:
        """Of a quantity, in the units of the rig's channels; ``"1"`` for a pure number."""
        powers: dict[str, int] = {}
        displacement = _parsed(self.output_unit)
        displacement["s"] = displacement.get("s", 0) + self.order
        parts = ((_parsed(self.input_unit), dimension[0]), (displacement, dimension[1]), ({"s": 1}, dimension[2]))
        for atoms, power in parts:
            for atom, own in atoms.items():
                powers[atom] = powers.get(atom, 0) + own * power
        return written({atom: power for atom, power in powers.items() if power})


#: The Silverbox's: input and output in volts, as they are.
VOLTS = Scales()


def _parsed(unit: str) -> dict[str, int]:
    """Atoms of a unit such as ``m/s²``, with their powers."""
    powers: dict[str, int] = {}
    for k, part in enumerate(unit.translate(_DIGITS).split("/")):
        for atom, power in _ATOM.findall(part):
            powers[atom] = powers.get(atom, 0) + (-1 if k else 1) * int(power or 1)
    return powers


def written(powers: Mapping[str, int]) -> str:
    """A unit from the powers of its atoms."""
    if dict(powers) == {"N": 1, "m": -1, "s": 2}:
        return "kg"
    above = [atom + _power(power) for atom, power in powers.items() if power > 0]
    below = {atom: -power for atom, power in powers.items() if power < 0}
    if above and len(below) == 1:
        ((atom, power),) = below.items()
        return f"{' '.join(above)}/{atom}{_power(power)}"
    return " ".join([*above, *(f"{atom}{_power(-power)}" for atom, power in below.items())]) or "1"


def labelled(name: str, unit: str) -> str:
    """What an axis or a column is called.

    Example:
        >>> labelled("u", "V"), labelled("u", "m/s"), labelled("u", "1")
        ('u / V', 'u / (m/s)', 'u')
    """
    if unit == "1":
        return name
    return f"{name} / {unit}" if unit.isalpha() else f"{name} / ({unit})"


def _power(power: int) -> str:
    return "" if power == 1 else str(power).translate(SUPERSCRIPTS)


def digits_of(low: float, high: float, least: int) -> int:
    """Significant digits, a ``least`` number or more, that show that the ends of an interval differ.

    Example:
        >>> digits_of(0.0023, 0.0023000001, 5), digits_of(1.0, 2.0, 5)
        (9, 5)
    """
    for digits in range(least, 16):
        if f"{low:.{digits}g}" != f"{high:.{digits}g}":
            return digits if digits == least else digits + 1
    return least
