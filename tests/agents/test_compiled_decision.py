"""Policies with features: one compiled function that decides as the network does, the same alone and in any batch."""

import json

import gymnasium as gym
import numpy as np
import pytest
from safetensors.numpy import load_file, save_file
from tables import table

from agents import make_policy
from agents.commands import main
from agents.evaluation.track_batch import make_track_batch
from agents.policies.networks.feature_encoder import FeatureEncoder
from agents.policies.networks.feature_names import MAX_FEATURE
from agents.policies.networks.trained_policy import (
    CARD_FILE,
    CARD_FORMAT,
    WEIGHTS_FILE,
    NetworkCard,
    TrainedPolicy,
    load_policy,
)

AMPLITUDE, POWER = "duffing_env/Amplitude-v0", "duffing_env/Power-v0"
ACTORS = {
    "tanh": {},
    "relu": {"activation": "relu", "levels": 3, "seed": 1},
    "elu": {"activation": "elu", "squashed": True},
    "any size, as it is": {"activation": "relu", "hidden": (7, 13, 5), "normalised": 0.0},
    "one layer": {"hidden": (), "levels": 4},
}


def written(found, hidden=(16, 8), normalised=MAX_FEATURE, spread="log_std", everywhere=False, seed=0, **network):
    """Network, tensors and card of a policy with features and random weights, so large that tanh and clipping matter.

    ``everywhere``: it is for all oscillators.
    """
    rng = np.random.default_rng(seed)
    sizes = [found.size, *hidden, network.get("levels") or 1]
    names = tuple(str(place) for place in range(len(sizes) - 1))
    tensors = {"setting": found.to_tensor()} if not everywhere else {}
    for name, inputs, outputs in zip(names, sizes, sizes[1:], strict=False):
        size = (2.0 if normalised else 0.7) / np.sqrt(inputs)
        tensors[f"{name}.weight"] = rng.normal(0.0, size, (outputs, inputs)).astype(np.float32)
        tensors[f"{name}.bias"] = rng.normal(0.0, 0.3, outputs).astype(np.float32)
    if normalised:
        values = found(scattered(found)).values
        tensors["normalizer.mean"], tensors["normalizer.std"] = values.mean(axis=0), values.std(axis=0) + 0.1
    if spread and not network.get("levels"):
        tensors["log_std"] = np.array([-1.0], np.float32)
    spread = "log_std" if "log_std" in tensors else None
    described = NetworkCard(names, spread=spread, features=True, normalised=normalised, **network)
    return described, tensors, {"features": {"own": False} if everywhere else found.describe()}


def folder_of(folder, policy):
    """The folder of a policy that was `written`."""
    network, tensors, card = policy
    folder.mkdir(exist_ok=True)
    save_file(tensors, folder / WEIGHTS_FILE)
    (folder / CARD_FILE).write_text(json.dumps({"format": CARD_FORMAT, "network": vars(network), **card}))
    return folder


def scattered(found, rows=300):
    """Observations of other beliefs and states each, mostly within the limit."""
    return np.random.default_rng(5).normal(0.0, 0.3, (rows, found.observation_size)).astype(np.float32)


def played(env_id, policy, rows=9, samples=60, **options):
    """What some environments show while a policy plays, and what it does."""
    envs = make_track_batch(env_id, rows, options)
    player = make_policy(str(policy), envs)
    shown, _ = envs.reset(seed=1)
    seen, done = [], []
    for _ in range(samples):
        actions, _ = player.predict(shown, deterministic=True)
        seen.append(shown.copy())
        done.append(actions)
        shown, *_ = envs.step(actions)
    return np.concatenate(seen), np.concatenate(done)


@pytest.fixture
def folder(tmp_path):
    """Of a policy for Power-v0."""
    return folder_of(tmp_path / "policy", written(FeatureEncoder.of(make_track_batch(POWER, 1))))


