"""Foresight: its features against a plain twin, its shield and drive, its rewards, and policies that have it."""

import json
import shutil
from dataclasses import replace
from functools import cache
from itertools import combinations, product
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rounding import U32, play
from safetensors.numpy import load_file, save_file
from tables import table

from agents import make_policy
from agents.evaluation.batch import make
from agents.policies import TRAINED
from agents.policies.foresight import Foresight
from agents.policies.learned import load_policy
from agents.policies.prospects import BOUND, HORIZONS, MARGIN, Outlook, feature_names
from agents.training import PPOSettings, TrainConfig, resume, train
from agents.training.algorithms import SACSettings
from agents.training.callbacks import Watch
from agents.training.foresight_env import ForesightVecEnv, example_rate
from agents.vec_env import DuffingVecEnv
from duffing_env.layout import observation_bounds
from estimator import Channel, Rig
from estimator.models.difference import difference
from estimator.parameters import SAMPLING_STEP
from estimator.priors import silverbox_prior

OBSERVATION = tuple(observation_bounds(difference()))
FEATURES = feature_names(difference())
N_OBSERVATION = len(OBSERVATION)
COEFFICIENTS = ("theta1", "theta2", "theta3", "eta")
PLACE = {name: i for i, name in enumerate(FEATURES)}
AMPLITUDE, POWER, OUTPUT, DRIFT = (f"duffing_env/{name}-v0" for name in ("Amplitude", "Power", "Output", "Drift"))
RATE = np.diag([590.0, 150.0, 680.0, 240.0]) @ (0.5 * np.eye(4) + 0.5) @ np.diag([590.0, 150.0, 680.0, 240.0])


class Row:
    """One row of a batch, as a policy sees an environment."""

    def __init__(self, envs, row):
        self.experiment, self.unwrapped = envs.experiment, self
        self._envs, self._row = envs, row

    @property
    def records(self):
        return self._envs.records[self._row : self._row + 1]

    @property
    def shown(self):
        return self._envs.shown[self._row : self._row + 1]


def observations_of(env_id, samples=40, count=12):
    """What a batch shows after some random pushes, gentle enough that most episodes go on."""
    envs = make(env_id, count)
    rng = np.random.default_rng(1)
    shown, _ = envs.reset(seed=0)
    seen = [shown.copy()]
    for _ in range(samples):
        shown, *_ = envs.step(rng.choice([-1.0, 0.0, 1.0], (count, 1)).astype(np.float32))
        seen.append(shown.copy())
    return envs, np.concatenate(seen[::8])


