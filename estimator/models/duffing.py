"""The Duffing oscillator, Eq. (1): m x'' + c x' + a x + b x³ = u + w, y = x + v.

Divided by the mass, and with time counted in samples of δ seconds,

    x'' = gain u - damping x' - stiffness x - cubic x³ + noise,        gain = δ²/m, damping = δ c/m, stiffness = δ² a/m.

With an input offset u0 and an output offset y0 it is the motion of z = x + y0 under a constant force,

    z'' = gain u + force - damping z' - stiffness z - cubic (z - y0)³,    y = z + v,    force = stiffness y0 - gain u0.

Outputs tell z and the force at once, but u0 and y0 only together. A filter that linearises in x, u0 and y0 takes the
changes of its own stiffness and gain for news that tells them apart, and its intervals become far too narrow.
"""

from __future__ import annotations

from functools import cache

from estimator.models.model import Model


@cache
def duffing(
    *, offsets: bool = False, cubic_damping: bool = False, feedthrough: bool = False, noise: str = "white"
) -> Model:
    """Eq. (1), with terms that real circuits have.

    Args:
        offsets: of the output (y0) and of the input (as a constant force).
        cubic_damping: a term e x'³ of the damping.
        feedthrough: d u in the output.
        noise: ``white`` in the acceleration, or ``held``: constant over a sample. Of unit strength it would move x by 1
            within a sample, without spring and damper.

    Raises:
        ValueError: for another noise.
    """
    if noise not in ("white", "held"):
        raise ValueError(f"noise must be 'white' or 'held', but is {noise!r}")
    coefficients = {"stiffness": "1", "cubic": "V⁻²", "damping": "1", "gain": "1"}
    acceleration = "gain*u - damping*v - stiffness*x - cubic*x**3"
    physical = {"m": "step**2/gain", "c": "step*damping/gain", "a": "stiffness/gain", "b": "cubic/gain"}
    units = {"m": "s²", "c": "s", "a": "1", "b": "V⁻²"}
    inverse = {"stiffness": "a*step**2/m", "cubic": "b*step**2/m", "damping": "c*step/m", "gain": "step**2/m"}
    if offsets:
        coefficients |= {"force": "V", "output_offset": "V"}
        acceleration = "gain*u + force - damping*v - stiffness*x - cubic*(x - output_offset)**3"
        physical |= {"u0": "(stiffness*output_offset - force)/gain", "y0": "output_offset"}
        units |= {"u0": "V", "y0": "V"}
        inverse |= {"force": "(a*y0 - u0)*step**2/m", "output_offset": "y0"}
    if cubic_damping:
        coefficients |= {"cubic_damping": "V⁻²"}
        acceleration += " - cubic_damping*v**3"
        physical |= {"e": "step**3*cubic_damping/gain"}
        units |= {"e": "V⁻² s³"}
        inverse |= {"cubic_damping": "e/(m*step)"}
    output = "x"
    if feedthrough:
        coefficients |= {"feedthrough": "1"}
        output = "x + feedthrough*u"
        physical |= {"d": "feedthrough"}
        units |= {"d": "1"}
        inverse |= {"feedthrough": "d"}
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
        physical_units=units,
        inverse=inverse,
    )
