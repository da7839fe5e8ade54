"""An oscillator whose drag is quadratic in its speed, for tests: a model with a magnitude."""

from estimator.models.model import Model

DRAG = Model(
    name="drag",
    states={"x": "V", "v": "V"},
    coefficients={"stiffness": "1", "drag": "1", "gain": "1"},
    rates=("v", "gain*u - stiffness*x - drag*v*sqrt(v**2)"),
    noise=("0", "sqrt(3)"),
    outputs={"y": "x"},
    substeps=4,
)
