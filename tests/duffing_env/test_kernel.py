"""The compiled step against its plain NumPy twin, over whole episodes."""

from itertools import combinations

import numpy as np
import pytest
from rounding import U64
from scipy import stats
from specimens import MODELS
from twin import PARAMETERS, TwinEnv, assert_env_follows_twin

from duffing_env.batch import Batch, spawn_seeds
from duffing_env.env import DuffingEnv
from duffing_env.experiment_config import SimulatedExperiment
from duffing_env.kernel import RESET_MANUALLY, RESET_NEXT_STEP, RESET_SAME_STEP
from duffing_env.rewards.named_rewards import REWARDS
from duffing_env.storage.kernel_spec import observation_bounds
from estimator import SILVERBOX_TWIN
from estimator.models.difference_equation import difference
from estimator.rigs.physical_parameters import coefficients_of

COEFFICIENTS = ("theta1", "theta2", "theta3", "eta")
CENTER = np.array([getattr(SILVERBOX_TWIN, name) for name in PARAMETERS])


#: Only `make evidence` runs these kernels: rewards use a mean-field belief as they use any other. The free energy of a
#: structured belief is compared over the record, in test_replay.py.
PAIRS = [("structured", reward) for reward in REWARDS if reward != "free_energy"]
PAIRS += [
    ("mean_field", "free_energy"),
    *(
        pytest.param("mean_field", reward, marks=pytest.mark.slow)
        for reward in ("fisher", "expected_free_energy", "simulation_error")
    ),
]


@pytest.mark.parametrize(("factorisation", "reward"), PAIRS)
def test_env_follows_its_twin(factorisation, reward):
    # All rewards meet the same episodes, so one reward suffices to compare seeds.
    whole = (factorisation, reward) == ("structured", "information_gain")
    for seed in (0, 1, 2**40) if whole else (0,):
        options = {"factorisation": factorisation, "horizon": 256 if whole else 64}
        env, twin = DuffingEnv(reward=reward, **options), TwinEnv(seed, **options)
        assert assert_env_follows_twin(env, twin, reward, seed) == [(False, True)] * 2


@pytest.mark.parametrize(
    "options",
    [
        {"max_output": 0.2, "horizon": 40},
        {"max_input": 0.03, "process_noise": 2e-3, "measurement_noise": 1e-5, "horizon": 40},
        {"spread": 0.8, "horizon": 40},
        {"max_rms": 0.03, "horizon": 40},
        {"max_slew": 0.05, "input_cost": 0.3, "horizon": 40},
        {"jump": 0.5, "drift": 0.01, "horizon": 40},
    ],
    ids=str,
)
def test_env_follows_its_twin_with_other_options(options):
    for seed in range(2):
        endings = assert_env_follows_twin(DuffingEnv(**options), TwinEnv(seed, **options), "information_gain", seed)
        if "max_output" in options:
            assert (True, False) in endings


def test_mean_field_follows_its_twin_with_other_options():
    options = {"factorisation": "mean_field", "iterations": 4, "max_output": 0.2, "horizon": 40, "process_noise": 2e-3}
    assert_env_follows_twin(DuffingEnv(reward="free_energy", **options), TwinEnv(1, **options), "free_energy", 1)
    with pytest.raises(ValueError, match="drift must be 0 in mean field"):
        DuffingEnv(factorisation="mean_field", drift=0.01)


def test_observation_names_its_entries_in_the_order_of_the_documentation():
    coefficients = ("theta1", "theta2", "theta3", "eta")
    names = [f"mean_{c}" for c in coefficients] + [f"log_std_{c}" for c in coefficients]
    names += [f"corr_{c}_{d}" for c, d in combinations(coefficients, 2)]
    names += ["log_gamma", "log_xi_y", "state_x1", "state_x2", "last_input", "last_y", "time_left", "budget_left"]
    assert list(observation_bounds(difference())) == names


@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
def test_the_length_of_an_observation_follows_from_the_model(model):
    k = model.n_coefficients
    expected = 2 * k + k * (k - 1) // 2 + model.n_states + 2 * model.n_outputs + 4
    assert len(observation_bounds(model)) == expected


@pytest.mark.parametrize("spread", [0.3, 0.9])
def test_oscillators_are_log_uniform_about_the_twin(spread):
    size = 4000
    batch = Batch(SimulatedExperiment(spread=spread), size, RESET_MANUALLY)
    for row, seed in enumerate(spawn_seeds(0, size)):
        batch.seed(row, np.random.default_rng(seed))
    batch.reset(np.ones(size, dtype=np.bool_))
    drawn = np.stack([batch.row_values(f"PARAM_{name}") for name in PARAMETERS])
    low, high = np.log(1 - spread), np.log(1 + spread)
    quantiles = (np.log(drawn / CENTER[:, None]) - low) / (high - low)
    assert quantiles.min() > 0
    assert quantiles.max() < 1
    for row in quantiles:
        assert stats.kstest(row, "uniform").pvalue > 0.01
    assert np.abs(np.corrcoef(quantiles)[np.triu_indices(4, 1)]).max() < 4 / np.sqrt(size)

    expected = coefficients_of(difference(), dict(zip(PARAMETERS, drawn, strict=True))).T
    # θ₁ = 1 + m / (m + c h) - a η cancels; the others are products. None takes more than eight operations on a side.
    sizes = np.abs(expected)
    sizes[0] = 1 - expected[2] + drawn[2] * expected[3]
    stored = np.stack([batch.row_values(f"TRUE_{name}") for name in COEFFICIENTS])
    assert (np.abs(stored - expected) <= 16 * U64 * sizes).all()


def test_prior_has_the_moments_of_the_oscillators():
    # The first belief is calibrated: 4,000 draws replace the quadrature of the prior.
    size = 4000
    batch = Batch(SimulatedExperiment(), size, RESET_MANUALLY)
    for row, seed in enumerate(spawn_seeds(1, size)):
        batch.seed(row, np.random.default_rng(seed))
    batch.reset(np.ones(size, dtype=np.bool_))
    prior = batch.belief(0)
    drawn = np.stack([batch.row_values(f"TRUE_{name}") for name in COEFFICIENTS], axis=1)
    whitened = np.linalg.solve(np.linalg.cholesky(prior.coefficients_cov), (drawn - prior.coefficients_mean).T)
    assert np.abs(whitened.mean(axis=1)).max() < 4 / np.sqrt(size)
    np.testing.assert_allclose(np.cov(whitened), np.eye(4), rtol=0, atol=0.1)


def test_plant_spread_is_for_the_plant_alone():
    env = DuffingEnv(plant_spread=0.0)
    env.reset(seed=0)
    np.testing.assert_array_equal([getattr(env.truth, name) for name in PARAMETERS], CENTER)
    np.testing.assert_array_equal(env.belief.record, DuffingEnv().belief.record)
    assert not np.array_equal(DuffingEnv(spread=0.1).belief.record, env.belief.record)


@pytest.mark.parametrize("mode", [RESET_MANUALLY, RESET_NEXT_STEP, RESET_SAME_STEP])
def test_lanes_beyond_the_last_environment_keep_within_bounds(mode):
    batch = Batch(SimulatedExperiment(horizon=50), 1, mode)
    batch.seed(0, np.random.default_rng(0))
    for _ in range(2000):
        if mode == RESET_MANUALLY and batch.row_values("TRUNCATED")[0]:
            batch.reset(np.ones(1, dtype=np.bool_))
        batch.step(np.zeros(1))
    assert np.isfinite(batch._observations).all()
    assert np.abs(batch._observations).max() <= 20
