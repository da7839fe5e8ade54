"""Learned policies: saved, loaded and acting as they did in Stable-Baselines3, with nothing ever unpickled."""

import ast
import json
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from rounding import Rounded, play
from safetensors.numpy import load_file, save_file
from tables import table

import agents
from agents import make_policy
from agents.evaluation.policy_evaluation import evaluate_policies
from agents.policies.networks.policy_saving import save_policy
from agents.policies.networks.trained_policy import CARD_FILE, WEIGHTS_FILE, load_policy
from agents.sb3_vec_env import DuffingVecEnv
from agents.training import ALGORITHMS

FEATURES = 22


def make_model(hidden=(16, 8), algo="ppo", log_std=-0.5, activation="tanh", **settings):
    """A model with random weights, so large that tanh and clipping matter."""
    if algo in ("tqc", "recurrent_ppo"):
        pytest.importorskip("sb3_contrib", reason="sb3-contrib is not installed; it is the extra contrib")
    found = ALGORITHMS[algo](num_envs=2, batch_size=64, hidden=hidden, activation=activation, **settings)
    model = found.make(DuffingVecEnv("duffing_env/Amplitude-v0", 2, levels=settings.get("levels", 0)), seed=0)
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for name, parameter in model.policy.named_parameters():
            parameter.normal_(0.0, 0.6, generator=generator) if name != "log_std" else parameter.fill_(log_std)
    return model


def saved(folder, card=None, **settings):
    """A policy folder, and the model that it was saved from."""
    model = make_model(**settings)
    save_policy(folder, model, card or {})
    return folder, model


def random_observations(count=200, seed=0):
    return np.random.default_rng(seed).normal(0.0, 1.0, (count, FEATURES)).astype(np.float32)


def rounding_of(folder, observations, state=None):
    """How far two float32 programs can differ in the actions and the next memory of a saved policy.

    The observations and the memory are the same for both.
    """
    network = json.loads((folder / CARD_FILE).read_text())["network"]
    if state is not None:
        state = tuple(Rounded.exact(values[0]) for values in state)
    actions, state = play(load_file(folder / WEIGHTS_FILE), network, observations, state)
    assert np.median(actions) < 0.01  # or the comparison would say little of actions in [-1, 1]
    return actions, None if state is None else np.array([[2 * values.error] for values in state])


def assert_acts_as(policy, model, folder, observations):
    actions, _ = policy.predict(observations, deterministic=True)
    expected, _ = model.predict(observations, deterministic=True)
    assert (np.abs(actions - expected) <= rounding_of(folder, observations)[0]).all()
    return actions


@table("hidden", [(16, 8), (), (4, 5, 6, 7, 8, 9), (8,) * 7])
def test_loaded_policy_acts_as_the_model(tmp_path, hidden):
    folder, model = saved(tmp_path / "run", hidden=hidden)
    policy = load_policy(folder)
    observations = random_observations()
    actions = assert_acts_as(policy, model, folder, observations)
    assert actions.shape == (200, 1)
    assert actions.dtype == np.float32
    assert policy.predict(observations, deterministic=True)[1] is None
    assert np.std(actions) > 0.1
    bound, _ = rounding_of(folder, observations)  # a product of matrices rounds by its size
    for observation, action, slack in zip(observations[:5], actions, bound, strict=False):
        single, _ = policy.predict(observation, deterministic=True)
        assert single.shape == (1,)
        assert np.abs(single - action) <= slack


@pytest.mark.parametrize("algo", ALGORITHMS)
@table("hidden", [(16, 8), (5,), ()])
def test_every_algorithm_is_played_as_stable_baselines_plays_it(tmp_path, algo, hidden):
    folder, model = saved(tmp_path, algo=algo, hidden=hidden)
    policy = load_policy(folder)
    observations = random_observations(2 * 40).reshape(40, 2, FEATURES)
    memory, starts = None, np.ones(2, dtype=bool)
    actions, bounds = [], []
    for t, observation in enumerate(observations):
        # Both go on from the same memory: a network like this one doubles a difference several times within an episode.
        expected, expected_state = model.predict(observation, memory, starts, deterministic=True)
        action, state = policy.predict(observation, memory, starts, deterministic=True)
        assert action.shape == (2, 1)
        assert action.dtype == np.float32
        kept = None if memory is None else [values * ~starts[:, None] for values in memory]
        bound, state_bound = rounding_of(folder, observation, kept)
        assert (np.abs(action - expected) <= bound).all()
        if algo == "recurrent_ppo":
            assert state[0].shape == (1, 2, 32)
            assert (np.abs(np.subtract(state, expected_state)) <= state_bound).all()
            memory = expected_state
        starts = np.array([t % 7 == 0, t % 5 == 0])  # rows begin anew at different times
        actions.append(action)
        bounds.append(bound)
    assert np.std(actions) > 0.1
    single, _ = policy.predict(observations[0, 0], deterministic=True)
    assert single.shape == (1,)
    assert np.abs(single - actions[0][0]) <= bounds[0][0]
    saturated, _ = policy.predict(1e4 * observations[0], deterministic=False)
    assert np.abs(saturated).max() <= 1


