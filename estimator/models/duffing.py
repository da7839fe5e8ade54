"""The Duffing oscillator, Eq. (1): m x'' + c x' + a x + b x³ = u + w, y = x + v.

Divided by the mass, and with time counted in samples of δ seconds,

    x'' = gain u - damping x' - stiffness x - cubic x³ + noise,        gain = δ²/m, damping = δ c/m, stiffness = δ² a/m.

With an input offset u0 and an output offset y0 it is the motion of z = x + y0 under a constant force,

    z'' = gain u + force - damping z' - stiffness z - cubic (z - y0)³,    y = z + v,    force = stiffness y0 - gain u0.

Outputs identify z and the force at once, but u0 and y0 only together. A filter that is linear in x, u0 and y0 mistakes
the changes of its own stiffness and gain for information that separates the two, and its intervals become far too
narrow.
"""

from __future__ import annotations

from functools import cache

from estimator.models.model import Model
from estimator.support.argument_checks import check_bool, check_choice

#: Parameter of Eq. (1) to its powers of the input's unit, the displacement's unit and the second.
PARAMETER_DIMENSIONS = {"m": (1, -1, 2), "c": (1, -1, 1), "a": (1, -1, 0), "b": (1, -3, 0)}

#: Kind of a sensor to the order of the time derivative of the displacement that it measures.
DERIVATIVE_ORDER_OF_SENSOR = {"displacement": 0, "velocity": 1, "acceleration": 2}


def duffing(
    *,
    offsets: bool = False,
    cubic_damping: bool = False,
    quintic: bool = False,
    feedthrough: bool = False,
    dry_friction: bool = False,
    noise: str = "white",
    sensor: str = "displacement",
) -> Model:
    """Eq. (1), with optional terms of real oscillators.

    Args:
        offsets: offsets of the output (y0) and of the input (as a constant force).
        cubic_damping: a damping force e x'³.
        quintic: a stiffness force q x⁵.
        feedthrough: a term d u in the output.
        dry_friction: a force f sign(x'), smoothed to f x'/√(x'² + s²) with the speed s.
        noise: process noise of the acceleration: ``white``, or ``held`` over each sample. With unit strength it moves x
            by 1 within a sample, without spring and damper.
        sensor: measured quantity: ``displacement``, ``velocity`` or ``acceleration``.

    Raises:
        ValueError: for an unknown noise or sensor.
    """
    terms = {
        "offsets": offsets, "cubic_damping": cubic_damping, "quintic": quintic, "feedthrough": feedthrough,
        "dry_friction": dry_friction,
    }  # fmt: skip
    for name, value in terms.items():
        check_bool(name, value)
    check_choice("noise", noise, ("white", "held"))
    check_choice("sensor", sensor, DERIVATIVE_ORDER_OF_SENSOR)
    return _duffing(*map(bool, terms.values()), noise, sensor)


@cache
def _duffing(
    offsets: bool, cubic_damping: bool, quintic: bool, feedthrough: bool, dry_friction: bool, noise: str, sensor: str
) -> Model:
    order = DERIVATIVE_ORDER_OF_SENSOR[sensor]
    # The state of a displacement sensor includes the offset.
    x = "(x - output_offset)" if offsets and order == 0 else "x"
    coefficients = {"stiffness": "1", "cubic": "V⁻²", "damping": "1", "gain": "1"}
    acceleration = f"gain*u - damping*v - stiffness*x - cubic*{x}**3"
    physical = {"m": "step**2/gain", "c": "step*damping/gain", "a": "stiffness/gain", "b": "cubic/gain"}
    dimensions = dict(PARAMETER_DIMENSIONS)
    inverse = {"stiffness": "a*step**2/m", "cubic": "b*step**2/m", "damping": "c*step/m", "gain": "step**2/m"}
    per_step, by_step = (("", ""), ("/step", "*step**1"), ("/step**2", "*step**2"))[order]

    def add(name: str, unit: str, parameter: str, text: str, dimension: tuple[int, int, int], back: str) -> None:
        """Add a coefficient and its parameter: unit, expression of the parameter, dimension, and inverse expression."""
        coefficients[name], inverse[name] = unit, back
        physical[parameter], dimensions[parameter] = text, dimension

    if offsets:
        acceleration += " + force"
        static, force = ("-force", "-u0") if order else ("stiffness*output_offset - force", "a*y0 - u0")
        add("force", "V", "u0", f"({static})/gain", (1, 0, 0), f"({force})*step**2/m")
        add("output_offset", "V", "y0", f"output_offset{per_step}", (0, 1, -order), f"y0{by_step}")
    if cubic_damping:
        acceleration += " - cubic_damping*v**3"
        add("cubic_damping", "V⁻²", "e", "step**3*cubic_damping/gain", (1, -3, 3), "e/(m*step)")
    if quintic:
        acceleration += f" - quintic*{x}**5"
        add("quintic", "V⁻⁴", "q", "quintic/gain", (1, -5, 0), "q*step**2/m")
    if dry_friction:
        acceleration += " - friction*v/sqrt(v**2 + creep**2)"
        add("friction", "V", "f", "friction/gain", (1, 0, 0), "f*step**2/m")
        add("creep", "V", "s", "creep/step", (0, 1, -1), "s*step")
    output = ("x", "v", acceleration)[order]
    if offsets and order:
        output += " + output_offset"
    if feedthrough:
        output += " + feedthrough*u"
        add("feedthrough", "1", "d", f"feedthrough{per_step}", (-1, 1, -order), f"d{by_step}")
    return Model(
        name="duffing",
        states={"x": "V", "v": "V"},
        coefficients=coefficients,
        rates=("v", acceleration),
        noise=("0", "sqrt(3)" if noise == "white" else "2"),
        held=noise == "held",
        outputs={"y": output},
        substeps=8,
        physical=physical,
        dimensions=dimensions,
        inverse=inverse,
    )
