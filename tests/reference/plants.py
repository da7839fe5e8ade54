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

#: A first-order lag.
LAG = Model(
    name="lag",
    states={"x": "V"},
    coefficients={"decay": "1", "gain": "1"},
    rates=("gain*u - decay*x",),
    noise=("1",),
    outputs={"y": "x"},
)

#: A spring that is not symmetric about rest.
ASYMMETRIC_SPRING = Model(
    name="asymmetric_spring",
    states={"x": "V", "v": "V"},
    coefficients={"stiffness": "1", "quadratic": "V⁻¹", "cubic": "V⁻²", "damping": "1", "gain": "1"},
    rates=("v", "gain*u - damping*v - stiffness*x - quadratic*x**2 - cubic*x**3"),
    noise=("0", "sqrt(3)"),
    outputs={"y": "x"},
    substeps=4,
)

#: Friction that hardly depends on the speed, and turns over within the creep.
DRY_FRICTION = Model(
    name="dry_friction",
    states={"x": "V", "v": "V"},
    coefficients={"stiffness": "1", "friction": "V", "damping": "1", "gain": "1"},
    constants={"creep": 0.02},
    rates=("v", "gain*u - damping*v - stiffness*x - friction*tanh(v/creep)"),
    noise=("0", "sqrt(3)"),
    outputs={"y": "x"},
    substeps=4,
)

#: The hysteresis of Bouc and Wen, whose force z follows the displacement and is lost to friction.
BOUC_WEN = Model(
    name="bouc_wen",
    states={"x": "V", "v": "V", "z": "V"},
    coefficients={"stiffness": "1", "hysteresis": "1", "damping": "1", "gain": "1", "loss": "V⁻¹"},
    rates=("v", "gain*u - damping*v - stiffness*x - hysteresis*z", "v - loss*(abs(v)*z + 0.5*v*abs(z))"),
    noise=("0", "sqrt(3)", "0"),
    outputs={"y": "x"},
    substeps=4,
)

_TORQUE_1 = "(t1 - drag*w1 + m2*l1*l2*sin(q2)*(2*w1*w2 + w2**2) - g*((m1 + m2)*l1*sin(q1) + m2*l2*sin(q1 + q2)))"
_TORQUE_2 = "(t2 - drag*w2 - m2*l1*l2*sin(q2)*w1**2 - g*m2*l2*sin(q1 + q2))"
_INERTIA_11 = "((m1 + m2)*l1**2 + m2*l2**2 + 2*m2*l1*l2*cos(q2))"
_INERTIA_12, _INERTIA_22 = "(m2*l2**2 + m2*l1*l2*cos(q2))", "(m2*l2**2)"
_DETERMINANT = "(m2*l2**2*l1**2*(m1 + m2*sin(q2)**2))"

#: The double pendulum of IO-SMC² (Iqbal et al., ICML 2024), with point masses and a torque on each joint. The second
#: angle is relative to the first arm.
DOUBLE_PENDULUM = Model(
    name="double_pendulum",
    time="s",
    states={"q1": "rad", "q2": "rad", "w1": "rad/s", "w2": "rad/s"},
    coefficients={"m1": "kg", "m2": "kg", "l1": "m", "l2": "m"},
    inputs={"t1": "N m", "t2": "N m"},
    constants={"g": 9.81, "drag": 0.1},
    rates=(
        "w1",
        "w2",
        f"({_INERTIA_22}*{_TORQUE_1} - {_INERTIA_12}*{_TORQUE_2})/{_DETERMINANT}",
        f"({_INERTIA_11}*{_TORQUE_2} - {_INERTIA_12}*{_TORQUE_1})/{_DETERMINANT}",
    ),
    noise=("0", "0", "1", "1"),
    independent_noise=True,
    outputs={"angle1": "q1", "angle2": "q2"},
    substeps=4,
)

#: Model, interpolation, coefficients, scale of the input.
CASES = {
    "paper": (difference(), "zero_order", [1.48, -1.47, -0.939, 0.39], 0.12),
    "motion": (duffing(), "linear", [0.49, 1.96, 0.0687, 0.5], 0.12),
    "pendulum": (PENDULUM, "zero_order", [14.7 * 0.0025, 0.01, 3 * 0.0025], 2.0),
    "tanks": (TANKS, "zero_order", [0.3, 0.2, 0.4, 0.05], 0.3),
}
