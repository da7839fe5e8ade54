"""The generated structured update against its equations with matrices."""

import numpy as np
import pytest
from engine_cases import CASES, assert_agrees, block, get_belief, interpreted, put, put_belief, random_belief, random_inputs  # fmt: skip  # noqa: E501
from engine_reference import update

from estimator.engine import tasks

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
        rows = tasks.input_rows(case.model, case.degree)
        put(W, task.layout, LANES, lane, dict(zip(rows, inputs, strict=True)))
        put(W, task.layout, LANES, lane, dict(zip((f"Y_{s}" for s in case.model.outputs), y, strict=True)))
    task.update(W)
    return W


def assert_equals_reference(case, task, samples, iterations):
    W = updated(case, task, samples)
    for lane, (belief, inputs, y) in enumerate(samples):
        expected = update(case.plant, case.model.n_states, belief, inputs, y, iterations)
        assert_agrees(get_belief(W, task.layout, LANES, lane, case), expected, case.operations)


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("iterations", [1, 3])
def test_an_update_equals_its_equations(name, iterations, monkeypatch):
    interpreted(monkeypatch)
    case = CASES[name]
    task = tasks._structured.__wrapped__(case.model, case.degree, iterations, LANES, None, False, False)
    assert_equals_reference(case, task, some_samples(case, 1), iterations)
