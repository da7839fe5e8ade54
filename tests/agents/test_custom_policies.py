"""Policies of a user's own: made from instances, classes, functions and models, and evaluated as any other."""

import os
import re
import sys

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3 import A2C, PPO, SAC, TD3
from stable_baselines3.common.vec_env import VecCheckNan, VecFrameStack, VecNormalize
from tables import table

from agents import make_policy, save_policy
from agents.evaluation.policy_evaluation import evaluate_policies
from agents.leaderboard.protocol import policy_fingerprint
from agents.policies.networks.trained_policy import load_policy
from agents.sb3_vec_env import DuffingVecEnv
from agents.training import TrainConfig, train
from agents.training.algorithms import PPOSettings

FEATURES = 22
SHORT = {"env_id": "duffing_env/Short-v0", "systems": 4, "options": {"horizon": 6}}


class Push:
    """Applies a constant input."""

    def __init__(self, seed, strength=1.0):
        self.seed, self.strength = seed, strength

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        return np.full((*np.shape(observation)[:-1], 1), self.strength, dtype=np.float32), state


def against_displacement(observations):
    return -np.sign(observations[:, :1])


def observations(count=50, seed=0):
    return np.random.default_rng(seed).normal(0.0, 1.0, (count, FEATURES)).astype(np.float32)


def test_an_object_that_predicts_is_a_policy():
    policy = Push(seed=0)
    assert make_policy(policy) is policy


def test_a_class_is_called_with_what_it_takes():
    policy = make_policy(Push, env=object(), seed=3, strength=0.5)
    assert (policy.seed, policy.strength) == (3, 0.5)
    with pytest.raises(ValueError, match=r"power=2 is no option of Push, which has \['seed', 'strength'\]"):
        make_policy(Push, power=2)


@table("function", [against_displacement, lambda x: against_displacement(x)[:, 0]])
def test_a_function_of_observations_is_a_policy(function):
    policy, seen = make_policy(function), observations()
    actions, state = policy.predict(seen, "state")
    np.testing.assert_array_equal(actions, -np.sign(seen[:, :1]))
    assert (state, actions.dtype) == ("state", np.float32)
    single, _ = policy.predict(seen[0])
    np.testing.assert_array_equal(single, actions[0])


@table("dtype", [torch.float32, torch.float64])
def test_a_module_of_torch_is_a_policy(dtype):
    torch.manual_seed(0)
    network, seen = torch.nn.Linear(FEATURES, 1, dtype=dtype), observations()
    actions, _ = make_policy(network).predict(seen)
    expected = network(torch.from_numpy(seen).to(dtype)).detach().numpy().clip(-1, 1)
    np.testing.assert_allclose(actions, expected, atol=1e-6)
    assert actions.dtype == np.float32
    assert np.abs(actions).max() == 1


@table("given", [np.zeros((3, 2)), np.zeros(2), np.array([0, np.nan, 0])])
def test_a_function_that_gives_something_else_is_refused(given):
    with pytest.raises(ValueError, match="policy must give a finite action for each of 3 observations"):
        make_policy(lambda seen: given).predict(observations(3))


@table(
    ("thing", "options", "message"),
    [(3, {}, "policy must have predict, or be a function"), (Push(0), {"strength": 1}, "options must be none")],
)
def test_what_is_no_policy_is_refused(thing, options, message):
    with pytest.raises(ValueError, match=message):
        make_policy(thing, **options)


def test_policies_in_a_file_are_found_by_module_and_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    (tmp_path / "laboratory.py").write_text("def push(seen):\n    return seen[:, 0] * 0 + 1\n")
    (push,) = evaluate_policies(["laboratory:push"], **SHORT)
    (named,) = evaluate_policies([Push(0)], **SHORT)
    assert (push.policy, named.policy) == ("laboratory:push", "Push")
    np.testing.assert_array_equal(push.inputs, named.inputs)
    with pytest.raises(ValueError, match="laboratory has no 'pull'"):
        make_policy("laboratory:pull")
    with pytest.raises(ValueError, match="policies must differ by their names"):
        evaluate_policies([Push(0), Push(1)], **SHORT)


