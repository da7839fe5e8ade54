"""The language of models: every function compiled is what NumPy says, and so are its slopes; refusals."""

import re

import numpy as np
import pytest
from reference.filters import FUNCTIONS, Plant, central, jacobian
from tables import table

from estimator import OnlineEstimator, Rig
from estimator.compilation.simd import LANES
from estimator.engine import printer_numba
from estimator.engine.expression_parser import parse_expression
from estimator.engine.kernels import RUNTIME_FUNCTIONS
from estimator.engine.reverse_mode import reverse_mode_derivative
from estimator.engine.source_cache import load_generated
from estimator.engine.symbolic import eliminate_common_subexpressions, substitute, symbol
from estimator.inference.free_run import free_run
from estimator.models.difference_equation import difference
from estimator.models.expression import evaluate, parse
from estimator.models.model import Model
from estimator.models.pendulum import PENDULUM
from estimator.priors import weak_prior
from estimator.rigs.physical_parameters import coefficients_of, to_physical
from estimator.rigs.units import Scales

EXPRESSIONS = (
    "sin(x) + cos(pi*y)", "exp(x)*tanh(y)",
    "log(x**2 + 1) + sqrt(y**2 + 1)", "atan(x)*atan(3*y)", "abs(x)*y",
    "sign(x)*y + sign(y - 1)", "min(x, y)", "max(x, 2*y, x*y)", "min(x, y, 0.5)*max(y, 0)",
    "abs(x)**1.5 + (y**2)**0.75",
    "where(x > y, x**2, sin(y))",
    "where(x*y <= 0.2, x, y*x)", "where(x < 0, -1, y)", "where(1 >= y, g*x, x + y)",
    "g*x + exp(1)*y", "where(abs(x) > 0.5, where(y > 0, x, -x), x**2)", "(x**2 + 1e-9)**(0.3/2)*y", "abs(sin(x) - y)",
)  # fmt: skip

BASE = {
    "name": "words", "states": {"x": "1", "y": "1"}, "coefficients": {}, "noise": ("1", "1"), "outputs": {"z": "x"},
    "next_state": ("x", "y"), "constants": {"g": 9.81},
}  # fmt: skip


#: What is compiled of each: its value, its slopes forwards, and its slopes in the reverse mode.
FOUND = ("VALUE", "BY_x", "BY_y", "ADJ_x", "ADJ_y")


def lines_of(k, text):
    """Assignments of `FOUND` of expression k."""
    x, y = symbol("x"), symbol("y")
    value = parse_expression(text, {"x": x, "y": y}, Model(**BASE))
    forward = {f"VALUE_{k}": value, f"BY_x_{k}": value.diff(x), f"BY_y_{k}": value.diff(y)}
    primal = eliminate_common_subexpressions({f"RESULT_{k}": value}, f"G{k}")
    backward = substitute(reverse_mode_derivative(primal, ["x", "y"], {f"RESULT_{k}": "SEED"}), {
        "ADJ_x": f"ADJ_x_{k}", "ADJ_y": f"ADJ_y_{k}",
    })  # fmt: skip
    return [*eliminate_common_subexpressions(forward, f"F{k}"), *primal, *backward]


def compiled_source():
    """``values(W)``, in all lanes, and ``alone(W)``, in one."""
    rows = [f"OUT_{name}_{k}" for k in range(len(EXPRESSIONS)) for name in FOUND]
    layout = {row: i for i, row in enumerate(["x", "y", "SEED", *rows])}
    lines = [line for k, text in enumerate(EXPRESSIONS) for line in lines_of(k, text)]
    results = {row: row.removeprefix("OUT_") for row in rows}
    return "".join(
        printer_numba.print_lane_loop(name, lines, results, layout, lanes, doc="All expressions.")
        for name, lanes in (("values", LANES), ("alone", 1))
    )