@pytest.mark.parametrize("algo", ["ppo", "recurrent_ppo"])
def test_a_choice_of_levels_is_that_of_stable_baselines(tmp_path, algo):
    folder, model = saved(tmp_path, algo=algo, levels=5)
    policy = load_policy(folder)
    levels = np.linspace(-1, 1, 5, dtype=np.float32)
    observations = random_observations()
    numbers, _ = model.predict(observations, deterministic=True)
    actions, _ = policy.predict(observations, deterministic=True)
    assert len(set(numbers.tolist())) == 5
    np.testing.assert_array_equal(actions, levels[numbers][:, None])
    np.testing.assert_array_equal(policy.predict(observations[0], deterministic=True)[0], actions[0])
    if algo == "recurrent_ppo":
        return
    n = 20_000
    drawn, _ = policy.predict(np.repeat(observations[:1], n, axis=0))
    with torch.no_grad():
        odds = model.policy.get_distribution(torch.from_numpy(observations[:1])).distribution.probs[0].numpy()
    shares = (drawn == levels).mean(axis=0)
    assert (np.abs(shares - odds) <= 4 * np.sqrt(odds * (1 - odds) / n) + 1e-6).all()
    again, _ = load_policy(folder).predict(np.repeat(observations[:1], n, axis=0))
    np.testing.assert_array_equal(again, drawn)


def test_a_memory_is_forgotten_where_an_episode_starts(tmp_path):
    folder, _ = saved(tmp_path, algo="recurrent_ppo")
    policy = load_policy(folder)
    first, second = random_observations(4).reshape(2, 2, FEATURES)
    fresh, _ = policy.predict(second, deterministic=True)
    _, state = policy.predict(first, deterministic=True)
    remembered, _ = policy.predict(second, state, deterministic=True)
    mixed, _ = policy.predict(second, state, np.array([True, False]), deterministic=True)
    assert not np.allclose(remembered, fresh, atol=1e-3)
    np.testing.assert_array_equal(mixed, [fresh[0], remembered[1]])
    with pytest.raises(ValueError, match=r"state must be two arrays of shape \(1, 3, 32\)"):
        policy.predict(random_observations(3), state)


@table("algo", ["sac", "tqc"])
def test_squashed_samples_are_those_of_stable_baselines(tmp_path, algo):
    """Same mean and spread before the tanh, by the quartiles of many samples at one observation."""
    folder, model = saved(tmp_path, algo=algo)
    many = np.tile(random_observations(1), (20_000, 1))
    ours, theirs = (np.quantile(p.predict(many)[0], [0.25, 0.5, 0.75]) for p in (load_policy(folder), model))
    np.testing.assert_allclose(ours, theirs, atol=0.05)


def test_td3_does_not_sample(tmp_path):
    policy = load_policy(saved(tmp_path, algo="td3")[0])
    observations = random_observations()
    np.testing.assert_array_equal(policy.predict(observations)[0], policy.predict(observations, deterministic=True)[0])


@table("algo", ["sac", "td3", "tqc"])
def test_critics_do_not_travel(tmp_path, algo):
    folder, _ = saved(tmp_path, algo=algo)
    assert all(name.startswith("actor.") for name in load_file(folder / WEIGHTS_FILE))