def twin(o, outlook):
    """Features, safety and sign of one observation, with matrices."""
    o = dict(zip(OBSERVATION, np.float64(o), strict=True))
    theta = outlook.center + outlook.std * [o[f"mean_{n}"] for n in COEFFICIENTS]
    stds = outlook.std * np.exp([o[f"log_std_{n}"] for n in COEFFICIENTS])
    correlation = (1 + 1e-6) * np.eye(4)
    for i, j in combinations(range(4), 2):
        correlation[i, j] = correlation[j, i] = o[f"corr_{COEFFICIENTS[i]}_{COEFFICIENTS[j]}"]
    C = np.diag(stds) @ correlation @ np.diag(stds)
    share, push = o["time_left"], outlook.max_input
    if np.isfinite(outlook.energy):
        left = max(1.0, share * outlook.samples)
        push = min(push, 3 * np.sqrt(o["budget_left"] * outlook.energy / left))
        share = (share + o["budget_left"]) / 2
    variance = outlook.process * np.exp(-o["log_gamma"]) + outlook.sensor * np.exp(-o["log_xi_y"])
    rate = outlook.rate * (outlook.process + outlook.sensor) / variance
    J = share * outlook.samples * rate
    W = np.linalg.inv(np.linalg.inv(C) + J)
    sign = -1.0 if o["state_x1"] < 0 else 1.0
    for name in ("state_x1", "state_x2", "last_input", "last_y"):
        o[name] *= sign
    limit = outlook.max_output
    start = limit * o["state_x1"], limit * o["state_x2"]

    def phi(x0, x1, u):
        return np.array([x0, x0**3, x1, u])

    def play(first, follow):
        x0, x1 = start
        total, brought, reach = 0.0, [], []
        for t in range(max(HORIZONS)):
            u = first if t == 0 else follow(t, x0, x1)
            p = phi(x0, x1, u)
            total += p @ W @ p / (2 * variance) * outlook.samples / 4
            margin = MARGIN * np.sqrt(p @ C @ p + variance)
            x0, x1 = np.clip(theta @ p, -2 * limit, 2 * limit), x0
            reach.append(abs(x0) + margin)
            total -= 500 * max(0.0, reach[-1] / limit - 1)
            if t + 1 in HORIZONS:
                brought.append(total)
        return np.array(brought), max(reach[:8])

    def pump(t, x0, x1):
        u = push if x0 >= x1 else -push
        return -u if abs(theta @ phi(x0, x1, u)) > 0.95 * limit else u

    def signs_then_pump(signs):
        return lambda t, x0, x1: push * signs[t - 1] if t <= 3 else pump(t, x0, x1)

    ways = {
        "best": [signs_then_pump(signs) for signs in product((-1, 1), repeat=3)],
        "pump": [pump],
        "brake": [lambda t, x0, x1: -push if x0 >= x1 else push],
        "rest": [lambda t, x0, x1: 0.0],
    }
    features, lowest = list(o.values()), np.full(3, np.inf)
    for follows in ways.values():
        played = [[play(first, follow) for follow in follows] for first in (push, 0.0, -push)]
        brought = np.array([np.max([b for b, _ in each], axis=0) for each in played])
        peaks = np.array([min(peak for _, peak in each) for each in played])
        for up, none, down in brought.T:
            features += [np.arcsinh(up - down), np.arcsinh(none - max(up, down))]
        features += list(peaks / limit)
        lowest = np.minimum(lowest, peaks)
        if follows is ways["best"]:
            most = max(0.0, brought[:, -1].max())
    x0, x1 = start
    free = []
    for _ in range(3):
        x0, x1 = np.clip(theta @ phi(x0, x1, 0.0), -2 * limit, 2 * limit), x0
        free.append(x0 / limit)
    to_come = 0.5 * np.linalg.slogdet(np.eye(4) + J @ C)[1]
    open_ = np.log(0.25 * outlook.samples * np.trace(W @ rate) + 1e-3)
    features += [np.log(most + 1e-3), *free, 5 * theta[3] * push / limit, to_come, open_]
    safe = (lowest <= limit) | (lowest == lowest.min())
    return np.clip(features, -BOUND, BOUND), safe, sign


@pytest.mark.parametrize("env_id", [AMPLITUDE, POWER, OUTPUT])
def test_features_are_those_of_the_twin(env_id):
    envs, observations = observations_of(env_id)
    foresight = Foresight.of(envs, RATE)
    view = foresight.look(observations)
    assert view.features.dtype == np.float32
    turned = 0
    for i, observation in enumerate(observations):
        features, safe, sign = twin(observation, foresight._outlook)
        np.testing.assert_allclose(view.features[i], features, rtol=2e-5, atol=2e-5)
        np.testing.assert_array_equal(view.safe[i], safe)
        assert view.signs[i] == sign
        turned += sign < 0
    assert 0 < turned < len(observations)


@table("name", ["Amplitude", "Power"])
def test_features_are_those_that_the_shipped_policies_were_trained_with(name):
    """The numbers of the code that they were trained with, within float32's rounding, where noises are the prior's."""
    stored = json.loads((Path(__file__).parent / "data" / "foresight-eq2.json").read_text())[name]
    observations, features = np.array(stored["observations"]), np.array(stored["features"])
    noises = [OBSERVATION.index(n) for n in ("log_gamma", "log_xi_y")]
    observations[:, noises] = features[:, noises] = 0.0
    view = Foresight.of(make(f"duffing_env/{name}-v0", 1), RATE).look(observations)
    np.testing.assert_allclose(view.features, features, rtol=4e-7, atol=1e-9)
    np.testing.assert_array_equal(view.safe, stored["safe"])
    np.testing.assert_array_equal(view.signs, stored["signs"])