def points(rng):
    """x and y in all lanes, away from kinks and jumps, which lie at round numbers."""
    return rng.uniform(-2, 2, (2, LANES))


def test_compiled_functions_and_slopes_are_those_of_numpy():
    code = load_generated("words", "language", repr((EXPRESSIONS, FOUND)), compiled_source, RUNTIME_FUNCTIONS)
    block = np.zeros((3 + len(FOUND) * len(EXPRESSIONS), LANES))
    block[:2], block[2] = points(np.random.default_rng(0)), 1.0
    single = block.copy()
    code.values(block.reshape(-1))
    for lane in range(LANES):
        column = np.ascontiguousarray(single[:, lane])
        code.alone(column)
        single[:, lane] = column
    np.testing.assert_array_equal(block, single)
    for k, text in enumerate(EXPRESSIONS):
        tree = parse(text, "words")
        of = lambda z, tree=tree: np.array(  # noqa: E731
            [evaluate(tree, {"x": z[0], "y": z[1], "pi": np.pi, "g": 9.81}, FUNCTIONS) + 0 * z[0]]
        )
        value, *slopes = block[3 + len(FOUND) * k :][: len(FOUND)]
        np.testing.assert_allclose(value, of(block[:2])[0], rtol=1e-13, atol=1e-14, err_msg=text)
        for lane in range(LANES):
            complex_step = jacobian(of, block[:2, lane])[0]
            np.testing.assert_allclose(np.array(slopes)[:2, lane], complex_step, 1e-12, 1e-13, err_msg=text)
            np.testing.assert_allclose(np.array(slopes)[2:, lane], complex_step, 1e-12, 1e-13, err_msg=text)
            differences = central(of, block[:2, lane], 1e-4)[0]
            np.testing.assert_allclose(np.array(slopes)[:2, lane], differences, 1e-6, 1e-6, err_msg=text)


def test_generated_code_chooses_without_branches():
    source = compiled_source()
    for foreign in ("Piecewise", "Heaviside", "DiracDelta", "Abs", "Derivative", "Subs", "re(", "im("):
        assert foreign not in source


def test_slopes_at_kinks_are_of_one_side():
    x = symbol("x")
    for text, slope in (
        ("abs(x)", 0), ("sign(x)", 0), ("max(x, 0)", 1), ("min(0, x)", 0), ("where(x > 0, 1, x)", 1), ("x*abs(x)", 0),
    ):  # fmt: skip
        assert parse_expression(text, {"x": x}, Model(**BASE)).diff(x).subs(x, 0) == slope


def test_a_model_of_all_functions_runs_as_its_reference():
    model = Model(
        "all_words", {"x": "1", "v": "1"}, {"k": "1", "c": "1"}, noise=("0", "1"), outputs={"y": "max(x, -0.2)"},
        constants={"g": 2.0},
        rates=("v", "u - k*atan(g*x) - c*v*abs(v) - where(x > 0.1, k*(x - 0.1), 0) - 0.1*min(v, 0.2) + 0.05*sign(v)"),
    )  # fmt: skip
    u = np.repeat(np.random.default_rng(0).uniform(-1, 1, 20), 5)
    plant, state, shown = Plant.of(model), np.zeros(2), []
    for level in u:
        k1 = np.array(plant.move(state, [0.7, 0.3], level))
        k2 = np.array(plant.move(state + k1 / 2, [0.7, 0.3], level))
        k3 = np.array(plant.move(state + k2 / 2, [0.7, 0.3], level))
        k4 = np.array(plant.move(state + k3, [0.7, 0.3], level))
        state = state + (k1 + 2 * k2 + 2 * k3 + k4) / 6
        shown.append(plant.show(state, [0.7, 0.3], level)[0])
    np.testing.assert_allclose(free_run(model, [0.7, 0.3], u), shown, rtol=1e-12, atol=1e-14)


