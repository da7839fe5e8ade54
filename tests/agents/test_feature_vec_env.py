"""Training with features: rewards, normalised features, imitation, and policies that act the same from their file."""

import json

import numpy as np
import pytest
from tables import table

from agents import make_policy
from agents.evaluation.track_batch import make_track_batch
from agents.policies.networks.feature_encoder import FeatureEncoder
from agents.policies.networks.feature_names import MAX_FEATURE
from agents.policies.networks.policy_saving import save_policy
from agents.policies.networks.trained_policy import load_policy
from agents.sb3_vec_env import DuffingVecEnv
from agents.training import ALGORITHMS, PPOSettings, TrainConfig, train
from agents.training.dagger_pretraining import imitate_policy
from agents.training.environments.feature_vec_env import REWARD_SCALE, FeatureNormalizer, FeatureVecEnv
from agents.training.training_logs import TrainingCallback

AMPLITUDE, POWER = "duffing_env/Amplitude-v0", "duffing_env/Power-v0"
#: Too narrow for the shield to keep all within.
NARROW = {"horizon": 24, "max_output": 0.14, "process_noise": 0.04}


def seen_through(rows=6, seed=2, env_id=AMPLITUDE, fitted=False, levels=0, in_nats=True, own=True, **options):
    """Environments with features; ``fitted``: normalised."""

    def envs():
        plain = DuffingVecEnv(env_id, rows, seed=seed, **options)
        return FeatureVecEnv(plain, levels=levels, reward_in_nats=in_nats, raw_observation=own)

    made = envs()
    if fitted:
        made.normalizer.fit(envs(), 20, seed=0)
    return made


def test_rewards_differ_from_the_environments_by_a_potential():
    """Over an episode they sum to the plain return minus the potential at its start, for any actions."""
    plain, envs = DuffingVecEnv(AMPLITUDE, 6, seed=2, **NARROW), seen_through(**NARROW)
    found, rng = FeatureEncoder.of(plain.envs), np.random.default_rng(0)
    envs.reset()
    plain.reset()
    start = envs.current_features.remaining_information.copy()
    returns, running, early = np.zeros(6), np.ones(6, dtype=bool), 0
    for _ in range(24):
        choices = rng.uniform(-1, 1, (6, 1)).astype(np.float32)
        actions = envs.current_features.to_actions(choices[:, 0])
        shown, rewards, dones, infos = envs.step(choices)
        observations, _, plain_dones, plain_infos = plain.step(actions)
        np.testing.assert_array_equal(dones, plain_dones)
        np.testing.assert_array_equal(shown, found(observations).values)
        returns += running * rewards
        for row in np.flatnonzero(dones):
            assert infos[row]["TimeLimit.truncated"] is False
            last = found(plain_infos[row]["terminal_observation"][None]).values[0]
            np.testing.assert_array_equal(infos[row]["terminal_observation"], last)
            if running[row]:
                gained = plain_infos[row]["episode"]["r"]
                assert returns[row] == pytest.approx(REWARD_SCALE * (gained - start[row]), abs=1e-3)
                early += not plain_infos[row]["TimeLimit.truncated"]
                running[row] = False
    assert not running.any()
    assert 0 < early < 6


@table(
    ("env_id", "in_nats", "options"),
    [(AMPLITUDE, False, {"reward": "parameter_error"}), (POWER, True, {}), (AMPLITUDE, True, {"drift": 0.01})],
)
def test_rewards_without_a_potential_stay_as_they_are(env_id, in_nats, options):
    """Rewards without information, and tracks with an energy limit or drift."""
    options = {"horizon": 24, **options}
    plain = DuffingVecEnv(env_id, 3, seed=2, **options)
    envs = seen_through(rows=3, env_id=env_id, in_nats=in_nats, **options)
    envs.reset()
    plain.reset()
    for _ in range(5):
        actions = envs.current_features.to_actions([1.0, 0.0, -1.0])
        _, rewards, _, _ = envs.step(np.array([[1.0], [0.0], [-1.0]], dtype=np.float32))
        np.testing.assert_allclose(rewards, REWARD_SCALE * plain.step(actions)[1], rtol=1e-6, atol=1e-9)


