"""Plants with process noise of its own for each state, and with unknown first states: against theory and coverage."""

import numpy as np
import pytest
from playing import random_actions
from reference.filters import Plant, spread

from duffing_env.kernel_stages.generated_environment_functions import generated_functions
from duffing_env.kernel_stages.plant_stages import compile_noise_draw
from duffing_env.kernel_stages.sample_stages import compile_simulation
from duffing_env.storage.kernel_spec import KernelSpec, block_layout, noise_draw_rows
from duffing_env.tracks.model_env import ModelVectorEnv
from estimator.compilation.simd import LANES
from estimator.models.model import Model

SWING = Model(
    "swing",
    {"x": "m", "v": "m/s"},
    {"k": "1", "c": "1"},
    noise=("0.7", "1.5"),
    outputs={"y": "x"},
    rates=("v", "u - k*x - c*v"),
    substeps=4,
    independent_noise=True,
)
HELD = Model(**{**SWING.to_dict(), "held": True})
ADDED = Model(
    "added",
    {"x": "m", "w": "m"},
    {"k": "1", "c": "1"},
    noise=("0.5", "2"),
    outputs={"y": "x"},
    next_state=("k*x + w + u", "c*w"),
    independent_noise=True,
)


def noise_of_a_sample(model, values, strength, draws):
    """(n, draws * LANES) what process noise of a strength adds to the states of plants at rest."""
    spec = KernelSpec(model, model)
    place, states = block_layout(spec), [f"X_{x}" for x in model.states]
    draw_noise = compile_noise_draw(place, noise_draw_rows(model))
    simulate = compile_simulation(spec, generated_functions(spec), draw_noise)
    W, found = np.zeros((max(place.values()) + 1, LANES)), []
    words = np.random.default_rng(2).integers(1, 2**63, (4, LANES), dtype=np.uint64)
    W[[place[f"SFC64_{letter}"] for letter in "abcd"]] = words.view(np.float64)
    W[[place[f"TRUE_{c}"] for c in model.coefficients]] = np.array(values)[:, None]
    W[place["PROCESS_STD"]] = strength
    for _ in range(draws):
        W[[place[x] for x in states]] = 0.0
        draw_noise(W.reshape(-1))
        simulate(W.reshape(-1))
        found.append(W[[place[x] for x in states]].copy())
    return np.concatenate(found, axis=1)


@pytest.mark.parametrize("model", [SWING, HELD, ADDED], ids=lambda model: model.name + model.held * " held")
def test_the_noise_is_what_the_estimator_takes_it_for(model):
    """Over 64,000 draws: a variance is known to 0.6 % and a correlation to 0.004, one standard deviation."""
    values = (0.4, 0.3)
    measured = np.cov(noise_of_a_sample(model, values, 2e-3, 2000)) / 2e-3**2
    plant = Plant.of(model)
    expected = spread(plant, np.zeros(2), np.array(values), (0.0, 0.0, 0.0))
    size = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(measured / size, expected / size, atol=0.025)
    assert np.abs(expected[0, 1]) < 0.9 * size[0, 1]


def test_intervals_of_coefficients_and_first_states_cover():
    """200 systems that begin at unknown places, with noise in both states: 600 intervals of 90 %."""
    model = Model(**{**SWING.to_dict(), "coefficients": {"k": "1", "c": "1", "x0": "m"}, "initial_states": {"x": "x0"}})
    envs = ModelVectorEnv(
        200,
        system=model,
        mean={"k": 0.4, "c": 0.3, "x0": 0.0},
        std={"k": 0.05, "c": 0.05, "x0": 0.3},
        process_noise=0.02,
        measurement_noise=0.02,
        noise_shape=100.0,
        max_input=0.3,
        max_output=50.0,
        horizon=100,
    )
    envs.reset(seed=0)
    truth = np.column_stack([getattr(envs.truth, name) for name in model.coefficients])
    np.testing.assert_array_equal(envs._batch.row_values("X_x"), truth[:, 2])
    first = np.array([envs.belief(i).cov[0, 4] for i in range(200)])
    np.testing.assert_allclose(first, 0.09, rtol=1e-12)
    for actions in random_actions(60, 200):
        envs.step(actions)
    beliefs = [envs.belief(i) for i in range(200)]
    mean = np.array([belief.coefficients_mean for belief in beliefs])
    std = np.array([np.sqrt(np.diag(belief.coefficients_cov)) for belief in beliefs])
    z = (truth - mean) / std
    assert std[:, 2].max() < 0.1
    assert 0.86 <= np.mean(np.abs(z) < 1.6449) <= 0.94