def test_a_policy_of_an_observation_by_a_function_says_what_it_needs(tmp_path):
    env = gym.make("duffing_env/Short-v0", observation=lambda beliefs: beliefs.coefficients_mean)
    save_policy(tmp_path / "mine", PPO("MlpPolicy", env, device="cpu"))
    with pytest.raises(ValueError, match=r"make it with the option observation=your function$"):
        evaluate_policies([str(tmp_path / "mine")], **SHORT)


class Forgetful:
    """Takes two arguments only."""

    def predict(self, observation, state=None):
        raise AssertionError("it is refused before it is asked")


class Picky:
    """Takes observations of another track only."""

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        raise ValueError("observation must have 35 entries")


def test_an_error_of_a_policy_names_the_policy(monkeypatch):
    message = r"policy Forgetful must have predict\(observation, .*, but its predict is \(observation, state=None\)"
    with pytest.raises(ValueError, match=message):
        evaluate_policies([Forgetful()], **SHORT)
    with pytest.raises(ValueError, match="policy Picky does not play duffing_env/Short-v0: observation must have 35"):
        evaluate_policies([Picky()], **SHORT)


@table(
    ("actions", "message"),
    [
        (np.full((4, 1), np.nan, dtype=np.float32), "must be finite, but row 0 is nan"),
        (np.zeros(4, dtype=np.float32), r"must have shape \(4, 1\), but have \(4,\)"),
    ],
)
def test_invalid_actions_name_the_policy(actions, message):
    class Broken(Push):
        def predict(self, observation, state=None, episode_start=None, deterministic=False):
            return actions, state

    with pytest.raises(ValueError, match=f"policy Broken does not play duffing_env/Short-v0: actions {message}"):
        evaluate_policies([Broken(0.5)], **SHORT)


def normalised_model(kind=PPO, **settings):
    envs = VecNormalize(VecCheckNan(DuffingVecEnv("duffing_env/Short-v0", 4, seed=0)), clip_obs=2.0)
    steps = {"n_steps": 8} if kind in (PPO, A2C) else {"learning_starts": 4, "buffer_size": 100}
    return kind("MlpPolicy", envs, seed=0, device="cpu", **steps, **settings).learn(32), envs


@table("kind", [PPO, A2C, SAC, TD3])
def test_the_normaliser_goes_with_the_policy(tmp_path, kind):
    model, envs = normalised_model(kind, **({"batch_size": 32} if kind is PPO else {}))
    save_policy(tmp_path / "mine", model)
    saved, instance, seen = make_policy(str(tmp_path / "mine")), make_policy(model), 3 * observations()
    expected, _ = model.predict(envs.normalize_obs(seen), deterministic=True)
    forgotten, _ = model.predict(seen, deterministic=True)
    assert np.abs(expected - forgotten).max() > 1e-3
    np.testing.assert_array_equal(instance.predict(seen, deterministic=True)[0], expected)
    np.testing.assert_allclose(saved.predict(seen, deterministic=True)[0], expected, atol=2e-6)
    assert saved.card["algorithm"] == kind.__name__.lower()
    assert saved.card["steps"] == model.num_timesteps


def test_elu_is_played(tmp_path):
    model, envs = normalised_model(batch_size=32, policy_kwargs={"activation_fn": torch.nn.ELU})
    save_policy(tmp_path, model)
    expected, _ = model.predict(envs.normalize_obs(observations()), deterministic=True)
    np.testing.assert_allclose(
        make_policy(str(tmp_path)).predict(observations(), deterministic=True)[0], expected, atol=2e-6
    )


@table(
    ("settings", "message"),
    [
        ({"policy_kwargs": {"activation_fn": torch.nn.GELU}}, "but has the activation gelu"),
        ({"use_sde": True}, "but has exploration that depends on the state"),
    ],
)
def test_what_cannot_be_played_is_not_saved(tmp_path, settings, message):
    model = PPO("MlpPolicy", DuffingVecEnv("duffing_env/Short-v0", 4), device="cpu", **settings)
    with pytest.raises(ValueError, match=message):
        save_policy(tmp_path / "mine", model)
    assert list(tmp_path.iterdir()) == []


def test_a_wrapper_that_is_not_written_is_refused(tmp_path):
    model = PPO("MlpPolicy", VecFrameStack(DuffingVecEnv("duffing_env/Short-v0", 4), 3), device="cpu")
    with pytest.raises(ValueError, match="but sees it through VecFrameStack"):
        save_policy(tmp_path / "mine", model)


