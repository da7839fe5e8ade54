"""The contract of every environment: Gymnasium's rules, seeds, copies, held actions, and finite numbers."""

import copy

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as gymnasium_check
from playing import (
    COPIES,
    assert_refused,
    assert_same,
    continue_vector,
    continue_with,
    overwrite,
    play,
    roll_out,
    same,
)
from specimens import COMPILED, ENVIRONMENTS, VECTORS, each

from estimator.rigs.physical_parameters import coefficients_of

FLAGS = {"diverged", "off_record"}


@pytest.mark.parametrize("environment", each())
def test_checkers_of_gymnasium_and_stable_baselines3_do_not_even_warn(environment):
    """A warning is an error in all tests."""
    from stable_baselines3.common.env_checker import check_env as sb3_check

    for check in (lambda env: gymnasium_check(env, skip_render_check=True), sb3_check):
        env = environment.make()
        env.spec = gym.spec("duffing_env/Amplitude-v0")  # what they miss in an environment that nobody registered
        check(env)


@pytest.mark.parametrize("environment", each())
def test_what_is_given_has_the_types_and_bounds_that_trainers_check(environment):
    env = environment.make()
    space, model = env.observation_space, env.experiment.model
    assert space.dtype == np.float32
    assert np.isfinite([space.low, space.high]).all()
    assert env.action_space == gym.spaces.Box(-1, 1, (environment.inputs,))
    assert environment.make().observation_space is not space
    assert environment.make().action_space is not env.action_space
    if env.experiment.observation == "posterior":
        k = model.n_coefficients
        assert space.shape == (
            2 * k + k * (k - 1) // 2 + model.n_states + 2 * model.n_outputs + 3 + environment.inputs,
        )
    keys = {"information_gain", "diverged"}
    keys |= {"off_record"} if environment.on_record else set()
    keys |= set() if environment.has_plant else {"log_posterior_gain"}
    for seed in range(3):
        (first, begun), *steps = play(env, environment.random_actions(30, seed=seed)[:, 0], seed=seed)
        assert begun == {key: key not in FLAGS and 0.0 for key in keys}
        for observation, reward, terminated, truncated, info in [(first, 0.0, False, False, begun), *steps]:
            assert type(observation) is np.ndarray
            assert observation.flags.c_contiguous
            assert observation in space
            assert [type(flag) for flag in (terminated, truncated)] == [bool, bool]
            assert not (terminated and truncated)
            assert type(reward) is float
            assert np.isfinite(reward)
            assert info.keys() == keys
            assert {key: type(value) for key, value in info.items()} == {k: bool if k in FLAGS else float for k in keys}
            assert np.isfinite(list(info.values())).all()
        kept = first.copy()
        assert not any(np.shares_memory(first, step[0]) for step in steps)
        np.testing.assert_array_equal(first, kept)


@pytest.mark.parametrize("environment", VECTORS)
def test_what_a_vector_gives_has_the_types_and_bounds_that_trainers_check(environment):
    envs = environment.make_vec(3)
    observations, infos = envs.reset(seed=0)
    keys = {name: bool if name in FLAGS else float for name in infos if name[0] != "_"}
    for action in environment.random_actions(30, 3):
        observations, rewards, *ends, infos = envs.step(action)
        assert observations in envs.observation_space
        assert (observations.dtype, rewards.dtype, *(end.dtype for end in ends)) == (np.float32, float, bool, bool)
        assert np.isfinite(rewards).all()
        for name, kind in keys.items():
            assert (infos[name].dtype, infos[f"_{name}"].dtype) == (kind, bool)
            assert infos[f"_{name}"].all()
        assert infos.keys() - keys.keys() <= {f"_{name}" for name in keys} | {"belief", "truth", "_belief", "_truth"}


def is_drawn(environment):
    """Whether its episodes differ by their seeds."""
    return not (environment.on_record or environment.has_plant)


@pytest.mark.parametrize("environment", each())
def test_a_seed_repeats_a_whole_episode(environment):
    env, actions = environment.make(), environment.random_actions(30)[:, 0]
    first = play(env, actions, seed=7)
    others = [play(env, actions, seed=seed) for seed in (8, None, None)]
    assert_same(play(env, actions, seed=7), first)
    assert_same(play(environment.make(), actions, seed=7), first)
    if is_drawn(environment):
        assert not any(same(first, other) for other in others)
        assert not same(others[1], others[2])  # random numbers go on


