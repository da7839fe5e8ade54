"""Excitation policies: batches, episodes, seeds, limits, and what each signal looks like."""

import copy
import pickle
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import cloudpickle
import gymnasium as gym
import numpy as np
import pytest
from tables import table

from agents.policies import POLICIES, make_policy
from agents.policies.excitations import EXCITATIONS, draw_prbs, draw_recorded, draw_regime, draw_uniform
from agents.policies.feedback import FEEDBACK
from agents.policies.signals import DEFAULT_SAMPLES, SignalPolicy
from duffing_env.plants import silverbox_record
from estimator import Channel, Rig

GUESS = {"m": (0.3, 0.5), "c": (0.4, 0.8), "a": (2e3, 3e3), "b": (2e7, 6e7)}
RIG = Rig(1e-3, input=Channel("N", limit=6.0), output=Channel("m", range=0.03, noise=5e-6), guess=GUESS)


def stand_in(**attributes):
    """An environment's wrapper, as far as policies look at it."""
    return SimpleNamespace(unwrapped=SimpleNamespace(**attributes))


def counting_policy(samples=5, seed=0):
    """Draws 1000·k + (0, 1, 2, ...) with a random k, so that a sample tells its signal and place.

    The volts are integers below max_input = 2^24, so that float32 actions keep them exactly.
    """

    def draw(rng, length):
        return 1000.0 * rng.integers(1, 10_000) + np.arange(length)

    return SignalPolicy("counting", draw, max_input=2.0**24, samples=samples, seed=seed)


def play(policy, rows, steps, episode_starts=None):
    """The volts of a batch, shape (steps, rows), with the state handed back each time."""
    state, volts = None, []
    for step in range(steps):
        start = None if episode_starts is None else episode_starts[step]
        actions, state = policy.predict(np.zeros((rows, 3)), state, start)
        volts.append(actions[:, 0].astype(np.float64) * policy.max_input)
    return np.array(volts)


@pytest.mark.parametrize("name", [*EXCITATIONS, *FEEDBACK])
@pytest.mark.parametrize("track", ["Short-v0", "Rig-v0"])
def test_a_policy_goes_on_from_a_copy(name, track):
    """Also within another process, which has the bytes alone."""
    rig = {"rig": RIG} if track == "Rig-v0" else {}
    policy = make_policy(name, gym.make(f"duffing_env/{track}", horizon=20, **rig), seed=4)
    seen = np.zeros((2, 35 if rig else 22))
    _, state = policy.predict(seen)
    copies = [copy.deepcopy((policy, state)), pickle.loads(pickle.dumps((policy, state)))]
    copies.append(pickle.loads(cloudpickle.dumps((policy, state))))
    starts = [[k % 7 == 0, k == 20] for k in range(1, 30)]

    def goes_on(policy, state):
        played = []
        for start in starts:
            actions, state = policy.predict(seen, state, start)
            played.append(actions)
        return np.array(played)

    expected = goes_on(policy, state)
    for copied in copies:
        np.testing.assert_array_equal(goes_on(*copied), expected)


@pytest.fixture
def without_record(monkeypatch):
    monkeypatch.setattr(silverbox_record, "record_available", lambda: False)


@table("name", EXCITATIONS)
def test_shapes_and_types_of_batch_and_single(name):
    policy = make_policy(name, stand_in(max_input=0.1, horizon=50))
    for rows in (1, 4):
        actions, state = policy.predict(np.zeros((rows, 7)))
        assert actions.shape == (rows, 1)
        assert actions.dtype == np.float32
        actions, _ = policy.predict(np.zeros((rows, 7)), state=state, episode_start=[False] * rows)
        assert actions.shape == (rows, 1)
    single, state = policy.predict(np.zeros(7), deterministic=True)
    assert single.shape == (1,)
    assert single.dtype == np.float32
    assert policy.predict(np.zeros(7), state, episode_start=True)[0].shape == (1,)


@table("name", EXCITATIONS)
def test_actions_stay_in_range(name):
    # Both regimes exceed 10 mV, so the limit has to clip them.
    policy = make_policy(name, stand_in(max_input=0.01, horizon=400))
    actions = play(policy, rows=20, steps=400) / policy.max_input
    assert np.all(np.abs(actions) <= 1.0)
    assert np.abs(actions).max() > 0.99


