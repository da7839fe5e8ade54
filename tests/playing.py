"""How tests play environments, and compare the results bit for bit."""

import copy
import pickle

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from estimator.belief import Belief

MODES = list(AutoresetMode)
BY_HAND = AutoresetMode.DISABLED
#: How an environment is copied.
COPIES = [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))]


def random_actions(steps, rows=1, seed=0, inputs=1):
    """Actions (steps, rows, inputs), some beyond the limits; a row's actions do not depend on the number of rows."""
    columns = [np.random.default_rng([seed, row]).uniform(-1.2, 1.2, (steps, inputs)) for row in range(rows)]
    return np.stack(columns, axis=1).astype(np.float32)


def play(env, actions, seed=None):
    """One episode of a single environment: all that `reset` and `step` gave."""
    given = [env.reset(seed=seed)]
    for action in actions:
        given.append(env.step(action))
        if given[-1][2] or given[-1][3]:
            break
    return given


def continue_with(env, actions):
    """All the steps of a single environment, and the resets after those that end an episode."""
    given = []
    for action in actions:
        given.append(env.step(action))
        if given[-1][2] or given[-1][3]:
            given.append(env.reset())
    return given


def continue_vector(envs, actions):
    """The same of a vector environment, whose finished rows are reset by hand where that is the mode."""
    given = []
    for action in actions:
        given.append(envs.step(action))
        finished = given[-1][2] | given[-1][3]
        if envs.metadata["autoreset_mode"] == BY_HAND and finished.any():
            given.append(envs.reset(options={"reset_mask": finished}))
    return given


def roll_out(envs, actions, seed=0):
    """All that `reset` and `step` of a vector environment gave."""
    return [envs.reset(seed=seed), *continue_vector(envs, actions)]


def same(first, second):
    """Whether two records of play have the same types and numbers, bit for bit."""
    if type(first) is not type(second):
        return False
    if isinstance(first, Belief):
        return np.array_equal(first.record, second.record)
    if isinstance(first, np.ndarray) and first.dtype != object:
        return first.dtype == second.dtype and np.array_equal(first, second)
    if isinstance(first, dict):
        return first.keys() == second.keys() and all(same(first[key], second[key]) for key in first)
    if isinstance(first, list | tuple | np.ndarray):
        return len(first) == len(second) and all(map(same, first, second))
    return first == second


def assert_same(first, second):
    """As `same`; says where two records of play of the same length begin to differ."""
    assert len(first) == len(second)
    for t, (one, other) in enumerate(zip(first, second, strict=True)):
        assert same(one, other), f"from entry {t}: {one} and {other}"


def overwrite(env, name, value, row=0):
    """Put a value into a row of the plant's or the belief's state."""
    batch = env.unwrapped._batch
    block, lane = divmod(row, batch._blocks.shape[2])
    batch._blocks[block, batch._row_of[name], lane] = value


def assert_refused(cases):
    """Each of (call, fragment) raises a ValueError that says the fragment; all that do not are reported."""
    wrong = []
    for call, fragment in cases:
        try:
            call()
        except ValueError as error:
            if fragment not in str(error):
                wrong.append(f"{fragment!r} is not in {str(error)!r}")
        else:
            wrong.append(f"nothing was refused where {fragment!r} was expected")
    if wrong:
        pytest.fail("\n".join(wrong))
