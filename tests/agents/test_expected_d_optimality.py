"""The mean criterion of inputs over many systems, and its gradient, against each system by itself."""

import sys
from pathlib import Path

import numpy as np
import pytest

from agents.planning.d_optimality import DIVERGED_RATIO, NominalSystem, compile_d_optimality
from agents.planning.open_loop.expected_d_optimality import SampledSystems, compile_expected_d_optimality
from estimator.compilation.simd import LANES
from estimator.engine.storage_layout import n_older_inputs

sys.path.append(str(Path(__file__).parents[1] / "estimator"))
from reference.plants import CASES

SAMPLES, PENALTY = 30, 5.0


def drawn(name, systems):
    """Model, degree, systems in motion, each with a start, noises and disturbances of its own, and inputs."""
    model, interpolation, c, size = CASES[name]
    degree, n, rng = int(interpolation == "linear"), model.n_states, np.random.default_rng(6)
    c = np.array(c, dtype=np.float64)
    coefficients = c * rng.uniform(0.9, 1.1, (systems, len(c)))
    starts = np.zeros((systems, compile_d_optimality(model, degree).start_size))
    starts[:, :n] = 0.05 * size * rng.standard_normal((systems, n))
    starts[:, n : n + n * (n + 1) // 2] = 1e-6 * np.eye(n)[np.triu_indices(n)]
    older = max(n_older_inputs(model, degree).values())
    starts[:, starts.shape[1] - older :] = size * rng.uniform(-1, 1, (systems, older))
    noises = 1e-6 * rng.uniform(1.0, 4.0, (systems, 1 + model.n_outputs))
    shakes = 0.1 * size * rng.standard_normal((systems, SAMPLES))
    precision = np.diag(1 / (0.1 * np.maximum(np.abs(c), 0.01)) ** 2)
    return (
        model,
        degree,
        SampledSystems(coefficients, starts, noises, shakes, precision),
        size * rng.uniform(-1, 1, SAMPLES),
    )


def one_by_one(model, degree, systems, limit, penalty, u):
    """The mean criterion, its gradient, and the peaks (S,)."""
    found, values, gradients, peaks = compile_d_optimality(model, degree), [], [], []
    memory = found.workspace(len(u))
    for c, start, noises, shakes in zip(*systems[:4], strict=True):
        value, peak = found.criterion_and_gradient(
            NominalSystem(c, systems.precision, tuple(noises)), limit, penalty, start, u + shakes, memory
        )
        values.append(value)
        peaks.append(peak)
        gradients.append(memory.gradient.copy())
    return np.mean(values), np.mean(gradients, axis=0), np.array(peaks)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name in ("motion", "tanks"))) for name in CASES]
)
def test_the_mean_worth_and_its_gradient_are_those_of_each_system(name):
    model, degree, systems, u = drawn(name, LANES + 5)
    *_, peaks = one_by_one(model, degree, systems, np.inf, 0.0, u)
    limit = float(np.median(peaks)) / DIVERGED_RATIO  # half of the systems are lost
    expected, slopes, peaks = one_by_one(model, degree, systems, limit, PENALTY, u)
    assert 0 < np.count_nonzero(peaks >= DIVERGED_RATIO * limit) < len(peaks)
    found = compile_expected_d_optimality(model, degree)
    memory = found.workspace(SAMPLES)
    assert found.criterion_and_gradient(systems, limit, PENALTY, u, memory) == pytest.approx(expected, rel=1e-11)
    np.testing.assert_allclose(memory.gradient, slopes, rtol=0, atol=1e-9 * np.abs(slopes).max())


def test_a_diverging_system_counts_its_information_until_then():
    model, degree, systems, u = drawn("paper", 3)
    systems.coefficients[1] *= 1e3  # its outputs overflow
    expected, slopes, peaks = one_by_one(model, degree, systems, 1.0, 0.0, u)
    assert peaks[1] > DIVERGED_RATIO
    found = compile_expected_d_optimality(model, degree)
    memory = found.workspace(SAMPLES)
    assert found.criterion_and_gradient(systems, 1.0, 0.0, u, memory) == pytest.approx(expected, rel=1e-11)
    assert np.isfinite(memory.gradient).all()
    np.testing.assert_allclose(memory.gradient, slopes, rtol=0, atol=1e-9 * np.abs(slopes).max())