def test_single_observation_follows_the_first_environment_of_a_batch():
    batch = play(counting_policy(), rows=3, steps=4)[:, 0]
    policy, state = counting_policy(), None
    for expected in batch:
        action, state = policy.predict(np.zeros(3), state)
        assert action[0] * policy.max_input == expected


def test_signal_advances_by_one_sample_and_differs_between_environments():
    volts = play(counting_policy(samples=6), rows=3, steps=6)
    np.testing.assert_array_equal(np.diff(volts, axis=0), 1.0)
    assert np.all(volts[0] % 1000 == 0)
    assert len(set(volts[0])) == 3


def test_episode_start_draws_anew_for_that_environment_only():
    starts = np.zeros((6, 3), dtype=bool)
    starts[4, 1] = True
    volts = play(counting_policy(samples=10), rows=3, steps=6, episode_starts=starts)
    np.testing.assert_array_equal(np.diff(volts[:, [0, 2]], axis=0), 1.0)
    np.testing.assert_array_equal(volts[:, 1] % 1000, [0, 1, 2, 3, 0, 1])
    assert volts[4, 1] != volts[0, 1]


def test_a_signal_that_runs_out_is_continued_by_a_new_draw():
    volts = play(counting_policy(samples=3), rows=2, steps=7)
    np.testing.assert_array_equal(volts[:, 0] % 1000, [0, 1, 2, 0, 1, 2, 0])
    assert len({volts[0, 0], volts[3, 0], volts[6, 0]}) == 3


def test_no_state_means_new_signals_and_leaves_states_in_hand_alone():
    policy = counting_policy(samples=4)
    first, state = policy.predict(np.zeros((2, 3)))
    kept = [part.copy() for part in state]
    branch, _ = policy.predict(np.zeros((2, 3)), state, episode_start=np.ones(2, dtype=bool))
    fresh, _ = policy.predict(np.zeros((2, 3)))
    assert len({first[0, 0], branch[0, 0], fresh[0, 0]}) == 3
    for part, before in zip(state, kept, strict=True):
        np.testing.assert_array_equal(part, before)


def test_signals_do_not_depend_on_the_batch_or_on_the_other_environments():
    starts = np.zeros((9, 5), dtype=bool)
    starts[[2, 3, 5], [1, 4, 0]] = True  # environments 2 and 3 are undisturbed
    large = play(counting_policy(), rows=5, steps=9, episode_starts=starts)
    small = play(counting_policy(), rows=3, steps=9, episode_starts=starts[:, :3])
    np.testing.assert_array_equal(small, large[:, :3])
    np.testing.assert_array_equal(large[:, 3], play(counting_policy(), rows=4, steps=9)[:, 3])


def test_growing_the_batch_keeps_the_generators():
    grown = counting_policy()
    grown.predict(np.zeros((2, 3)))
    whole = counting_policy()
    first, _ = whole.predict(np.zeros((4, 3)))
    second, _ = whole.predict(np.zeros((4, 3)))
    actions, _ = grown.predict(np.zeros((4, 3)))
    np.testing.assert_array_equal(actions[:2], second[:2])
    np.testing.assert_array_equal(actions[2:], first[2:])


def test_reset_starts_over_and_takes_a_seed():
    policy = counting_policy(seed=1)
    first = play(policy, rows=2, steps=8)
    assert not np.array_equal(play(policy, rows=2, steps=8), first)
    policy.reset()
    np.testing.assert_array_equal(play(policy, rows=2, steps=8), first)
    policy.reset(seed=2)
    other = play(policy, rows=2, steps=8)
    assert not np.array_equal(other, first)
    np.testing.assert_array_equal(other, play(counting_policy(seed=2), rows=2, steps=8))


