"""Environments of other models than the oscillator's, and of one's own with two sensors."""

from dataclasses import replace

import numpy as np
import pytest
from playing import random_actions
from reference.filters import Plant, moved
from reference.plants import ASYMMETRIC_SPRING
from specimens import COMPILED, SEEN_TWICE, SPECIMENS

from duffing_env.tracks.model_env import ModelEnv, ModelExperiment
from estimator.models.named_parameters import Parameters
from estimator.models.pendulum import PENDULUM, PENDULUM_SAMPLING_STEP
from estimator.priors import log_uniform_moments
from estimator.rigs.physical_parameters import coefficients_of
from estimator.rigs.units import Scales

(OWN,) = (environment for environment in COMPILED if environment.name == "own model")
PENDULA = {"p1": 14.7, "p2": 0.5, "p3": 3.0}


def test_its_observation_has_entries_for_two_sensors():
    env = OWN.make()
    assert env.observation_space.shape == (2 * 3 + 3 + 2 + 2 * 2 + 4,)
    first, _ = env.reset(seed=0)
    np.testing.assert_allclose(first[[*range(6), *range(9, 17)]], 0.0, atol=1e-6)
    observation, *_ = env.step([1.0])
    outputs = [env._batch.row_values(f"Y_{name}")[0] / 0.7 for name in SEEN_TWICE.outputs]
    np.testing.assert_allclose(observation[15:17], outputs, rtol=1e-6)
    assert outputs[0] != outputs[1] != 0
    assert isinstance(env.truth, Parameters)
    assert list(env.truth) == list(SEEN_TWICE.coefficients)


def test_its_beliefs_are_calibrated():
    # 200 episodes: the squared distance of the truth from the mean, in standard deviations, is 3 on average.
    envs = OWN.make_vec(200, max_output=100.0, horizon=201, process_noise=1e-3, measurement_noise=1e-2)
    envs.reset(seed=0)
    truth = coefficients_of(SEEN_TWICE, envs.truth, Scales())
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


def test_it_is_played_and_believed():
    """A plant with a nonlinear sensor against the reference: both outputs, and the convergence of a belief."""
    env = OWN.make(horizon=64, max_output=6.0)
    env.reset(seed=0)
    plant, truth = Plant.of(SEEN_TWICE), np.array([env.truth[name] for name in SEEN_TWICE.coefficients])
    z, shown, expected = np.zeros(2), [], []
    for u in np.random.default_rng(0).choice([-0.5, 0.5], 64):
        env.step(np.array([u / 0.5], dtype=np.float32))
        shown.append([env._batch.row_values(f"Y_{name}")[0] for name in SEEN_TWICE.outputs])
        z = moved(plant, z, truth, (u,))
        expected.append(z)
    assert (np.ptp(expected, axis=0) > 0.5).all()
    noises = np.array(shown) - expected
    assert abs(np.corrcoef(noises.T)[0, 1]) < 0.5  # within four standard errors: each sensor has a noise of its own
    deviations = np.abs(noises)
    assert (deviations < 6 * np.array([1e-4, 3e-4])).all()  # standard deviations of the sensors
    assert (deviations.max(axis=0) > [1e-4, 3e-4]).all()
    for name, (mean, std) in env.belief.coefficients().items():
        assert abs(mean - env.truth[name]) < 4 * std < 0.05 * env.truth[name]


def test_the_prior_of_a_range_is_as_wide_as_the_range_for_several_sensors_too():
    experiment = ModelExperiment(
        system="pendulum", mean=PENDULA, spread=0.2, sampling_step=PENDULUM_SAMPLING_STEP, sensor_noise=[0.01]
    )
    belief = experiment.prior_belief
    mean, cov = log_uniform_moments(PENDULUM, PENDULA, 0.2, Scales(PENDULUM_SAMPLING_STEP))
    np.testing.assert_array_equal(belief.coefficients_mean, mean)
    np.testing.assert_array_equal(belief.coefficients_cov, cov)
    assert belief.noises[2:] == pytest.approx([2.0, 2.0 * 5e-4**2, 2.0, 2.0 * 0.01**2])


@pytest.mark.slow  # a kernel of its own
def test_noise_hypotheses_of_a_nonlinear_model_use_sigma_points():
    """To first order, 0.80 of the intervals cover under this input, and NEES per coefficient is 2.5."""
    from agents.evaluation.policy_evaluation import evaluate_policies

    (played,) = evaluate_policies(["prbs-4"], "duffing_env/WienerHammerstein-v0", 256, options={"noise_hypotheses": 3})
    assert np.mean(played.metrics["coverage"]) > 0.85
    assert np.mean(played.metrics["nees"]) < 1.7
    assert np.mean(played.metrics["log_posterior_gain"]) > 18.5


def test_a_spread_is_not_ignored_where_deviations_say_how_plants_are_drawn():
    options = {"system": "pendulum", "mean": PENDULA, "std": {"p1": 0.3, "p2": 0.1, "p3": 0.3}}
    with pytest.raises(ValueError, match=r"plant_spread must be 0 or left out where std gives .* but is 0.1"):
        ModelEnv(**options, plant_spread=0.1)
    assert not ModelExperiment(**options, plant_spread=0.0).kernel_params.parameter_stds.any()
    assert ModelExperiment(**options).kernel_params.parameter_stds.tolist() == [0.3, 0.1, 0.3]


def test_a_limit_as_good_as_none_leaves_a_model_in_seconds_finite():
    # Its states are in parts of the limit, whose square is in the cubic coefficient.
    system = replace(ASYMMETRIC_SPRING, time="s", states={"x": "V", "v": "V/s"})
    options = SPECIMENS["asymmetric spring"] | {"system": system, "max_output": 1e300}
    env = ModelEnv(**options)
    env.reset(seed=0)
    assert np.isfinite(env.step([0.5])[0]).all()
