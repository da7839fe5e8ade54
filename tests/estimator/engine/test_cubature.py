"""The generated update with sigma points against its equations with matrices."""

from dataclasses import replace

import numpy as np
import pytest
from engine_cases import CASES, Case, assert_agrees, block, get_belief, put_belief, random_belief
from reference.filters import EPS, Plant
from reference.structured import update
from tables import table
from test_gaussian_update import LANES, some_samples, updated

from estimator.engine import kernels
from estimator.engine.cubature import PIVOT_TOLERANCE
from estimator.engine.storage_layout import input_rows
from estimator.engine.variational_free_energy import compile_free_energies
from estimator.models.model import Model

NAMES = ["duffing, all terms", "cubic", "pendulum", "wiener-hammerstein", "van der pol"]


def generated(case):
    return kernels.compile_belief_update(
        case.model, case.degree, lanes=LANES, may_be_missing=True, expectations="sigma_points"
    )


def movers(case):
    return [case.model.names.index(i) for i in case.model.dynamic_names]


def assert_equals_reference(case, task, samples):
    W = updated(case, task, samples)
    for lane, (belief, inputs, y) in enumerate(samples):
        expected = update(case.plant, case.model.n_states, belief, inputs, y, 3, movers(case))
        # A factor of m columns sums m products for each of m rows; 2 m images are summed in turn.
        m = len(case.model.names)
        assert_agrees(get_belief(W, task.layout, LANES, lane, case), expected, case.operations + m * m + 4 * m)
        assert W[task.layout["INDEFINITE_COUNT"] * LANES + lane] == 0


@pytest.mark.parametrize("name", NAMES)
def test_an_update_equals_its_equations(name):
    """Lanes with a missing output, and lanes with known quantities."""
    case = CASES[name]
    samples = some_samples(case, 11)
    samples[0][2][:] = np.nan
    for lane, known in enumerate(([2], [0], [1, 3], [len(case.center) - 1]), start=1):
        samples[lane][0].cov[known, :] = samples[lane][0].cov[:, known] = 0.0
    assert_equals_reference(case, generated(case), samples)


def test_free_energies_of_an_update_equal_their_definition():
    case = CASES["van der pol"]
    task = kernels.compile_belief_update(
        case.model, case.degree, lanes=LANES, may_be_missing=True, keep_trace=True, expectations="sigma_points"
    )  # fmt: skip
    samples = some_samples(case, 12)
    W, found = updated(case, task, samples), np.empty((3, LANES))
    compile_free_energies(case.model, 3, LANES, task.layout)(W, found.ravel())
    belief, inputs, y = samples[0]
    expected = update(case.plant, 2, belief, inputs, y, 3, movers(case)).free_energies[0]
    np.testing.assert_allclose(found[:, 0], expected, rtol=1e-9)


def test_dependent_quantities_get_no_sigma_points():
    case = CASES["van der pol"]
    samples = some_samples(case, 13)
    onto = np.eye(5)
    onto[1], onto[3] = onto[0] * 0.5, onto[0] - 2 * onto[2]
    tied = [(replace(b, cov=onto @ b.cov @ onto.T), u, y) for b, u, y in samples]
    task = generated(case)
    assert_equals_reference(case, task, tied)
    W = updated(case, task, tied)
    weights = np.array([W[task.layout[f"WEIGHT_{c}"] * LANES] for c in range(5)])
    np.testing.assert_array_equal(weights > 0, [True, False, True, False, True])
    np.testing.assert_allclose(weights[weights > 0], 1 / 6, rtol=4 * EPS)


def test_a_belief_without_variance_moves_with_its_mean():
    case = CASES["pendulum"]
    belief, inputs, _ = some_samples(case, 14)[0]
    sure = replace(belief, cov=np.zeros((5, 5)))
    W = updated(case, generated(case), [(sure, inputs, [np.nan, np.nan])] * LANES)
    first = kernels.compile_belief_update(case.model, case.degree, lanes=LANES, may_be_missing=True)
    V = updated(case, first, [(sure, inputs, [np.nan, np.nan])] * LANES)
    ours, theirs = (get_belief(w, first.layout, LANES, 0, case) for w in (W, V))
    np.testing.assert_allclose(ours.mean, theirs.mean, rtol=EPS * case.operations)
    np.testing.assert_allclose(ours.cov, theirs.cov, rtol=EPS * case.operations, atol=0)