class Halved(gym.ActionWrapper):
    """Halves every action."""

    def action(self, action):
        return action / 2


class Three(gym.ActionWrapper):
    """Chooses one of three inputs, which are not evenly spaced."""

    def __init__(self, env):
        super().__init__(env)
        self.action_space = gym.spaces.Discrete(3)

    def action(self, action):
        return np.array([(-1.0, 0.5, 1.0)[action]], dtype=np.float32)


class Stacked(gym.Wrapper):
    """Shows every observation twice, though it is no `ObservationWrapper`."""

    def __init__(self, env):
        super().__init__(env)
        self.observation_space = gym.spaces.Box(-10, 10, (2 * FEATURES,), np.float32)

    def reset(self, **how):
        seen, info = self.env.reset(**how)
        return np.tile(seen, 2), info


def normalised(env):
    from gymnasium.wrappers import NormalizeObservation

    return NormalizeObservation(env)


@table(
    ("wrap", "name"), [(normalised, "NormalizeObservation"), (Halved, "Halved"), (Three, "Three"), (Stacked, "Stacked")]
)
def test_a_wrapper_of_gymnasium_that_would_not_be_played_is_refused(tmp_path, wrap, name):
    model = PPO("MlpPolicy", wrap(gym.make("duffing_env/Short-v0")), device="cpu")
    message = (
        f"model must see its environment as it is or through VecNormalize, but it is wrapped in {name}; train without"
    )
    with pytest.raises(ValueError, match=message):
        save_policy(tmp_path / "mine", model)
    with pytest.raises(ValueError, match=message):
        make_policy(model)
    assert list(tmp_path.iterdir()) == []


def test_wrappers_that_change_nothing_are_no_matter(tmp_path):
    from gymnasium.wrappers import RecordEpisodeStatistics, TimeLimit, TransformReward

    env = TimeLimit(RecordEpisodeStatistics(gym.make("duffing_env/Short-v0")), 20)
    model = PPO("MlpPolicy", TransformReward(env, lambda reward: 2 * reward), device="cpu")
    save_policy(tmp_path, model)
    expected, _ = model.predict(observations(), deterministic=True)
    for policy in (make_policy(str(tmp_path)), make_policy(model)):
        np.testing.assert_allclose(
            policy.predict(observations(), deterministic=True)[0].clip(-1, 1), expected, atol=2e-6
        )


def test_numbers_as_actions_are_those_of_our_levels(tmp_path):
    envs = DuffingVecEnv("duffing_env/Short-v0", 2, levels=3)
    model = PPO("MlpPolicy", VecNormalize(envs), n_steps=8, batch_size=16, device="cpu")
    save_policy(tmp_path / "mine", model)
    model.env = None  # as of an archive that is opened without one
    with pytest.raises(ValueError, match=r"its actions are 3 numbers of another environment; train and save it with"):
        save_policy(tmp_path / "other", model)


def test_an_archive_says_how_it_is_converted(tmp_path):
    (tmp_path / "model.zip").write_bytes(b"")
    with pytest.raises(ValueError, match=r"agents.save_policy\('.*/model', PPO.load"):
        make_policy(str(tmp_path / "model.zip"))


def sequence(between=torch.nn.ReLU, *after):
    torch.manual_seed(0)
    return torch.nn.Sequential(torch.nn.Linear(FEATURES, 8), between(), torch.nn.Linear(8, 1), *after)


@table("between", [torch.nn.Tanh, torch.nn.ReLU, torch.nn.ELU])
@table("after", [(), (torch.nn.Tanh(),)])
def test_a_network_alone_is_saved_with_what_it_sees(tmp_path, between, after):
    model, seen = sequence(between, *after), observations()
    mean, std = np.full(FEATURES, 0.1), np.linspace(0.2, 1.0, FEATURES)
    save_policy(tmp_path, model, {"steps": 5}, normalizer=(mean, std, 2.0))
    shown = ((seen - mean) / std).clip(-2, 2).astype(np.float32)
    expected = model(torch.from_numpy(shown)).detach().numpy().clip(-1, 1)
    policy = make_policy(str(tmp_path))
    np.testing.assert_allclose(policy.predict(seen)[0], expected, atol=1e-6)
    assert policy.card["steps"] == 5
    save_policy(tmp_path, model)
    plain = model(torch.from_numpy(seen)).detach().numpy().clip(-1, 1)
    np.testing.assert_allclose(make_policy(str(tmp_path)).predict(seen)[0], plain, atol=1e-6)


