"""The paper's difference equation, Eq. (2), and its presets.

    x_t = θ1 x_{t-1} + θ2 x_{t-1}³ + θ3 x_{t-2} + η u_{t-1} + w̃,        y_t = x_t + v

Other terms are products of powers of the two lags and possibly an input tap. An offset and three taps represent a
band-limited input better than the hold of a single tap.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

from estimator.models.duffing import PARAMETER_DIMENSIONS
from estimator.models.expression import older_input
from estimator.models.model import MAX_POWER, Model
from estimator.support.argument_checks import check_integer, short_repr


class Term(NamedTuple):
    """One regressor.

    Attributes:
        lag1: power of x_{t-1}, 0 to 16.
        lag2: power of x_{t-2}, 0 to 16.
        tap: delay of the input that multiplies it, 0 to 2, from the newest input that acts; None for no input.
    """

    lag1: int = 0
    lag2: int = 0
    tap: int | None = None

    @property
    def expression(self) -> str:
        """Expression of the term, such as ``x1``, ``x1**3``, ``x1**2*x2`` or ``u[-1]``; ``1`` for the offset."""
        factors = [f"{x}**{n}" if n > 1 else x for x, n in (("x1", self.lag1), ("x2", self.lag2)) if n]
        factors += [] if self.tap is None else [older_input("u", self.tap)]
        return "*".join(factors) or "1"

    @property
    def unit(self) -> str:
        """Unit of its coefficient, with x and u in volts."""
        power = 1 - self.lag1 - self.lag2 - (self.tap is not None)
        return {0: "1", 1: "V"}.get(power, f"V^{power}")


_PAPER_TERMS = (Term(1), Term(3), Term(0, 1))
_INPUT_TAPS = (Term(tap=0), Term(tap=1), Term(tap=2))

#: Name of a preset to its terms. ``paper`` has the regressors of Eq. (2), in its order; ``linear`` is the FEM-LARX of
#: the paper.
PRESETS: dict[str, tuple[Term, ...]] = {
    "paper": (*_PAPER_TERMS, Term(tap=0)),
    "linear": (Term(1), Term(0, 1), Term(tap=0)),
    "offset": (*_PAPER_TERMS, Term(tap=0), Term()),
    "three-tap": (*_PAPER_TERMS, *_INPUT_TAPS, Term()),
    "cubic": (*_PAPER_TERMS, *_INPUT_TAPS, Term(), Term(2), Term(2, 1), Term(1, 2), Term(0, 3)),
}

#: Eq. (3): coefficient to its formula in the parameters of an oscillator.
_COEFFICIENT_FORMULAS = {
    "theta1": "(2*m + c*step - a*step**2)/(m + c*step)",
    "theta2": "-b*step**2/(m + c*step)",
    "theta3": "-m/(m + c*step)",
    "eta": "step**2/(m + c*step)",
}

#: Eq. (4): parameter of an oscillator to its formula in the coefficients.
_PHYSICAL_FORMULAS = {
    "m": "-theta3*step**2/eta",
    "c": "(1 + theta3)*step/eta",
    "a": "(1 - theta1 - theta3)/eta",
    "b": "-theta2/eta",
}


def difference(preset: str | tuple[Term, ...] = "paper") -> Model:
    """Eq. (2), or another difference equation that is linear in its coefficients.

    Args:
        preset: a name of `PRESETS`, or terms. The coefficients of ``paper`` are theta1, theta2, theta3 and eta, with m,
            c, a and b by Eqs. (3) and (4); ``linear`` has no theta2 and no b. The coefficients of other terms are k0,
            k1, ...

    Raises:
        ValueError: for an unknown preset, for repeated terms or other objects, or for a power or tap out of its range.
    """
    is_terms = isinstance(preset, tuple) and all(isinstance(term, Term) for term in preset)
    if not is_terms and not (isinstance(preset, str) and preset in PRESETS):
        raise ValueError(f"preset must be one of {list(PRESETS)} or terms, but is {short_repr(preset)}")
    for term in preset if isinstance(preset, tuple) else ():
        check_integer("lag1 of a term", term.lag1, MAX_POWER, 0)
        check_integer("lag2 of a term", term.lag2, MAX_POWER, 0)
        if term.tap is not None:
            check_integer("tap of a term", term.tap, 2, 0)
    return _difference(preset)


@cache
def _difference(preset: str | tuple[Term, ...]) -> Model:
    terms = PRESETS[preset] if isinstance(preset, str) else preset
    if not terms or len(set(terms)) < len(terms):
        raise ValueError(f"preset must have different terms, at least one, but is {preset!r}")
    known = preset in ("paper", "linear")
    kept = {"paper": list(_COEFFICIENT_FORMULAS), "linear": ["theta1", "theta3", "eta"]}.get(str(preset), [])
    names = kept if known else [f"k{i}" for i in range(len(terms))]
    moved = " + ".join(f"{name}*{term.expression}" for name, term in zip(names, terms, strict=True))
    physical = {p: text for p, text in _PHYSICAL_FORMULAS.items() if known and (p != "b" or preset == "paper")}
    return Model(
        name="difference",
        states={"x1": "V", "x2": "V"},
        coefficients={name: term.unit for name, term in zip(names, terms, strict=True)},
        next_state=(moved, "x1"),
        noise=("1", "0"),
        outputs={"y": "x1"},
        physical=physical,
        dimensions={p: PARAMETER_DIMENSIONS[p] for p in physical},
        inverse={name: _COEFFICIENT_FORMULAS[name] for name in names} if known else {},
    )
