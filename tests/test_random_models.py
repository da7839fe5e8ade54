"""Fifty random models: compiled against matrices, a batch against single environments, saved against loaded."""

import numpy as np
import pytest
from playing import BY_HAND, continue_with, random_actions, roll_out
from random_models import interpolation, random_model
from reference.likelihoods import STD, Q, R, assert_likelihood_is_that_with_matrices, simulated_record

from duffing_env.batch import spawn_seeds
from duffing_env.tracks.model_env import ModelEnv, ModelVectorEnv
from estimator import Channel, OnlineEstimator, Rig
from estimator.models.expression import FUNCTIONS
from estimator.priors import weak_prior
from estimator.rigs.units import Scales
from estimator.saving import load_estimator, save_estimator

#: The first ones run always; a model takes half a minute to derive and compile.
SEEDS = [0, 3, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(50) if seed not in (0, 3))]


def record(seed):
    """Inputs (T, inputs) and outputs (T, sensors) of a random model."""
    return simulated_record(*random_model(seed), interpolation(seed))


def test_they_use_every_function():
    drawn = [random_model(seed)[0] for seed in range(50)]
    text = " ".join(" ".join([*model.rates, *model.next_state, *model.outputs.values()]) for model in drawn)
    assert not [name for name in (*FUNCTIONS, "pi", "derivative", "[-1]", "[-2]") if name not in text]
    for count, most in (("n_states", 5), ("n_inputs", 3), ("n_outputs", 3)):
        assert {getattr(model, count) for model in drawn} == set(range(1, most + 1))


@pytest.mark.parametrize("seed", SEEDS)
def test_a_compiled_likelihood_is_that_with_matrices(seed):
    assert_likelihood_is_that_with_matrices(*random_model(seed), interpolation(seed))


@pytest.mark.parametrize("seed", SEEDS)
def test_rows_of_a_batch_are_single_environments(seed):
    model, coefficients = random_model(seed)
    options = {
        "system": model, "mean": dict(zip(model.coefficients, coefficients.tolist(), strict=True)), "spread": 0.1,
        "process_noise": Q, "measurement_noise": R, "max_input": 0.4, "max_output": 0.8, "horizon": 12,
        "interpolation": interpolation(seed),
    }  # fmt: skip
    actions = random_actions(30, 2, inputs=model.n_inputs)
    together = roll_out(ModelVectorEnv(2, autoreset_mode=BY_HAND, **options), actions, seed=7)
    together = [given for given in together if len(given) == 5]
    for row, row_seed in enumerate(spawn_seeds(7, 2)):
        env = ModelEnv(**options)
        env.reset(seed=row_seed)
        alone = [given for given in continue_with(env, actions[:, row]) if len(given) == 5]
        for kind in range(4):  # observations, rewards, and both ends
            np.testing.assert_array_equal([given[kind][row] for given in together], [given[kind] for given in alone])


@pytest.mark.parametrize("seed", SEEDS)
def test_a_saved_estimator_goes_on_as_it_was(seed, tmp_path):
    model, coefficients = random_model(seed)
    u, y = record(seed)
    held = model.is_continuous and interpolation(seed) == "zero_order"
    rig = Rig(0.01, interpolation(seed), -1 if held else 0, {name: Channel("V") for name in model.inputs})
    prior = weak_prior(
        model, coefficients, np.diag(0.2 * coefficients) ** 2, Q, R, state_std=[STD] * model.n_states,
        scales=Scales(0.01),
    )  # fmt: skip
    estimator = OnlineEstimator(prior=prior, rig=rig)
    u, y = (array[:, 0] if array.shape[1] == 1 else array for array in (u, y))
    estimator.run(u[:10], y[:10])
    save_estimator(estimator, tmp_path / "estimator.npz")
    loaded = load_estimator(tmp_path / "estimator.npz")
    np.testing.assert_array_equal(loaded.run(u[10:], y[10:]), estimator.run(u[10:], y[10:]))
    np.testing.assert_array_equal(loaded.belief.record, estimator.belief.record)
    assert np.isfinite(estimator.belief.record).all()
