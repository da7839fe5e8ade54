"""Systems drawn from a belief have its noises, and blocks are planned for the models that they can be simulated of."""

import gymnasium as gym
import numpy as np
import pytest
from scipy.stats import norm

from agents.planner import block_policy, blocks
from agents.planner.block_policy import BlockPlanner, counted
from agents.planner.futures import drawn_from_records, force_of_noise
from agents.policies import make_policy
from estimator import Belief
from estimator.models.difference import difference
from estimator.models.duffing import duffing
from estimator.models.pendulum import PENDULUM


def test_every_sensor_has_its_own_noise():
    shape = 1e6  # nearly known
    stds = np.array([1e-3, 2e-2, 3e-1])
    gamma, *xi = [(shape, shape * std**2) for std in stds]
    record = Belief.of(PENDULUM, np.ones(5), 0.01 * np.eye(5), gamma, xi).record
    systems, noises = drawn_from_records(PENDULUM, record[None], np.ones(1), np.random.default_rng(0), 200)
    assert systems.shape == (200, 5)
    np.testing.assert_allclose(noises, np.tile(stds, (200, 1)), rtol=0.01)


def test_a_spread_widens_deviations_and_noises():
    record = Belief.of(PENDULUM, np.arange(1.0, 6.0), 0.01 * np.eye(5), (2.0, 3.0), [(4.0, 5.0)] * 2).record
    one, wide = (
        drawn_from_records(PENDULUM, record[None], np.ones(1), np.random.default_rng(0), 50, spread)
        for spread in (1.0, 1.25)
    )
    np.testing.assert_allclose(wide[0] - np.arange(1.0, 6.0), 1.25 * (one[0] - np.arange(1.0, 6.0)), atol=1e-12)
    np.testing.assert_allclose(wide[1], 1.25 * one[1])


@pytest.mark.parametrize(
    ("model", "name", "unit"),
    [(duffing(), "gain", np.sqrt(3)), (duffing(offsets=True), "gain", np.sqrt(3)), (difference(), "eta", 1.0),
     (PENDULUM, "torque", np.sqrt(3))],
)  # fmt: skip
def test_process_noise_is_a_force(model, name, unit):
    coefficients = np.random.default_rng(0).uniform(0.5, 2.0, (3, model.n_coefficients))
    gain = coefficients[:, list(model.coefficients).index(name)]
    np.testing.assert_allclose(force_of_noise(model)(*coefficients.T), unit / gain)


def test_noise_that_is_no_force_is_refused():
    env = gym.make("duffing_env/WienerHammerstein-v0")
    with pytest.raises(ValueError, match="model must have its process noise where its input acts"):
        make_policy("efe-block-16", env)


def test_blocks_play_a_model_of_two_sensors():
    env = gym.make("duffing_env/Pendulum-v0", horizon=32)
    policy = make_policy("efe-block-16", env)
    observation, _ = env.reset(seed=0)
    state, done, total = None, False, 0.0
    while not done:
        action, state = policy.predict(observation, state)
        observation, reward, terminated, done, _ = env.step(action)
        total += reward
        assert not terminated
    assert total > 2.0


@pytest.mark.parametrize(
    ("block", "parts"), [(256, [1]), (64, [3 / 8, 1 / 4, 3 / 16, 3 / 16]), (100, [5 / 12, 7 / 24, 7 / 24])]
)
def test_blocks_share_the_risk_of_an_episode(block, parts):
    env = gym.make("duffing_env/Amplitude-v1").unwrapped
    policy = BlockPlanner(env, block=block)
    shares = [policy.bound(left) / 2.5e-4 for left in range(256, 0, -block)]
    assert shares == pytest.approx(parts)
    assert sum(shares) == pytest.approx(1.0)


def test_rare_events_are_counted_with_larger_deviations():
    for probability in (1e-2, 5e-4, 1e-4, 1e-5):
        bound, spread = counted(probability)
        assert bound == max(probability, 5e-4)
        assert norm.sf(spread * norm.isf(bound)) == pytest.approx(probability)


def test_a_safe_block_is_tried_nearer_to_the_limit(monkeypatch):
    """It tells more then, and is as safe."""
    env = gym.make("duffing_env/Amplitude-v1").unwrapped
    observation, _ = env.reset(seed=0)
    told = {}

    def best_block(view, systems, futures, candidates, amplitude, bound, played):
        found = blocks.best_block(view, systems, futures, candidates, amplitude, bound, played)
        told[blocks._HALVINGS] = blocks.expected(view, systems, futures.limit, found[0])[0]
        assert found[1] == 1.0
        assert found[2] < bound
        return found

    monkeypatch.setattr(block_policy, "best_block", best_block)
    for halvings in (0, blocks._HALVINGS):
        monkeypatch.setattr(blocks, "_HALVINGS", halvings)
        BlockPlanner(env, block=64).predict(observation)
    never, often = told.values()
    assert often > never + 0.05


def test_blocks_begin_with_the_episode_in_a_batch():
    """Where a step only begins the next episode, no block goes into it."""
    envs = gym.make_vec("duffing_env/Short-v0", 2, vectorization_mode="vector_entry_point", horizon=24)
    policy = make_policy("efe-block-16", envs)
    observations, _ = envs.reset(seed=0)
    state, played = None, []
    for _ in range(2 * 25):
        actions, state = policy.predict(observations, state)
        observations, _, terminated, _, _ = envs.step(actions)
        assert not terminated.any()
        played.append(actions[:, 0])
    first, over, second = np.split(np.array(played), [24, 25])
    np.testing.assert_array_equal(over, 0.0)
    for episode in (first, second[:24]):
        assert (np.abs(episode).max(axis=0) > 0.5).all()
        assert (np.count_nonzero(episode[:16], axis=0) > 12).all()