def test_what_is_seen_is_normalised_over_random_choices():
    first, second = (seen_through(rows=32, fitted=True) for _ in range(2))
    for one, two in zip(first.tensors.values(), second.tensors.values(), strict=True):
        np.testing.assert_array_equal(one, two)
    other = FeatureNormalizer(first.observation_space.shape[0])
    other.fit(seen_through(rows=32), 20, seed=1)
    assert not np.array_equal(other.mean, first.normalizer.mean)
    rng = np.random.default_rng(0)  # the same choices again
    normalised = [first.reset()]
    for _ in range(20):
        normalised.append(first.step(rng.uniform(-1, 1, (32, 1)).astype(np.float32))[0])
        expected = (first.current_features.values - first.normalizer.mean) / first.normalizer.std
        np.testing.assert_array_equal(normalised[-1], np.clip(expected, -MAX_FEATURE, MAX_FEATURE))
    least = first.normalizer.std.min()  # of what is constant
    assert least == np.float32(0.05)
    kept = np.abs(expected).max(axis=0) < MAX_FEATURE
    found, varied = np.concatenate(normalised)[:, kept], first.normalizer.std[kept] > least
    np.testing.assert_allclose(found.mean(axis=0), 0.0, atol=1e-2)
    np.testing.assert_allclose(found.std(axis=0)[varied], 1.0, atol=1e-2)
    assert varied.sum() > 20


def test_episodes_are_gone_on_with_where_they_were_recalled():
    first, second = (seen_through(levels=3, seed=seed, horizon=24) for seed in (2, 3))
    rng = np.random.default_rng(0)
    first.reset()
    for _ in range(10):
        shown, *_ = first.step(rng.integers(3, size=6))
    memory = {name: array.copy() for name, array in first.venv.episode_state.items()}
    np.testing.assert_array_equal(second.restore_episode_state(memory), shown)
    for _ in range(30):
        choices = rng.integers(3, size=6)
        for one, two in zip(first.step(choices)[:3], second.step(choices)[:3], strict=True):
            np.testing.assert_array_equal(one, two)


@pytest.mark.parametrize(
    ("algo", "settings"),
    [
        ("ppo", {"levels": 3}),
        ("ppo", {"activation": "elu"}),
        ("ppo", {"own": False, "activation": "tanh"}),
        ("sac", {}),
        ("recurrent_ppo", {"lstm_units": 4}),
    ],
)
def test_a_policy_acts_the_same_from_its_file(tmp_path, algo, settings):
    """As the model of Stable-Baselines3 in the environments that it is trained in, to rounding."""
    if algo == "recurrent_ppo":
        pytest.importorskip("sb3_contrib", reason="sb3-contrib is not installed; it is the extra contrib")
    asked = ALGORITHMS[algo](num_envs=6, batch_size=24, hidden=(5,), **settings)
    envs = seen_through(env_id=POWER, fitted=True, levels=settings.get("levels", 0), own=asked.own)
    model = asked.make(envs, seed=0)
    save_policy(tmp_path, model)
    policy, other = load_policy(tmp_path), make_policy(str(tmp_path), make_track_batch(POWER, 6))
    assert policy.network.features
    assert policy.card["features"] == json.loads(json.dumps(envs.features))
    shown, state, own_state, starts = envs.reset(), None, None, np.ones(6, dtype=bool)
    for _ in range(30):
        choices, state = model.predict(shown, state, starts, deterministic=True)
        expected = envs.current_features.to_actions(
            np.linspace(-1, 1, 3)[choices] if choices.ndim == 1 else choices[:, 0]
        )
        before = own_state
        actions, own_state = policy.predict(envs.raw_observations, before, starts, deterministic=True)
        np.testing.assert_allclose(actions, expected, atol=1e-5)
        np.testing.assert_array_equal(
            actions, other.predict(envs.raw_observations, before, starts, deterministic=True)[0]
        )
        shown, _, starts, _ = envs.step(choices)
    with pytest.raises(ValueError, match="observation must have 22 entries"):
        policy.predict(np.zeros((3, 58), dtype=np.float32))


