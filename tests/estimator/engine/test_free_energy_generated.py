"""The free energy of the generated update, from what it leaves in its trace."""

import numpy as np
import pytest
from engine_cases import CASES, random_belief
from engine_reference import EPS, update
from estimator.inference.noise import sample_free_energy
from test_structured_generated import LANES, some_samples, updated

from estimator.engine import tasks
from estimator.engine.free_energy import free_energies

ITERATIONS = 3


@pytest.mark.parametrize("name", [pytest.param("duffing", marks=pytest.mark.slow), "pendulum"])
def test_free_energies_equal_their_definition(name):
    """Over one and over two sensors, of which only the first tells of the process noise."""
    case = CASES[name]
    task = tasks.structured(case.model, case.degree, iterations=ITERATIONS, lanes=LANES, trace=True, missing=True)
    free_energy = free_energies(case.model, ITERATIONS, LANES, task.layout)
    samples = some_samples(case, 3)
    samples[1][2][0] = np.nan
    samples[2][2][:] = np.nan
    W = updated(case, task, samples)
    out = np.full(ITERATIONS, np.nan)
    for lane, (belief, inputs, y) in enumerate(samples):
        expected = update(case.plant, case.model.n_states, belief, inputs, y, ITERATIONS)
        free_energy(W, lane, out)
        total = np.sum([part for part in expected.free_energies if part] or [np.zeros(ITERATIONS)], axis=0)
        # Digamma and log Gamma of shapes up to 1e3 are up to 6e3 in size, and cancel to numbers of order one.
        tolerance = EPS * case.operations * expected.condition * 10 + 6e3 * 8 * EPS
        np.testing.assert_allclose(out, total, rtol=tolerance, atol=tolerance * (1 + np.abs(total).max()))


def test_a_single_sensor_has_the_free_energy_of_a_sample():
    case = CASES["paper"]
    task = tasks.structured(case.model, iterations=ITERATIONS, lanes=LANES, trace=True)
    free_energy = free_energies(case.model, ITERATIONS, LANES, task.layout)
    belief = random_belief(case, np.random.default_rng(5))
    W = updated(case, task, [(belief, [0.3], [0.2])] * LANES)
    row = lambda name: W[task.layout[name] * LANES + LANES - 1]  # noqa: E731
    out = np.empty(ITERATIONS)
    free_energy(W, LANES - 1, out)
    (g_shape, g_rate), (n_shape, n_rate) = belief.gamma, belief.xi[0]
    for i in range(ITERATIONS):
        q, r = row(f"TRACE_0_q_{i}"), row(f"TRACE_0_r_{i}")
        expected = sample_free_energy(
            row("TRACE_0_innovation"), row("TRACE_0_variance"), q, r, g_shape + 0.5, g_rate, n_shape + 0.5, n_rate
        )  # fmt: skip
        # The rates before the sample come back from variances and shapes, by two roundings.
        assert out[i] == pytest.approx(expected, rel=1e-13, abs=1e-13)
