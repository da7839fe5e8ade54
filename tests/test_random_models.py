"""Fifty random models: compiled against matrices, a batch against single environments, saved against loaded."""

import numpy as np
import pytest
from playing import BY_HAND, continue_with, random_actions, roll_out
from random_models import interpolation, random_model
from reference.filters import EPS, Plant, acting, input_seen, moved, path

from duffing_env.batch import spawn_seeds
from duffing_env.tracks.model_env import ModelEnv, ModelVectorEnv
from estimator import Channel, OnlineEstimator, Rig
from estimator.inference.record_filter import inputs_by_sample, noise_variances, record_likelihoods
from estimator.models.expression import FUNCTIONS
from estimator.priors import weak_prior
from estimator.rigs.units import Scales
from estimator.saving import load_estimator, save_estimator

#: The first ones run always; a model takes half a minute to derive and compile.
SEEDS = [0, 3, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(50) if seed not in (0, 3))]
#: Standard deviations of both noises and of the first state, in V.
Q, R, STD = 2e-3, 1e-3, 1e-2


def record(seed, samples=20):
    """Inputs (T, inputs) and outputs (T, sensors) of a random model, with noise."""
    (model, coefficients), plant = random_model(seed), Plant.of(random_model(seed)[0])
    rng, z = np.random.default_rng(1), np.zeros(model.n_states)
    u, y = rng.uniform(-0.4, 0.4, (samples, model.n_inputs)), np.empty((samples, model.n_outputs))
    for t in range(samples):
        inputs = acting(plant, u, t, interpolation(seed))
        z = moved(plant, z, coefficients, inputs) + Q * plant.effects(z, coefficients).sum(1) * rng.standard_normal()
        y[t] = plant.show(z, coefficients, input_seen(plant, inputs))
    return u, y + R * rng.standard_normal(y.shape)


def test_they_use_every_function():
    drawn = [random_model(seed)[0] for seed in range(50)]
    text = " ".join(" ".join([*model.rates, *model.next_state, *model.outputs.values()]) for model in drawn)
    assert not [name for name in (*FUNCTIONS, "pi", "derivative", "[-1]", "[-2]") if name not in text]
    for count, most in (("n_states", 5), ("n_inputs", 3), ("n_outputs", 3)):
        assert {getattr(model, count) for model in drawn} == set(range(1, most + 1))


@pytest.mark.parametrize("seed", SEEDS)
def test_a_compiled_likelihood_is_that_with_matrices(seed):
    model, coefficients = random_model(seed)
    between, plant = interpolation(seed), Plant.of(model)
    u, y = record(seed)
    cov = STD**2 * np.eye(model.n_states)
    inputs = [acting(plant, u, t, between) for t in range(len(u))]
    expected = path(plant, np.zeros(model.n_states), cov, coefficients, inputs, Q**2, [R**2] * model.n_outputs, y)
    rows = inputs_by_sample(model, u[None], int(between == "linear"))
    found = record_likelihoods(model, coefficients[None], rows, y[None], noise_variances(model, Q, R), cov)
    # Some hundred operations a sample, whose rounding grows with the state's, and with the share of its variance that
    # an output leaves.
    allowed = 300 * len(u) * EPS * expected.growth * (STD / R) ** 2
    np.testing.assert_allclose(found.loss[0], expected.loss, rtol=allowed, atol=allowed * len(u))
    scale = np.sqrt(np.diag(expected.information))
    scale[scale == 0] = 1.0  # of a state that no sensor sees
    difference = (found.information[0] - expected.information) / np.outer(scale, scale)
    np.testing.assert_allclose(difference, 0, atol=allowed)


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
