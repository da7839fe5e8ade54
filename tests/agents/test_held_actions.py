"""Policies and evaluation where an action is held for several samples."""

from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from tables import table

from agents.evaluation.policy_evaluation import evaluate_policies
from agents.evaluation.track_batch import TEST_OPTIONS, make_track_batch
from agents.policies import make_policy
from estimator import SILVERBOX_SAMPLING_STEP

TRACK = "duffing_env/Amplitude-v0"
HOLD = 4


def stand_in(hold, **limits):
    """An environment of 50 samples, as far as signals look at it."""
    experiment = SimpleNamespace(hold=hold, max_rms=limits.get("max_rms"))
    return SimpleNamespace(unwrapped=SimpleNamespace(max_input=0.15, horizon=50, experiment=experiment))


def play(policy, rows, steps):
    """Actions (steps, rows)."""
    state, played = None, []
    for _ in range(steps):
        actions, state = policy.predict(np.zeros((rows, 22)), state)
        played.append(actions[:, 0])
    return np.array(played)


@table("name", ["uniform", "chirp-linear", "prbs-2", "schroeder"])
def test_a_signal_is_played_by_the_first_of_every_held_sample(name):
    sampled = play(make_policy(name, stand_in(1), seed=3), 2, 100)
    held = play(make_policy(name, stand_in(HOLD), seed=3), 2, 26)
    np.testing.assert_array_equal(held[:13], sampled[:50:HOLD])  # 50 samples are 13 actions, the last for two
    np.testing.assert_array_equal(held[13:], sampled[50::HOLD])


def test_a_signal_keeps_to_its_budget_as_it_is_held():
    held = play(make_policy("schroeder", stand_in(HOLD, max_rms=0.03)), 3, 13)
    volts = 0.15 * np.repeat(held, HOLD, axis=0)[:50]
    np.testing.assert_allclose(np.sqrt((volts**2).mean(axis=0)), 0.03, rtol=2e-6)
    envs = make_track_batch("duffing_env/Power-v0", 3, {"hold": HOLD})
    policy, state = make_policy("uniform", envs), None
    observations, _ = envs.reset(seed=0)
    for _ in range(64):
        actions, state = policy.predict(observations, state)
        observations, *_ = envs.step(actions)
        np.testing.assert_array_equal(observations[:, 18], actions[:, 0])  # nothing was cut
    assert (observations[:, 21] < 1e-5).all()


def test_a_square_wave_goes_on_by_as_many_samples_as_it_was_held():
    phases = []
    for hold in (1, HOLD):
        envs = make_track_batch(TRACK, 2, {"hold": hold})
        observations, _ = envs.reset(seed=0)
        policy = make_policy("square-believed", envs)
        _, phase = policy.predict(observations)
        np.testing.assert_allclose(phase, hold * SILVERBOX_SAMPLING_STEP * policy.frequency(observations), rtol=1e-6)
        phases.append(phase)
    np.testing.assert_allclose(phases[1], HOLD * phases[0], rtol=1e-12)


def test_the_planner_refuses_and_says_what_to_do():
    env = gym.make(TRACK, hold=2)
    with pytest.raises(
        ValueError, match=r"env must take an action for every sample, .* hold is 2; make it with hold=1"
    ):
        make_policy("efe", env)


def test_every_sample_is_evaluated(monkeypatch):
    monkeypatch.setattr("agents.evaluation.policy_evaluation.record_available", lambda: False)
    options = {"hold": HOLD, "horizon": 50, "max_output": 0.3}
    (evaluation,) = evaluate_policies(["uniform"], systems=6, seed=5, options=options)
    envs = make_track_batch(TRACK, 6, options | TEST_OPTIONS)
    policy, state = make_policy("uniform", envs, seed=5), None
    observations, _ = envs.reset(seed=5)
    gains, running, samples = np.zeros(6), np.ones(6, dtype=bool), np.zeros(6)
    for k in range(13):
        actions, state = policy.predict(observations, state)
        observations, _, terminated, truncated, infos = envs.step(actions)
        gains[running] += infos["log_posterior_gain"][running]
        held = evaluation.inputs[k * HOLD : (k + 1) * HOLD]
        played = ~np.isnan(held)
        assert (played.all(axis=0) | ~running | terminated | truncated).all()
        np.testing.assert_allclose(held[played], np.broadcast_to(0.15 * actions[:, 0], held.shape)[played], rtol=1e-6)
        samples += played.sum(axis=0)
        running &= ~(terminated | truncated)
    assert (samples == (~np.isnan(evaluation.outputs)).sum(axis=0)).all()
    assert 0 < evaluation.metrics["ended_early"].sum() < 6
    np.testing.assert_allclose(evaluation.metrics["log_posterior_gain"], gains, rtol=1e-9)
    assert (evaluation.gain_curve[-1] == evaluation.metrics["log_posterior_gain"]).all()
    # The other estimators see what the environment's own saw: every sample.
    own = evaluation.metrics["error_m"]
    np.testing.assert_allclose(evaluation.estimator_metrics["structured"]["error_m"], own, rtol=0.05, atol=2e-3)
