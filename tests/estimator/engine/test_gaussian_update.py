"""The generated structured update against its equations with matrices."""

from dataclasses import replace

import numpy as np
import pytest
from engine_cases import CASES, Case, assert_agrees, block, get_belief, put, put_belief, random_belief, random_inputs
from reference.filters import EPS, Plant
from reference.structured import update
from tables import table

from estimator.engine import kernels
from estimator.engine.storage_layout import input_rows
from estimator.models.model import Model

LANES = 8


def some_samples(case, seed):
    """A belief, inputs and outputs per lane."""
    rng = np.random.default_rng(seed)
    samples = []
    for _ in range(LANES):
        belief, inputs = random_belief(case, rng), random_inputs(case, rng)
        samples.append((belief, inputs, rng.uniform(-0.5, 0.5, case.model.n_outputs)))
    return samples


def updated(case, task, samples):
    """What the generated update makes of samples, one per lane: the block."""
    W = block(task.layout, LANES)
    for lane, (belief, inputs, y) in enumerate(samples):
        put_belief(W, task.layout, LANES, lane, case, belief)
        rows = input_rows(case.model, case.degree)
        put(W, task.layout, LANES, lane, dict(zip(rows, inputs, strict=True)))
        put(W, task.layout, LANES, lane, dict(zip((f"Y_{s}" for s in case.model.outputs), y, strict=True)))
    task.update(W)
    return W


def assert_equals_reference(case, task, samples, iterations):
    W = updated(case, task, samples)
    for lane, (belief, inputs, y) in enumerate(samples):
        expected = update(case.plant, case.model.n_states, belief, inputs, y, iterations)
        assert_agrees(get_belief(W, task.layout, LANES, lane, case), expected, case.operations)


@pytest.mark.parametrize(("name", "iterations"), [*((name, 3) for name in CASES), ("paper", 1), ("pendulum", 1)])
def test_an_update_equals_its_equations(name, iterations):
    case = CASES[name]
    task = kernels.compile_belief_update(case.model, case.degree, iterations=iterations, lanes=LANES)
    assert_equals_reference(case, task, some_samples(case, 1), iterations)


@pytest.mark.parametrize("name", ["pendulum", "duffing, all terms", "cubic"])
def test_an_update_equals_its_equations_with_missing_outputs(name):
    """Of two sensors none, the first, the second or both are missing."""
    case = CASES[name]
    task = kernels.compile_belief_update(case.model, case.degree, iterations=2, lanes=LANES, may_be_missing=True)
    samples = some_samples(case, 2)
    for lane, (_, _, y) in enumerate(samples):
        y[[bool(lane & bit) for bit in (1, 2)][: len(y)]] = np.nan
    assert_equals_reference(case, task, samples, 2)


def test_a_missing_output_leaves_the_belief_bit_by_bit_as_predicted():
    """And one that is there keeps the digits of its own variance, however much smaller than the predicted one it is."""
    case = CASES["paper"]
    task = kernels.compile_belief_update(case.model, lanes=LANES, may_be_missing=True)
    belief, inputs, y = some_samples(case, 6)[0]
    precise = replace(belief, gamma=(100.0, 100.0), xi=[(100.0, 1e-16)])
    W = updated(case, task, [(precise, inputs, y), (belief, inputs, [np.nan])] + [(belief, inputs, y)] * (LANES - 2))
    exact = get_belief(W, task.layout, LANES, 0, case)
    # r/S is 1e-18: 1 - (s + q)/S would be 0, or a few 1e-16.
    r = exact.xi[0][1] / exact.xi[0][0]
    assert exact.cov[0, 0] == pytest.approx(r, rel=0.5)
    still = get_belief(W, task.layout, LANES, 1, case)
    np.testing.assert_array_equal(still.mean[2:], belief.mean[2:])
    np.testing.assert_array_equal(still.cov[2:, 2:], belief.cov[2:, 2:])
    assert (still.gamma, still.xi) == (belief.gamma, belief.xi)


def test_noise_that_no_sensor_shows_widens_the_state_and_is_not_learned():
    hidden = Model(
        "hidden", {"x": "1", "w": "1"}, {"k": "1"}, noise=("0", "1"), outputs={"y": "x"}, next_state=("k*x + w", "w/2")
    )
    plant = Plant(lambda z, c, u: [c[0] * z[0] + z[1], z[1] / 2], lambda z, c, u: [z[0]], lambda z, c: [0.0, 1.0])
    case = Case(hidden, plant, (0.5, 0.2, 0.9))
    task = kernels.compile_belief_update(hidden, lanes=LANES, keep_trace=True)
    samples = some_samples(case, 7)
    assert_equals_reference(case, task, samples, 3)
    W = updated(case, task, samples)
    assert get_belief(W, task.layout, LANES, 0, case).gamma == samples[0][0].gamma


