"""A Wiener-Hammerstein system: a second-order filter, a static cubic, and a first-order filter in series.

Kouw (2020) names this structure as future work. A sensor measures the output of the second filter alone.
"""

from __future__ import annotations

from estimator.models.model import Model

#: The system. The static gain of the first filter and the small-signal gain of the cubic are 1: otherwise no input
#: could distinguish the gains of the blocks.
WIENER_HAMMERSTEIN = Model(
    name="wiener_hammerstein",
    states={"x": "V", "v": "V", "z": "V"},
    coefficients={"stiffness": "1", "damping": "1", "cubic": "V⁻²", "decay": "1"},
    rates=("v", "stiffness*(u - x) - damping*v", "decay*(x + cubic*x**3 - z)"),
    noise=("0", "sqrt(3)", "1"),
    outputs={"y": "z"},
    substeps=4,
)
