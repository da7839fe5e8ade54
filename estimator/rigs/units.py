"""Units and scales: conversion between physical units and the scaled numbers near 1 of the compiled code.

Scaled time counts samples, the scaled input is in units of its scale U, and the scaled displacement in units of X. A
sensor of displacement, velocity or acceleration (``order`` 0, 1, 2) has the scale S = X / step**order: its scaled
output is per sample, or per sample squared.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import TypeVar

import numpy as np

from estimator.rigs.silverbox_constants import SILVERBOX_SAMPLING_STEP
from estimator.support.argument_checks import check_number
from estimator.support.array_types import FloatArray

#: A number or a unit.
_T = TypeVar("_T")

#: Powers of the input's unit, the displacement's unit and the second.
UnitPowers = tuple[int, int, int]

#: Smallest and largest magnitude of a quantity in its unit: products of several neither underflow nor overflow.
MAGNITUDE_BOUNDS = 1e-30, 1e30

#: SI units that take prefixes, as a regular expression.
_SI_UNITS = "N|V|A|Pa|m"

#: SI prefix to factor.
_SI_PREFIXES = {"n": 1e-9, "u": 1e-6, "m": 1e-3, "c": 1e-2, "d": 0.1, "": 1.0, "k": 1e3, "M": 1e6}

#: Units outside the SI to their factor and SI unit.
_OTHER_UNITS = {"in": (0.0254, "m"), "ft": (0.3048, "m"), "deg": (math.pi / 180, "rad"), "°": (math.pi / 180, "rad")}

#: Units that take no prefix to their factor and SI unit.
_UNITS_WITHOUT_PREFIX = {"g": (9.80665, "m/s²"), "lb": (4.4482216152605, "N"), "lbf": (4.4482216152605, "N")}
_UNITS_WITHOUT_PREFIX |= {"mps": (1.0, "m/s"), "mps2": (1.0, "m/s²")}

#: Suffix of a compound unit to its usual form.
_COMPOUND_SUFFIXES = {"": "", "/s": "/s", "/s2": "/s²", "/s/s": "/s²", "m": " m", "/V": "/V"}

#: Kind of an output to the pattern of the units that it alone has.
_UNIT_PATTERN_OF_KIND = {
    "displacement": r"[mµμun]?m|cm|in",
    "velocity": r"[^/]+/s",
    "acceleration": r".+/s(²|\^?2|/s)|m?g",
}

#: Digits to superscripts, for `str.translate`.
SUPERSCRIPTS = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")

#: Superscripts to digits, for `str.translate`.
_DIGITS_OF_SUPERSCRIPTS = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻", "0123456789-")

#: A factor of a unit and its power.
_UNIT_FACTOR = re.compile(r"([^\s·/\d⁰¹²³⁴⁵⁶⁷⁸⁹⁻^-]+)(?:\^?(-?\d+))?")


def sensor_kind_of_unit(unit: str) -> str | None:
    """The kind of output that alone has a unit; None for a unit of any kind, such as V."""
    return next((kind for kind, units in _UNIT_PATTERN_OF_KIND.items() if re.fullmatch(units, unit)), None)


def normalise_unit(unit: str) -> str:
    """A unit in a unique spelling."""
    for written, usual in (("µ", "u"), ("μ", "u"), ("²", "2"), ("^", ""), ("·", " "), ("*", " ")):
        unit = unit.replace(written, usual)
    return unit.replace(" ", "")


def to_si_unit(unit: str) -> tuple[float, str]:
    """The factor and the SI unit of a unit; 1 and the unit itself where it is unknown.

    Example:
        >>> [to_si_unit(unit) for unit in ("mm", "µm/s", "N", "m/s^2", "counts")]
        [(0.001, 'm'), (1e-06, 'm/s'), (1.0, 'N'), (1.0, 'm/s²'), (1.0, 'counts')]
    """
    bare = normalise_unit(unit)
    if bare in _UNITS_WITHOUT_PREFIX:
        return _UNITS_WITHOUT_PREFIX[bare]
    found = re.fullmatch(rf"(?:([{''.join(_SI_PREFIXES)}]?)({_SI_UNITS})|({'|'.join(_OTHER_UNITS)}))(.*)", bare)
    if found is None or found[4] not in _COMPOUND_SUFFIXES:
        return 1.0, unit
    factor, base = _OTHER_UNITS[found[3]] if found[3] else (_SI_PREFIXES[found[1]], found[2])
    return factor, base + _COMPOUND_SUFFIXES[found[4]]


def conversion_factor(source: str, target: str) -> float | None:
    """Factor from numbers in the source unit to numbers in the target unit; None between different quantities.

    Example:
        >>> conversion_factor("mm", "m"), conversion_factor("m", "mm"), conversion_factor("mm", "V")
        (0.001, 1000.0, None)
    """
    (source_factor, source_unit), (target_factor, target_unit) = to_si_unit(source), to_si_unit(target)
    return source_factor / target_factor if normalise_unit(source_unit) == normalise_unit(target_unit) else None


@dataclass(frozen=True)
class Scales:
    """Physical values of the scaled units.

    Attributes:
        step: sampling step [s].
        input: scale U of the input, in its unit.
        output: scale S of the sensor, in its unit.
        order: order of the time derivative of the displacement that the sensor measures: 0, 1 or 2.
        input_unit: unit of the input, such as ``"N"``.
        output_unit: unit of the output, such as ``"m"``, or ``"m/s"`` for a velocity.
        more_inputs: scales of the inputs after the first, in their units; empty where all inputs have the first one's.
        more_input_units: units of the inputs after the first, likewise.

    Example:
        >>> from estimator.rigs.units import Scales
        >>> scales = Scales(step=1e-3, input=20.0, output=0.03, input_unit="N", output_unit="m")
        >>> scales.unit((1, -1, 2)), scales.unit((1, -3, 0)), scales.unit((1, -1, 1))
        ('kg', 'N/m³', 'N s/m')
    """

    step: float = SILVERBOX_SAMPLING_STEP
    input: float = 1.0
    output: float = 1.0
    order: int = 0
    input_unit: str = "V"
    output_unit: str = "V"
    more_inputs: tuple[float, ...] = ()
    more_input_units: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name in ("more_inputs", "more_input_units"):  # lists come from JSON
            object.__setattr__(self, name, tuple(getattr(self, name)))
        for i, scale in enumerate(self.more_inputs):
            check_number(f"more_inputs[{i}]", scale, *MAGNITUDE_BOUNDS)
        check_number("step", self.step, *MAGNITUDE_BOUNDS, "give the seconds between samples")
        for name in ("input", "output"):
            check_number(name, getattr(self, name), *MAGNITUDE_BOUNDS)

    def input_scales(self, count: int) -> FloatArray:
        """(count,) scales of a model's inputs, in their units.

        Raises:
            ValueError: for another number of inputs than ``more_inputs`` has.
        """
        return np.array(_of_all(count, self.input, self.more_inputs), dtype=np.float64)

    def input_units(self, count: int) -> tuple[str, ...]:
        """(count,) units of a model's inputs.

        Raises:
            ValueError: for another number of inputs than ``more_input_units`` has.
        """
        return _of_all(count, self.input_unit, self.more_input_units)

    def to_dict(self) -> dict[str, object]:
        """The scales for JSON; ``Scales(**d)`` makes the same scales again."""
        return {name: value for name, value in asdict(self).items() if value != ()}

    @property
    def displacement(self) -> float:
        """Scale X of the displacement, in the unit of the output times seconds to the order."""
        return float(self.output * self.step**self.order)

    def factor(self, dimension: UnitPowers | str) -> float:
        """Factor from scaled to physical numbers, for a quantity with the given powers whose time is in seconds.

        It is 1 for a unit instead of powers: the numbers are then in that unit.
        """
        if isinstance(dimension, str):
            return 1.0
        return float(self.input ** dimension[0] * self.displacement ** dimension[1])

    def unit(self, dimension: UnitPowers | str) -> str:
        """Unit of a quantity with the given powers, in the units of the channels; ``"1"`` for a pure number."""
        if isinstance(dimension, str):
            return dimension
        powers: dict[str, int] = {}
        displacement = _parse_unit(self.output_unit)
        displacement["s"] = displacement.get("s", 0) + self.order
        parts = ((_parse_unit(self.input_unit), dimension[0]), (displacement, dimension[1]), ({"s": 1}, dimension[2]))
        for atoms, power in parts:
            for atom, exponent in atoms.items():
                powers[atom] = powers.get(atom, 0) + exponent * power
        return format_unit({atom: power for atom, power in powers.items() if power})


#: Scales of the Silverbox: input and output in volts, unscaled.
VOLT_SCALES = Scales()


def _of_all(count: int, first: _T, others: tuple[_T, ...]) -> tuple[_T, ...]:
    """The first input's value and the others', or the first one's for all."""
    found = (first, *others) if others else (first,) * count
    if count and len(found) != count:
        raise ValueError(f"scales must be of {count} inputs, but are of {len(found)}; give more_inputs {count - 1}")
    return found[:count]


