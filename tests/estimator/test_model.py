"""Declarations of a model: what is refused, when it is written and not when it runs."""

import re

import numpy as np
import pytest
from tables import table

from estimator.engine.symbolic import differentiate, symbol
from estimator.inference.fisher_information import fisher_information
from estimator.inference.free_run import free_run
from estimator.models.difference_equation import Term, difference
from estimator.models.model import Model
from estimator.rigs.physical_parameters import coefficients_of, propagate_to_physical
from estimator.rigs.units import Scales

TANK = {
    "name": "tank", "states": {"x": "V"}, "coefficients": {"loss": "1"}, "noise": ("1",), "outputs": {"y": "x"},
    "rates": ("u - loss*x",),
}  # fmt: skip


@table(
    ("given", "words"),
    [
        (
            {"rates": ("u - leak*x",)},
            "may use ['derivative(u)', 'loss', 'u', 'x'] and ['abs', 'atan', 'cos', 'exp', 'log', 'max', 'min', 'sign'",
        ),
        ({"rates": ("u - loss*x*u[-1]",)}, "uses ['u[-1]']"),
        ({"rates": ("u - loss*x//2",)}, "may use + - * / **, brackets and ['sin', 'cos'"),
        ({"rates": ("u - loss*x if x else 0",)}, "uses something else"),
        ({"rates": ("u - loss*(x",)}, "expressions of tank must be formulas, but 'u - loss*(x' is not one"),
        ({"rates": ("u - x",)}, "coefficients must stand in an expression, but ['loss'] do not"),
        ({"outputs": {"y": "2"}}, "outputs must show a state or a coefficient each, but 'y' shows none"),
        ({"noise": ("u",)}, "may use ['loss', 'x']"),
        ({"rates": ("u", "loss*x")}, "rates must have one expression per state, 1, but has 2"),
        ({"next_state": ("u - loss*x",)}, "either rates or next_state must be given"),
        ({"states": {"X": "V"}}, "names must be lower-case identifiers"),
        ({"outputs": {"capped": "x"}}, "but one is 'capped'; rename it"),
        ({"coefficients": {"x": "1"}}, "must have different names, but share ['x']"),
        ({"physical": {"t": "1/loss"}, "dimensions": {"t": (0, 0, 1)}}, "physical and inverse go together"),
        (
            {"physical": {"t": "step/loss"}, "dimensions": {"t": (0, 0, 1)}, "inverse": {"loss": "step/tau"}},
            "may use ['step', 't']",
        ),
    ],
)
def test_what_does_not_fit_is_refused_at_once(given, words):
    with pytest.raises(ValueError, match=re.escape(words)):
        Model(**{**TANK, **given})


def test_powers_too_high_for_a_product_are_refused():
    with pytest.raises(ValueError, match="powers of tank must be from -16 to 16, but 'u - loss"):
        differentiate(Model(**{**TANK, "rates": ("u - loss*x**17",)}))


@table(
    ("term", "words"),
    [
        (Term(lag1=-2), "lag1 of a term must be a whole number from 0 to 16, but is -2"),
        (Term(lag1=True), "lag1 of a term must be a whole number from 0 to 16, but is True"),
        (Term(lag2=1.5), "lag2 of a term must be a whole number from 0 to 16, but is 1.5"),
        (Term(lag1=17), "lag1 of a term must be a whole number from 0 to 16, but is 17"),
        (Term(tap=3), "tap of a term must be a whole number from 0 to 2, but is 3"),
    ],
)
def test_terms_are_products_of_whole_powers(term, words):
    with pytest.raises(ValueError, match=re.escape(words)):
        difference((Term(1), term))


def test_powers_equal_pythons_powers():
    powers = ["0.5", "1.5", "(-1/2)", "2.0", "9", "(-3)", "0.3", "loss", "(loss - 1)"]
    x, loss, names = 1.7, 0.4, [f"c{i}" for i in range(len(powers))]
    terms = " + ".join(f"{name}*(exp(log(x)))**{power}" for name, power in zip(names, powers, strict=True))
    coefficients = {"loss": "1", **dict.fromkeys(names, "1")}
    model = Model(**{**TANK, "coefficients": coefficients, "rates": (), "next_state": (f"u + {terms}",)})
    (slopes,) = differentiate(model).jacobian[0][:1]
    for name, power in zip(names, powers, strict=True):
        given = dict(zip(coefficients, [loss, *(1.3 * (name == other) for other in names)], strict=True))
        exponent = eval(power, {"loss": loss})
        assert free_run(model, list(given.values()), [0.25], [x])[0] == pytest.approx(
            0.25 + 1.3 * x**exponent, rel=1e-14
        )
        slope = slopes.subs({symbol("x"): x, **{symbol(c): value for c, value in given.items()}})
        assert float(slope) == pytest.approx(1.3 * exponent * x ** (exponent - 1), rel=1e-12)


