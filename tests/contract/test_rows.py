"""Rows of a vector environment equal single environments, to the bit, for any number of rows and threads."""

import gymnasium as gym
import numba
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from playing import BY_HAND, MODES, assert_same, continue_vector, roll_out, same
from specimens import ENVIRONMENTS, VECTORS

from duffing_env.batch import spawn_seeds


class Remembered(gym.Wrapper):
    """A single environment that keeps the final infos of its episodes."""

    def __init__(self, env):
        super().__init__(env)
        self.endings = []

    def step(self, action):
        given = self.env.step(action)
        if given[2] or given[3]:
            self.endings.append((self.env.belief, self.env.truth))
        return given


def without_endings(infos):
    """Infos less the beliefs and truths of finished rows, and less the keys that no row has, as Gymnasium's."""
    kept = {}
    for key, value in infos.items():
        if not key.startswith("_") and key not in ("belief", "truth") and infos[f"_{key}"].any():
            kept[key] = without_endings(value) if isinstance(value, dict) else value
            kept[f"_{key}"] = infos[f"_{key}"]
    return kept


def assert_rows_are_singles(environment, mode, rows=5, steps=60, **options):
    """Compare all results with Gymnasium's own vector of single environments; return the steps."""
    envs = environment.make_vec(rows, autoreset_mode=mode, **options)
    makers = [lambda: Remembered(environment.make(**options))] * rows
    singles = SyncVectorEnv(makers, autoreset_mode=mode)
    for space in ("single_observation_space", "observation_space", "single_action_space", "action_space"):
        assert getattr(envs, space) == getattr(singles, space)
    actions = environment.random_actions(steps, rows)
    ours, theirs = roll_out(envs, actions, seed=7), roll_out(singles, actions, seed=spawn_seeds(7, rows))
    assert_same([given[:-1] for given in ours], [given[:-1] for given in theirs])
    assert_same([without_endings(given[-1]) for given in ours], [given[-1] for given in theirs])
    steps = [given for given in ours if len(given) == 5]
    endings = [[] for _ in range(rows)]
    for *_, terminated, truncated, infos in steps:
        finished = terminated | truncated
        assert ("belief" in infos.get("final_info", infos)) == finished.any()
        for row in np.flatnonzero(finished):
            ending = infos["final_info"] if mode == AutoresetMode.SAME_STEP else infos
            np.testing.assert_array_equal(ending["_belief"], finished)
            endings[row].append((ending["belief"][row], ending["truth"][row]))
    assert_same(endings, [single.endings for single in singles.envs])
    return steps


@pytest.mark.parametrize("environment", VECTORS)
def test_rows_are_single_environments_in_all_modes(environment):
    for mode in MODES:
        steps = assert_rows_are_singles(environment, mode)
        assert np.sum([step[2] for step in steps]) > 0
        assert np.sum([step[3] for step in steps]) > 0 or environment.on_record


def test_rows_that_diverge_are_single_environments():
    # The plant runs away, now and then beyond the range of numbers.
    (fisher,) = (environment for environment in ENVIRONMENTS if environment.name == "fisher")
    steps = assert_rows_are_singles(fisher, AutoresetMode.NEXT_STEP, rows=8, steps=200)
    assert np.sum([step[4]["diverged"] for step in steps]) > 3
    assert np.isfinite([step[0] for step in steps]).all()


HOLDING = [param for param in VECTORS if not param.values[0].on_record]


@pytest.mark.parametrize("environment", HOLDING)
def test_rows_that_hold_their_actions_are_single_environments(environment):
    steps = assert_rows_are_singles(environment, AutoresetMode.SAME_STEP, rows=3, steps=30, hold=4)
    assert np.sum([step[2] | step[3] for step in steps]) > 3


@pytest.mark.parametrize("environment", VECTORS)
def test_rows_do_not_depend_on_their_neighbours_in_a_block(environment):
    # A block has 32 lanes: the first row alone, rows across two blocks, and one of a third, which is not full.
    whole, actions, seeds = environment.make_vec(70), environment.random_actions(30, 70), spawn_seeds(3, 70)
    together = roll_out(whole, actions, 3)
    for rows in (range(1), range(29, 36), range(69, 70)):
        few = environment.make_vec(len(rows))
        apart = roll_out(few, actions[:, rows], [seeds[row] for row in rows])
        assert_same([given[:-1] for given in apart], [tuple(part[rows] for part in given[:-1]) for given in together])
        np.testing.assert_array_equal(few.records, whole.records[rows])


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="Numba has one thread only")
@pytest.mark.parametrize("options", [{}, {"hold": 4}, {"autoreset_mode": "SameStep"}], ids=str)
def test_threads_change_nothing(options):
    # Blocks are dealt to threads in one way for all kernels, of which each would be seconds of compilation.
    actions = ENVIRONMENTS[0].random_actions(40, 70)
    one, two = (ENVIRONMENTS[0].make_vec(70, threads=threads, **options) for threads in (1, 2))
    assert_same(roll_out(one, actions, seed=5), roll_out(two, actions, seed=5))


@pytest.mark.parametrize(
    "environment", [p for p in VECTORS if p.id in ("difference", "hypotheses", "continuous", "two inputs")]
)
def test_the_stored_arrays_determine_the_next_step(environment):
    envs, others = environment.make_vec(5), environment.make_vec(5)
    roll_out(envs, environment.random_actions(30, 5))
    others.reset(seed=99)
    for name, values in envs.memory.items():
        others.memory[name][...] = values
    actions = environment.random_actions(20, 5, seed=1)
    assert_same(
        [step[:4] for step in continue_vector(others, actions)], [s[:4] for s in continue_vector(envs, actions)]
    )


def test_rows_are_reset_by_hand_alone():
    envs = ENVIRONMENTS[0].make_vec(5, autoreset_mode=BY_HAND)
    before = roll_out(envs, ENVIRONMENTS[0].random_actions(7, 5))[-1][0]
    again, infos = envs.reset(seed=11, options={"reset_mask": np.arange(5) == 2})
    assert same(np.delete(again, 2, 0), np.delete(before, 2, 0))
    assert infos["_information_gain"].tolist() == [False, False, True, False, False]
