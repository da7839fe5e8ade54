"""The single environment: Gymnasium's contract, and the statements of the class docstring."""

import copy
import dataclasses
import json
import re
import threading

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.error import ResetNeeded
from playing import assert_refused, assert_same, continue_with, play, same
from rounding import U32
from twin import to_coefficients

from duffing_env.env import DuffingEnv
from duffing_env.experiment_config import SimulatedExperiment
from duffing_env.vector_env import DuffingVectorEnv

TRACK = "duffing_env/Amplitude-v0"
SHORT = {"horizon": 20}


def random_actions(seed, steps=10_000):
    return np.random.default_rng(seed).uniform(-1, 1, (steps, 1)).astype(np.float32)


def test_the_observation_is_bounded():
    env = DuffingEnv()
    assert env.observation_space == gym.spaces.Box(
        np.float32([-10] * 4 + [-20] * 4 + [-1] * 6 + [-20] * 2 + [-2] * 2 + [-1, -2, 0, 0]),
        np.float32([10] * 4 + [5] * 4 + [1] * 6 + [20] * 2 + [2] * 2 + [1, 2, 1, 1]),
        dtype=np.float32,
    )


def test_observations_are_given_away():
    env = DuffingEnv()
    first, _ = env.reset(seed=0)
    kept = first.copy()
    second = env.step([1.0])[0]
    np.testing.assert_array_equal(first, kept)
    second[:] = 9.0
    assert not (env.step([1.0])[0] == 9.0).any()


def test_the_first_observation_shows_the_prior():
    env = DuffingEnv()
    for seed in range(3):
        observation, _ = env.reset(seed=seed)
        np.testing.assert_allclose(observation[[*range(8), *range(14, 20)]], 0.0, rtol=0, atol=1e-6)
        np.testing.assert_array_equal(observation[20:], 1.0)
        np.testing.assert_array_equal(observation, DuffingEnv().reset(seed=99)[0])


def test_a_generator_that_is_put_in_is_used_at_the_next_reset():
    env = DuffingEnv(**SHORT)
    expected = play(env, random_actions(0), seed=4)
    env.reset(seed=5)
    env.np_random = np.random.default_rng(4)
    assert same(play(env, random_actions(0)), expected)


def test_steps_outside_an_episode_are_refused():
    env = DuffingEnv(**SHORT)
    with pytest.raises(ResetNeeded, match=r"no system is drawn yet: call reset\(\)"):
        _ = env.truth
    with pytest.raises(ResetNeeded, match=r"call reset\(\)"):
        env.step([0.0])
    play(env, random_actions(0), seed=0)
    belief = env.belief
    with pytest.raises(ResetNeeded, match=r"call reset\(\)"):
        env.step([0.0])
    assert same(env.belief, belief)
    env.reset()
    env.step([0.0])


NO_NUMBERS = [
    "a", "0.5", ["0.5"], b"0.5", np.array(["0.5"]), np.array("0.5", object), [None], {}, 1j, [10**400],
    np.array([None]), np.array(["x"]), np.array([1j]), np.array([{}]), np.ma.masked,
    np.ma.masked_array([0.5], [True]), lambda: 0.5,
]  # fmt: skip


def test_actions_that_are_not_one_number_are_refused_and_change_nothing():
    env, untouched = DuffingEnv(**SHORT), DuffingEnv(**SHORT)
    for each in (env, untouched):
        each.reset(seed=0)
        each.step([0.5])
    given = [[np.nan], [np.inf], -np.inf, [], [0.1, 0.2], np.zeros((2, 1)), None, *NO_NUMBERS]
    message = "action must be one finite number in [-1, 1], but is"
    assert_refused((lambda action=action: env.step(action), message) for action in given)
    assert_same(continue_with(env, random_actions(0, 40)), continue_with(untouched, random_actions(0, 40)))


def test_actions_are_clipped():
    env, given = DuffingEnv(**SHORT), []
    for action in (1.0, 1.5, 1e30, 1e300, np.float32(3), [[7.0]], 2):
        env.reset(seed=0)
        given.append([env.step(action), env.step(-np.asarray(action))])
        assert same(given[-1], given[0]), action
    assert given[0][0][0][18] == 1.0
    assert given[0][1][0][18] == -1.0