@table(
    ("model", "message"),
    [
        (sequence(torch.nn.GELU), r"but is \['linear', 'gelu', 'linear'\]"),
        (torch.nn.Sequential(torch.nn.ReLU()), "must be linear layers"),
        (torch.nn.LSTM(FEATURES, 1), r"but is \['lstm'\]"),
        (torch.nn.Linear(FEATURES, 2), "0.weight must be finite float32 of shape"),
        (torch.nn.Linear(FEATURES, 1, bias=False), "must have a bias in every layer, but '0.bias' is missing"),
        (torch.nn.ELU(2.0), "must be linear layers"),
        (sequence(lambda: torch.nn.ELU(2.0)), r"ELU\(alpha=2.0\)"),
    ],
)
def test_a_network_alone_that_could_not_be_played_is_refused(tmp_path, model, message):
    with pytest.raises(ValueError, match=message):
        save_policy(tmp_path / "new", model)
    assert not (tmp_path / "new").exists()


@table(
    ("normalizer", "message"),
    [
        ((np.zeros(FEATURES), np.zeros(FEATURES), 10.0), "normalizer.std must be positive, but is 0.0 somewhere"),
        ((np.zeros(FEATURES), np.full(FEATURES, 1e-60), 10.0), "normalizer.std must be positive, but is 0.0 somewhere"),
        (
            (np.zeros(FEATURES), np.full(FEATURES, np.inf), 10.0),
            "normalizer.std must be finite .*, but 22 of its 22 numbers are not finite",
        ),
        ((np.full(FEATURES, np.nan), np.ones(FEATURES), 10.0), "normalizer.mean must be finite .*, but 22 of its 22"),
        (
            (np.zeros(FEATURES), np.ones(FEATURES), -1.0),
            r"normalizer\[2\] must be a number from .*, but is -1.0; pass e.g.",
        ),
        (
            (np.zeros(FEATURES), np.ones(FEATURES), 0.0),
            r"normalizer\[2\] must be a number from .*, but is 0.0; pass e.g.",
        ),
        ((np.zeros(FEATURES), "ones", 10.0), r"normalizer\[1\] must be numbers, but is 'ones'"),
        (
            (np.zeros(FEATURES), np.ones(FEATURES)),
            r"(?s)normalizer must be mean, standard deviation, .*; pass all three",
        ),
        (3, "normalizer must be mean, standard deviation, .*, but is 3; pass all three"),
    ],
)
def test_a_normaliser_that_cannot_be_played_is_refused(tmp_path, normalizer, message):
    with pytest.raises(ValueError, match=message):
        save_policy(tmp_path / "new", sequence(), normalizer=normalizer)
    assert not (tmp_path / "new").exists()


@table("kind", ["network", "algorithm"])
def test_weights_that_are_not_finite_are_refused(tmp_path, kind):
    model = sequence() if kind == "network" else PPO("MlpPolicy", gym.make("duffing_env/Short-v0"), device="cpu")
    layer = model[2] if kind == "network" else model.policy.action_net
    torch.nn.init.constant_(layer.weight, float("nan"))
    with pytest.raises(
        ValueError, match=r"weight must be finite .*, but .* of its .* numbers are not finite; find what made them so"
    ):
        save_policy(tmp_path / "new", model)
    assert not (tmp_path / "new").exists()


def test_a_network_for_other_observations_is_refused_by_name():
    message = r"policy Sequential does not play duffing_env/Short-v0: it must take observations of shape \(4, 22\), but"
    with pytest.raises(ValueError, match=message):
        evaluate_policies([torch.nn.Sequential(torch.nn.Linear(10, 1))], **SHORT)


HISTORY = {"observation": "history", "history": 10}