def test_every_weight_is_saved_as_it_is(tmp_path):
    folder, model = saved(tmp_path)
    tensors, expected = load_file(folder / WEIGHTS_FILE), model.policy.state_dict()
    assert tensors.keys() == expected.keys()
    for name, tensor in tensors.items():
        np.testing.assert_array_equal(tensor, expected[name].numpy())
    assert sorted(path.name for path in folder.iterdir()) == [CARD_FILE, WEIGHTS_FILE]


def test_saving_again_replaces_the_policy(tmp_path):
    saved(tmp_path, hidden=(4,))
    folder, model = saved(tmp_path, hidden=(5, 6))
    assert_acts_as(load_policy(folder), model, folder, random_observations())


def test_the_card_has_the_given_settings(tmp_path):
    folder, _ = saved(tmp_path, card={"algorithm": "ppo", "steps": 7, "config": {"reward": "log_posterior"}})
    card = load_policy(folder).card
    assert json.loads((folder / CARD_FILE).read_text()) == card
    assert card.pop("network")["activation"] == "tanh"
    settings = {"format": 4, "observation": "posterior", "algorithm": "ppo", "steps": 7}
    assert card == {**settings, "config": {"reward": "log_posterior"}}


def test_actions_are_in_range_and_the_state_is_passed_on(tmp_path):
    folder, model = saved(tmp_path)
    policy = load_policy(folder)
    observations = 20 * random_observations()
    for deterministic in (True, False):
        actions, state = policy.predict(observations, "state", np.ones(200, dtype=bool), deterministic)
        assert state == "state"
        assert np.abs(actions).max() == 1.0
        assert len(np.unique(actions)) > 10
    assert_acts_as(policy, model, folder, observations)


def test_sampling_is_seeded_and_normal_about_the_mean(tmp_path):
    folder, _ = saved(tmp_path, log_std=-3.0)
    inside = next(x for x in random_observations() if abs(load_policy(folder).predict(x, deterministic=True)[0]) < 0.3)
    many = np.tile(inside, (20_000, 1))

    def samples(seed, times=1):
        policy = load_policy(folder, seed)
        return [policy.predict(many)[0][:, 0] for _ in range(times)]

    (first, second), (again,), (other,) = samples(1, times=2), samples(1), samples(2)
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, second)
    assert not np.array_equal(first, other)
    mean, std = load_policy(folder).predict(inside, deterministic=True)[0][0], np.exp(-3.0)
    # five standard errors
    assert first.mean() == pytest.approx(mean, abs=5 * std / np.sqrt(20_000))
    assert first.std() == pytest.approx(std, rel=5 / np.sqrt(40_000))
    assert load_policy(folder, 1).predict(inside)[0].shape == (1,)


@table("shape", [(21,), (3, 23), (22, 3), ()])
def test_a_wrong_observation_is_refused(tmp_path, shape):
    folder, _ = saved(tmp_path)
    with pytest.raises(ValueError, match="observation must have 22 entries, but has shape"):
        load_policy(folder).predict(np.zeros(shape))


@table("missing", [WEIGHTS_FILE, CARD_FILE, None])
def test_a_folder_without_the_files_is_refused(tmp_path, missing):
    folder = tmp_path / "run"
    if missing:
        saved(folder)
        (folder / missing).unlink()
    with pytest.raises(
        ValueError, match=f"must hold {WEIGHTS_FILE} and {CARD_FILE}, but .*run does not; pass a run folder"
    ):
        load_policy(folder)