@pytest.mark.parametrize("own", [True, False], ids=["own", "features alone"])
@pytest.mark.parametrize("name", ACTORS)
def test_what_is_compiled_decides_as_the_network(name, own):
    found = FeatureEncoder.of(make_track_batch(AMPLITUDE, 1), with_observation=own)
    policy, seen = TrainedPolicy(*written(found, **ACTORS[name])), scattered(found)
    shown = found(seen)
    choices, _ = policy._network_output(shown.values, None, None, True)
    expected, (decided, _) = shown.to_actions(choices[:, 0]), policy.predict(seen, deterministic=True)
    assert (decided.shape, decided.dtype) == ((len(seen), 1), np.float32)
    if policy.network.levels:
        np.testing.assert_array_equal(decided, expected)
        assert len(np.unique(choices)) > 1
    else:
        np.testing.assert_allclose(decided, expected, atol=2e-5)
        assert np.std(decided) > 0.2


@pytest.mark.parametrize("name", ACTORS)
def test_a_decision_is_the_same_alone_in_a_batch_and_in_a_batch_of_another_size(tmp_path, name):
    policy = written(FeatureEncoder.of(make_track_batch(AMPLITUDE, 1)), **ACTORS[name])
    seen, decided = played(AMPLITUDE, folder_of(tmp_path / "policy", policy))
    alone = TrainedPolicy(*policy)

    def decide(rows):
        return alone.predict(rows, deterministic=True)[0]

    np.testing.assert_array_equal(decide(seen), decided)
    np.testing.assert_array_equal([decide(row) for row in seen], decided)
    np.testing.assert_array_equal(np.concatenate([decide(seen[i : i + 7]) for i in range(0, len(seen), 7)]), decided)
    np.testing.assert_array_equal(decide(np.asfortranarray(seen.astype(np.float64))), decided)
    np.testing.assert_array_equal(decide(seen.tolist()), decided)


def test_of_recorded_observations_it_decides_the_same_without_an_environment(folder):
    seen, decided = played(POWER, folder)
    np.testing.assert_array_equal(load_policy(folder).predict(seen, deterministic=True)[0], decided)
    assert np.abs(decided).max() < 1  # the energy is limited


@table("actor", [{}, {"levels": 3}])
def test_what_is_sampled_is_seeded_and_within_the_span(actor):
    found = FeatureEncoder.of(make_track_batch(AMPLITUDE, 1))
    policy, again = (TrainedPolicy(*written(found, **actor), seed=3) for _ in range(2))
    seen = scattered(found)
    low, high = (found(seen).to_actions(np.full(len(seen), end)) for end in (-1.0, 1.0))
    sampled, _ = policy.predict(seen)
    np.testing.assert_array_equal(again.predict(seen)[0], sampled)
    assert not np.array_equal(policy.predict(seen)[0], sampled)
    assert not np.array_equal(policy.predict(seen, deterministic=True)[0], sampled)
    assert ((np.minimum(low, high) <= sampled) & (sampled <= np.maximum(low, high))).all()


@table("value", [np.nan, np.inf, -np.inf])
def test_an_observation_that_is_not_finite_is_refused(value):
    found = FeatureEncoder.of(make_track_batch(AMPLITUDE, 1))
    policy = TrainedPolicy(*written(found))
    seen = np.zeros((5, found.observation_size), np.float32)
    seen[3, -1] = value
    for deterministic in (True, False):
        with pytest.raises(ValueError, match=f"observation must be finite, but is {value} somewhere"):
            policy.predict(seen, deterministic=deterministic)
    for shape in [(21,), (3, 58), ()]:
        with pytest.raises(ValueError, match="observation must have 22 entries, but has shape"):
            policy.predict(np.zeros(shape), deterministic=True)


def test_in_another_environment_it_takes_the_prior_and_the_limits_there(folder):
    options = {"max_rms": 0.05, "spread": 0.2, "horizon": 64}
    seen, decided = played(POWER, folder, samples=64, **options)
    there = FeatureEncoder.of(make_track_batch(POWER, 1, options))
    policy = load_policy(folder)
    assert not np.array_equal(policy.predict(seen, deterministic=True)[0], decided)
    policy.adapt_to(make_track_batch(POWER, 2, options))
    np.testing.assert_array_equal(policy.predict(seen, deterministic=True)[0], decided)
    np.testing.assert_array_equal(policy._encoder.to_tensor(), there.to_tensor())


