"""Systems drawn from a belief have its noises, and blocks are planned for the models that they can be simulated of."""

import gymnasium as gym
import numpy as np
import pytest
from scipy.stats import norm

from agents.planning.open_loop import chance_constrained_block
from agents.planning.open_loop.posterior_samples import draw_from_records, noise_as_input
from agents.policies import block_planner, make_policy
from agents.policies.block_planner import BlockPlanner, countable_probability
from estimator import Belief
from estimator.models.difference_equation import difference
from estimator.models.duffing import duffing
from estimator.models.pendulum import PENDULUM


def test_every_sensor_has_its_own_noise():
    shape = 1e6  # nearly known
    stds = np.array([1e-3, 2e-2, 3e-1])
    gamma, *xi = [(shape, shape * std**2) for std in stds]
    record = Belief.of(PENDULUM, np.ones(5), 0.01 * np.eye(5), gamma, xi).record
    systems, noises = draw_from_records(PENDULUM, record[None], np.ones(1), np.random.default_rng(0), 200)
    assert systems.shape == (200, 5)
    np.testing.assert_allclose(noises, np.tile(stds, (200, 1)), rtol=0.01)


def test_a_spread_widens_deviations_and_noises():
    record = Belief.of(PENDULUM, np.arange(1.0, 6.0), 0.01 * np.eye(5), (2.0, 3.0), [(4.0, 5.0)] * 2).record
    one, wide = (
        draw_from_records(PENDULUM, record[None], np.ones(1), np.random.default_rng(0), 50, spread)
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
    np.testing.assert_allclose(noise_as_input(model)(*coefficients.T), unit / gain)


def test_noise_that_is_no_force_is_refused():
    env = gym.make("duffing_env/WienerHammerstein-v0")
    with pytest.raises(ValueError, match="model must have its process noise where its input acts"):
        make_policy("efe-block-16", env)


def runge_kutta_of_the_pendulum(coefficients, start, u, steps=PENDULUM.substeps):
    """Angles after each sample, the input held."""
    gravity, friction, torque = coefficients
    z, h, seen = np.array(start), 1.0 / steps, []
    for value in u:

        def rates(z, value=value):
            return np.array([z[1], torque * value - friction * z[1] - gravity * np.sin(z[0])])

        for _ in range(steps):
            k1 = rates(z)
            k2 = rates(z + h / 2 * k1)
            k3 = rates(z + h / 2 * k2)
            z = z + h / 6 * (k1 + 2 * k2 + 2 * k3 + rates(z + h * k3))
        seen.append(z[0])
    return np.array(seen)


def test_a_block_is_planned_for_a_model_of_two_sensors(monkeypatch):
    """Its systems have a noise for each sensor, and what must keep the limit is what the first one shows."""
    env = gym.make("duffing_env/Pendulum-v0", horizon=32).unwrapped
    observation, _ = env.reset(seed=0)
    asked = []

    def best_block(view, systems, futures, candidates, amplitude, bound, played):
        asked.append((systems, futures, candidates, amplitude, bound, played))
        return candidates[0], 1.0, 0.0

    monkeypatch.setattr(
        block_planner, "initial_guesses", lambda settings, record, samples, seed: np.full((1, samples), 0.3)
    )
    monkeypatch.setattr(block_planner, "optimise_block", best_block)
    policy, plan, state = BlockPlanner(env, block=8), [], None
    for _ in range(9):
        action, state = policy.predict(observation, state)
        plan.append(action[0])
        observation, *_ = env.step(action)
    assert len(asked) == 2  # the second block begins with its ninth input
    np.testing.assert_allclose(plan, 0.3 / env.max_input, rtol=1e-6)
    systems, futures, candidates, amplitude, bound, played = asked[0]
    assert (systems.noises.shape, systems.path_starts.shape[0]) == (
        (chance_constrained_block.N_SYSTEMS, 3),
        chance_constrained_block.N_SYSTEMS,
    )
    np.testing.assert_array_equal(systems.noises, futures.noises[: chance_constrained_block.N_SYSTEMS] ** 2)
    assert amplitude == env.max_input
    assert 8 < played < candidates.shape[1]
    assert bound >= 5e-4
    u = candidates[0]
    process, sensor = futures.disturbances(len(u))
    shown = futures.simulate_outputs(u, slice(0, 3))
    for i in range(3):
        expected = runge_kutta_of_the_pendulum(futures.coefficients[i], futures.states[i], u + process[i])
        np.testing.assert_allclose(shown[i], expected + sensor[i], atol=1e-9)
    leaving = futures.violating_draws(u, len(futures.states))
    is_out = (np.abs(futures.simulate_outputs(u, slice(None))) > futures.limit).any(axis=1)
    np.testing.assert_array_equal(leaving, np.flatnonzero(is_out))


@pytest.mark.parametrize(
    ("block", "parts"), [(256, [1]), (64, [3 / 8, 1 / 4, 3 / 16, 3 / 16]), (100, [5 / 12, 7 / 24, 7 / 24])]
)
def test_blocks_share_the_risk_of_an_episode(block, parts):
    env = gym.make("duffing_env/Amplitude-v1").unwrapped
    policy = BlockPlanner(env, block=block)
    shares = [policy.risk_of_block(left) / 2.5e-4 for left in range(256, 0, -block)]
    assert shares == pytest.approx(parts)
    assert sum(shares) == pytest.approx(1.0)


def test_rare_events_are_counted_with_larger_deviations():
    for probability in (1e-2, 5e-4, 1e-4, 1e-5):
        bound, spread = countable_probability(probability)
        assert bound == max(probability, 5e-4)
        assert norm.sf(spread * norm.isf(bound)) == pytest.approx(probability)