def test_feedback_at_resonance_reaches_the_limit_and_terminates():
    env = DuffingEnv()
    for seed in range(5):
        env.reset(seed=seed)
        action, last_y = 1.0, 0.0
        for _ in range(256):
            observation, _, terminated, truncated, info = env.step([action])
            y = 0.6 * observation[19]
            action, last_y = np.sign(y - last_y) or 1.0, y  # push along the velocity
            if terminated:
                break
        assert terminated
        assert not truncated
        assert not info["diverged"]
        assert abs(y) > 0.6
        np.testing.assert_allclose(env.unwrapped._batch.row_values("Y_y"), y, rtol=1e-6)


def test_episodes_end_at_the_limit_or_at_the_horizon_but_never_at_both():
    env = gym.make(TRACK, max_output=0.1, horizon=12)
    endings = {(True, False): 0, (False, True): 0}
    limit_at_horizon = 0
    for seed in range(300):
        episode = play(env, random_actions(seed), seed=seed)
        *_, terminated, truncated, info = episode[-1]
        endings[terminated, truncated] += 1
        assert [step[2] or step[3] for step in episode[1:-1]] == [False] * (len(episode) - 2)
        assert not info["diverged"]
        output = abs(env.unwrapped._batch.row_values("Y_y")[0])
        assert (output > 0.1) == terminated
        assert truncated == (len(episode) - 1 == 12 and not terminated)
        limit_at_horizon += terminated and len(episode) - 1 == 12
    assert min(endings.values()) > 20
    assert limit_at_horizon > 0


def test_no_time_limit_but_the_horizon():
    env = gym.make(TRACK, horizon=300, max_input=1e-3)
    episode = play(env, random_actions(0), seed=0)
    assert len(episode) - 1 == 300
    np.testing.assert_allclose([step[0][20] for step in episode], 1 - np.arange(301) / 300, rtol=2 * U32)


def test_the_truth_of_an_episode_stays_as_it_was():
    env = DuffingEnv(**SHORT)
    play(env, random_actions(0), seed=0)
    truth, kept = env.truth, dict(env.truth)
    assert env.truth == truth  # until the next reset
    play(env, random_actions(1))
    assert dict(truth) == kept
    assert truth != env.truth


def test_structured_beliefs_are_calibrated_and_precise():
    # 200 episodes: the squared distance of the truth from the mean, in standard deviations, is 4 on average.
    envs = DuffingVectorEnv(200)
    envs.reset(seed=0)
    endings = [None] * 200
    for action in np.random.default_rng(0).uniform(-1, 1, (256, 200, 1)).astype(np.float32):
        _, _, terminated, truncated, infos = envs.step(action)
        for row in np.flatnonzero(terminated | truncated):
            endings[row] = endings[row] or (infos["belief"][row], infos["truth"][row])
    distances, errors = [], []
    for belief, truth in endings:
        deviation = to_coefficients(truth) - belief.coefficients_mean
        distances.append(deviation @ np.linalg.solve(belief.coefficients_cov, deviation))
        errors.append(abs(belief.physical()[0][0] / truth.m - 1))
    assert 3.2 < np.mean(distances) < 4.8
    assert np.median(errors) < 0.003


def test_specifications_travel_as_json():
    options = {"reward": "log_posterior", "horizon": 30, "spread": 0.2, "max_slew": 0.1, "branch": "test"}
    env = gym.make(TRACK, **options)
    text = env.spec.to_json()
    assert json.loads(text)["kwargs"].items() >= options.items()
    again = gym.make(EnvSpec.from_json(text))
    assert again.unwrapped.experiment == env.unwrapped.experiment
    assert same(play(env, random_actions(0), seed=0), play(again, random_actions(0), seed=0))
    assert gym.make(env.spec).unwrapped.experiment == env.unwrapped.experiment