def test_a_policy_that_sees_its_observation_refuses_another_model(folder):
    with pytest.raises(ValueError, match=r"env must be of the model .* but is of 'duffing'; play ppo/universal there"):
        make_policy(str(folder), gym.make("duffing_env/Amplitude-v1"))
    with pytest.raises(ValueError, match=r"env must be one of duffing_env for .*features, but is PendulumEnv"):
        make_policy(str(folder), gym.make("Pendulum-v1"))
    with pytest.raises(ValueError, match=r"must show the observation 'posterior', .* but shows 'history'"):
        make_policy(str(folder), gym.make(POWER, observation="history"))


def test_a_policy_for_all_oscillators_plays_each_but_not_without_one(tmp_path):
    found = FeatureEncoder.of(make_track_batch(AMPLITUDE, 1), with_observation=False)
    place = folder_of(tmp_path / "policy", written(found, everywhere=True))
    for env_id, size in ((POWER, 22), ("duffing_env/Amplitude-v1", 22), ("duffing_env/Pendulum-v0", 19)):
        seen, decided = played(env_id, place, rows=3, samples=5)
        assert seen.shape[1] == size
        assert np.abs(decided).max() > 0
    with pytest.raises(ValueError, match="env must be given to a policy for all oscillators, but is None"):
        make_policy(str(place)).predict(np.zeros(22), deterministic=True)


@table(
    ("name", "change", "message"),
    [
        ("setting", lambda t: t[:-1], "setting must be"),
        ("setting", lambda t: t * np.nan, "setting must be"),
        ("setting", lambda t: -t, "of setting must be positive"),
        ("0.weight", lambda t: t[:, 1:].copy(), "the first layer must take"),
        ("normalizer.mean", lambda t: t[1:], "normalizer.mean must be finite"),
        ("normalizer.std", lambda t: 0 * t, "normalizer.std must be positive, but is 0.0"),
    ],
)
def test_damaged_tensors_are_refused(tmp_path, name, change, message):
    place = folder_of(tmp_path / "policy", written(FeatureEncoder.of(make_track_batch(POWER, 1))))
    tensors = load_file(place / WEIGHTS_FILE)
    save_file(tensors | {name: change(tensors[name])}, place / WEIGHTS_FILE)
    with pytest.raises(ValueError, match=rf"policy must be what its card says, but .*{message}"):
        load_policy(place)


@table("wrong", ["3", "[1]", '{"own": true}', '{"own": true, "model": {"name": "x"}, "degree": 0, "lag": 0}'])
def test_a_damaged_description_is_refused(tmp_path, wrong):
    place = folder_of(tmp_path / "policy", written(FeatureEncoder.of(make_track_batch(POWER, 1))))
    card = json.loads((place / CARD_FILE).read_text()) | {"features": json.loads(wrong)}
    (place / CARD_FILE).write_text(json.dumps(card))
    with pytest.raises(ValueError, match="policy must be what its card says"):
        load_policy(place)


@pytest.mark.parametrize("name", ACTORS)
def test_the_network_as_onnx_chooses_the_same(tmp_path, name):
    onnx = pytest.importorskip("onnx", reason="onnx is not installed; it is the extra onnx")
    from onnx.reference import ReferenceEvaluator

    found = FeatureEncoder.of(make_track_batch(AMPLITUDE, 1))
    place = folder_of(tmp_path / "policy", written(found, **ACTORS[name]))
    main(["export", str(place), "--output", str(tmp_path / "network.onnx")])
    policy, seen = load_policy(place), found(scattered(found, 200)).values
    graph = onnx.load(tmp_path / "network.onnx")
    onnx.checker.check_model(graph, full_check=True)
    (chosen,) = ReferenceEvaluator(graph).run(["action"], {"observation": seen})
    expected, _ = policy._network_output(seen, None, None, True)
    np.testing.assert_allclose(chosen, expected, atol=1e-5)
    assert chosen.shape == (200, 1)
    assert len(np.unique(chosen)) > 1