def test_on_a_linear_model_it_is_first_order():
    linear = Model(
        "linear", {"x": "1", "v": "1"}, {"force": "1", "gain": "1", "bias": "1"}, noise=("0", "sqrt(3)"),
        outputs={"y": "x + bias"}, rates=("v", "force + gain*u - x/2 - v/10"), substeps=4,
    )  # fmt: skip
    assert linear.dynamic_names == ("x", "v", "force", "gain")
    plant = Plant(
        lambda z, c, u: [z[1], c[0] + c[1] * u - z[0] / 2 - z[1] / 10], lambda z, c, u: [z[0] + c[2]],
        lambda z, c: [0.0, np.sqrt(3.0)], substeps=4,
    )  # fmt: skip
    case = Case(linear, plant, (0.2, 0.1, 0.3, 0.4, 0.05))
    samples = some_samples(case, 15)
    task = generated(case)
    W = updated(case, task, samples)
    for lane, (belief, inputs, y) in enumerate(samples):
        expected = update(plant, 2, belief, inputs, y, 3)
        # Differences of points lose the digits by which the mean exceeds the standard deviation.
        lost = 1 + np.abs(expected.belief.mean).max() / expected.scale.min()
        assert_agrees(get_belief(W, task.layout, LANES, lane, case), expected, 4 * case.operations * lost)


@pytest.mark.parametrize("name", ["paper", "van der pol"])
def test_a_covariance_is_sound_or_flagged_at_any_scale(name):
    """Beliefs, inputs and outputs over sixteen decades, sixty samples on end."""
    case = CASES[name]
    task = kernels.compile_belief_update(
        case.model, case.degree, lanes=LANES, may_be_missing=True, expectations="sigma_points"
    )
    rng = np.random.default_rng(16)
    sound = flagged = 0
    for width in 10.0 ** np.arange(-12, 5):
        W = block(task.layout, LANES)
        for lane in range(LANES):
            belief = random_belief(case, rng, width)
            precise = replace(belief, xi=[(a, a * width**2 * 10.0 ** rng.uniform(-20, 0)) for a, _ in belief.xi])
            put_belief(W, task.layout, LANES, lane, case, precise)
        table = W.reshape(-1, LANES)
        for _ in range(60):
            for row in input_rows(case.model, case.degree):
                table[task.layout[row]] = width * rng.standard_normal(LANES)
            table[task.layout["Y_y"]] = width * rng.standard_normal(LANES)
            task.update(W)
        task.count_unsound(W)
        for lane in range(LANES):
            cov = get_belief(W, task.layout, LANES, lane, case).cov
            if table[task.layout["INDEFINITE_COUNT"], lane] > 0:
                flagged += 1
                continue
            assert np.isfinite(cov).all()
            std = np.sqrt(np.diag(cov))
            known = std == 0
            assert (cov[known] == 0).all()
            std[known] = 1.0
            # Pivots down to -ROUNDING, and in inactive columns √ROUNDING of two standard deviations.
            assert np.linalg.eigvalsh(cov / np.outer(std, std))[0] >= -len(std) * np.sqrt(PIVOT_TOLERANCE)
            sound += 1
    assert sound > 20
    assert sound + flagged == 17 * LANES
    assert name != "paper" or not flagged  # which has no steps to be too long


@table(
    ("entries", "flagged"),
    [
        ({}, False),
        ({(1, 1): -1e-3}, True),
        ({(0, 2): 0.999, (0, 3): 0.999, (2, 3): -0.9}, True),
        ({(4, 4): 0.0, (3, 4): 1e-6}, True),
        ({(2, 2): np.nan}, True),
        ({(2, 2): 0.0}, False),
    ],
)
def test_an_indefinite_matrix_is_flagged(entries, flagged):
    case = CASES["van der pol"]
    belief = random_belief(case, np.random.default_rng(17))
    cov = np.eye(5)
    for (i, j), value in entries.items():
        cov[i, j] = cov[j, i] = value
    task = generated(case)
    W = block(task.layout, LANES)
    for lane in range(LANES):
        put_belief(W, task.layout, LANES, lane, case, replace(belief, cov=cov if lane == 2 else np.eye(5)))
    task.count_unsound(W)
    counts = W.reshape(-1, LANES)[task.layout["INDEFINITE_COUNT"]]
    np.testing.assert_array_equal(counts > 0, [flagged and lane == 2 for lane in range(LANES)])


def test_other_expectations_are_refused():
    with pytest.raises(ValueError, match=r"expectations must be one of .*, but is 'unscented'"):
        kernels.compile_belief_update(CASES["paper"].model, expectations="unscented")
