"""Analytic policy gradient: exact derivatives, and a network that climbs by them."""

from dataclasses import asdict

import numpy as np
import pytest
import torch
from stable_baselines3 import PPO

from agents.analytic_gradient import AscentSettings, ascend_policy, differentiate
from agents.design import START_SIZE, roll
from agents.vec_env import DuffingVecEnv
from duffing_env.vector_env import DuffingVectorEnv
from estimator.fisher import as_rows
from estimator.parameters import to_coefficients

TRACK, OPTIONS = "duffing_env/Short-v0", {"horizon": 24}
SETTINGS = AscentSettings(updates=30, num_envs=64, learning_rate=3e-3)
Q = R = 5e-4**2


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def systems():
    """True coefficients (5, 4) of a batch, and the prior's precision."""
    envs = DuffingVectorEnv(5)
    envs.reset(seed=0)
    return as_rows(to_coefficients(envs.truth)), np.linalg.inv(envs.belief(0).coefficients_cov)


def response(theta, inputs):
    """Displacements without noise (n, T + 1)."""
    tape, F = np.empty((inputs.shape[1] + 1, START_SIZE)), np.empty((4, 4))
    rows = []
    for system, u in zip(theta, inputs, strict=True):
        roll(system, Q, R, 10.0, np.zeros(START_SIZE), u, tape, F)
        rows.append(tape[:, 0].copy())
    return np.array(rows)


def derivatives(theta, precision, inputs, fading=1.0, limit=10.0, lengths=None):
    gradients, worths = np.full(inputs.shape, np.nan), np.empty(len(inputs))
    lengths = np.full(len(inputs), inputs.shape[1]) if lengths is None else lengths
    seen = response(theta, inputs)
    differentiate(theta, precision, Q, R, limit, 300.0, fading, lengths, seen, inputs, gradients, worths)
    return gradients, worths


def test_derivatives_are_those_of_differences(systems):
    """Without noise the displacements that were seen are the response, whose worth can be differenced."""
    theta, precision = systems
    inputs = 0.15 * np.random.default_rng(0).choice([-1.0, 1.0], (5, 20))
    limit = 0.8 * np.abs(response(theta, inputs)).max(axis=1).min()
    gradients, worths = derivatives(theta, precision, inputs, limit=limit)
    step = 1e-6
    for t in (0, 7, 19):
        ends = []
        for sign in (1, -1):
            moved = inputs.copy()
            moved[:, t] += sign * step
            over = np.maximum(0, np.abs(response(theta, moved)) / limit - 1)
            ends.append(derivatives(theta, precision, moved)[1] - 300.0 * (over**2).sum(axis=1))
        np.testing.assert_allclose(gradients[:, t], (ends[0] - ends[1]) / (2 * step), rtol=2e-4, atol=1e-3)
    assert np.isfinite(worths).all()


def test_what_is_far_ahead_fades(systems):
    """With a fading of 0 an input is told the next sample only, and then it is all the same how an episode goes on."""
    theta, precision = systems
    inputs = 0.15 * np.random.default_rng(1).choice([-1.0, 1.0], (5, 24))
    exact, near, faded, myopic = (derivatives(theta, precision, inputs, fading)[0] for fading in (1.0, 0.99, 0.9, 0.0))
    np.testing.assert_allclose(exact[:, -1], faded[:, -1], rtol=1e-12)
    np.testing.assert_allclose(exact[:, -1], myopic[:, -1], rtol=1e-12)
    errors = [np.abs(other - exact)[:, :12].mean() for other in (near, faded, myopic)]
    assert 0 < errors[0] < errors[1] < errors[2]


def test_nothing_is_told_after_the_end_of_an_episode(systems):
    theta, precision = systems
    inputs = 0.15 * np.random.default_rng(2).choice([-1.0, 1.0], (5, 24))
    gradients, worths = derivatives(theta, precision, inputs, lengths=np.array([24, 20, 9, 1, 24]))
    for row, length in enumerate((24, 20, 9, 1, 24)):
        assert not gradients[row, length:].any()
    np.testing.assert_allclose(worths[2], derivatives(theta, precision, inputs[:, :9])[1][2], rtol=1e-12)


def ascended(seed=0, **changes):
    """A fresh model after some updates, and the mean gain of each."""
    envs = DuffingVecEnv(TRACK, 2, seed=0, **OPTIONS)
    model = PPO("MlpPolicy", envs, n_steps=8, batch_size=16, policy_kwargs={"net_arch": [16]}, seed=0, device="cpu")
    gains = []
    settings = AscentSettings(**{**asdict(SETTINGS), **changes})
    ascend_policy(model, TRACK, OPTIONS, settings, seed, lambda _, gain: gains.append(gain))
    return model.policy.state_dict(), gains


def test_a_network_climbs():
    """From hardly any input to more than six nats: the same systems' best fixed signal gains about ten."""
    _, gains = ascended(updates=60)
    assert len(gains) == 60
    assert np.mean(gains[-5:]) > np.mean(gains[:5]) + 4


def test_the_same_seed_gives_the_same_weights_and_another_one_others():
    (first, gains), (again, same), (other, _) = (ascended(seed, updates=5) for seed in (0, 0, 1))
    assert gains == same
    for name, tensor in first.items():
        assert torch.equal(tensor, again[name]), name
    assert not torch.equal(first["action_net.weight"], other["action_net.weight"])


def test_critic_and_exploration_stay_as_they_are():
    before, _ = ascended(updates=0)
    after, _ = ascended(updates=2)
    changed = {name for name in before if not torch.equal(before[name], after[name])}
    assert changed == {
        "mlp_extractor.policy_net.0.weight", "mlp_extractor.policy_net.0.bias", "action_net.weight", "action_net.bias",
    }  # fmt: skip


@pytest.mark.parametrize("track", ["duffing_env/Continuous-v0", "duffing_env/Drift-v0"])
def test_tracks_without_the_difference_equation_or_with_a_jump_are_refused(track):
    model = PPO("MlpPolicy", DuffingVecEnv(track, 2), n_steps=8, batch_size=16, device="cpu")
    with pytest.raises(ValueError, match=r"env must simulate the difference equation without a jump, but is .*leave"):
        ascend_policy(model, track, {}, SETTINGS, 0)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"updates": -1}, "updates must be at least 0, but is -1; 0 is no ascent"),
        ({"num_envs": 0}, "num_envs must be at least 1, but is 0"),
        ({"minibatches": 0}, "minibatches must be at least 1, but is 0"),
        ({"fading": 1.5}, r"fading must be in \[0, 1\], but is 1.5"),
        ({"learning_rate": 0.0}, "learning_rate must be positive, but is 0.0"),
        ({"largest": 0.0}, "largest must be positive, but is 0.0"),
        ({"aim": 1.1}, r"aim must be in \(0, 1\], but is 1.1; it is a part of the displacement limit"),
        ({"penalty": float("inf")}, "penalty must be 0 or more and finite, but is inf"),
    ],
)
def test_senseless_settings_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        AscentSettings(**settings)