@pytest.mark.slow  # seconds of compilation
def test_equation_1_has_features_too_and_its_rule_is_worth_more_than_chance():
    envs = make("duffing_env/Amplitude-v1", 8, {"horizon": 96})
    foresight = Foresight.of(envs, RATE)
    model = envs.experiment.model
    assert foresight.observation_size == envs.single_observation_space.shape[0]
    best, free = (feature_names(model).index(name) for name in ("best_up_4", "free_1"))
    gains = {}
    for name in ("rule", "prbs"):
        policy = make_policy("prbs", envs, seed=1)
        observations, _ = envs.reset(seed=0)
        gains[name], state, gone = 0.0, None, np.zeros(8, dtype=bool)
        for _ in range(envs.horizon):
            view = foresight.look(observations)
            assert np.isfinite(view.features).all()
            push = np.where(view.features[:, best] >= 0, 1.0, -1.0)
            actions, state = policy.predict(observations, state)
            actions = view.act(push) if name == "rule" else actions
            observations, rewards, terminated, _, _ = envs.step(actions.astype(np.float32))
            gains[name] += (~gone * rewards).mean()
            gone |= terminated
    assert gains["rule"] > gains["prbs"] + 0.5
    # What comes without input is the Runge-Kutta step of the state alone.
    at = list(observation_bounds(model)).index
    row = np.zeros((1, foresight.observation_size), dtype=np.float32)
    row[0, at("state_x")], row[0, at("state_v")], row[0, at("time_left")] = 0.3, 0.2, 1.0
    stiffness, cubic, damping, _ = envs.experiment.believed.coefficients_mean

    def rates(z):
        return np.array([z[1], -stiffness * z[0] - cubic * z[0] ** 3 - damping * z[1]])

    z = 0.6 * np.array([0.3, 0.2])
    for _ in range(200):
        k1 = rates(z)
        z = z + rates(z + k1 / 400) / 200
    assert foresight.look(row).features[0, free] == pytest.approx(z[0] / 0.6, abs=1e-3)


def test_foresight_of_another_model_survives_being_written():
    envs = make("duffing_env/Amplitude-v1", 2)
    foresight = Foresight.of(envs, RATE)
    observations, _ = envs.reset(seed=0)
    again = Foresight.from_array(foresight.to_array(), json.loads(json.dumps(foresight.describe())))
    np.testing.assert_array_equal(again.look(observations).features, foresight.look(observations).features)


def test_an_observation_looks_the_same_alone_and_in_a_batch():
    envs, observations = observations_of(AMPLITUDE)
    foresight = Foresight.of(envs, RATE)
    together = foresight.look(observations).features
    alone = np.concatenate([foresight.look(one[None]).features for one in observations])
    np.testing.assert_array_equal(together, alone)


def test_turning_the_task_over_turns_the_action_over():
    envs, observations = observations_of(AMPLITUDE)
    foresight = Foresight.of(envs, RATE)
    over = observations.copy()
    over[:, [list(OBSERVATION).index(n) for n in ("state_x1", "state_x2", "last_input", "last_y")]] *= -1
    moving = observations[:, list(OBSERVATION).index("state_x1")] != 0
    one, other = foresight.look(observations[moving]), foresight.look(over[moving])
    np.testing.assert_array_equal(one.features, other.features)
    choices = np.random.default_rng(0).uniform(-1, 1, len(one.features))
    np.testing.assert_array_equal(one.act(choices), -other.act(choices))


@cache
def any_environment():
    return make(AMPLITUDE, 1)


