"""The pendulum is the published one, with the exact posterior; policies are judged beside the planner."""

import numpy as np
import pytest

from agents.evaluation.metrics import fisher_information_gain
from agents.evaluation.policy_rollout import run_episodes
from agents.evaluation.track_batch import TEST_OPTIONS
from agents.policies import make_policy
from research.studies import changed_options, iosmc_pendulum, sb3_baselines


def test_the_pendulum_is_the_published_one_and_its_posterior_exact():
    played, beliefs, truth, experiment = run_episodes("uniform", iosmc_pendulum.TRACK, 64, 0, TEST_OPTIONS)
    u, (ahead, w) = played.inputs.T, np.moveaxis(played.outputs, 2, 0).swapaxes(1, 2)
    h, start = 0.05, np.zeros((64, 1))
    q, velocity = (np.concatenate([start, seen], axis=1) for seen in (ahead - w, w / h))
    np.testing.assert_allclose(np.diff(q), h * velocity[:, :-1], atol=1e-5)
    features = np.stack([-np.sin(q[:, :-1]), -velocity[:, :-1], u], axis=2)
    coefficients = np.stack([truth.p1, truth.p2, truth.p3], axis=1)
    moved = np.diff(velocity)
    rest = moved - h * (features @ coefficients[:, :, None])[:, :, 0]
    variance = 0.1**2 * h + 1e-8
    assert rest.std() == pytest.approx(np.sqrt(variance), rel=0.05)
    prior = np.diag(1 / np.array([0.1, 0.01, 0.1]))
    for i, belief in enumerate(beliefs):
        precision = prior + h**2 * features[i].T @ features[i] / variance
        mean = np.linalg.solve(precision, prior @ [14.7, 0.0, 3.0] + h * features[i].T @ moved[i] / variance)
        found, cov = belief.physical()
        exact = np.linalg.inv(precision)
        stds = np.sqrt(np.diag(exact))
        # The belief does not know that the first velocity is 0, and so learns less from the first sample.
        assert np.abs((found - mean) / stds).max() < 0.2
        np.testing.assert_allclose(cov / np.outer(stds, stds), exact / np.outer(stds, stds), atol=0.02)
    gained = played.metrics["information_gain"]
    assert gained.mean() == pytest.approx(
        fisher_information_gain(played.inputs, truth, experiment, played.outputs).mean(), abs=0.01
    )


@pytest.mark.parametrize("policy", ["uniform", "prbs"])
def test_signals_gain_what_is_published(policy):
    mean, std = iosmc_pendulum.PUBLISHED[policy]
    found = iosmc_pendulum.information_gains(policy, 256)[0][iosmc_pendulum.PUBLISHED_SAMPLE - 1]
    assert abs(found.mean() - mean) < 4 * std * np.sqrt(1 / 256 + 1 / 1024) + 0.005
    assert found.std() == pytest.approx(std, rel=0.2)


def test_policies_are_judged_beside_the_planner():
    track, options = "duffing_env/Amplitude-v0", {"horizon": 24, "max_input": 0.05}
    planned, signal, again = changed_options.compare_with_planner(track, options, ("prbs", "efe"), 4)
    assert (planned["efficiency"] == 1.0).all()
    np.testing.assert_array_equal(again["efficiency"], planned["efficiency"])
    expected = np.exp((signal["fisher_gain"] - planned["fisher_gain"]) / 2)
    np.testing.assert_allclose(signal["efficiency"], expected)
    assert signal["efficiency"].mean() < 1.0
    assert changed_options.shipped_policy_name("Power", 0) == "ppo/power"
    assert changed_options.shipped_policy_name("Power", 1) == "ppo/power-v1"


@pytest.mark.parametrize("cases", [(9,), (0,), ()])
def test_unknown_cases_are_refused(cases):
    with pytest.raises(ValueError, match=r"cases must be of \[1, 2, 3, 4\], but are \["):
        changed_options.Config(cases=cases)
    with pytest.raises(ValueError, match=r"versions must be of \[0, 1\], but are \[2\]"):
        changed_options.Config(versions=(2,))


def test_an_algorithm_with_its_defaults_is_trained_and_saved(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    sb3_baselines.main(sb3_baselines.Config("ppo", steps=100))
    policy = make_policy("runs/sb3-ppo-short-v0-0")
    assert policy.card["steps"] == 2048  # a roll-out of PPO as it comes
    assert policy.predict(np.zeros((50, 22)), deterministic=True)[0].shape == (50, 1)
