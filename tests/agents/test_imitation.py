"""Imitation: a network that comes to act as its teacher does."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from stable_baselines3 import PPO

from agents import make_policy
from agents.actor import Actor, at_rest, turned
from agents.evaluation import make
from agents.imitation import ImitationSettings, imitate
from agents.vec_env import DuffingVecEnv

TRACK, OPTIONS = "duffing_env/Short-v0", {"horizon": 32}
SETTINGS = ImitationSettings(labels=8192, rounds=2, num_envs=64, teacher="velocity-sign", fits=80, batch_size=256)


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def make_model(hidden=(32,)):
    envs = DuffingVecEnv(TRACK, 2, seed=0, **OPTIONS)
    return PPO(
        "MlpPolicy", envs, n_steps=8, batch_size=16, policy_kwargs={"net_arch": list(hidden)}, seed=0, device="cpu"
    )


def imitated(settings=SETTINGS, seed=0, hidden=(32,)):
    model, told = make_model(hidden), []
    imitate(model, TRACK, OPTIONS, settings, seed, lambda labels, error: told.append((labels, error)))
    return model, told


@pytest.fixture(scope="module")
def pupil():
    return imitated()


def episode(act):
    """Gain of 64 systems (64,), and how often the action has the sign of the velocity-sign policy's."""
    envs = make(TRACK, 64, {**OPTIONS, "reward": "fisher"})
    teacher = make_policy("velocity-sign", envs)
    observations, _ = envs.reset(seed=9)
    state, gains, agreed, running = None, np.zeros(64), [], np.ones(64, dtype=bool)
    for t in range(envs.horizon):
        labels, state = teacher.predict(observations, state, np.full(64, t == 0))
        actions = act(observations)
        if t:
            agreed.append((np.sign(actions) == np.sign(labels))[running].mean())
        observations, rewards, terminated, truncated, _ = envs.step(actions)
        gains += np.where(running, rewards, 0)
        running &= ~(terminated | truncated)
        if not running.any():
            break
    return gains, np.mean(agreed)


def test_the_network_comes_to_act_as_its_teacher_and_is_worth_more(pupil):
    model, _ = pupil
    gains, agreed = episode(lambda observations: model.predict(observations, deterministic=True)[0])
    fresh = make_model()
    untrained, by_chance = episode(lambda observations: fresh.predict(observations, deterministic=True)[0])
    assert agreed > 0.85 > by_chance + 0.1
    assert gains.mean() > untrained.mean() + 3


def test_progress_tells_labels_and_errors_that_fall(pupil):
    _, told = pupil
    assert [labels for labels, _ in told] == [4096, 8192]
    assert all(0 < error < 1 for _, error in told)


def test_the_same_seed_gives_the_same_weights_and_another_one_others():
    few = replace(SETTINGS, labels=1024, fits=4)
    first, again, other = (imitated(few, seed)[0].policy.state_dict() for seed in (0, 0, 1))
    for name, tensor in first.items():
        assert torch.equal(tensor, again[name]), name
    assert not torch.equal(first["action_net.weight"], other["action_net.weight"])


def test_critic_and_exploration_stay_as_they_are(pupil):
    before, after = make_model().policy.state_dict(), pupil[0].policy.state_dict()
    changed = {name for name in before if not torch.equal(before[name], after[name])}
    assert changed == {
        "mlp_extractor.policy_net.0.weight", "mlp_extractor.policy_net.0.bias", "action_net.weight", "action_net.bias",
    }  # fmt: skip


@pytest.mark.parametrize("hidden", [(), (5, 7)])
def test_any_hidden_layers_learn(hidden):
    model, _ = imitated(ImitationSettings(256, "velocity-sign", rounds=2, num_envs=16), hidden=hidden)
    before = make_model(hidden).policy.state_dict()
    assert not torch.equal(before["action_net.weight"], model.policy.state_dict()["action_net.weight"])


def test_no_labels_change_nothing():
    before, after = make_model().policy.state_dict(), imitated(ImitationSettings())[0].policy.state_dict()
    assert all(torch.equal(before[name], after[name]) for name in before)


def test_a_standard_changes_the_weights_and_not_the_function():
    actor = Actor(make_model())
    observations = np.random.default_rng(0).normal(3.0, 0.5, (200, 22)).astype(np.float32)
    expected, weight = actor.act(observations), actor.parameters[0].detach().clone()
    with actor.standardised(observations) as standard:
        assert np.abs(standard(observations).mean(axis=0)).max() < 1e-3
        np.testing.assert_allclose(standard(observations).std(axis=0), 1, rtol=1e-3)
        np.testing.assert_allclose(actor.act(standard(observations)), expected, atol=1e-5)
        assert not torch.allclose(actor.parameters[0], weight)
    np.testing.assert_allclose(actor.act(observations), expected, atol=1e-5)


def test_what_is_turned_over_is_the_oscillator_in_motion():
    envs = make(TRACK, 200, OPTIONS)
    rest, _ = envs.reset(seed=0)
    motion = envs.step(np.ones((200, 1), dtype=np.float32))[0]
    assert at_rest(rest).all()
    assert not at_rest(motion).any()
    same, signs = turned(rest, np.random.default_rng(0))
    np.testing.assert_array_equal(same, rest)
    assert np.all(signs == 1)
    over, signs = turned(motion, np.random.default_rng(0))
    assert 60 < np.sum(signs < 0) < 140
    np.testing.assert_array_equal(over[:, 16:20], signs[:, None] * motion[:, 16:20])
    np.testing.assert_array_equal(np.delete(over, range(16, 20), axis=1), np.delete(motion, range(16, 20), axis=1))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"labels": -1}, "labels must be at least 0, but is -1; 0 is no imitation"),
        ({"labels": 100}, r"labels must be at least rounds \* num_envs = 1024, but is 100; ask for more labels"),
        ({"rounds": 0}, "rounds must be at least 1, but is 0"),
        ({"num_envs": 0}, "num_envs must be at least 1, but is 0"),
        ({"fits": 0}, "fits must be at least 1, but is 0"),
        ({"batch_size": 0}, "batch_size must be at least 1, but is 0"),
        ({"learning_rate": 0.0}, "learning_rate must be positive, but is 0.0"),
    ],
)
def test_senseless_settings_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        ImitationSettings(**settings)


def test_an_unknown_teacher_is_refused():
    with pytest.raises(ValueError, match=r"name must be one of .*but it is 'eef'; did you mean 'efe'"):
        imitated(ImitationSettings(labels=1024, teacher="eef"))