@settings(derandomize=True, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_features_of_any_observation_are_finite_and_bounded(seed):
    envs, rng = any_environment(), np.random.default_rng(seed)
    space = envs.single_observation_space
    observations = rng.uniform(space.low, space.high, (8, N_OBSERVATION)).astype(np.float32)
    observations[0] = space.low
    observations[1] = space.high
    foresight = Foresight.of(envs, RATE)
    view = foresight.look(observations)
    assert np.isfinite(view.features).all()
    assert (np.abs(view.features) <= BOUND).all()
    assert view.safe.any(axis=1).all()
    assert np.isfinite(view.act(rng.uniform(-2, 2, 8))).all()


def test_the_shield_keeps_even_random_pushes_within_the_limit():
    """Of 64 systems that are pushed at random, hardly one leaves; without the shield most do."""
    envs = make(AMPLITUDE, 64)
    foresight = Foresight.of(envs, RATE)
    ended = {}
    for shielded in (True, False):
        rng = np.random.default_rng(3)
        observations, _ = envs.reset(seed=0)
        gone = np.zeros(64, dtype=bool)
        for _ in range(envs.horizon):
            choices = rng.choice([-1.0, 1.0], 64)
            actions = foresight.look(observations).act(choices) if shielded else choices[:, None]
            observations, _, terminated, _, _ = envs.step(actions.astype(np.float32))
            gone |= terminated
        ended[shielded] = gone.sum()
    assert ended[True] <= 1
    assert ended[False] >= 20


def test_the_shield_takes_what_is_safe_and_nearest():
    foresight = Foresight.of(make(AMPLITUDE, 1), RATE)
    view = foresight.look(np.zeros((1, N_OBSERVATION), dtype=np.float32))
    cases = [  # safe: up, none, down; choice; action
        ((1, 1, 1), 0.4, 0.4), ((0, 1, 1), 0.4, 0.0), ((0, 0, 1), 0.4, -1.0), ((0, 0, 1), 0.0, -1.0),
        ((0, 0, 1), -0.3, -1.0), ((1, 0, 0), -0.3, 1.0), ((1, 1, 0), -0.3, 0.0), ((1, 0, 1), 0.0, 1.0),
    ]  # fmt: skip
    for safe, choice, action in cases:
        view.safe[:] = safe
        assert view.act([choice])[0, 0] == np.float32(action), (safe, choice)
    view.shares[:] = 0.5, 1.0  # half of a push up
    for safe, choice, action in [
        ((1, 1, 1), 0.4, 0.4), ((1, 1, 1), 0.9, 0.5), ((1, 1, 1), -0.9, -0.9), ((1, 0, 0), -0.3, 0.5)
    ]:  # fmt: skip
        view.safe[:] = safe
        assert view.act([choice])[0, 0] == np.float32(action), (safe, choice)


def test_it_survives_being_written():
    for env_id in (AMPLITUDE, POWER):
        envs, observations = observations_of(env_id, samples=8)
        foresight = Foresight.of(envs, RATE)
        again = Foresight.from_array(foresight.to_array())
        assert isinstance(again._outlook, Outlook)
        np.testing.assert_array_equal(again.look(observations).features, foresight.look(observations).features)


def test_where_it_makes_no_sense_it_says_so():
    with pytest.raises(ValueError, match="hold must be 1 for foresight, but is 2"):
        Foresight.of(make(AMPLITUDE, 1, {"hold": 2}), RATE)


@table("env_id", [AMPLITUDE, POWER, "duffing_env/Drift-v0"])
def test_in_its_own_environment_it_stays_as_it_is(env_id):
    foresight = Foresight.of(make(env_id, 3), RATE)
    for env in (make(env_id, 2), gym.make(env_id).unwrapped):
        np.testing.assert_array_equal(foresight.moved_to(env).to_array(), foresight.to_array())


def test_in_another_environment_it_takes_what_is_ahead_there():
    foresight = Foresight.of(make(AMPLITUDE, 1), RATE)
    options = {"horizon": 90, "max_input": 0.05, "max_output": 0.2, "spread": 0.2, "process_noise": 1e-3}
    moved = foresight.moved_to(make(AMPLITUDE, 1, options))._outlook
    there = Foresight.of(make(AMPLITUDE, 1, options), RATE)._outlook
    for name, entry in moved._asdict().items():
        if name != "rate":
            np.testing.assert_array_equal(entry, getattr(there, name))
    # x, x³, x and u are a third of what they were, or a third to its third power; the variance is 2.5 times as large.
    third = np.array([1 / 3, 1 / 27, 1 / 3, 1 / 3])
    np.testing.assert_allclose(moved.rate, RATE * np.outer(third, third) / 2.5, rtol=1e-12)


VOLTS = Rig(SAMPLING_STEP, input=Channel("V", limit=1.0), output=Channel("V", range=1.0))


def test_on_a_plant_of_ones_own_it_takes_the_prior_and_the_limits():
    class Silent:
        def reset(self):
            pass

        def step(self, u):
            return 0.0

    prior = silverbox_prior(spread=0.1, process_noise=1e-4, measurement_noise=2e-4, noise_shape=5.0)
    env = gym.make(
        "duffing_env/Rig-v0", rig=VOLTS, plant=Silent(), max_input=0.15, max_output=0.4, prior=prior, noise_hypotheses=1
    ).unwrapped
    moved = Foresight.of(make(AMPLITUDE, 1), RATE).moved_to(env)._outlook
    np.testing.assert_allclose(moved.center, prior.coefficients_mean)
    np.testing.assert_allclose(moved.std, np.sqrt(np.diag(prior.coefficients_cov)))
    assert (moved.max_output, moved.energy) == (0.4, np.inf)
    assert (moved.process, moved.sensor) == pytest.approx((1e-4**2, 2e-4**2))


@table(
    ("trained_in", "env_id"),
    [(AMPLITUDE, "duffing_env/Amplitude-v1"), (AMPLITUDE, POWER), (POWER, AMPLITUDE)],
)
def test_where_its_network_could_not_be_meant_it_stays_as_it_is(trained_in, env_id):
    foresight = Foresight.of(make(trained_in, 1), RATE)
    assert foresight.moved_to(make(env_id, 1)) is foresight


def test_a_policy_keeps_to_the_limit_of_another_track():
    envs = make(OUTPUT, 16)
    policy = make_policy("ppo/amplitude", envs)
    observations, _ = envs.reset(seed=0)
    for _ in range(envs.horizon):
        observations, _, terminated, _, _ = envs.step(policy.predict(observations, deterministic=True)[0])
        assert not terminated.any()


@pytest.mark.parametrize("name", ["ppo/amplitude", "ppo/drift"])
def test_a_policy_with_foresight_refuses_a_foreign_environment(name):
    with pytest.raises(ValueError, match=r"env must be (one|an environment) of duffing_env for .*foresight, but is"):
        make_policy(name, gym.make("Pendulum-v1"))


def test_rewards_differ_from_the_environments_by_a_potential():
    """Over an episode they add up to the plain return less what was to come at its start, whatever is done."""
    options = {"horizon": 24, "max_output": 0.1, "process_noise": 0.04}  # too narrow for the shield to keep all within
    plain = DuffingVecEnv(AMPLITUDE, 6, seed=2, **options)
    envs = ForesightVecEnv(DuffingVecEnv(AMPLITUDE, 6, seed=2, **options), Foresight.of(plain.envs, RATE))
    features = envs.reset()
    plain.reset()
    start = features[:, PLACE["to_come"]].copy()
    rng = np.random.default_rng(0)
    returns, running, early = np.zeros(6), np.ones(6, dtype=bool), 0
    for _ in range(24):
        choices = rng.uniform(-1, 1, (6, 1)).astype(np.float32)
        actions = envs._view.act(choices[:, 0])
        features, rewards, dones, infos = envs.step(choices)
        observations, _, plain_dones, plain_infos = plain.step(actions)
        np.testing.assert_array_equal(dones, plain_dones)
        np.testing.assert_array_equal(features, envs.foresight.look(observations).features)
        returns += running * rewards
        for row in np.flatnonzero(dones):
            assert infos[row]["TimeLimit.truncated"] is False
            last = plain_infos[row]["terminal_observation"]
            np.testing.assert_array_equal(
                infos[row]["terminal_observation"], envs.foresight.look(last[None]).features[0]
            )
            if running[row]:
                gained = plain_infos[row]["episode"]["r"]
                assert returns[row] == pytest.approx(5 * (gained - start[row]), abs=1e-3)
                early += not plain_infos[row]["TimeLimit.truncated"]
                running[row] = False
    assert not running.any()
    assert 0 < early < 6


def test_rewards_that_count_no_information_stay_as_they_are():
    options = {"reward": "parameter_error", "horizon": 24}
    plain = DuffingVecEnv(AMPLITUDE, 3, seed=2, **options)
    envs = ForesightVecEnv(
        DuffingVecEnv(AMPLITUDE, 3, seed=2, **options), Foresight.of(plain.envs, RATE), in_nats=False
    )
    envs.reset()
    plain.reset()
    for _ in range(5):
        actions = envs._view.act([1.0, 0.0, -1.0])
        _, rewards, _, _ = envs.step(np.array([[1.0], [0.0], [-1.0]], dtype=np.float32))
        np.testing.assert_allclose(rewards, 5 * plain.step(actions)[1], rtol=1e-6, atol=1e-9)


def test_the_example_brings_about_as_much_as_the_oracle():
    """In the volume of what a sample tells, within a factor of two."""
    from agents.evaluation.oracle import Oracle, Systems
    from estimator import fisher_information

    systems = Systems.of(AMPLITUDE, 24)
    model, experiment = systems.plant.model, systems.experiment
    noises = experiment.process_noise, experiment.measurement_noise
    told = fisher_information(model, systems.theta, Oracle.of(systems).inputs, *noises)
    best = told.mean(axis=0) / systems.samples
    example = example_rate(AMPLITUDE, {}, seed=0)
    ratio = np.exp((np.linalg.slogdet(example)[1] - np.linalg.slogdet(best)[1]) / 4)
    assert 0.5 < ratio < 1.1


@pytest.mark.parametrize(
    "settings",
    [PPOSettings(levels=3), PPOSettings(), pytest.param(SACSettings(learning_starts=64), marks=pytest.mark.slow)],
)
def test_a_policy_that_was_trained_with_it_acts_the_same_from_its_file(tmp_path, settings):
    settings = replace(settings, foresight=True, num_envs=8, batch_size=32, hidden=(4,))
    algo = "sac" if isinstance(settings, SACSettings) else "ppo"
    run = train(TrainConfig(algo, AMPLITUDE, steps=1024, output=tmp_path / "run", hyperparameters=settings))
    envs = make(AMPLITUDE, 5)
    policy, tensors = make_policy(str(run.folder), envs), load_file(run.folder / "policy.safetensors")
    one = make_policy(str(run.folder), Row(envs, 2))
    observations, _ = envs.reset(seed=1)
    for _ in range(20):
        actions, _ = policy.predict(observations, deterministic=True)
        alone, _ = one.predict(observations[2], deterministic=True)
        assert actions.shape == (5, 1)
        # A product of matrices rounds by its size: what a choice that differs by so much stands for is between these.
        if algo == "sac" or settings.levels == 0:
            view = one._foresight.look(observations[2:3])
            choice, _ = one._choose(view.features, None, None, True)
            bound, _ = play(tensors, policy.card["network"], view.features)
            ends = [view.act((choice + step)[:, 0]) for step in (-bound, bound)]
            assert np.min(ends) - U32 <= alone[0] <= np.max(ends) + U32
            assert np.min(ends) - U32 <= actions[2] <= np.max(ends) + U32
        else:
            np.testing.assert_array_equal(alone, actions[2])
        observations, *_ = envs.step(actions)
    with pytest.raises(ValueError, match="observation must have 22 entries"):
        policy.predict(np.zeros((3, len(FEATURES)), dtype=np.float32))


def test_entropy_counts_less_and_less(tmp_path):
    settings = PPOSettings(foresight=True, num_envs=8, n_steps=16, batch_size=64, hidden=(4,), entropy_bonus=0.5)
    seen = []
    original = Watch._on_rollout_end

    def spy(self):
        original(self)
        seen.append(self.model.ent_coef)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Watch, "_on_rollout_end", spy)
        train(TrainConfig("ppo", AMPLITUDE, steps=512, output=tmp_path / "run", hyperparameters=settings))
    assert seen == [pytest.approx(0.5 * (1 - k / 4)) for k in range(4)]


