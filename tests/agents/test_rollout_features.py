"""Features of networks: against a plain reference, for every model, mirrored; and the shield."""

import json
from functools import cache

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from playing import assert_refused
from reference.features import ENTRIES, features
from specimens import COMPILED
from tables import table

from agents import make_policy
from agents.evaluation.track_batch import make_track_batch
from agents.planning.model_probe import observation_layout
from agents.policies.networks.feature_encoder import FeatureEncoder, ShieldedFeatures
from agents.policies.networks.feature_names import FEATURE_NAMES, MAX_FEATURE
from estimator.engine.noise_free_step import compile_noise_free_step

AMPLITUDE, POWER = "duffing_env/Amplitude-v0", "duffing_env/Power-v0"
REACHES = [FEATURE_NAMES.index(f"braked_peak_with_margin_{first}") for first in ("down", "none", "up")]
STATE = ENTRIES.index("state_x1")

#: An environment of each model and of what changes its setting.
MODELS = {e.name: e for e in COMPILED if e.name in ("difference", "fisher", "continuous", "rig", "plant", "own model")}


@cache
def environment(name):
    return MODELS[name].make().unwrapped


def observed(env_id, samples=120, rows=12):
    """Observations of some episodes, in which most inputs have the sign of the velocity."""
    envs, rng = make_track_batch(env_id, rows), np.random.default_rng(1)
    shown, _ = envs.reset(seed=0)
    seen = [shown.copy()]
    for _ in range(samples):
        along = np.where(shown[:, STATE] >= shown[:, STATE + 1], 1.0, -1.0)
        shown, *_ = envs.step(np.where(rng.random(rows) < 0.8, along, 0.0).astype(np.float32)[:, None])
        seen.append(shown.copy())
    return FeatureEncoder.of(envs, with_observation=False), np.concatenate(seen[::8])


def anywhere(env, seed, rows=8):
    """Observations from the whole of their space, with both of its corners."""
    space, rng = env.observation_space, np.random.default_rng(seed)
    drawn = rng.uniform(space.low, space.high, (rows, *space.shape)).astype(np.float32)
    return np.concatenate([[space.low, space.high], drawn])


def near_the_limit(rows=400):
    """Observations of Eq. (2), well known, that move about the limit of Amplitude-v0."""
    rng, seen = np.random.default_rng(2), np.zeros((rows, len(ENTRIES)), dtype=np.float32)
    seen[:, STATE : STATE + 2] = rng.uniform(-1.0, 1.0, (rows, 2))
    seen[:, [i for i, name in enumerate(ENTRIES) if name.startswith("log_std")]] = -3.0
    seen[:, ENTRIES.index("time_left")] = 0.5
    return FeatureEncoder.of(make_track_batch(AMPLITUDE, 1), with_observation=False), seen