@table(
    ("text", "words"),
    [
        ("k*sqrt(x)", "the slope of 'sqrt(x)' is not finite where x is 0; write (x**2 + 1e-9)**(1/4)"),
        ("k*abs(x)**0.5", "the slope of 'abs(x) ** 0.5' is not finite where x is 0; write (x**2 + 1e-9)**(0.5/2)"),
        ("abs(x)**k", "write (x**2 + 1e-9)**(k/2)"),
        ("k*x/abs(x)", "write (k * x)/(x**2 + 1e-9)**(1/2)"),
        ("k*x/sqrt(x**2)", "write (k * x)/(x**2 + 1e-9)**(1/2)"),
        ("sqrt(k + x)", "write ((k + x)**2 + 1e-9)**(1/4)"),
        ("k*sqrt(u)", "write (u**2 + 1e-9)**(1/4)"),
        ("k*sqrt(x**2 + u**2)", "write (x ** 2 + u ** 2 + 1e-9)**(1/2)"),
        ("k*(x**2)**0.3", "write (x**2 + 1e-9)**(0.3)"),
        ("k*abs(x)**third", "write (x**2 + 1e-9)**(0.25/2)"),
        ("k*sqrt(max(x, 0))", "write (max(x, 0) + 1e-9)**(1/2)"),
        ("k*1/sqrt(x)", "write (x**2 + 1e-9)**(1/4)"),
    ],
)
def test_slopes_that_are_not_finite_are_refused_with_the_way_to_write_them(text, words):
    with pytest.raises(ValueError, match=re.escape(words)):
        Model("root", {"x": "1"}, {"k": "1"}, ("1",), {"y": "x"}, rates=(text,), constants={"third": 0.25})


@table(
    "text",
    [
        "sqrt(k)*x", "sqrt(k**2 + x**2)", "k*exp(x)**0.3", "k*sqrt(x**2 + 1)", "k*abs(x)**1.5", "k*sqrt(x**2)",
        "k*sqrt(2 + sin(x))", "(x**2 + 1e-9)**(k/2)", "u*x/(k + x)", "k/x", "k*sqrt(max(x, 1e-6))",
        "k*x/(1 + abs(x))", "x/(k + abs(x))", "k*x*abs(x)**2", "k*x**2/sqrt(x*x + 1)", "k/x**2", "k*x/exp(sqrt(k))",
        "k*sqrt(where(x > 1, x**2 + 1, 2))", "abs(x)**pi*k", "k*sqrt(exp(u) + x**2)", "k*sqrt(atan(exp(x)))",
    ],
)  # fmt: skip
def test_finite_slopes_and_poles_are_taken(text):
    assert Model("root", {"x": "1"}, {"k": "1"}, ("1",), {"y": "x"}, rates=(text,)).n_states == 1


@table(
    ("changed", "words"),
    [
        ({"next_state": ("where(x, 1, 2)", "y")}, "the condition of where must be a comparison by < <= > >=, but is x"),
        ({"next_state": ("where(x == 1, 1, 2)", "y")}, "the condition of where must be a comparison by < <= > >="),
        ({"next_state": ("where(0 < x < 1, 1, 2)", "y")}, "the condition of where must be a comparison"),
        ({"next_state": ("x > 1", "y")}, "uses something else: x > 1"),
        ({"next_state": ("min(x)", "y")}, "uses something else: min(x) is no function with its arguments"),
        ({"next_state": ("abs(x, y)", "y")}, "abs(x, y) is no function with its arguments"),
        ({"next_state": ("u[-3]", "y")}, "uses ['u[-3]']"),
        ({"next_state": ("u[0]", "y")}, "uses something else: u[0]"),
        ({"next_state": ("x[-1]", "y")}, "uses ['x[-1]']"),
        ({"next_state": ("'x'", "y")}, "uses something else: 'x' is no number"),
        ({"constants": {"pi": 3.0}}, "but one is 'pi'; rename it"),
        ({"constants": {"x": 3.0}}, "must have different names, but share ['x']"),
        ({"constants": {"g": "9.81"}}, "constants['g'] must be a number"),
    ],
)
def test_the_language_refuses_by_name(changed, words):
    with pytest.raises(ValueError, match=re.escape(words)):
        Model(**{**BASE, **changed})