@table("how", ["saved", "trained", "card", "config"])
def test_a_policy_plays_the_observation_that_it_learned_from(tmp_path, how):
    """A history of ten samples has as many entries as the posterior."""
    mine = str(tmp_path / "mine")
    if how == "saved":
        model = PPO(
            "MlpPolicy", DuffingVecEnv("duffing_env/Short-v0", 2, **HISTORY), device="cpu", n_steps=8, batch_size=16
        )
        save_policy(mine, model)
    elif how == "trained":
        tiny = PPOSettings(num_envs=4, n_steps=8, batch_size=32, hidden=(4,), features=False)
        train(TrainConfig(env="Short-v0", steps=32, hyperparameters=tiny, output=tmp_path / "mine", options=HISTORY))
    else:
        card = {"observation": "history"} if how == "card" else {"config": {"options": HISTORY}}
        save_policy(mine, sequence(), card)
    message = (
        r"mine: env must show the observation 'history', which the policy learned from, but shows 'posterior'; make it"
    )
    with pytest.raises(ValueError, match=message):
        evaluate_policies([mine], **SHORT)
    (found,) = evaluate_policies([mine], SHORT["env_id"], 4, options={"horizon": 6, **HISTORY})
    assert np.isfinite(found.inputs).all()


def test_a_policy_of_the_posterior_does_not_play_a_history(tmp_path):
    save_policy(tmp_path / "mine", PPO("MlpPolicy", gym.make("duffing_env/Short-v0"), device="cpu"))
    assert make_policy(tmp_path / "mine").card["observation"] == "posterior"
    for name in (str(tmp_path / "mine"), "ppo/short"):
        with pytest.raises(ValueError, match="must show the observation 'posterior', which the policy learned from"):
            evaluate_policies([name], SHORT["env_id"], 4, options=HISTORY)