def _parse_unit(unit: str) -> dict[str, int]:
    """Factors of a unit such as ``m/s²`` to their powers."""
    powers: dict[str, int] = {}
    for k, part in enumerate(unit.translate(_DIGITS_OF_SUPERSCRIPTS).split("/")):
        for atom, power in _UNIT_FACTOR.findall(part):
            powers[atom] = powers.get(atom, 0) + (-1 if k else 1) * int(power or 1)
    return powers


def format_unit(powers: Mapping[str, int]) -> str:
    """A unit from its factors and their powers."""
    if dict(powers) == {"N": 1, "m": -1, "s": 2}:
        return "kg"
    numerator = [atom + _format_power(power) for atom, power in powers.items() if power > 0]
    denominator = {atom: -power for atom, power in powers.items() if power < 0}
    if numerator and len(denominator) == 1:
        ((atom, power),) = denominator.items()
        return f"{' '.join(numerator)}/{atom}{_format_power(power)}"
    return " ".join([*numerator, *(f"{atom}{_format_power(-power)}" for atom, power in denominator.items())]) or "1"


def axis_label(name: str, unit: str) -> str:
    """The label of an axis or a column.

    Example:
        >>> axis_label("u", "V"), axis_label("u", "m/s"), axis_label("u", "1")
        ('u / V', 'u / (m/s)', 'u')
    """
    if unit == "1":
        return name
    return f"{name} / {unit}" if unit.isalpha() else f"{name} / ({unit})"