@pytest.mark.parametrize("env_id", [AMPLITUDE, POWER])
def test_features_are_those_of_the_reference(env_id):
    found, seen = observed(env_id)
    shown = found(seen)
    for i, observation in enumerate(seen):
        values, sign, span, push, to_come = features(observation, found.setting)
        np.testing.assert_allclose(shown.values[i], values, rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(shown.allowed_intervals[i], span, rtol=1e-5, atol=1e-5)
        assert (shown.mirror_signs[i], shown.action_scales[i]) == (sign, pytest.approx(push, rel=1e-6))
        assert shown.remaining_information[i] == pytest.approx(to_come, rel=1e-5)
    assert 0 < (shown.mirror_signs < 0).sum() < len(seen)
    if env_id == AMPLITUDE:
        assert (shown.allowed_intervals[:, 1] < 1).any()
    else:
        assert (shown.action_scales < 1).any()


def test_the_shield_is_that_of_the_reference_near_the_limit():
    found, seen = near_the_limit()
    for span, observation in zip(found(seen).allowed_intervals, seen, strict=True):
        np.testing.assert_allclose(span, features(observation, found.setting)[2], rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("name", MODELS)
@settings(derandomize=True, deadline=None, max_examples=50)
@given(st.integers(0, 2**32 - 1))
def test_features_of_any_observation_are_finite_and_bounded(name, seed):
    env = environment(name)
    found, seen = FeatureEncoder.of(env), anywhere(env, seed)
    shown = found(seen)
    assert (
        shown.values.shape
        == (len(seen), found.size)
        == (len(seen), len(FEATURE_NAMES) + env.observation_space.shape[0])
    )
    assert (np.abs(shown.values) <= MAX_FEATURE).all()  # and so finite
    assert (
        (shown.allowed_intervals[:, 0] <= shown.allowed_intervals[:, 1])
        & (np.abs(shown.allowed_intervals) <= 1).all(axis=1)
    ).all()
    assert ((shown.action_scales >= 0) & (shown.action_scales <= 1)).all()
    if name != "fisher":  # whose swing without a limit leaves the range of numbers
        assert np.isfinite(shown.remaining_information).all()


@pytest.mark.parametrize("name", MODELS)
def test_features_are_the_same_alone_in_a_batch_and_mirrored(name):
    env = environment(name)
    found, seen = FeatureEncoder.of(env), anywhere(env, 1, rows=40)
    together = found(seen)
    for i in range(len(seen)):
        for whole, alone in zip(together, found(seen[i : i + 1]), strict=True):
            np.testing.assert_array_equal(alone[0], whole[i])
    at, model = observation_layout(found.model_view.model), found.model_view.model
    if not compile_noise_free_step(*found.model_view).is_odd:  # a rig has offsets
        assert name == "rig"
        assert (together.mirror_signs == 1).all()
        return
    odd = [*range(at.state, at.state + model.n_states), at.last_input]
    odd += range(at.last_output, at.last_output + model.n_outputs)
    moving = seen[2:]  # in the corners nothing rises or falls
    over = moving.copy()
    over[:, odd] *= -1
    together, turned = found(moving), found(over)
    choices = np.random.default_rng(0).uniform(-1, 1, len(over))
    np.testing.assert_array_equal(turned.values, together.values)
    np.testing.assert_array_equal(turned.mirror_signs, -together.mirror_signs)
    np.testing.assert_array_equal(turned.to_actions(choices), -together.to_actions(choices))


def test_the_observation_stands_behind_the_features():
    found, seen = observed(AMPLITUDE, samples=16)
    own = FeatureEncoder(found.setting, found.model_view)
    shown = own(seen)
    np.testing.assert_array_equal(shown.values[:, : len(FEATURE_NAMES)], found(seen).values)
    risen = shown.mirror_signs > 0
    np.testing.assert_array_equal(
        shown.values[risen, len(FEATURE_NAMES) :], np.clip(seen[risen], -MAX_FEATURE, MAX_FEATURE)
    )
    assert (own.observation_size, own.size) == (len(ENTRIES), len(FEATURE_NAMES) + len(ENTRIES))


def test_the_shield_keeps_nearly_all_random_inputs_within_the_limit():
    """Of 64 systems most leave the range without the shield, under random inputs."""
    ended = {}
    for shielded in (True, False):
        envs, rng = make_track_batch(AMPLITUDE, 64), np.random.default_rng(3)
        found, (shown, _) = FeatureEncoder.of(envs, with_observation=False), envs.reset(seed=0)
        gone = np.zeros(64, dtype=bool)
        for _ in range(envs.horizon):
            choices = rng.choice([-1.0, 1.0], 64)
            actions = found(shown).to_actions(choices) if shielded else choices[:, None]
            shown, _, terminated, _, _ = envs.step(actions.astype(np.float32))
            gone |= terminated
        ended[shielded] = gone.sum()
    assert ended[True] <= 1
    assert ended[False] >= 24


def test_the_span_is_where_the_peak_is_within_the_limit():
    """Linear between the three first inputs; where none is, the one that leads beyond it the least."""
    found, seen = near_the_limit()
    shown, choices = found(seen), np.linspace(-1, 1, 81)
    kinds = {"free": 0, "bounded": 0, "one side": 0, "none": 0}
    for reaches, (low, high) in zip(shown.values[:, REACHES], shown.allowed_intervals, strict=True):
        peaks = np.interp(choices, [-1, 0, 1], reaches)
        within = (choices >= low) & (choices <= high)
        if reaches.min() > 1:
            assert low == high == (-1, 0, 1)[reaches.argmin()]
            kinds["none"] += 1
        elif reaches[1] > 1:
            assert (peaks[within] <= 1 + 1e-5).all()
            assert (low, high)[int(reaches[2] < reaches[0])] == (-1, 1)[int(reaches[2] < reaches[0])]
            kinds["one side"] += 1
        else:
            np.testing.assert_array_equal(within[np.abs(peaks - 1) > 1e-5], peaks[np.abs(peaks - 1) > 1e-5] <= 1)
            kinds["free" if within.all() else "bounded"] += 1
    assert min(kinds.values()) > 5, kinds


@table(
    ("span", "push", "sign", "choice", "action"),
    [
        ((-1, 1), 1, 1, 0.4, 0.4), ((-1, 1), 1, -1, 0.4, -0.4), ((-1, 0.25), 1, 1, 0.4, 0.25),
        ((0.5, 1), 1, 1, 0.4, 0.5), ((-1, -1), 1, -1, 0.4, 1.0), ((-1, 0.5), 0.5, 1, 0.75, 0.25),
    ],
)  # fmt: skip
def test_an_action_is_the_nearest_choice_within_the_span(span, push, sign, choice, action):
    nothing = np.zeros((1, 1), np.float32)
    found = ShieldedFeatures(nothing, *(np.array([part], np.float32) for part in (sign, span, push, 0.0)))
    assert found.to_actions([choice]).tolist() == [[np.float32(action)]]


@pytest.mark.parametrize("name", MODELS)
def test_a_setting_survives_being_written(name):
    env = environment(name)
    found, seen = FeatureEncoder.of(env), anywhere(env, 3)
    again = FeatureEncoder.from_tensor(found.to_tensor(), json.loads(json.dumps(found.describe())))
    assert (again.model_view, again.with_observation) == (found.model_view, found.with_observation)
    for one, other in zip(found(seen), again(seen), strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_damaged_setting_is_refused():
    found = FeatureEncoder.of(make_track_batch(POWER, 1))
    whole, description = found.to_tensor(), found.describe()

    def put(place, value):
        damaged = whole.copy()
        damaged[place] = value
        return damaged

    at = {name: i - len(found.setting) for i, name in enumerate(found.setting._fields)}
    cases = [(whole[:-1], "numbers, but is"), (put(0, np.nan), "center of setting must be positive")]
    cases += [(put(9, np.inf), "of setting must be positive and finite")]
    cases += [(put(4, -1.0), "std of setting"), (put(at["samples"], 0.0), "samples of setting")]
    cases += [
        (put(at["hold_samples"], 1e6), "hold_samples of setting"),
        (put(at["energy"], np.nan), "energy of setting"),
    ]
    assert_refused([(lambda t=tensor: FeatureEncoder.from_tensor(t, description), part) for tensor, part in cases])


@table(
    ("env", "message"),
    [
        (lambda: gym.make("Pendulum-v1").unwrapped, "env must be one of duffing_env .* but is PendulumEnv"),
        (lambda: make_track_batch(AMPLITUDE, 1, {"hold": 2}), "hold must be 1 for features, but is 2"),
        (
            lambda: make_track_batch(AMPLITUDE, 1, {"observation": "history"}),
            "'posterior' for features, but shows 'history'",
        ),
    ],
)
def test_where_there_are_no_features_it_says_so(env, message):
    with pytest.raises(ValueError, match=message):
        FeatureEncoder.of(env())


def test_it_takes_the_prior_and_the_limits_of_the_environment():
    options = {"horizon": 90, "max_input": 0.05, "max_output": 0.2, "spread": 0.2, "process_noise": 1e-3}
    usual, other = (FeatureEncoder.of(make_track_batch(AMPLITUDE, 1, o)).setting for o in ({}, options))
    assert (other.samples, other.max_input, other.limit, other.energy) == (90, 0.05, 0.2, np.inf)
    assert (usual.process_variance, other.process_variance) == pytest.approx((2.5e-7, 1e-6))
    assert (other.std < usual.std).all()
    np.testing.assert_array_equal(other.scales, 0.2)
    limited = FeatureEncoder.of(make_track_batch(POWER, 1, {"max_rms": 0.01, "horizon": 100})).setting
    assert limited.energy == pytest.approx(100 * 0.01**2)
    single, several = (
        FeatureEncoder.of(env).to_tensor() for env in (gym.make(POWER).unwrapped, make_track_batch(POWER, 3))
    )
    np.testing.assert_array_equal(single, several)


def test_the_shield_alone_pushes_along_the_velocity_and_stays():
    envs = make_track_batch(AMPLITUDE, 32)
    policy = make_policy("shield", envs)
    shown, _ = envs.reset(seed=0)
    for _ in range(envs.horizon):
        actions, _ = policy.predict(shown)
        found = policy._encoder(shown)
        velocity = found.values[:, FEATURE_NAMES.index("velocity")]
        np.testing.assert_array_equal(actions, found.to_actions(np.where(velocity >= 0, 1.0, -1.0)))
        shown, _, terminated, _, _ = envs.step(actions)
        assert not terminated.any()
    np.testing.assert_array_equal(policy.predict(shown[3])[0], policy.predict(shown)[0][3])
    for wrong, message in ((np.zeros(21), "must have 22 entries"), (np.full(22, np.nan), "must be finite")):
        with pytest.raises(ValueError, match=message):
            policy.predict(wrong)
