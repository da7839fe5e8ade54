"""The single environment: Gymnasium's contract, and what the class docstring promises."""

import copy
import dataclasses
import json
import pickle
import re
import threading

import gymnasium as gym
import numpy as np
import pytest
from checkers import assert_checkers_are_content
from gymnasium.envs.registration import EnvSpec
from gymnasium.error import ResetNeeded
from rounding import U32
from twin import PAIRS, to_coefficients

from duffing_env.env import DuffingEnv
from duffing_env.experiment import SimulatedExperiment
from estimator import Parameters
from estimator.belief import Belief

TRACK = "duffing_env/Amplitude-v0"
FACTORISATIONS = ("structured", "mean_field")
SHORT = {"horizon": 20}
TIGHT = {"max_output": 0.2, "horizon": 64}  # random inputs end most episodes early


def random_actions(seed, steps=10_000):
    return np.random.default_rng(seed).uniform(-1, 1, (steps, 1)).astype(np.float32)


def play(env, actions, seed=None):
    """One episode: all that `reset` and `step` gave."""
    told = [env.reset(seed=seed)]
    for action in actions:
        told.append(env.step(action))
        if told[-1][2] or told[-1][3]:
            break
    return told


def continue_with(env, actions):
    """All the steps, and the resets after those that end an episode."""
    told = []
    for action in actions:
        told.append(env.step(action))
        if told[-1][2] or told[-1][3]:
            told.append(env.reset())
    return told


def same(first, second):
    """Whether two records of play are the same, bit for bit."""
    if isinstance(first, Belief):
        return np.array_equal(first.record, second.record)
    if isinstance(first, np.ndarray):
        return first.dtype == second.dtype and np.array_equal(first, second)
    if isinstance(first, dict):
        return first.keys() == second.keys() and all(same(first[key], second[key]) for key in first)
    if isinstance(first, list | tuple):
        return len(first) == len(second) and all(same(a, b) for a, b in zip(first, second, strict=True))
    return type(first) is type(second) and first == second


def overwrite(env, name, value):
    """Put a value into the plant's or the belief's state."""
    batch = env.unwrapped._batch
    batch._blocks[0, batch._place[name], 0] = value


@pytest.mark.parametrize(("factorisation", "reward"), PAIRS)
def test_checkers_of_gymnasium_and_stable_baselines3_do_not_even_warn(factorisation, reward):
    assert_checkers_are_content(lambda: gym.make(TRACK, factorisation=factorisation, reward=reward))


def test_spaces_are_bounded_float32_and_each_environment_has_its_own():
    env = DuffingEnv()
    assert env.observation_space == gym.spaces.Box(
        np.float32([-10] * 4 + [-20] * 4 + [-1] * 6 + [-20] * 2 + [-2] * 2 + [-1, -2, 0, 0]),
        np.float32([10] * 4 + [5] * 4 + [1] * 6 + [20] * 2 + [2] * 2 + [1, 2, 1, 1]),
        dtype=np.float32,
    )
    assert env.action_space == gym.spaces.Box(-1, 1, (1,), np.float32)
    assert DuffingEnv().observation_space is not env.observation_space
    assert DuffingEnv().action_space is not env.action_space


@pytest.mark.parametrize("factorisation", FACTORISATIONS)
def test_what_a_step_gives_has_the_types_that_trainers_check(factorisation):
    env = DuffingEnv(factorisation=factorisation, **SHORT)
    (first, nothing), *steps = play(env, random_actions(0), seed=0)
    assert nothing == {"information_gain": 0.0, "log_posterior_gain": 0.0, "diverged": False}
    for observation, reward, terminated, truncated, info in [(first, 0.0, False, False, nothing), *steps]:
        assert type(observation) is np.ndarray
        assert observation.dtype == np.float32
        assert observation.shape == (22,)
        assert observation.flags.c_contiguous
        assert type(reward) is float
        assert type(terminated) is bool
        assert type(truncated) is bool
        assert info.keys() == nothing.keys()
        assert [type(value) for value in info.values()] == [float, float, bool]


