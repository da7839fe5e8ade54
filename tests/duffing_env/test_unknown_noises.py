"""Unknown noises: drawn for every episode, and wrong guesses of them."""

import numpy as np
import pytest
from scipy import stats
from specimens import COMPILED
from twin import PARAMETERS, TwinContinuousEnv, TwinEnv, assert_env_follows_twin

from duffing_env.batch import Batch, spawn_seeds
from duffing_env.env import DuffingEnv
from duffing_env.experiment_config import SimulatedExperiment
from duffing_env.kernel import RESET_MANUALLY
from duffing_env.tracks.differential_equation_tracks import ContinuousEnv
from duffing_env.tracks.model_env import ModelExperiment
from duffing_env.tracks.track_registry import TRACKS
from duffing_env.vector_env import DuffingVectorEnv

UNKNOWN = {"noise_range": 10.0, "process_noise_guess": 2e-4, "measurement_noise_guess": 1e-3, "horizon": 40}
ENVS = {"difference": (DuffingEnv, TwinEnv), "continuous": (ContinuousEnv, TwinContinuousEnv)}


def begun(size, **options):
    """A batch at the start of its episodes."""
    batch = Batch(SimulatedExperiment(**options), size, RESET_MANUALLY)
    for row, seed in enumerate(spawn_seeds(0, size)):
        batch.seed(row, np.random.default_rng(seed))
    batch.reset(np.ones(size, dtype=np.bool_))
    return batch


# --- Drawn for every episode ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("equation", "reward"),
    [
        ("difference", "information_gain"),
        ("difference", "fisher"),
        ("continuous", "expected_free_energy"),
        pytest.param("continuous", "fisher", marks=pytest.mark.slow),
    ],
)
def test_an_environment_with_unknown_noises_follows_its_twin(equation, reward):
    env, twin = ENVS[equation]
    assert_env_follows_twin(env(reward=reward, **UNKNOWN), twin(0, **UNKNOWN), reward, 0)


def test_noises_are_log_uniform_about_what_is_given_and_independent():
    centers = {"process_noise": 2e-3, "measurement_noise": 1e-4}
    batch = begun(4000, noise_range=100.0, **centers)
    truth = batch.truth()
    assert list(truth) == [*PARAMETERS, *centers]
    powers = np.stack([np.log(truth[name] / centers[name]) / np.log(100.0) + 0.5 for name in centers])
    assert powers.min() > 0
    assert powers.max() < 1
    for row in powers:
        assert stats.kstest(row, "uniform").pvalue > 0.01
    drawn = np.log(np.stack([truth[name] for name in truth]))
    assert np.abs(np.corrcoef(drawn)[np.triu_indices(len(drawn), 1)]).max() < 4 / np.sqrt(4000)


def test_drawn_noises_are_the_plants_noises_and_change_nothing_else():
    loud, plain = begun(100, noise_range=10.0), begun(100)
    for name in PARAMETERS:
        np.testing.assert_array_equal(loud.truth()[name], plain.truth()[name])
    assert list(plain.truth()) == list(PARAMETERS)
    np.testing.assert_array_equal(plain.row_values("PROCESS_STD"), 5e-4)
    loud.step(np.zeros((100, 1)))  # from rest: the noise is all that moves it
    x, truth = loud.row_values("X_x1"), loud.truth()
    np.testing.assert_allclose(x, truth.process_noise * loud.row_values("NOISE_w"), rtol=1e-14)
    shown = truth.measurement_noise * loud.row_values("NOISE_v")
    np.testing.assert_allclose(loud.row_values("Y_y") - x, shown, rtol=0, atol=1e-17)


def test_the_truth_has_the_noises_at_the_end_of_an_episode():
    env = DuffingEnv(noise_range=10.0, horizon=3)
    env.reset(seed=0)
    for _ in range(3):
        env.step([0.5])
    assert list(env.truth) == [*PARAMETERS, "process_noise", "measurement_noise"]
    envs = DuffingVectorEnv(2, autoreset_mode="SameStep", noise_range=10.0, horizon=3)
    envs.reset(seed=[0, 1])
    for _ in range(3):
        *_, infos = envs.step(np.full((2, 1), 0.5, dtype=np.float32))
    assert infos["final_info"]["truth"][0] == env.truth
    assert envs.truth.process_noise[0] != env.truth.process_noise


def test_every_sensor_has_a_noise_of_its_own():
    (own,) = (environment for environment in COMPILED if environment.name == "own model")
    env = own.make(noise_range=10.0)
    env.reset(seed=0)
    noises = dict(list(env.truth.items())[3:])
    assert list(noises) == ["process_noise", "measurement_noise_y", "measurement_noise_speed"]
    factors = np.array(list(noises.values())) / [1e-6, 1e-4, 3e-4]
    assert len(set(factors)) == 3
    assert (np.abs(np.log(factors)) < np.log(10) / 2).all()


# --- Guessed ---------------------------------------------------------------------------------------------------------


def test_the_prior_is_centred_at_the_guess():
    experiment = SimulatedExperiment(process_noise_guess=2e-4, measurement_noise_guess=3e-3, noise_shape=4.0)
    known = SimulatedExperiment(process_noise=2e-4, measurement_noise=3e-3, noise_shape=4.0)
    assert experiment.prior_belief == known.prior_belief
    assert experiment.kernel_params.process_noise == 5e-4
    assert experiment.kernel_params.measurement_noise.tolist() == [5e-4]


def test_the_guess_of_further_sensors_is_as_far_off_as_that_of_the_first():
    settings = TRACKS["duffing_env/Pendulum-v0"]["kwargs"]
    belief = ModelExperiment(**settings, sensor_noise=(4e-6,), measurement_noise_guess=3e-6).prior_belief
    stds = np.sqrt(belief.noises[1::2] / belief.noises[::2])
    np.testing.assert_allclose(stds, [settings["process_noise"], 3e-6, 12e-6], rtol=1e-12)
