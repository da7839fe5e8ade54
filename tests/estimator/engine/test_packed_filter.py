"""The linearised filter in loops over packed arrays against its equations with matrices."""

from dataclasses import replace

import numpy as np
import pytest
from engine_cases import CASES, Case, block
from reference.filters import Plant
from tables import table
from test_linearised_filter import NOISE, assert_equals_reference, feed, matrix, some_walk, start, walked

from estimator.engine import kernels
from estimator.engine.storage_layout import is_packed
from estimator.models.model import Model

#: Three masses in a chain, of which the sensors see the last and a speed.
THREE_MASSES = Model(
    name="three_masses",
    states={"x1": "m", "v1": "m", "x2": "m", "v2": "m", "x3": "m", "v3": "m"},
    coefficients={"stiffness": "1", "coupling": "1", "offset": "m", "drag": "1", "cubic": "1", "gain": "1"},
    rates=(
        "v1",
        "gain*u - stiffness*x1 - drag*v1 - coupling*(x1 - x2)",
        "v2",
        "-drag*v2 - coupling*(2*x2 - x1 - x3) - cubic*x2**3",
        "v3",
        "0.5*gain*u - drag*v3 - coupling*(x3 - x2)",
    ),
    noise=("0", "1 + 0.1*x1", "0", "2", "0.1", "0.5"),
    outputs={"y": "x3 + offset", "speed": "v1 + 0.1*v1**2 + 0.1*drag*x2"},
    substeps=4,
)
#: A delay line with a bend.
DELAY_LINE = Model(
    name="delay_line",
    states={f"x{i}": "V" for i in range(5)},
    coefficients={"a": "1", "b": "1", "offset": "V"},
    next_state=("a*x4 + b*x0 - 0.1*x2**3 + u[-1]", "x0", "x1 + 0.1*u", "x2", "tanh(x3)"),
    noise=("1", "0", "0.2", "0", "0"),
    outputs={"y": "x0 + 0.1*u + offset", "z": "x4"},
)
CENTER = (0.1, -0.2, 0.3, 0.1, -0.1, 0.2, 0.6, 0.3, 0.05, 0.2, 0.4, 0.5)
LARGE = {
    "chain, independent noises": Case(
        model := replace(THREE_MASSES, independent_noise=True), Plant.of(model), CENTER, degree=1
    ),
    "chain, held noise": Case(model := replace(THREE_MASSES, held=True, substeps=2), Plant.of(model), CENTER),
    "chain, independent held noises": Case(
        model := replace(THREE_MASSES, held=True, independent_noise=True), Plant.of(model), CENTER
    ),
    "delay line": Case(DELAY_LINE, Plant.of(DELAY_LINE), (0.1, -0.2, 0.3, 0.1, -0.1, 0.5, 0.3, 0.1)),
}


@table("observed", [True, False])
@pytest.mark.parametrize("name", LARGE)
def test_a_large_model_equals_its_equations(name, observed):
    case = LARGE[name]
    assert is_packed(case.model)
    task = kernels.compile_linearised_filter(case.model, case.degree, follows_outputs=observed, lanes=8)
    assert_equals_reference(case, task, observed)


@table("observed", [True, False])
@pytest.mark.parametrize("name", CASES)
def test_a_small_model_in_loops_equals_its_equations(name, observed, monkeypatch):
    case = CASES[name]
    monkeypatch.setattr("estimator.engine.storage_layout.MIN_PACKED_STATES", 1)
    compile_filter = kernels.compile_linearised_filter.__wrapped__
    task = compile_filter(case.model, case.degree, follows_outputs=observed, lanes=1)
    assert_equals_reference(case, task, observed)


@table("observed", [True, False])
def test_loops_equal_straight_lines(observed, monkeypatch):
    """One source of white noise that drives all states, whose covariance is so near singular that it is clipped.

    That enlarges rounding errors to more than the reference's tolerance, but both ways of writing have the same. In few
    samples only: sooner or later rounding decides whether one is clipped.
    """
    case = Case(THREE_MASSES, Plant.of(THREE_MASSES), CENTER, degree=1)
    walk, found = some_walk(case, 1), []
    for packed_from in (5, 99):
        monkeypatch.setattr("estimator.engine.storage_layout.MIN_PACKED_STATES", packed_from)
        compile_filter = kernels.compile_linearised_filter.__wrapped__
        task = compile_filter(case.model, case.degree, follows_outputs=observed, lanes=8)
        W, _ = walked(case, task, [walk] * 8, observed, samples=2)
        names = list(case.model.coefficients)
        found.append(matrix(W, task.layout, 8, 7, ("INFORMATION", names), names))
    size = np.sqrt(np.diag(found[1]))
    # Without the clipping the information would be another by 4e-6.
    np.testing.assert_allclose(found[0] / np.outer(size, size), found[1] / np.outer(size, size), rtol=0, atol=1e-11)


def test_sources_variances_scale_the_noise():
    """With ratios of 1 the loops equal those without ratios, and halving a ratio is not without effect."""
    case = LARGE["chain, independent noises"]
    z, V, c, inputs, R, y = some_walk(case, 1)
    ends = []
    for ratio in (None, 1.0, 0.5):
        task = kernels.compile_linearised_filter(
            case.model, case.degree, follows_outputs=True, lanes=8, noise_ratios=ratio is not None
        )
        W = block(task.layout, 8)
        start(case, task.layout, z, V, c, (NOISE, *R), W, 0, 8)
        for source in case.model.noise_sources if ratio else ():
            W[task.layout[f"VARIANCE_RATIO_{source}"] * 8] = ratio
        for t in range(3):
            feed(case, task.layout, inputs[t], y[t], W, 0, 8)
            task.sample(W, case.model.substeps)
        ends.append(np.array([W[task.layout[row] * 8] for row in ("LOSS", "GRADIENT_drag")]))
    np.testing.assert_allclose(ends[1], ends[0], rtol=1e-12)
    assert (abs(ends[2] / ends[0] - 1) > 1e-3).any()
