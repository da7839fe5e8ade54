"""A Wiener-Hammerstein system: a filter of second order, a static cubic, a filter of first order.

The structure that Kouw (2020) names as future work. The first filter rings at the input, the cubic bends what it gives,
and the second filter smooths that; only its output is seen.
"""

from __future__ import annotations

from estimator.models.model import Model

#: The gain of the first filter is 1 at rest, and that of the cubic at small signals: otherwise gains could move from
#: one block to the next, and no input could tell them apart.
WIENER_HAMMERSTEIN = Model(
    name="wiener_hammerstein",
    states={"x": "V", "v": "V", "z": "V"},
    coefficients={"stiffness": "1", "damping": "1", "cubic": "V⁻²", "decay": "1"},
    rates=("v", "stiffness*(u - x) - damping*v", "decay*(x + cubic*x**3 - z)"),
    noise=("0", "sqrt(3)", "1"),
    outputs={"y": "z"},
    substeps=4,
)