@table("name", ["square", "velocity-sign", "efe-myopic", "efe-block-16", lambda seen: seen[:, 0]])
def test_an_object_that_is_no_array_is_refused_by_name(name):
    env = gym.make("duffing_env/Amplitude-v0")
    observation, _ = env.reset(seed=0)
    policy = make_policy(name, env)
    with pytest.raises(ValueError, match=r"observation must be numbers, but is \[\[1.0\], \[2.0, 3.0\]\]"):
        policy.predict([[1.0], [2.0, 3.0]])
    if isinstance(name, str):
        with pytest.raises(ValueError, match="episode_start must be numbers"):
            policy.predict(observation, None, [[True], []])
    if isinstance(name, str) and name.startswith("efe"):
        with pytest.raises(ValueError, match="state must be what the last call returned, or None, but is 3"):
            policy.predict(observation, 3)
        with pytest.raises(ValueError, match="observation must be finite"):
            policy.predict(np.full_like(observation, np.nan))


def test_mismatched_batches_are_refused():
    policy = counting_policy()
    _, state = policy.predict(np.zeros((2, 3)))
    with pytest.raises(ValueError, match="state must be for as many environments as observation, 3, but is for 2"):
        policy.predict(np.zeros((3, 3)), state)
    with pytest.raises(ValueError, match="episode_start must be for as many environments as observation"):
        policy.predict(np.zeros((2, 3)), state, episode_start=[True])
    with pytest.raises(ValueError, match=r"its shape is \(2, 3, 4\)"):
        policy.predict(np.zeros((2, 3, 4)))


@table("max_input", [0.0, -0.1, np.inf, np.nan])
def test_senseless_limits_are_refused(max_input):
    with pytest.raises(ValueError, match="max_input must be positive and finite"):
        SignalPolicy("uniform", draw_uniform(0.1), max_input=max_input)


def test_senseless_lengths_are_refused():
    with pytest.raises(ValueError, match="samples must be a whole number from 1 to 4194304, but is 0"):
        SignalPolicy("uniform", draw_uniform(0.1), max_input=0.1, samples=0)
    with pytest.raises(ValueError, match="hold must be a whole number from 1 to 1000000000, but is 0"):
        draw_prbs(0.1, hold=0)


def test_uniform_is_white_and_fills_its_range():
    u = draw_uniform(0.2)(np.random.default_rng(1), 100_000)
    assert u.shape == (100_000,)
    assert -0.2 <= u.min() < -0.1999
    assert 0.1999 < u.max() <= 0.2
    assert u.std() == pytest.approx(0.2 / np.sqrt(3), rel=0.01)
    assert abs(np.mean(u[1:] * u[:-1])) < 0.01 * u.var()


@table("hold", [1, 4])
def test_prbs_has_two_values_and_keeps_each_for_hold_samples(hold):
    u = draw_prbs(0.2, hold)(np.random.default_rng(2), 40_001)  # no multiple of 4
    assert u.shape == (40_001,)
    assert set(u) == {-0.2, 0.2}
    changes = np.flatnonzero(np.diff(u)) + 1
    assert np.all(changes % hold == 0)
    # A fair coin changes sides every other time: 5 standard deviations around one half.
    throws = 40_000 // hold
    assert changes.size / throws == pytest.approx(0.5, abs=2.5 / np.sqrt(throws))
    assert abs(u.mean()) < 0.2 * 5 / np.sqrt(throws)


def is_stretch_of(stretch, whole):
    windows = np.lib.stride_tricks.sliding_window_view(whole, stretch.size)
    return np.any(np.all(windows[windows[:, 0] == stretch[0]] == stretch, axis=1))


def test_reference_policies_play_stretches_of_the_record(record):
    for name, regime in (("multisine", record.multisine), ("arrow", record.arrow)):
        draw = draw_regime(name)
        rng = np.random.default_rng(3)
        first, second = draw(rng, 500), draw(rng, 500)
        assert is_stretch_of(first, regime.u)
        assert is_stretch_of(second, regime.u)
        assert not np.array_equal(first, second)
        policy = make_policy(f"silverbox-{name}", stand_in(max_input=0.15, horizon=500), seed=5)
        volts = play(policy, rows=1, steps=500)[:, 0]
        single = (regime.u / 0.15).astype(np.float32).astype(np.float64) * 0.15
        assert is_stretch_of(volts, single)


