"""The tracks on Eq. (1): against their twin, and the statements of the docstring."""

import gymnasium as gym
import numpy as np
import pytest
from playing import random_actions
from twin import TwinContinuousEnv, assert_env_follows_twin

from duffing_env.tracks.differential_equation_tracks import ContinuousEnv, ContinuousVectorEnv

TRACK = "duffing_env/Amplitude-v1"
#: As they are compiled for tests/specimens.py: the belief does not depend on the reward.
ODE = {"reward": "expected_free_energy"}
NLARX = {"estimator": "nlarx", "iterations": 1}


def test_the_fisher_information_is_refused_to_an_equation_that_the_plant_does_not_obey():
    with pytest.raises(ValueError, match="reward must not be 'fisher' for estimator='nlarx'"):
        ContinuousEnv(reward="fisher", estimator="nlarx")


#: Only `make evidence` runs these, because a kernel takes seconds to compile: the rewards by free energy, free run and
#: Fisher information are tested on the difference equation.
EVIDENCE = ("free_energy", "simulation_error", "fisher")
MEAN_FIELD = {"estimator": "nlarx", "factorisation": "mean_field"}
FOLLOWED = [
    ({}, "expected_free_energy"),
    *(pytest.param({}, reward, marks=pytest.mark.slow) for reward in EVIDENCE),
    *(
        (each, reward)
        for each in (NLARX, MEAN_FIELD)
        for reward in ("information_gain", "log_posterior", "parameter_error")
    ),
    *(
        pytest.param(each, reward, marks=pytest.mark.slow)
        for each in (NLARX, MEAN_FIELD)
        for reward in (*EVIDENCE[:2], "expected_free_energy")  # the other is refused, as tested above
    ),
]


@pytest.mark.parametrize(("options", "reward"), FOLLOWED, ids=str)
def test_env_follows_its_twin(options, reward):
    options = {**options, "horizon": 60}
    env = ContinuousEnv(reward=reward, **options)
    assert assert_env_follows_twin(env, TwinContinuousEnv(3, **options), reward, 3) == [(False, True)] * 2


@pytest.mark.parametrize(
    "options",
    [
        {"max_output": 0.15, "horizon": 64},
        {"max_input": 0.03, "process_noise": 2e-3, "measurement_noise": 1e-5, "horizon": 40},
        pytest.param({"spread": 0.8, "iterations": 5, "horizon": 64}, marks=pytest.mark.slow),  # a kernel of its own
    ],
    ids=str,
)
def test_env_follows_its_twin_with_other_options(options):
    assert_env_follows_twin(ContinuousEnv(**ODE, **options), TwinContinuousEnv(1, **options), ODE["reward"], 1)


def test_the_plant_does_not_depend_on_the_estimator():
    outputs = []
    for options in (ODE, NLARX):
        envs = ContinuousVectorEnv(4, **options)
        envs.reset(seed=0)
        outputs.append([])
        for actions in random_actions(40, 4):
            envs.step(actions)
            outputs[-1].append(envs._batch.row_values("Y_y"))
    np.testing.assert_array_equal(*outputs)


def test_the_first_observation_shows_the_prior():
    env = gym.make(TRACK)
    observation, _ = env.reset(seed=0)
    np.testing.assert_allclose(observation[[*range(8), *range(14, 20)]], 0.0, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(observation[20:], 1.0)


def test_the_parameters_errors_sum_to_their_change():
    env = ContinuousEnv(reward="parameter_error", horizon=60, noise_hypotheses=3)
    prior = env.belief
    for seed in range(3):
        env.reset(seed=seed)
        total = sum(env.step(action)[1] for action in random_actions(60, seed=seed)[:, 0])
        true = np.array([env.truth[name] for name in ("m", "c", "a", "b")])
        error = [np.minimum(np.abs(belief.physical()[0] / true - 1), 1).mean() for belief in (prior, env.belief)]
        assert total == pytest.approx(error[0] - error[1], abs=1e-9)


def test_beliefs_are_calibrated_and_those_of_the_difference_equation_are_not():
    # 200 episodes: the squared distance of the truth from the mean, in standard deviations, is 4 on average.
    distances = []
    for options in (ODE, NLARX):
        envs = ContinuousVectorEnv(200, max_output=2.0, **options)
        envs.reset(seed=0)
        for actions in np.clip(random_actions(256, 200), -1, 1):
            envs.step(actions)
        found = []
        for row in range(200):
            mean, cov = envs.belief(row).physical()
            true = np.array([getattr(envs.truth, name)[row] for name in ("m", "c", "a", "b")])
            deviation, relative = mean / true - 1, cov / np.outer(true, true)
            found.append(deviation @ np.linalg.solve(relative, deviation))
        distances.append(np.mean(found))
    assert 3.2 < distances[0] < 4.8
    assert distances[1] > 100


def test_a_soft_spring_that_pushes_is_a_number_if_a_bad_one():
    env = ContinuousEnv(**ODE)
    for value in (1e300, -1e5):
        env.reset(seed=0)
        env.step([0.7])
        batch = env._batch
        batch._blocks[0, batch._row_of["stiffness"], 0] = value
        before = env.belief
        observation, received, terminated, _, info = env.step([0.5])
        assert observation in env.observation_space
        assert np.isfinite(received)
        if info["diverged"]:
            assert (received, terminated) == (0.0, True)
            assert env.belief == before
        env.reset()
        assert np.isfinite(env.step([0.5])[1])


def test_an_episode_is_drawn_with_the_maps_of_its_estimator():
    from duffing_env.rendering.episode_renderer import _physical_moments

    env = gym.make(TRACK, render_mode="rgb_array", horizon=5)
    env.reset(seed=0)
    env.step(np.float32([0.5]))
    assert env.render().shape[-1] == 3
    belief = env.unwrapped.belief
    means, stds = _physical_moments([belief])
    mean, cov = belief.physical()
    np.testing.assert_allclose(means[:, 0], mean, rtol=1e-14)
    np.testing.assert_allclose(stds[:, 0], np.sqrt(np.diag(cov)), rtol=1e-14)