def test_observations_are_given_away():
    env = DuffingEnv()
    first, _ = env.reset(seed=0)
    kept = first.copy()
    second = env.step([1.0])[0]
    np.testing.assert_array_equal(first, kept)
    second[:] = 9.0
    assert not (env.step([1.0])[0] == 9.0).any()


def test_the_first_observation_says_that_nothing_is_known_yet():
    env = DuffingEnv()
    for seed in range(3):
        observation, _ = env.reset(seed=seed)
        np.testing.assert_allclose(observation[[*range(8), *range(14, 20)]], 0.0, rtol=0, atol=1e-6)
        np.testing.assert_array_equal(observation[20:], 1.0)
        np.testing.assert_array_equal(observation, DuffingEnv().reset(seed=99)[0])


@pytest.mark.parametrize("factorisation", FACTORISATIONS)
def test_a_seed_repeats_a_whole_episode(factorisation):
    env = DuffingEnv(factorisation=factorisation, **TIGHT)
    first = play(env, random_actions(0), seed=7)
    assert same(first, play(env, random_actions(0), seed=7))
    assert same(first, play(DuffingEnv(factorisation=factorisation, **TIGHT), random_actions(0), seed=7))
    assert not same(first, play(env, random_actions(0), seed=8))


def test_reset_without_a_seed_goes_on_and_differs():
    def three_episodes():
        env = DuffingEnv(**TIGHT)
        return [play(env, random_actions(0), seed=seed) for seed in (3, None, None)]

    episodes = three_episodes()
    assert not same(episodes[0], episodes[1])
    assert not same(episodes[1], episodes[2])
    assert same(episodes, three_episodes())
    unseeded = [play(DuffingEnv(**TIGHT), random_actions(0)) for _ in range(2)]
    assert not same(*unseeded)


def test_a_generator_that_is_put_in_is_used_at_the_next_reset():
    env = DuffingEnv(**SHORT)
    expected = play(env, random_actions(0), seed=4)
    env.reset(seed=5)
    env.np_random = np.random.default_rng(4)
    assert same(play(env, random_actions(0)), expected)


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))], ids=["copy", "pickle"])
def test_copies_made_within_an_episode_continue_alike_and_apart(copied):
    env = gym.make(TRACK, **TIGHT)
    env.reset(seed=0)
    for action in random_actions(0, 5):
        env.step(action)
    twin, witness = copied(env), copied(env)
    expected = continue_with(env, random_actions(1, 200))
    assert sum(len(step) == 2 for step in expected) > 1  # it went on into further episodes
    assert same(continue_with(twin, random_actions(1, 200)), expected)
    assert not same(continue_with(env, random_actions(1, 200)), expected)
    assert same(continue_with(witness, random_actions(1, 200)), expected)


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


@pytest.mark.parametrize("action", [[np.nan], [np.inf], -np.inf, [], [0.1, 0.2], np.zeros((2, 1)), None, *NO_NUMBERS])
def test_actions_that_are_no_number_are_refused_and_change_nothing(action):
    env, untouched = DuffingEnv(**SHORT), DuffingEnv(**SHORT)
    for each in (env, untouched):
        each.reset(seed=0)
        each.step([0.5])
    with pytest.raises(ValueError, match=r"action must be one finite number in \[-1, 1\], but is"):
        env.step(action)
    assert same(continue_with(env, random_actions(0, 40)), continue_with(untouched, random_actions(0, 40)))


