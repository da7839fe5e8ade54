"""Environments of other models than the oscillator's: the pendulum, which has two sensors."""

from dataclasses import dataclass

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as gymnasium_check
from gymnasium.vector import AutoresetMode
from test_vector_env import play_beside_singles, random_actions

from duffing_env.env import DuffingEnv
from duffing_env.experiment import SimulatedExperiment
from duffing_env.model_env import ModelEnv
from duffing_env.vector_env import DuffingVectorEnv
from estimator.models.model import Model
from estimator.models.pendulum import PENDULUM, STEP
from estimator.parameters import Parameters
from estimator.physical import coefficients_of
from estimator.priors import log_uniform_moments
from estimator.units import Scales

# Random inputs end some such episodes at the limit, the others at the horizon.
BOTH_ENDS = {"max_input": 5.0, "max_output": 0.5, "horizon": 30}


@dataclass(frozen=True)
class PendulumExperiment(SimulatedExperiment):
    """A new pendulum in every episode, hanging at rest."""

    @property
    def plant(self):
        return PENDULUM

    @property
    def model(self):
        return PENDULUM

    @property
    def step(self):
        return STEP

    @property
    def center(self):
        return {"p1": 14.7, "p2": 0.5, "p3": 3.0}


class PendulumEnv(DuffingEnv):
    experiment_kind = PendulumExperiment


class PendulumVectorEnv(DuffingVectorEnv):
    single = PendulumEnv


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_rows_are_single_environments(mode):
    steps = play_beside_singles(5, 120, vector=PendulumVectorEnv, mode=mode, **BOTH_ENDS)
    assert np.sum([step[2] for step in steps]) > 3
    assert np.sum([step[3] for step in steps]) > 3


def test_its_observation_has_what_two_sensors_tell():
    env = PendulumEnv(**BOTH_ENDS)
    assert env.observation_space.shape == (2 * 3 + 3 + 2 + 2 * 2 + 4,)
    gymnasium_check(env, skip_render_check=True)
    first, _ = env.reset(seed=0)
    np.testing.assert_allclose(first[[*range(6), *range(9, 17)]], 0.0, atol=1e-6)
    observation, *_ = env.step([1.0])
    batch = env.unwrapped._batch
    outputs = [batch.quantity(f"Y_{name}")[0] / 0.5 for name in PENDULUM.outputs]
    np.testing.assert_allclose(observation[15:17], outputs, rtol=1e-6)
    assert outputs[0] != outputs[1] != 0
    assert isinstance(env.truth, Parameters)
    assert sorted(env.truth) == ["p1", "p2", "p3"]


def test_its_beliefs_are_calibrated():
    # 200 episodes: the squared distance of the truth from the mean, in standard deviations, is 3 on average.
    envs = PendulumVectorEnv(200, max_input=5.0, max_output=100.0, process_noise=1e-3, measurement_noise=1e-2)
    envs.reset(seed=0)
    truth = coefficients_of(PENDULUM, envs.truth, Scales(STEP))
    start = envs.belief(0)
    for actions in np.clip(random_actions(200, 200), -1, 1):
        envs.step(actions)
    distances, shrunk = [], []
    for row in range(200):
        belief = envs.belief(row)
        deviation = truth[row] - belief.coefficients_mean
        distances.append(deviation @ np.linalg.solve(belief.coefficients_cov, deviation))
        shrunk.append(start.entropy() - belief.entropy())
    assert 2.3 < np.mean(distances) < 3.8
    assert np.mean(shrunk) > 3


def test_the_prior_of_a_range_is_as_wide_as_the_range_for_several_sensors_too():
    center = {"p1": 14.7, "p2": 0.5, "p3": 3.0}
    env = ModelEnv(system="pendulum", mean=center, spread=0.2, sampling_step=STEP, sensor_noise=[0.01])
    belief = env.belief
    mean, cov = log_uniform_moments(PENDULUM, center, 0.2, Scales(STEP))
    np.testing.assert_array_equal(belief.coefficients_mean, mean)
    np.testing.assert_array_equal(belief.coefficients_cov, cov)
    assert belief.noises[2:] == pytest.approx([2.0, 2.0 * 5e-4**2, 2.0, 2.0 * 0.01**2])


@pytest.mark.slow  # a kernel of its own
def test_hypotheses_about_a_model_that_bends_are_moved_by_sigma_points():
    """To first order, 0.80 of the intervals cover under this input, and NEES per coefficient is 2.5."""
    from agents.evaluation.rollout import evaluate

    (played,) = evaluate(["prbs-4"], "duffing_env/WienerHammerstein-v0", 256, options={"noise_hypotheses": 3})
    assert np.mean(played.metrics["coverage"]) > 0.85
    assert np.mean(played.metrics["nees"]) < 1.7
    assert np.mean(played.metrics["log_posterior_gain"]) > 18.5


def test_a_spread_is_not_ignored_where_deviations_say_how_plants_are_drawn():
    told = {"system": "pendulum", "mean": {"p1": 14.7, "p2": 0.5, "p3": 3.0}, "std": {"p1": 0.3, "p2": 0.1, "p3": 0.3}}
    with pytest.raises(ValueError, match=r"plant_spread must be 0 or left out where std says .* but is 0.1"):
        ModelEnv(**told, plant_spread=0.1)
    ModelEnv(**told, plant_spread=0.0)


def test_drag_is_played_and_believed():
    """A plant with a bend, against Runge and Kutta's method by hand: its outputs, and that a belief finds its truth."""
    drag = Model(
        name="drag", states={"x": "V", "v": "V"}, coefficients={"k": "1", "c": "1", "g": "1"},
        rates=("v", "g*u - k*x - c*v*abs(v)"), noise=("0", "sqrt(3)"), outputs={"y": "x"}, substeps=4,
    )  # fmt: skip
    env = ModelEnv(
        system=drag, mean={"k": 0.3, "c": 0.1, "g": 0.3}, spread=0.2, process_noise=1e-6, measurement_noise=1e-4,
        horizon=64, max_input=0.5, max_output=6.0,
    )  # fmt: skip
    env.reset(seed=0)
    k, c, g = (env.truth[name] for name in "kcg")
    rates = lambda z, u: np.array([z[1], g * u - k * z[0] - c * z[1] * np.abs(z[1])])  # noqa: E731
    z, rng, shown, expected = np.zeros(2), np.random.default_rng(0), [], []
    for u in rng.choice([-0.5, 0.5], 64):
        env.step(np.array([u / 0.5], dtype=np.float32))
        shown.append(env._batch.quantity("Y_y")[0])
        for _ in range(4):
            a = rates(z, u)
            b = rates(z + a / 8, u)
            d = rates(z + b / 8, u)
            z = z + (a + 2 * b + 2 * d + rates(z + d / 4, u)) / 24
        expected.append(z[0])
    assert np.ptp(expected) > 0.5
    np.testing.assert_allclose(shown, expected, atol=6e-4)
    for name, (mean, std) in env.belief.coefficients().items():
        assert abs(mean - env.truth[name]) < 4 * std < 0.05 * env.truth[name]
