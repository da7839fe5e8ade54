"""Actions that are held for several samples: the same as applying them sample by sample, to the bit."""

from itertools import pairwise

import gymnasium as gym
import numba
import numpy as np
import pytest
from checkers import assert_checkers_are_content
from gymnasium.vector import AutoresetMode
from rounding import U32
from test_rig_plant import Difference, around
from test_vector_env import assert_same, play_beside_singles, random_actions, roll_out

from duffing_env.continuous import ContinuousEnv
from duffing_env.env import DuffingEnv
from duffing_env.replay import ReplayExperiment
from duffing_env.vector_env import ContinuousVectorEnv, DuffingVectorEnv

TRACK = "duffing_env/Amplitude-v0"
# Held random inputs end many such episodes at the limit, most of them within an action; 22 is no multiple of 4.
BOTH_ENDS = {"hold": 4, "horizon": 22, "max_output": 0.25}
GAINS = ("information_gain", "log_posterior_gain")

KINDS = [
    (DuffingEnv, {}),
    (DuffingEnv, {"factorisation": "mean_field", "reward": "log_posterior"}),
    (DuffingEnv, {"max_rms": 0.06, "max_slew": 0.04, "input_cost": 0.3, "reward": "free_energy", "max_output": 0.1}),
    (DuffingEnv, {"jump": 0.3, "drift": 0.01, "reward": "simulation_error"}),
    (DuffingEnv, {"terminal": True, "terminated_return": -5.0, "reward": "expected_free_energy"}),
    (DuffingEnv, {"max_output": 1e300, "spread": 0.9, "horizon": 60, "terminated_return": -5.0, "reward": "fisher"}),
    (ContinuousEnv, {"reward": "parameter_error"}),
]
PLANT = pytest.param(around, {"horizon": 22, "max_output": 0.25}, id="own plant")


def make(kind, **options):
    return kind(Difference(), **options) if kind is around else kind(**options)


@pytest.mark.parametrize(("kind", "options"), [*KINDS, PLANT])
def test_a_held_action_is_the_same_action_at_every_sample(kind, options):
    options = {**BOTH_ENDS, **options}
    held, sampled = make(kind, **options), make(kind, **{**options, "hold": 1})
    endings, within = set(), 0
    for seed, actions in enumerate(np.random.default_rng(0).uniform(-1.2, 1.2, (30, 15, 1))):
        np.testing.assert_array_equal(held.reset(seed=seed)[0], sampled.reset(seed=seed)[0])
        terminated = truncated = False
        for action in actions:
            observation, reward, terminated, truncated, info = held.step(action)
            steps = []
            for _ in range(options["hold"]):
                steps.append(sampled.step(action))
                if steps[-1][2] or steps[-1][3]:
                    break
            np.testing.assert_array_equal(observation, steps[-1][0])
            assert (terminated, truncated) == steps[-1][2:4]
            total, gains = steps[0][1], {name: steps[0][4][name] for name in GAINS if name in info}
            for step in steps[1:]:
                total += step[1]
                gains = {name: gain + step[4][name] for name, gain in gains.items()}
            assert reward == total
            assert {name: info[name] for name in gains} == gains
            assert info["diverged"] == steps[-1][4]["diverged"]
            np.testing.assert_array_equal(held.records, sampled.records)
            if terminated or truncated:
                assert info.keys() == steps[-1][4].keys()
                endings.add((terminated, truncated))
                within += len(steps) < options["hold"]
                break
        assert terminated or truncated
    assert within > 3
    assert (True, False) in endings


@pytest.mark.parametrize(("kind", "options"), KINDS)
@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_rows_are_single_environments(mode, kind, options):
    vector = ContinuousVectorEnv if kind is ContinuousEnv else DuffingVectorEnv
    steps = play_beside_singles(5, 60, vector=vector, mode=mode, **{**BOTH_ENDS, **options})
    assert np.sum([step[2] for step in steps]) > 3


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="Numba has one thread only")
@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_neither_the_number_of_rows_nor_threads_change_anything(mode):
    actions = random_actions(30, 70)
    one, two = (DuffingVectorEnv(70, autoreset_mode=mode, threads=n, **BOTH_ENDS) for n in (1, 2))
    told = roll_out(one, actions, seed=5)
    assert_same(told, roll_out(two, actions, seed=5))
    few = roll_out(DuffingVectorEnv(7, autoreset_mode=mode, **BOTH_ENDS), actions[:, :7], seed=5)
    assert_same([[part[:7] for part in step[:-1]] for step in told], [list(step[:-1]) for step in few])


def test_the_horizon_counts_samples():
    env = gym.make(TRACK, hold=5, horizon=22, max_input=1e-3)
    observation, _ = env.reset(seed=0)
    left = [observation[20]]
    truncated = False
    while not truncated:
        observation, _, _, truncated, _ = env.step([0.5])
        left.append(observation[20])
    np.testing.assert_allclose(left, 1 - np.array([0, 5, 10, 15, 20, 22]) / 22, rtol=2 * U32)
    assert env.spec.max_episode_steps == 5
    # A limit of steps is one of actions.
    envs = gym.make_vec(TRACK, num_envs=2, max_episode_steps=3, hold=5, max_input=1e-3)
    envs.reset(seed=0)
    assert [envs.step(np.zeros((2, 1)))[3].tolist() for _ in range(3)] == [[False] * 2, [False] * 2, [True] * 2]


def test_limits_hold_for_every_sample():
    envs = DuffingVectorEnv(3, hold=8, max_slew=0.02, max_rms=0.05, horizon=64)
    single = DuffingEnv(hold=8, max_slew=0.02, max_rms=0.05, horizon=64)
    envs.reset(seed=0)
    single.reset(seed=0)
    inputs, apply = [], single._apply
    single._apply = lambda action: (apply(action), inputs.append(single._batch.quantity("INPUT")[0]))
    for _ in range(8):
        envs.step(np.ones((3, 1), dtype=np.float32))
        single.step([1.0])
    np.testing.assert_allclose(np.diff([0.0, *inputs[:5]]), 0.02, rtol=1e-12)
    assert np.abs(np.diff(inputs)).max() <= 0.15
    assert np.sum(np.square(inputs)) <= 64 * 0.05**2 * (1 + 1e-12)
    np.testing.assert_array_equal(envs._batch.quantity("SPENT"), single._batch.quantity("SPENT")[0])


def test_every_sample_is_drawn():
    env = DuffingEnv(hold=3, horizon=8, render_mode="rgb_array")
    env.reset(seed=0)
    frames = [env.render()]
    for count in (3, 6, 8):
        env.step([0.5])
        assert env._screen._samples == count
        frames.append(env.render())
    assert not any(np.array_equal(a, b) for a, b in pairwise(frames))


@pytest.mark.parametrize(
    "options",
    [{"hold": 4}, {"terminal": True}, {"terminated_return": -10.0}, {"hold": 3, "terminal": True, "horizon": 16}],
    ids=str,
)
def test_checkers_of_gymnasium_and_stable_baselines3_do_not_even_warn(options):
    assert_checkers_are_content(lambda: gym.make(TRACK, **options))


@pytest.mark.usefixtures("record")
def test_a_record_is_not_held():
    with pytest.raises(ValueError, match=r"hold must be 1 for a record, .* but is 2"):
        ReplayExperiment(hold=2)