def test_noise_that_depends_on_the_state_may_vanish():
    growing = Model("growing", {"x": "1"}, {"k": "1"}, noise=("x",), outputs={"y": "x"}, next_state=("k*x + u",))
    plant = Plant(lambda z, c, u: [c[0] * z[0] + u[0]], lambda z, c, u: [z[0]], lambda z, c: [z[0]])
    case = Case(growing, plant, (0.5, 0.9))
    task = kernels.compile_belief_update(growing, lanes=LANES, keep_trace=True)
    samples = some_samples(case, 8)
    assert_equals_reference(case, task, samples, 3)
    at_rest = replace(samples[0][0], mean=np.array([0.0, 0.9]))
    W = updated(case, task, [(at_rest, *samples[0][1:])] * LANES)
    assert np.isfinite(W).all()
    # A sample that shows nothing of γ leaves its expectation.
    shape, rate = get_belief(W, task.layout, LANES, 0, case).gamma
    assert rate / shape == pytest.approx(at_rest.gamma[1] / at_rest.gamma[0], rel=4 * EPS)


def test_what_is_generated_names_nothing_twice():
    """A model with the engine's own names for stages, lanes and loops."""
    model = Model(
        "odd", {"j": "1", "j_a": "1", "j_e": "1"}, {"s": "1", "lane": "1"}, noise=("1", "0", "0"), outputs={"w": "j"},
        rates=("j_a - s*j", "lane*u - j", "j - j_e"), substeps=2,
    )  # fmt: skip
    plant = Plant(
        lambda z, c, u: [z[1] - c[0] * z[0], c[1] * u - z[0], z[0] - z[2]], lambda z, c, u: [z[0]],
        lambda z, c: [1.0, 0.0, 0.0], substeps=2,
    )  # fmt: skip
    case = Case(model, plant, (0.1, 0.2, 0.3, 0.4, 0.5))
    task = kernels.compile_belief_update(model, iterations=2, lanes=LANES)
    assert_equals_reference(case, task, some_samples(case, 9), 2)


@pytest.mark.parametrize(("name", "scale"), [("paper", 1e9), ("duffing", 1e3), ("wiener-hammerstein", 1e3)])
def test_a_covariance_stays_positive_semidefinite_for_any_samples(name, scale):
    """Samples with 1e18 times the prior information, and rates too fast for the steps."""
    case = CASES[name]
    task = kernels.compile_belief_update(case.model, case.degree, lanes=LANES)
    rng = np.random.default_rng(11)
    whole = 0
    for size in scale ** rng.uniform(0.0, 1.0, 40):
        W = block(task.layout, LANES)
        for lane in range(LANES):
            put_belief(W, task.layout, LANES, lane, case, random_belief(case, rng))
        table = W.reshape(-1, LANES)
        for _ in range(6):
            for row in (*input_rows(case.model, case.degree), *(f"Y_{y}" for y in case.model.outputs)):
                table[task.layout[row]] = size * rng.uniform(-1, 1, LANES)
            task.update(W)
            for lane in np.flatnonzero(np.isfinite(table[: max(task.layout.values())]).all(axis=0)):
                cov = get_belief(W, task.layout, LANES, lane, case).cov
                std = np.sqrt(np.diag(cov))
                assert (std > 0).all()
                assert np.linalg.eigvalsh(cov / np.outer(std, std))[0] > -EPS * case.operations
                whole += 1
    assert whole > 500


def test_lanes_are_independent():
    case = CASES["pendulum"]
    task = kernels.compile_belief_update(case.model, case.degree, iterations=2, lanes=LANES, may_be_missing=True)
    samples = some_samples(case, 10)
    W = updated(case, task, samples).reshape(-1, LANES)
    alone = updated(case, task, samples[3:4] * LANES).reshape(-1, LANES)
    np.testing.assert_array_equal(alone, np.repeat(W[:, 3:4], LANES, axis=1))


@table("iterations", [0, 101])
def test_iterations_out_of_range_are_refused(iterations):
    with pytest.raises(ValueError, match=f"iterations must be a whole number from 1 to 100, but is {iterations}"):
        kernels.compile_belief_update(CASES["paper"].model, iterations=iterations)