def _format_power(power: int) -> str:
    return "" if power == 1 else str(power).translate(SUPERSCRIPTS)


def format_interval(mean: float, low: float, high: float, minimum: int) -> tuple[str, str, str]:
    """Mean and ends of an interval with the same decimals and the same power of ten.

    The larger end has ``minimum`` significant digits, or as many as show the width with three digits.

    Example:
        >>> format_interval(0.40028, 0.39935, 0.4012, 5), format_interval(2500.41, 2494.0, 2506.9, 5)
        (('0.40028', '0.39935', '0.40120'), ('2500.4', '2494.0', '2506.9'))
        >>> format_interval(4.04e7, 3.96818e7, 4.11173e7, 5), format_interval(1.46e-5, -5.7277e-6, 3.4938e-5, 5)
        (('4.0400e+07', '3.9682e+07', '4.1117e+07'), ('1.4600e-05', '-0.5728e-05', '3.4938e-05'))
        >>> format_interval(0.0023, 0.0023, 0.0023000001, 5)
        ('0.00230000000', '0.00230000000', '0.00230000010')
    """
    largest, width = max(abs(low), abs(high)), high - low
    if not (math.isfinite(largest) and math.isfinite(mean)) or largest == 0:
        return f"{mean:.{minimum}g}", f"{low:.{minimum}g}", f"{high:.{minimum}g}"
    exponent = int(f"{largest:.{minimum - 1}e}".partition("e")[2])
    digits = min(max(minimum, exponent - math.floor(math.log10(width)) + 2), 16) if width > 0 else minimum
    if -5 < exponent < digits:
        return tuple(f"{value:z.{digits - 1 - exponent}f}" for value in (mean, low, high))  # type: ignore[return-value]
    return tuple(f"{value / 10.0**exponent:z.{digits - 1}f}e{exponent:+03d}" for value in (mean, low, high))  # type: ignore[return-value]