@table("regime", ["multisine", "arrow"])
def test_reference_policies_work_without_the_record(without_record, regime):
    synthesise = getattr(silverbox_record, f"synthesise_{regime}")
    stretch = draw_regime(regime)(np.random.default_rng(4), 500)
    assert is_stretch_of(stretch, synthesise(np.random.default_rng(4)))
    policy = make_policy(f"silverbox-{regime}", seed=6)
    first = play(policy, rows=2, steps=30)
    policy.reset()
    np.testing.assert_array_equal(play(policy, rows=2, steps=30), first)


def test_stretches_start_uniformly_over_the_regime(monkeypatch):
    monkeypatch.setattr("agents.policies.excitations.regime_input", lambda name, rng: np.arange(10.0))
    rng = np.random.default_rng(5)
    starts = [draw_regime("arrow")(rng, 7)[0] for _ in range(4000)]
    values, counts = np.unique(starts, return_counts=True)
    np.testing.assert_array_equal(values, [0, 1, 2, 3])
    np.testing.assert_allclose(counts, 1000, atol=5 * np.sqrt(750))
    np.testing.assert_array_equal(
        draw_regime("arrow")(rng, 23), np.concatenate([np.arange(10.0)] * 2 + [np.arange(3.0)])
    )


@table("name", ["silverbox-multisine", "silverbox-arrow"])
def test_replay_plays_the_recorded_input_from_its_first_sample(name):
    recorded = np.random.default_rng(7).uniform(-0.14, 0.14, 40)
    env = stand_in(max_input=0.15, horizon=30, recorded_input=recorded)
    policy = make_policy(name, env, seed=8)
    starts = np.zeros((60, 2), dtype=bool)
    starts[25, 1] = True
    volts = play(policy, rows=2, steps=60, episode_starts=starts)
    rounding = {"rtol": 2.0**-23, "atol": 0.0}
    np.testing.assert_allclose(volts[:40, 0], recorded, **rounding)
    np.testing.assert_allclose(volts[40:, 0], recorded[:20], **rounding)
    np.testing.assert_allclose(volts[25:, 1], recorded[:35], **rounding)


def test_recorded_input_repeats_when_too_short():
    u = np.array([0.1, -0.2, 0.3])
    repeated = draw_recorded(u)(np.random.default_rng(0), 7)
    np.testing.assert_array_equal(repeated, [0.1, -0.2, 0.3, 0.1, -0.2, 0.3, 0.1])


def test_policies_take_limit_and_length_from_the_environment():
    policy = make_policy("prbs", stand_in(max_input=0.3, horizon=77), seed=9)
    assert (policy.name, policy.max_input, policy.samples) == ("prbs", 0.3, 77)
    assert policy.seed == 9
    endless = make_policy("uniform", stand_in(max_input=0.3, horizon=None))
    assert endless.samples == DEFAULT_SAMPLES
    assert make_policy("silverbox-arrow").max_input == 0.15
    for name in EXCITATIONS:
        assert make_policy(name).name == name


def test_foreign_environment_is_refused():
    with pytest.raises(ValueError, match=r"must be an environment of duffing_env.*SimpleNamespace"):
        make_policy("uniform", stand_in(horizon=10))


def test_unknown_name_is_refused_with_the_names_and_the_nearest():
    with pytest.raises(ValueError, match="did you mean 'silverbox-multisine'") as error:
        make_policy("silverbox-multisin")
    for name in POLICIES:
        assert name in str(error.value)
    with pytest.raises(ValueError, match=r"but is 'zzz'; known are silverbox-multisine, "):
        make_policy("zzz")


def test_a_path_loads_the_trained_policy(tmp_path, monkeypatch):
    learned = ModuleType("agents.policies.networks.trained_policy")
    learned.load_policy = lambda path, seed: ("loaded", Path(path), seed)
    monkeypatch.setitem(sys.modules, "agents.policies.networks.trained_policy", learned)
    assert make_policy(str(tmp_path), seed=3) == ("loaded", tmp_path, 3)


@table("name", ["prbs", "efe", "shield"])
def test_the_name_of_an_environment_is_no_policy(name):
    with pytest.raises(ValueError, match="env must be an environment, but is 'duffing_env/Short-v1'; pass what gym"):
        make_policy(name, "duffing_env/Short-v1")
