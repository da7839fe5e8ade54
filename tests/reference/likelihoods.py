"""The compiled likelihood of any model against the Kalman filter with matrices."""

import numpy as np

from estimator.inference.record_filter import inputs_by_sample, noise_variances, record_likelihoods
from estimator.models.model import Model
from reference.filters import EPS, Plant, acting, input_seen, moved, path

#: Standard deviations of process noise, measurement noise and first state, of numbers near one.
Q, R, STD = 2e-3, 1e-3, 1e-2


def simulated_record(
    model: Model, coefficients: np.ndarray, interpolation: str, samples: int = 20
) -> tuple[np.ndarray, np.ndarray]:
    """Inputs (T, inputs) of up to 0.4 and outputs (T, sensors) of a model at rest at first, with noise."""
    plant, rng, z = Plant.of(model), np.random.default_rng(1), np.zeros(model.n_states)
    u, y = rng.uniform(-0.4, 0.4, (samples, model.n_inputs)), np.empty((samples, model.n_outputs))
    for t in range(samples):
        inputs = acting(plant, u, t, interpolation)
        z = moved(plant, z, coefficients, inputs) + Q * plant.effects(z, coefficients).sum(1) * rng.standard_normal()
        y[t] = plant.show(z, coefficients, input_seen(plant, inputs))
    return u, y + R * rng.standard_normal(y.shape)


def assert_likelihood_is_that_with_matrices(model: Model, coefficients: np.ndarray, interpolation: str) -> None:
    """Loss and Fisher information of a `simulated_record` are those of `path`, to rounding."""
    u, y = simulated_record(model, coefficients, interpolation)
    plant, cov = Plant.of(model), STD**2 * np.eye(model.n_states)
    inputs = [acting(plant, u, t, interpolation) for t in range(len(u))]
    noises = noise_variances(model, Q, R)
    expected = path(plant, np.zeros(model.n_states), cov, coefficients, inputs, noises[0], [R**2] * model.n_outputs, y)
    rows = inputs_by_sample(model, u[None], int(interpolation == "linear"))
    found = record_likelihoods(model, coefficients[None], rows, y[None], noises, cov)
    # Some hundred operations in each step of a sample, whose rounding grows with the state's, and with the share of its
    # variance that an output leaves.
    allowed = 300 * model.substeps * len(u) * EPS * expected.growth * (STD / R) ** 2
    np.testing.assert_allclose(found.loss[0], expected.loss, rtol=allowed, atol=allowed * len(u))
    scale = np.sqrt(np.diag(expected.information))
    scale[scale == 0] = 1.0  # of a state that no sensor sees
    difference = (found.information[0] - expected.information) / np.outer(scale, scale)
    np.testing.assert_allclose(difference, 0, atol=allowed)