@pytest.mark.parametrize("beyond", [1.5, 1e30, 1e300, np.float32(3), [[7.0]], 2])
def test_actions_are_clipped(beyond):
    steps = []
    for action in (1.0, beyond):
        env = DuffingEnv(**SHORT)
        env.reset(seed=0)
        steps.append([env.step(action), env.step(-np.asarray(action))])
    assert same(*steps)
    assert steps[0][0][0][18] == 1.0
    assert steps[0][1][0][18] == -1.0


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
        np.testing.assert_allclose(env.unwrapped._batch.quantity("Y_y"), y, rtol=1e-6)


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
        output = abs(env.unwrapped._batch.quantity("Y_y")[0])
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


@pytest.mark.parametrize(("factorisation", "reward"), PAIRS)
@pytest.mark.parametrize(
    ("name", "value"),
    [*(("X_x1", value) for value in (np.nan, np.inf, -np.inf, 1e200, 1e70)), ("X_x2", np.inf), ("theta1", 1e300)],
)
def test_numbers_that_are_not_finite_end_the_episode_flagged(factorisation, reward, name, value):
    env = DuffingEnv(factorisation=factorisation, reward=reward)
    env.reset(seed=0)
    for action in random_actions(0, 10):
        env.step(action)
    overwrite(env, name, value)
    before = env.belief
    observation, received, terminated, truncated, info = env.step([0.5])
    assert (received, terminated, truncated, info["diverged"]) == (0.0, True, False, True)
    assert info["information_gain"] == info["log_posterior_gain"] == 0.0
    assert observation in env.observation_space
    assert same(env.belief, before)
    assert isinstance(env.truth, Parameters)
    observation, _ = env.reset()
    assert observation in env.observation_space
    assert np.isfinite(env.step([0.5])[1])


EXTREMES = [
    {"max_output": 1e-4},
    {"max_output": 1e300},
    {"max_output": 1e6, "max_input": 1e3},
    {"max_output": 1e250, "max_input": 1e200},
    {"max_input": 1e-12},
    {"spread": 0.999},
    {"spread": 1e-6},
    {"process_noise": 1e-9},
    {"process_noise": 1.0},
    {"measurement_noise": 1e-9},
    {"measurement_noise": 10.0},
    {"noise_shape": 1e-3},
    {"noise_shape": 1e9},
    {"horizon": 1},
    # A mean-field covariance of the state loses its determinant to rounding, and the free energy becomes NaN.
    {"max_output": 4000.0, "max_input": 300.0, "process_noise": 3e-9, "measurement_noise": 3e-9, "spread": 0.999},
]


#: The iterations of a structured update are generated: another kernel for another number.
MANY = [pytest.param("structured", "information_gain", {"iterations": n}, marks=pytest.mark.slow) for n in (1, 50)]


@pytest.mark.parametrize(
    ("factorisation", "reward", "options"),
    [pytest.param(*pair.values, options, marks=pair.marks) for pair in PAIRS for options in [{}, *EXTREMES]] + MANY,
    ids=str,
)
def test_observations_stay_in_their_space_and_rewards_finite(factorisation, reward, options):
    env = DuffingEnv(factorisation=factorisation, reward=reward, **options)
    for seed in range(4):
        rng = np.random.default_rng(seed)
        actions = rng.uniform(-1, 1, (256, 1)) if seed % 2 else rng.choice([-1.0, 1.0], (256, 1))
        for step in play(env, actions, seed=seed):
            assert step[0] in env.observation_space
            if len(step) == 5:
                numbers = step[1], step[4]["information_gain"], step[4]["log_posterior_gain"]
                assert np.isfinite(numbers).all(), numbers


@pytest.mark.parametrize("factorisation", FACTORISATIONS)
def test_gains_sum_to_the_change_of_the_belief(factorisation):
    env = DuffingEnv(factorisation=factorisation, reward="parameter_error")
    prior = env.belief
    for seed in range(10):
        steps = play(env, random_actions(seed), seed=seed)[1:]
        final, truth = env.belief, env.truth
        gain = sum(step[4]["information_gain"] for step in steps)
        np.testing.assert_allclose(gain, prior.entropy() - final.entropy(), rtol=1e-9)
        density = sum(step[4]["log_posterior_gain"] for step in steps)
        coefficients = to_coefficients(truth)
        np.testing.assert_allclose(density, final.log_prob(coefficients) - prior.log_prob(coefficients), rtol=1e-7)
        assert -1 <= sum(step[1] for step in steps) <= 1