def test_a_run_that_was_stopped_goes_on_with_the_same_foresight(tmp_path):
    settings = PPOSettings(foresight=True, levels=3, num_envs=8, n_steps=16, batch_size=64, hidden=(4,))
    config = TrainConfig(
        env=DRIFT,
        steps=512,
        checkpoints=2,
        eval_every=128,
        output=tmp_path / "run",
        hyperparameters=settings,
        options={"horizon": 48},
    )

    def stop(steps, found):
        if steps >= 384:
            raise InterruptedError

    with pytest.raises(InterruptedError):
        train(config, stop)
    before = load_file(tmp_path / "run" / "checkpoints" / "000000256" / "policy.safetensors")
    run = resume(tmp_path / "run")
    after = load_file(run.folder / "policy.safetensors")
    np.testing.assert_array_equal(before["foresight"], after["foresight"])
    assert not np.array_equal(before["action_net.weight"], after["action_net.weight"])


def test_a_damaged_foresight_is_refused(tmp_path):
    shutil.copytree(TRAINED / "ppo" / "drift", tmp_path / "copy")
    file = tmp_path / "copy" / "policy.safetensors"
    tensors = load_file(file)
    save_file(tensors | {"foresight": tensors["foresight"][:-1]}, file)
    with pytest.raises(ValueError, match=r"policy must be what its card says, but .*copy is not"):
        load_policy(tmp_path / "copy")
