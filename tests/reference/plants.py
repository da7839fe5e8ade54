"""Models of the tests, as a user would write them."""

from estimator.models.difference_equation import difference
from estimator.models.duffing import duffing
from estimator.models.model import Model
from estimator.models.pendulum import PENDULUM

#: That of docs/own_model.md, whose kernels are then its.
VAN_DER_POL = Model(
    name="van_der_pol",
    states={"x": "V", "v": "V"},
    coefficients={"stiffness": "1", "friction": "1", "gain": "1"},
    rates=("v", "gain*u - stiffness*x + friction*(1 - x**2)*v"),
    noise=("0", "sqrt(3)"),
    outputs={"y": "x"},
    substeps=4,
)

#: Drag that is quadratic in the speed: a magnitude.
DRAG = Model(
    name="drag",
    states={"x": "V", "v": "V"},
    coefficients={"stiffness": "1", "drag": "1", "gain": "1"},
    rates=("v", "gain*u - stiffness*x - drag*v*abs(v)"),
    noise=("0", "sqrt(3)"),
    outputs={"y": "x"},
    substeps=4,
)

#: Two taps of the input, two sensors of which one sees it, and noise that moves both states.
TANKS = Model(
    name="tanks",
    states={"upper": "m", "lower": "m"},
    coefficients={"flow": "1", "leak": "1", "valve": "1", "bias": "m"},
    next_state=("upper - flow*tanh(upper) + valve*(u + 0.5*u[-1])", "lower + flow*tanh(upper) - leak*tanh(lower)"),
    noise=("1", "0.5"),
    outputs={"level": "lower + bias", "top": "upper + 0.1*u"},
)

#: Two masses in a chain of springs, a force on each, and the positions of both.
TWO_MASSES = Model(
    name="two_masses",
    states={"x1": "m", "v1": "m", "x2": "m", "v2": "m"},
    coefficients={"stiffness": "1", "coupling": "1", "drag": "1", "gain": "1"},
    inputs={"f1": "N", "f2": "N"},
    rates=(
        "v1",
        "gain*f1 - stiffness*x1 - drag*v1 - coupling*(x1 - x2)",
        "v2",
        "gain*f2 - stiffness*x2 - drag*v2 - coupling*(x2 - x1)",
    ),
    noise=("0", "sqrt(3)", "0", "sqrt(3)"),
    outputs={"y1": "x1", "y2": "x2"},
)

#: Model, interpolation, coefficients, scale of the input.
CASES = {
    "paper": (difference(), "zero_order", [1.48, -1.47, -0.939, 0.39], 0.12),
    "motion": (duffing(), "linear", [0.49, 1.96, 0.0687, 0.5], 0.12),
    "pendulum": (PENDULUM, "zero_order", [14.7 * 0.0025, 0.01, 3 * 0.0025], 2.0),
    "tanks": (TANKS, "zero_order", [0.3, 0.2, 0.4, 0.05], 0.3),
}