def test_the_belief_and_truth_of_an_episode_stay_as_they_were():
    env = DuffingEnv(**SHORT)
    play(env, random_actions(0), seed=0)
    belief, truth = env.belief, env.truth
    kept = copy.deepcopy((belief, truth))
    assert same((env.belief, env.truth), kept)  # until the next reset
    play(env, random_actions(1))
    assert same((belief, truth), kept)
    assert truth != env.truth
    assert not same(belief, env.belief)


def test_structured_beliefs_are_calibrated_and_precise():
    # 200 episodes: the squared distance of the truth from the mean, in standard deviations, is 4 on average.
    env = DuffingEnv()
    distances, errors = [], []
    for seed in range(200):
        play(env, random_actions(seed), seed=seed)
        belief, truth = env.belief, env.truth
        deviation = to_coefficients(truth) - belief.coefficients_mean
        distances.append(deviation @ np.linalg.solve(belief.coefficients_cov, deviation))
        errors.append(abs(belief.physical()[0][0] / truth.m - 1))
    assert 3.2 < np.mean(distances) < 4.8
    assert np.median(errors) < 0.003


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"horizn": 3}, "unexpected keyword argument 'horizn': .* did you mean 'horizon'"),
        ({"reward": "informationgain"}, "did you mean 'information_gain'"),
        ({"factorisation": "meanfield"}, "factorisation must be one of"),
        ({"max_input": -1}, "max_input must be a number from 1e-12 to 1e\\+300, but is -1"),
        ({"render_mode": "ansi"}, "render_mode must be one of"),
    ],
)
def test_bad_options_are_refused_with_a_remedy(options, message):
    with pytest.raises(ValueError, match=message):
        DuffingEnv(**options)


def test_specifications_travel_as_json():
    options = {"reward": "log_posterior", "factorisation": "mean_field", "iterations": 4, "horizon": 30, "spread": 0.2}
    env = gym.make(TRACK, **options)
    text = env.spec.to_json()
    assert json.loads(text)["kwargs"].items() >= options.items()
    again = gym.make(EnvSpec.from_json(text))
    assert again.unwrapped.experiment == env.unwrapped.experiment
    assert same(play(env, random_actions(0), seed=0), play(again, random_actions(0), seed=0))
    assert gym.make(env.spec).unwrapped.experiment == env.unwrapped.experiment


@pytest.mark.parametrize("travels", [False, True])
def test_a_specification_takes_other_options(travels):
    """What follows from the old ones is no limit of what is made with new ones."""
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


OPTIONS = [field.name for field in dataclasses.fields(SimulatedExperiment)]


@pytest.mark.parametrize("name", OPTIONS)
def test_an_option_is_read_and_not_set(name):
    env = gym.make("duffing_env/Short-v0")
    before = env.get_wrapper_attr(name)
    assert before == getattr(env.unwrapped.experiment, name)
    envs = gym.vector.SyncVectorEnv([lambda: env])
    sets = (
        lambda: setattr(env.unwrapped, name, 0.3),
        lambda: env.set_wrapper_attr(name, 0.3),
        lambda: env.set_wrapper_attr(name, 0.3, force=False),
        lambda: envs.set_attr(name, 0.3),
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

    draw = env._draw

    def slow():
        thread = threading.Thread(target=call_from_another_thread)
        thread.start()
        thread.join()
        draw()

    for each in (env, untouched):
        each.reset(seed=0)
    env._draw = slow
    assert same(env.step([0.5]), untouched.step([0.5]))
    assert len(refused) == 3
    env._draw = draw
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