@table("name", ["coefficients", "u", "state"])
def test_a_free_run_is_of_numbers(name):
    given = {"coefficients": [0.4], "u": [0.25], "state": [1.0]}
    with pytest.raises(ValueError, match=f"{name} must be numbers"):
        free_run(Model(**TANK), **{**given, name: [1j]})


def test_free_runs_of_many_systems_are_those_of_each():
    model = Model(**TANK)
    c, u = np.array([[0.4], [0.1], [0.7]]), np.linspace(0.0, 1.0, 12).reshape(3, 4)
    state = np.array([[1.0], [2.0], [0.5]])
    each = [free_run(model, *system) for system in zip(c, u, state, strict=True)]
    np.testing.assert_array_equal(free_run(model, c, u, state), each)
    np.testing.assert_array_equal(free_run(model, c[0], u[0], state), [free_run(model, c[0], u[0], x) for x in state])
    assert free_run(model, c, u[0]).shape == (3, 4)


@table(("c", "u", "state"), [((2, 1), (3, 4), (1,)), ((2,), (4,), (1,)), ((1,), (4,), (2, 3))])
def test_a_free_run_names_the_shapes_that_do_not_fit(c, u, state):
    with pytest.raises(ValueError, match="or one more axis for systems, but have"):
        free_run(Model(**TANK), np.ones(c), np.ones(u), np.ones(state))


def test_a_free_run_refuses_a_number_for_a_series():
    with pytest.raises(ValueError, match=r"u must have shape \(T,\) or \(n, T\), but has \(\)"):
        free_run(Model(**TANK), [0.4], 1.0, [1.0])


def test_the_information_of_powers_is_that_of_differences():
    model = Model(**{**TANK, "rates": ("u - loss*x**1.5",)})
    u = np.repeat([0.5, 0.1], 20)
    slope = (free_run(model, [0.3 + 1e-6], u) - free_run(model, [0.3 - 1e-6], u)) / 2e-6
    found = fisher_information(model, [0.3], u, process_noise=0.0, measurement_noise=0.02)
    assert found[0, 0] == pytest.approx((slope**2).sum() / 0.02**2, rel=1e-6)


@table("magnitude", ["abs({})", "sqrt({}**2)"])
def test_a_magnitude_equals_numpys(magnitude):
    """Of a number on either side of 0, at it, and of what SymPy does not know to be real."""
    moves = f"u + loss*{magnitude.format('x')} + {magnitude.format('log(loss)')}"
    model = Model(**{**TANK, "rates": (), "next_state": (moves,)})
    for x in (-1.7, 0.0, 1.7):
        expected = 0.25 + 0.4 * abs(x) + abs(np.log(0.4))
        assert free_run(model, [0.4], [0.25], [x])[0] == pytest.approx(expected, rel=1e-14)
        slope = differentiate(model).jacobian[0][0].subs({symbol("x"): x, symbol("loss"): 0.4})
        assert float(slope) == pytest.approx(0.4 * np.sign(x))


def test_parameters_may_be_magnitudes():
    given = {
        "physical": {"t": "step/sqrt(loss**2)"},
        "dimensions": {"t": (0, 0, 1)},
        "inverse": {"loss": "step/abs(t)"},
    }
    model = Model(**{**TANK, **given})
    scales = Scales(0.01, 1.0, 1.0)
    assert coefficients_of(model, {"t": 0.05}, scales) == pytest.approx([0.2])
    mean, cov = propagate_to_physical(model, np.array([0.2]), np.array([[1e-6]]), scales)
    assert (mean[0], cov[0, 0]) == pytest.approx((0.05, (0.05 * 1e-3 / 0.2) ** 2))