@pytest.mark.parametrize("travels", [False, True])
def test_a_specification_takes_other_options(travels):
    """Values derived from the old options do not limit an environment with new ones."""
    spec = gym.make("duffing_env/Short-v0", max_input=1e-3, max_output=0.5).spec
    assert spec.max_episode_steps == copy.deepcopy(spec).max_episode_steps == 48
    spec = EnvSpec.from_json(spec.to_json()) if travels else dataclasses.replace(spec)
    env = gym.make(spec, horizon=60, max_output=0.4)
    assert (env.spec.max_episode_steps, env.spec.kwargs["max_output"]) == (60, 0.4)
    assert gym.wrappers.TimeAwareObservation(env).max_timesteps == 60
    assert len(play(env, np.zeros((80, 1)), seed=0)) == 61
    for mode in ("vector_entry_point", "sync"):
        envs = gym.make_vec(spec, num_envs=2, vectorization_mode=mode, horizon=60)
        envs.reset(seed=0)
        assert mode == "sync" or envs.spec.max_episode_steps == 60
        ends = [envs.step(np.zeros((2, 1), np.float32))[3].all() for _ in range(60)]
        assert ends == [False] * 59 + [True]
    limited = gym.make(spec, max_episode_steps=9).spec
    assert limited.max_episode_steps == gym.make(limited, horizon=60).spec.max_episode_steps == 9
    assert gym.make_vec(spec, num_envs=2, max_episode_steps=9).spec.max_episode_steps == 9


def test_options_are_read_and_not_set():
    env = gym.make("duffing_env/Short-v0")
    envs = gym.vector.SyncVectorEnv([lambda: env])
    for name in (field.name for field in dataclasses.fields(SimulatedExperiment)):
        before = env.get_wrapper_attr(name)
        assert before == getattr(env.unwrapped.experiment, name)
        sets = (
            lambda name=name: setattr(env.unwrapped, name, 0.3),
            lambda name=name: env.set_wrapper_attr(name, 0.3),
            lambda name=name: env.set_wrapper_attr(name, 0.3, force=False),
            lambda name=name: envs.set_attr(name, 0.3),
        )
        for call in sets:
            with pytest.raises(AttributeError, match=f"^{name} cannot be set to 0.3 in .* make a new one with {name}="):
                call()
        assert env.get_wrapper_attr(name) is before
    assert not env.set_wrapper_attr("stage", 2, force=False)
    env.set_wrapper_attr("stage", 2)
    assert env.get_wrapper_attr("stage") == 2


def test_a_tensor_that_requires_a_gradient_is_refused_with_what_to_do():
    torch = pytest.importorskip("torch")
    env = DuffingEnv(**SHORT)
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"^action must be .*; pass action.detach\(\)"):
        env.step(torch.zeros(1, requires_grad=True))


def test_closing_twice_is_fine():
    env = gym.make(TRACK)
    env.close()
    env.close()


def test_a_second_thread_is_refused_and_changes_nothing():
    """The second call comes while the first is on its way: from within its drawing."""
    env, untouched = DuffingEnv(**SHORT, render_mode="rgb_array"), DuffingEnv(**SHORT, render_mode="rgb_array")
    refused = []

    def call_from_another_thread():
        for call in (lambda: env.step([1.0]), env.reset, lambda: env.reset(seed=3)):
            with pytest.raises(RuntimeError, match=r"must wait until the last call .* an environment of its own"):
                call()
            refused.append(call)

    draw = env._draw_sample

    def slow():
        thread = threading.Thread(target=call_from_another_thread)
        thread.start()
        thread.join()
        draw()

    for each in (env, untouched):
        each.reset(seed=0)
    env._draw_sample = slow
    assert same(env.step([0.5]), untouched.step([0.5]))
    assert len(refused) == 3
    env._draw_sample = draw
    assert same(continue_with(env, random_actions(0, 40)), continue_with(untouched, random_actions(0, 40)))


def test_the_observation_has_the_bounds_of_the_documentation():
    """The table of the class's docstring, row by row."""
    space = DuffingEnv().observation_space
    table = DuffingEnv.__doc__.split("## Observation space")[1].split("## Reward")[0]
    rows = re.findall(r"^ *\| ([\d, -]+?) \|.*\| (\S+) \| (\S+) \|$", table, flags=re.MULTILINE)
    found = {}
    for places, low, high in rows:
        first, last = (re.findall(r"\d+", places) * 2)[:2] if "," not in places else re.findall(r"\d+", places)
        found |= dict.fromkeys(range(int(first), int(last) + 1), (float(low), float(high)))
    assert found == dict(enumerate(zip(space.low.tolist(), space.high.tolist(), strict=True)))