def agreement(choose, envs):
    """The share of an episode's decisions with the same sign as velocity-sign's."""
    teacher, agreed = make_policy("velocity-sign", envs), []
    shown, _ = envs.reset(seed=0)
    for _ in range(80):
        wanted, _ = teacher.predict(shown)
        agreed.append(choose(shown)[:, 0] * wanted[:, 0] > 0)
        shown, *_ = envs.step(wanted)
    return np.mean(agreed)


@pytest.mark.parametrize("levels", [0, 3])
def test_a_network_learns_what_another_policy_decides(levels):
    """In the teacher's episodes the network agrees rarely before imitation, and mostly after it."""
    asked = PPOSettings(num_envs=32, n_steps=16, batch_size=64, hidden=(64,), levels=levels)
    envs = seen_through(rows=32, fitted=True, levels=levels)
    model, found, progress = asked.make(envs, seed=1), FeatureEncoder.of(envs.venv.envs), []

    def choose(shown):
        features = found(shown)
        choices, _ = model.predict(envs.normalizer(features.values), deterministic=True)
        return features.to_actions(np.linspace(-1, 1, levels)[choices] if levels else choices[:, 0])

    before = agreement(choose, make_track_batch(AMPLITUDE, 32))
    imitate_policy(model, envs, "velocity-sign", 8192, 0, progress.append)
    assert progress == sorted(progress)
    assert progress[-1] == 1.0
    assert before < 0.5 < 0.8 < agreement(choose, make_track_batch(AMPLITUDE, 32))


def test_a_run_begins_with_what_was_imitated(tmp_path):
    """A run that learns almost nothing from rewards decides like its teacher, and the same seed repeats it."""
    settings = PPOSettings(num_envs=32, n_steps=16, batch_size=64, hidden=(64,), levels=3, learning_rate=1e-9)
    envs, agreed, weights = make_track_batch(AMPLITUDE, 32), [], []
    for name, teacher in (("plain", None), ("one", "velocity-sign"), ("again", "velocity-sign")):
        run = tmp_path / name
        train(TrainConfig(seed=1, steps=512, imitate=teacher, imitations=8192, output=run, hyperparameters=settings))
        policy = make_policy(str(run), envs)
        agreed.append(agreement(lambda shown, by=policy: by.predict(shown, deterministic=True)[0], envs))
        weights.append((run / "policy.safetensors").read_bytes())
    assert agreed[1] == agreed[2] > max(0.8, agreed[0])
    assert weights[1] == weights[2]


@table(
    ("settings", "message"),
    [
        ({"algo": "sac"}, "imitate needs ppo with features on one track, but algo is sac"),
        ({"hyperparameters": PPOSettings(features=False)}, "features False"),
        ({"env": "family"}, "env family"),
        ({"vary": {"horizon": [64, 128]}}, r"vary \{'horizon'"),
        ({"begin": "somewhere"}, "imitate must be left out with begin, but is 'efe'; choose one of them"),
        ({"imitations": 0}, "imitations must be a whole number from 1 to 1000000000, but is 0"),
    ],
)
def test_what_cannot_imitate_is_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        TrainConfig(imitate="efe", **settings)


def test_the_entropy_weight_decreases(tmp_path, monkeypatch):
    seen = []
    original = TrainingCallback._on_rollout_end

    def spy(self):
        original(self)
        seen.append(self.model.ent_coef)

    monkeypatch.setattr(TrainingCallback, "_on_rollout_end", spy)
    settings = PPOSettings(num_envs=8, n_steps=16, batch_size=64, hidden=(4,), entropy_bonus=0.5)
    train(TrainConfig("ppo", AMPLITUDE, steps=512, output=tmp_path / "run", hyperparameters=settings))
    assert seen == [pytest.approx(0.5 * (1 - k / 4)) for k in range(4)]