@pytest.mark.parametrize("environment", each())
def test_copies_made_within_an_episode_continue_alike_and_apart(environment):
    env, actions = environment.make(), environment.random_actions(70, seed=1)[:, 0]
    assert len(play(env, 0.3 * environment.random_actions(5)[:, 0], seed=0)) == 6
    twin, witness = (copied(env) for copied in COPIES)
    expected = continue_with(env, actions)
    assert any(len(given) == 2 for given in expected)  # it went on into further episodes
    assert_same(continue_with(twin, actions), expected)
    if is_drawn(environment):
        assert not same(continue_with(env, actions), expected)
    assert_same(continue_with(witness, actions), expected)


@pytest.mark.parametrize("environment", VECTORS)
def test_copies_of_a_vector_continue_alike_and_apart(environment):
    envs, actions = environment.make_vec(5), environment.random_actions(50, 5)
    roll_out(envs, actions[:20])
    twin, witness = (copied(envs) for copied in COPIES)
    expected = continue_vector(envs, actions[20:])
    assert_same(continue_vector(twin, actions[20:]), expected)
    assert_same(continue_vector(witness, actions[20:]), expected)


@pytest.mark.parametrize("environment", each(lambda environment: environment.sums))
def test_a_held_action_is_the_same_action_at_every_sample(environment):
    held, sampled = environment.make(hold=4), environment.make()
    names, ended, within = list(held._info_gains), 0, 0
    for seed in range(12):
        given, expected = held.reset(seed=seed), sampled.reset(seed=seed)
        assert same(given, expected)
        for action in environment.random_actions(16, seed=seed)[:, 0]:
            observation, reward, *flags, info = held.step(action)
            steps = []
            while len(steps) < 4 and not (steps and (steps[-1][2] or steps[-1][3])):
                steps.append(sampled.step(action))
            np.testing.assert_array_equal(observation, steps[-1][0])
            np.testing.assert_array_equal(held.records, sampled.records)
            assert flags == list(steps[-1][2:4])
            # From left to right, as a held action sums them: to the bit.
            total, gained = steps[0][1], {name: steps[0][4][name] for name in names}
            for step in steps[1:]:
                total += step[1]
                gained = {name: value + step[4][name] for name, value in gained.items()}
            assert reward == total
            assert info == gained | {"diverged": steps[-1][4]["diverged"]}
            if any(flags):
                ended, within = ended + 1, within + (len(steps) < 4)
                break
    assert ended == 12
    assert within >= 2


DRAWN = each(is_drawn)


def impossible(env):
    """Rows of the plant's states and of the belief, and values that they cannot have."""
    experiment = env.experiment
    for state in experiment.truth_model.states:
        yield from ((f"X_{state}", value) for value in (np.nan, np.inf, -np.inf, 1e200))
    # A mixture continues from its members; a user's observation is computed from the present belief.
    if experiment.noise_hypotheses == 1 and not callable(experiment.observation):
        yield from ((name, value) for name in experiment.model.coefficients for value in (np.nan, np.inf))


@pytest.mark.parametrize("environment", DRAWN)
def test_numbers_that_are_not_finite_end_the_episode_flagged_and_leave_the_belief(environment):
    env = environment.make(max_output=max(0.6, environment.options["max_output"]))
    for name, value in impossible(env):
        env.reset(seed=0)
        gained = sum(env.step([action] * environment.inputs)[1] for action in (0.3, -0.3))
        overwrite(env, name, value)
        before, truth = env.belief, env.truth
        observation, reward, terminated, truncated, info = env.step([0.0] * environment.inputs)
        assert (terminated, truncated, info.pop("diverged")) == (True, False, True), (name, value)
        assert set(info.values()) == {0.0}
        assert observation in env.observation_space
        np.testing.assert_array_equal(env.belief.record, before.record)
        assert env.truth == truth
        assert np.isfinite(reward)
        if not env.experiment.terminal:
            worth = env.experiment.terminated_return
            assert reward == pytest.approx(0.0 if worth is None else worth - gained)
        again, _ = env.reset()
        assert again in env.observation_space
        assert np.isfinite(env.step([0.5] * environment.inputs)[1])


