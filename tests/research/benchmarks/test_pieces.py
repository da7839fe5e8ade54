"""The functions that are timed separately compute the same as the environment and the estimator."""

import gymnasium as gym
import numpy as np
import pytest

from benchmarks.component_timing import NOISE, SAMPLES, EstimatorOnly, experiment_of, play
from benchmarks.environments import TRACK, vector_steps
from estimator import SILVERBOX_TWIN, OnlineEstimator, Rig, coefficients_of, difference
from estimator.compilation.simd import LANES


@pytest.mark.parametrize(("factorisation", "iterations"), [("structured", 3), ("mean_field", 10)])
def test_the_estimator_alone_is_the_estimator(factorisation: str, iterations: int) -> None:
    data = play(LANES + 1)
    alone = EstimatorOnly(data, factorisation, iterations)
    for t in range(SAMPLES):
        alone.step(t)
    row, experiment = LANES + 5, experiment_of(factorisation)
    rig = Rig.silverbox("linear")
    reference = OnlineEstimator(experiment.model, experiment.prior_belief, rig, factorisation=factorisation)
    reference.run(data.inputs[:, row], data.outputs[:, row])
    np.testing.assert_allclose(alone.records()[row], reference.belief.record, rtol=1e-9, atol=1e-15)


def test_the_plant_alone_is_the_twin() -> None:
    data = play(1)
    theta1, theta2, theta3, eta = coefficients_of(difference(), SILVERBOX_TWIN)
    x, last, u = data.outputs[1:-1], data.outputs[:-2], data.inputs[2:]
    residual = data.outputs[2:] - (theta1 * x + theta2 * x**3 + theta3 * last + eta * u)
    # The process noise, and three measurement noises with their weights.
    expected = NOISE * np.sqrt(1 + 1 + theta1**2 + theta3**2)
    assert np.std(residual) == pytest.approx(expected, rel=0.1)


def test_steps_that_only_start_an_episode_are_not_counted() -> None:
    envs = gym.make_vec(TRACK, num_envs=3, vectorization_mode="vector_entry_point", horizon=10)
    assert vector_steps(envs, episode=10)(2) == 2 * 10 * 3