class Trap:
    """Unpickled, it writes a file."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.write_text, (self.path, "sprung")


def test_pickles_and_archives_are_refused_unopened(tmp_path):
    sprung = tmp_path / "sprung"
    folder = tmp_path / "run"
    folder.mkdir()
    make_model().save(folder / "policy.zip")
    for name in ("policy.pkl", "policy.pth", "data"):
        (folder / name).write_bytes(pickle.dumps(Trap(sprung)))
    for path in (folder, folder / "policy.zip", folder / "policy.pkl"):
        with pytest.raises(ValueError, match="must hold"):
            make_policy(str(path))
    (folder / CARD_FILE).write_text('{"format": 4}')
    for content in (pickle.dumps(Trap(sprung)), (folder / "policy.zip").read_bytes()):
        (folder / WEIGHTS_FILE).write_bytes(content)
        with pytest.raises(ValueError, match=r"must hold sound files, but .*run does not"):
            load_policy(folder)
    assert not sprung.exists()
    pickle.loads((folder / "policy.pkl").read_bytes())  # the trap would have sprung
    assert sprung.exists()


@table(
    ("card", "message"),
    [
        ('{"format": 99}', "must have format 4, but .*policy.json has 99"),
        ("{}", "must have format 4, but .*policy.json has None"),
        ("[1]", "must have format 4, but .*policy.json has None"),
        ('{"format": 4}', "must be what its card says, but .* is not: KeyError"),
        ('{"format": 4, "network": {"layers": ["elsewhere"]}}', "KeyError.'elsewhere.weight'"),
        ('{"format": 4, "network": {"layers": []}}', "IndexError"),
        ('{"format": 4, "network": {"layers": ["action_net"], "activation": "swish"}}', "KeyError.'swish'"),
        ('{"format": 4, "network": {"layers": ["action_net"], "depth": 3}}', "TypeError.*depth"),
        ('{"format": 4', "must hold sound files"),
        ("", "must hold sound files"),
        ("[" * 100_000, "must hold sound files"),
        ("\0\xff", "must hold sound files"),
        (
            '{"format": 4, "network": {"layers": ["action_net"], "levels": 1000000000000}}',
            "must be finite float32 of shape",
        ),
        ('{"format": 4, "network": "action_net"}', "must be what its card says"),
    ],
)
def test_an_unknown_card_is_refused(tmp_path, card, message):
    folder, _ = saved(tmp_path)
    (folder / CARD_FILE).write_text(card)
    with pytest.raises(ValueError, match=message):
        load_policy(folder)


def test_cut_off_weights_are_refused(tmp_path):
    folder, _ = saved(tmp_path)
    (folder / WEIGHTS_FILE).write_bytes((folder / WEIGHTS_FILE).read_bytes()[:-10])
    with pytest.raises(ValueError, match="must hold sound files"):
        load_policy(folder)


CHANGED = {
    "not a number": ("action_net.bias", lambda t: t * np.float32(np.nan)),
    "infinite": ("mlp_extractor.policy_net.0.weight", lambda t: t / np.float32(0)),
    "an empty bias": ("action_net.bias", lambda t: t[:0]),
    "a bias that is too long": ("mlp_extractor.policy_net.0.bias", lambda t: np.tile(t, 2)),
    "two actions": ("action_net.weight", lambda t: np.tile(t, (2, 1))),
    "a weight that does not take what comes": ("mlp_extractor.policy_net.2.weight", lambda t: t[:, :-1]),
    "a weight of three sides": ("action_net.weight", lambda t: t[None]),
    "another kind of number": ("action_net.weight", lambda t: t.astype(np.float64)),
    "a spread of no number": ("log_std", lambda t: t * np.float32(np.nan)),
}


@pytest.mark.filterwarnings("ignore:divide by zero")
@table("change", CHANGED)
def test_tensors_that_cannot_act_are_refused(tmp_path, change):
    folder, _ = saved(tmp_path)
    name, changed = CHANGED[change]
    tensors = load_file(folder / WEIGHTS_FILE)
    save_file({**tensors, name: np.ascontiguousarray(changed(tensors[name]))}, folder / WEIGHTS_FILE)
    with pytest.raises(ValueError, match=rf"must be what its card says, but .*{name} must be finite float32 of shape"):
        load_policy(folder)


@table("name", ["weight_ih_l0", "weight_hh_l0", "bias_ih_l0"])
def test_a_memory_of_wrong_shape_is_refused(tmp_path, name):
    folder, _ = saved(tmp_path, algo="recurrent_ppo")
    tensors = load_file(folder / WEIGHTS_FILE)
    save_file({**tensors, f"lstm_actor.{name}": tensors[f"lstm_actor.{name}"][:-1].copy()}, folder / WEIGHTS_FILE)
    with pytest.raises(ValueError, match=r"lstm_actor.* must be finite float32 of shape"):
        load_policy(folder)


def test_an_observation_that_is_not_finite_is_refused(tmp_path):
    folder, _ = saved(tmp_path)
    observations = random_observations(3)
    observations[1, 4] = np.nan
    with pytest.raises(ValueError, match="observation must be finite, but is nan somewhere"):
        load_policy(folder).predict(observations)


def test_weights_of_something_else_are_refused(tmp_path):
    folder, _ = saved(tmp_path)
    save_file({"weights": np.zeros(3)}, folder / WEIGHTS_FILE)
    with pytest.raises(ValueError, match=r"must be what its card says, but .*KeyError\('.*weight'\); copy it anew"):
        load_policy(folder)


def test_loading_and_acting_needs_no_torch(tmp_path):
    folder, model = saved(tmp_path)
    script = (
        "import sys, json, numpy as np\n"
        "from agents import make_policy\n"
        "observations = np.array(json.load(sys.stdin), dtype=np.float32)\n"
        "actions, _ = make_policy(sys.argv[1]).predict(observations, deterministic=True)\n"
        "loaded = [name for name in ('torch', 'stable_baselines3', 'matplotlib') if name in sys.modules]\n"
        "print(json.dumps([actions.tolist(), loaded]))\n"
    )
    observations = random_observations(4)
    finished = subprocess.run(
        [sys.executable, "-c", script, folder],
        input=json.dumps(observations.tolist()), capture_output=True, text=True, timeout=600, check=True,
        cwd=Path(agents.__file__).parents[1],
    )  # fmt: skip
    actions, loaded = json.loads(finished.stdout)
    assert loaded == []
    assert (
        np.abs(actions - model.predict(observations, deterministic=True)[0]) <= rounding_of(folder, observations)[0]
    ).all()


UNPICKLERS = {"pickle", "cloudpickle", "dill", "joblib", "shelve", "marshal", "zipfile", "copyreg", "pandas"}
SOURCES = sorted(Path(agents.__file__).parent.rglob("*.py"))


def unpickling(source):
    """The imports and calls in a source that could unpickle or open an archive."""
    tree = ast.parse(source)
    # An archive of numbers may be read where pickles in it are refused.
    safe = {
        id(part)
        for call in ast.walk(tree)
        if isinstance(call, ast.Call) and ast.unparse(call.func) == "np.load"
        for keyword in call.keywords
        if keyword.arg == "allow_pickle" and ast.unparse(keyword.value) == "False"
        for part in (call.func, keyword)
    }
    for node in ast.walk(tree):
        if id(node) in safe:
            continue
        modules = []
        if isinstance(node, ast.Import):
            modules = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            modules = [node.module or ""]
            if any(alias.name == "load" for alias in node.names):
                yield f"from {node.module} import load"
        for module in modules:
            if module.split(".")[0] in UNPICKLERS or "save_util" in module:
                yield f"import {module}"
        if isinstance(node, ast.Attribute) and node.attr in ("load", "load_from_zip_file", "set_parameters"):
            yield ast.unparse(node)
        if isinstance(node, ast.keyword) and node.arg == "allow_pickle":
            yield ast.unparse(node)


def test_the_search_covers_the_package():
    assert {"checkpoints", "policy_evaluation", "trained_policy", "signals", "sb3_vec_env"} <= {
        path.stem for path in SOURCES
    }


@table("path", SOURCES)
def test_no_source_can_unpickle(path):
    assert list(unpickling(path.read_text())) == []


@table(
    "source",
    [
        "import pickle", "from pickle import loads", "import cloudpickle as c", "torch.load('x')", "PPO.load('x')",
        "from torch import load", "import zipfile", "np.load('x')", "np.savez('x', allow_pickle=True)",
        "np.load('x', allow_pickle=True)", "np.load('x', allow_pickle=False); np.load('y')",
        "from stable_baselines3.common.save_util import load_from_zip_file",
    ],
)  # fmt: skip
def test_the_search_for_unpicklers_finds_them(source):
    assert len(list(unpickling(source))) >= 1


@pytest.mark.parametrize("name", ["ppo/drift", "ppo/short"])  # of the others: tests/research/test_ship_policy.py
def test_a_shipped_policy_scores_as_its_card_says(name):
    card = make_policy(name).card
    (evaluation,) = evaluate_policies([name], card["config"]["env"], systems=32)
    # With several training seeds the card has the scores of all, and names the one that ships.
    place = card["seeds"].index(card["shipped"]["seed"])
    for metric, slack in (("information_gain", 0.05), ("coverage", 0.02)):
        values = evaluation.metrics[metric]
        scores = card["scores"][metric]
        expected = scores["seeds"][place] if "seeds" in scores else scores["mean"]
        assert abs(values.mean() - expected) < 4 * values.std() / np.sqrt(32) + slack