@pytest.mark.parametrize("environment", DRAWN)
def test_a_row_that_breaks_touches_no_other(environment):
    envs, plain = environment.make_vec(4), environment.make_vec(4)
    actions = environment.random_actions(20, 4)
    for each_of in (envs, plain):
        roll_out(each_of, actions[:3])
    overwrite(envs, f"X_{next(iter(envs.experiment.truth_model.states))}", np.nan, row=2)
    for given, expected in zip(continue_vector(envs, actions[3:]), continue_vector(plain, actions[3:]), strict=True):
        for one, other in zip(given[:4], expected[:4], strict=True):
            np.testing.assert_array_equal(np.delete(one, 2, 0), np.delete(other, 2, 0))
        assert given[0] in envs.observation_space


@pytest.mark.parametrize("environment", DRAWN)
def test_gains_sum_to_the_change_of_the_belief(environment):
    env = environment.make()
    prior, model = env.belief, env.experiment.model
    for seed in range(5):
        steps = play(env, environment.random_actions(60, seed=seed)[:, 0], seed=seed)[1:]
        if steps[-1][4]["diverged"]:
            continue
        final, truth = env.belief, coefficients_of(model, env.truth, env.experiment.scales)
        gained, density = (sum(step[4][name] for step in steps) for name in ("information_gain", "log_posterior_gain"))
        assert gained == pytest.approx(prior.entropy() - final.entropy(), rel=1e-9, abs=1e-9)
        if not env.experiment.jump:
            assert density == pytest.approx(final.log_prob(truth) - prior.log_prob(truth), rel=1e-7, abs=1e-7)
        if env.experiment.reward == "parameter_error":
            assert -1 <= sum(step[1] for step in steps) <= 1


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


@pytest.mark.parametrize("environment", DRAWN)
def test_observations_stay_in_their_space_and_rewards_finite(environment):
    rng = np.random.default_rng(0)
    shape = (128, 4, environment.inputs)
    actions = np.concatenate([rng.uniform(-1, 1, shape), rng.choice([-1.0, 1.0], shape)], axis=1)
    for options in EXTREMES:
        if environment.name == "rig" and (options.keys() & {"spread"} or options.get("max_output", 0) > 1):
            continue  # which the rig says
        if environment.name == "double pendulum" and options.keys() & {"max_output", "max_input"}:
            continue  # which scale a model in seconds, and compile another
        envs = environment.make_vec(8, **{"horizon": 128} | options)
        envs.reset(seed=0)
        for action in actions:
            observations, rewards, _, _, infos = envs.step(action)
            given = rewards, infos["information_gain"], infos["log_posterior_gain"]
            assert observations in envs.observation_space, options
            assert np.isfinite(given).all(), options


@pytest.mark.parametrize("environment", each())
def test_bad_options_are_named(environment):
    cases = [
        ({"horizn": 3}, "unexpected keyword argument 'horizn'"),
        ({"render_mode": "ansi"}, "render_mode must be"),
        ({"reward": "informationgain"}, "did you mean 'information_gain'"),
        ({"observation": "all"}, "observation must be one of"),
        ({"max_input": -1}, "max_input must be"),
        ({"max_output": np.nan}, "max_output must be"),
        ({"hold": 0}, "hold must be"),
        ({"history": 0}, "history must be"),
        ({"terminal": "yes", "reward": "information_gain"}, "terminal must be"),
        ({"iterations": 0}, "iterations must be"),
        ({"noise_hypotheses": 0}, "noise_hypotheses must be"),
        ({"branch": "exam"}, "branch must be one of"),
    ]
    makers = [environment.make]
    if environment.vector is not None:
        makers.append(lambda **options: environment.make_vec(2, **options))
    refusable = environment.make().experiment
    known = {"horizn", "render_mode", *vars(refusable), *type(refusable).__dataclass_fields__}
    assert_refused(
        (lambda make=make, options=options: make(**options), fragment)
        for make in makers
        for options, fragment in cases
        if options.keys() <= known
    )


@pytest.mark.parametrize("environment", each())
def test_the_belief_of_an_episode_stays_as_it_was(environment):
    env = environment.make()
    play(env, environment.random_actions(30)[:, 0], seed=0)
    belief, kept = env.belief, copy.deepcopy(env.belief)
    play(env, environment.random_actions(30, seed=1)[:, 0])
    assert same(belief, kept)
    assert not same(belief, env.belief)


def test_every_compiled_combination_is_there_once():
    kinds = [environment.make().experiment.kernel_spec for environment in COMPILED if not environment.on_record]
    assert len(set(kinds)) == len(kinds)
    assert {environment.make().experiment.kernel_spec for environment in ENVIRONMENTS[len(COMPILED) :]} <= set(kinds)