def everything(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_run_is_not_replaced_and_a_policy_is(tmp_path):
    tiny = PPOSettings(num_envs=4, n_steps=8, batch_size=32, hidden=(4,))
    run = train(TrainConfig(env="Short-v0", steps=32, hyperparameters=tiny, output=tmp_path / "run", checkpoints=1))
    before = everything(run.folder)
    with pytest.raises(ValueError, match=r"folder must be a folder for a policy, but .*run holds a run; remove it or"):
        save_policy(run.folder, sequence())
    assert everything(run.folder) == before
    (run.folder / "policy.json").unlink()  # as a training that was stopped leaves it
    with pytest.raises(ValueError, match="holds a run"):
        save_policy(run.folder, sequence())
    with pytest.raises(NotADirectoryError, match=r"folder must be a folder, but .*config.json is a file"):
        save_policy(run.folder / "config.json", sequence())
    for steps in (1, 2):
        save_policy(tmp_path / "mine", sequence(), {"steps": steps})
        assert make_policy(tmp_path / "mine").card["steps"] == steps


@table(
    ("card", "message"),
    [
        (
            {"steps": 2, "loss": np.float32(0.1)},
            r"card\['loss'\] must be what JSON can hold, but is .*0.1.*; pass e.g.",
        ),
        ({"config": {"output": object}}, r"card\['config'\] must be what JSON can hold, but is {'output'"),
        ({"steps": -5}, r"card\['steps'\] must be a whole number from 0 to 1000000000000000, but is -5"),
        ({"steps": "many"}, r"card\['steps'\] must be a whole number from 0 to 1000000000000000, but is 'many'"),
        ({3: 2}, "card must be a dictionary from names to values, but is {3: 2}"),
        ([3], r"card must be a dictionary from names to values, but is \[3\]"),
    ],
)
def test_a_card_that_cannot_be_written_is_refused_and_leaves_what_was_there(tmp_path, card, message):
    save_policy(tmp_path, sequence(), {"steps": 1})
    before = everything(tmp_path)
    for folder in (tmp_path, tmp_path / "new"):
        with pytest.raises(ValueError, match=message):
            save_policy(folder, sequence(torch.nn.Tanh), card)
    assert everything(tmp_path) == before
    assert not (tmp_path / "new").exists()


def test_the_card_of_another_policy_says_nothing_of_the_network(tmp_path):
    save_policy(tmp_path / "first", sequence(torch.nn.Tanh), {"steps": 1})
    card = load_policy(tmp_path / "first").card
    save_policy(tmp_path / "second", sequence(), card)
    assert load_policy(tmp_path / "second").card["network"]["activation"] == "relu"


@table("failing", [1, 2, 3, 4])
def test_a_policy_that_is_half_written_is_no_policy(tmp_path, monkeypatch, failing):
    """Each file is renamed once beside the policy, and once into its place."""
    save_policy(tmp_path, sequence(), {"steps": 1})
    before, replace, calls = everything(tmp_path), os.replace, []

    def fails(source, target):
        calls.append(target)
        if len(calls) == failing:
            raise OSError(28, "No space left on device")
        replace(source, target)

    monkeypatch.setattr(os, "replace", fails)
    with pytest.raises(OSError, match="No space left"):
        save_policy(tmp_path, sequence(torch.nn.Tanh), {"steps": 2})
    assert everything(tmp_path) == before if failing < 3 else not (tmp_path / "policy.json").exists()
    assert all(path.is_file() for path in tmp_path.iterdir())


@pytest.mark.parametrize("name", ["efe", "ppo/short", "velocity-sign", "prbs"])
def test_an_environment_of_stable_baselines3_is_taken_as_it_is(name):
    envs = DuffingVecEnv("duffing_env/Short-v0", 2, seed=0, max_input=0.1)
    expected, _ = make_policy(name, envs.envs).predict(envs.reset(), deterministic=True)
    for held in (envs, VecCheckNan(envs), VecNormalize(envs, norm_obs=False)):
        actions, _ = make_policy(name, held).predict(envs.envs.last_observations, deterministic=True)
        np.testing.assert_array_equal(actions, expected)
    normalised = VecNormalize(envs)
    if name == "prbs":
        np.testing.assert_array_equal(make_policy(name, normalised).predict(normalised.reset())[0], expected)
    else:
        with pytest.raises(ValueError, match=r"VecNormalize changes them, .* without it, or choose a signal"):
            make_policy(name, VecCheckNan(normalised))
    with pytest.raises(ValueError, match=r"env must take inputs as actions, but .* Discrete\(5\); make it without"):
        make_policy(name, DuffingVecEnv("duffing_env/Short-v0", 2, seed=0, levels=5))


def test_a_model_does_not_normalise_twice():
    envs = VecNormalize(DuffingVecEnv("duffing_env/Short-v0", 2, seed=0))
    model = PPO("MlpPolicy", envs, n_steps=4, batch_size=8, device="cpu")
    make_policy(model, envs.venv)
    with pytest.raises(ValueError, match=r"env must show its observations as they are, .* VecNormalize, too"):
        make_policy(model, envs)


def test_a_normaliser_beside_an_algorithm_is_refused(tmp_path):
    model = PPO("MlpPolicy", DuffingVecEnv("duffing_env/Short-v0", 2, seed=0), device="cpu")
    with pytest.raises(ValueError, match="normalizer must be None for an algorithm"):
        save_policy(tmp_path, model, normalizer=(0.0, 1.0, 10.0))


@pytest.mark.parametrize(
    ("policy", "message"),
    [
        (
            "os:system",
            "policy must be an object or a function of your own, but os:system is <built-in function system>",
        ),
        ("os:path", "policy must be an object or a function of your own, but os:path is <module"),
        ("os:makedirs", "policy must be one, but os:makedirs fails: TypeError"),
        ("os:nothing", "os has no 'nothing'; name one it has"),
        ("enum:Enum", "policy must be one, but enum:Enum fails: TypeError"),
        ("decimal:Context", "policy must have predict, or be a function of observations"),
        ("broken_of_tests:policy", "'broken_of_tests' cannot be imported: SyntaxError"),
        ("leaving_of_tests:policy", "'leaving_of_tests' cannot be imported: SystemExit: 3"),
        ("needing_of_tests:policy", "needing_of_tests needs another package: No module named 'no_such_package'"),
        ("failing_of_tests:policy", "policy must be one, but failing_of_tests:policy fails: KeyError: 'gone' ("),
        (".:policy", "cannot be imported"),
    ],
)
def test_an_invalid_policy_gives_one_sentence(policy, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "broken_of_tests.py").write_text("policy = (\n")
    (tmp_path / "leaving_of_tests.py").write_text("raise SystemExit(3)\n")
    (tmp_path / "needing_of_tests.py").write_text("import no_such_package\n")
    (tmp_path / "failing_of_tests.py").write_text("def policy(seen):\n    return {}['gone']\n")
    with pytest.raises(ValueError, match=re.escape(message)):
        evaluate_policies([policy], **SHORT)


def test_an_object_of_a_module_has_the_fingerprint_of_its_class(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "object_of_tests.py").write_text("class Still:\n    predict = None\npolicy = Still()\n")
    assert policy_fingerprint("object_of_tests:policy") == policy_fingerprint("object_of_tests:Still") != ""