def test_constants_belong_to_the_digest_and_none_does_not():
    plain = Model(**{**BASE, "constants": {}})
    assert (difference().digest, PENDULUM.digest) == ("c41def760f93", "0ceb5fc40441")  # oracles are named by these
    assert Model(**BASE).digest != plain.digest != Model(**{**BASE, "constants": {"g": 1.6}}).digest
    assert Model(**Model(**BASE).to_dict()) == Model(**BASE)


def test_constants_and_choices_stand_in_physical_parameters():
    model = Model(
        "pendulum", {"q": "rad"}, {"rate": "1"}, ("1",), {"y": "q"}, rates=("-rate*sin(q)",), constants={"g": 9.81},
        physical={"length": "g*step/max(rate, 0.01)"}, dimensions={"length": (0, 0, 0)},
        inverse={"rate": "g*step/length"},
    )  # fmt: skip
    lengths = np.array([0.5, 2.0])
    found = coefficients_of(model, {"length": lengths}, Scales(0.1))
    np.testing.assert_allclose(found[:, 0], 0.981 / lengths)
    np.testing.assert_allclose(to_physical(model, found, Scales(0.1))[:, 0], lengths)


#: An input that acts by its slope, and a sensor that shows it.
FOLLOWER = Model(
    "follower", {"x": "1"}, {"k": "1"}, ("1",), {"y": "x + 0.1*derivative(u)"}, substeps=2,
    rates=("derivative(u) - k*x",), inputs={"u": "1"},
)  # fmt: skip


def test_the_derivative_of_a_linear_input_is_its_slope():
    rng = np.random.default_rng(0)
    u = rng.standard_normal(30)
    state, k, shown, h = 0.2, 0.3, [], 0.5
    for slope in np.diff(u, prepend=0.0):
        for _ in range(2):
            rate = lambda x, slope=slope: slope - k * x  # noqa: E731
            k1 = rate(state)
            k2 = rate(state + h / 2 * k1)
            k3 = rate(state + h / 2 * k2)
            k4 = rate(state + h * k3)
            state += h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        shown.append(state + 0.1 * slope)
    found = free_run(FOLLOWER, [k], u, [0.2], interpolation="linear")
    np.testing.assert_allclose(found, shown, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("interpolation", ["linear", "spline"])
def test_a_coefficient_is_learned_under_a_derivative(interpolation):
    rng = np.random.default_rng(0)
    times = np.arange(400)
    u = np.sin(0.3 * times) + np.sin(0.11 * times)
    y = free_run(FOLLOWER, [0.3], u, interpolation="linear") + 1e-2 * rng.standard_normal(400)
    prior = weak_prior(FOLLOWER, [0.2], [[0.1**2]], process_noise=1e-3, measurement_noise=1e-2)
    estimator = OnlineEstimator(FOLLOWER, prior, Rig(prior.step, interpolation))
    estimator.run(u, y)
    mean, std = estimator.belief.coefficients()["k"]
    assert std < 0.02
    # The record is of a linear input; a spline has another slope at a sample.
    assert abs(mean - 0.3) < (4 * std if interpolation == "linear" else 0.1)


def test_a_held_input_has_no_derivative():
    with pytest.raises(
        ValueError, match=re.escape("interpolation must be 'linear', 'look_ahead' or 'spline' for foll")
    ):
        free_run(FOLLOWER, [0.3], np.ones(4))
    with pytest.raises(ValueError, match=re.escape("uses ['derivative(u)']")):
        Model("late", {"x": "1"}, {"k": "1"}, ("1",), {"y": "x"}, next_state=("k*x + derivative(u)",))
