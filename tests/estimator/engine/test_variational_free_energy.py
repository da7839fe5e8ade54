"""The free energy of the compiled update, from its trace."""

from dataclasses import replace

import numpy as np
import pytest
from engine_cases import CASES, get_belief, random_belief
from reference.filters import EPS, difference_step, seen
from reference.mean_field import expected_log_gaussian, expected_log_normal, gamma_divergence, gaussian_entropy
from reference.structured import update
from scipy.linalg import block_diag
from scipy.stats import norm
from test_gaussian_update import LANES, some_samples, updated

from estimator.engine import kernels
from estimator.engine.variational_free_energy import compile_free_energies

ITERATIONS = 3


@pytest.mark.parametrize("name", ["duffing", "paper", "pendulum"])
def test_free_energies_equal_their_definition(name):
    """One sensor, and two of which only the first informs the process noise."""
    case = CASES[name]
    task = kernels.compile_belief_update(
        case.model, case.degree, iterations=ITERATIONS, lanes=LANES, keep_trace=True, may_be_missing=True
    )
    free_energy = compile_free_energies(case.model, ITERATIONS, LANES, task.layout)
    samples = some_samples(case, 3)
    samples[1][2][0] = np.nan
    samples[2][2][:] = np.nan
    W = updated(case, task, samples)
    found = np.full((ITERATIONS, LANES), np.nan)
    free_energy(W, found.ravel())
    for out, (belief, inputs, y) in zip(found.T, samples, strict=False):
        expected = update(case.plant, case.model.n_states, belief, inputs, y, ITERATIONS)
        total = np.sum([part for part in expected.free_energies if part] or [np.zeros(ITERATIONS)], axis=0)
        # Digamma and log Gamma of shapes up to 1e3 are up to 6e3 in size, and cancel to numbers of order one.
        tolerance = EPS * case.operations * expected.condition * 10 + 6e3 * 8 * EPS
        np.testing.assert_allclose(out, total, rtol=tolerance, atol=tolerance * (1 + np.abs(total).max()))


def test_the_reference_has_the_free_energy_of_the_joint_gaussian():
    """Of the quantities before a sample and its process noise, with q(γ) and q(ξ): entropies and divergences."""
    case = CASES["paper"]
    for belief, inputs, y in some_samples(case, 8):
        step, d = difference_step(belief.mean, inputs[0]), len(belief.mean)
        T = np.append(step.jacobian[0], 1.0)  # from these to the displacement
        gamma, xi = belief.gamma, belief.xi[0]
        for _ in range(ITERATIONS):
            q, r = gamma[1] / gamma[0], xi[1] / xi[0]
            P = block_diag(belief.cov, q)
            gain, _, posterior = seen(P, r, T)
            deviation = gain * (y[0] - step.moved[0])
            w_power = deviation[d] ** 2 + posterior[d, d]
            v_power = (y[0] - step.moved[0] - T @ deviation) ** 2 + T @ posterior @ T
            gamma = belief.gamma[0] + 0.5, belief.gamma[1] + w_power / 2
            xi = belief.xi[0][0] + 0.5, belief.xi[0][1] + v_power / 2
        energy = -gaussian_entropy(posterior)
        energy -= expected_log_gaussian((deviation[:d], posterior[:d, :d]), (np.zeros(d), belief.cov))
        energy -= expected_log_normal(w_power, gamma) + expected_log_normal(v_power, xi)
        energy += gamma_divergence(gamma, belief.gamma) + gamma_divergence(xi, belief.xi[0])
        found = update(case.plant, 2, belief, inputs, y, ITERATIONS)
        assert found.free_energies[0][-1] == pytest.approx(energy, rel=1e-9, abs=1e-9)
        np.testing.assert_allclose([found.belief.gamma, found.belief.xi[0]], [gamma, xi], rtol=1e-9)


def traced(iterations):
    """The update of the paper's equation, its free energies, and belief and sample after sample for it."""
    case = CASES["paper"]
    task = kernels.compile_belief_update(case.model, iterations=iterations, lanes=LANES, keep_trace=True)
    return case, task, compile_free_energies(case.model, iterations, LANES, task.layout)


def predicted(belief, u):
    """Mean and variance of the next displacement without its noise, to first order."""
    x, last, theta1, theta2, theta3, eta = belief.mean
    slope = np.array([theta1 + 3 * theta2 * x**2, theta3, x, x**3, last, u])
    return theta1 * x + theta2 * x**3 + theta3 * last + eta * u, slope @ belief.cov @ slope


def noise_variances(rng, precision, draws):
    """Variances (draws,) of a noise whose precision is Gamma (shape, rate)."""
    shape, rate = precision
    return 1 / rng.gamma(shape, 1 / rate, draws)


def test_known_noises_make_it_the_surprise_of_a_kalman_filter():
    """With shapes of 1e12 the noises stay where they are; then F is -log N(y | prediction, S), which is exact."""
    case, task, free_energy = traced(ITERATIONS)
    q, r, shape, found, rng = 0.01**2, 0.02**2, 1e12, np.empty((ITERATIONS, LANES)), np.random.default_rng(4)
    samples, surprises = [], []
    for belief, inputs, _ in some_samples(case, 4):
        mean, variance = predicted(belief, inputs[0])
        std = np.sqrt(variance + q + r)
        y = mean + std * rng.standard_normal()
        samples.append((replace(belief, gamma=(shape, shape * q), xi=[(shape, shape * r)]), inputs, [y]))
        surprises.append(-norm.logpdf(y, mean, std))
    W = updated(case, task, samples)
    free_energy(W, found.ravel())
    for out, surprise in zip(found.T, surprises, strict=False):
        # Both KL[q(γ)] and KL[q(ξ)] are below (ν²/r)² / shape, which is 1e-8 nats here.
        assert out[-1] == pytest.approx(surprise, abs=1e-7)


def test_it_never_rises_and_bounds_the_surprise():
    """The iterations are coordinate descent on F of the linearised model, and F >= -log p(y) for any noise prior."""
    case, task, free_energy = traced(10)
    rng, draws, found = np.random.default_rng(5), 20_000, np.empty((10, LANES))
    samples, densities = [], []
    for belief, inputs, _ in some_samples(case, 5):
        mean, variance = predicted(belief, inputs[0])
        noises = noise_variances(rng, belief.gamma, draws) + noise_variances(rng, belief.xi[0], draws)
        std = np.sqrt(variance + noises)
        y = rng.normal(mean, std[0])
        samples.append((belief, inputs, [y]))
        densities.append(norm.pdf(y, mean, std))
    W = updated(case, task, samples)
    free_energy(W, found.ravel())
    for out, density in zip(found.T, densities, strict=False):
        assert (
            np.diff(out).max() <= 1e-12
        )  # some twenty terms, each of them to 5e-14 as `test_elementary_functions` has it
        evidence, error = density.mean(), density.std() / np.sqrt(draws)
        assert out[-1] >= -np.log(evidence) - 5 * error / evidence
    # With equal priors E[w²] = E[v²] for every sample, so that E[γ] = E[ξ] for ever: docs/evidence/coverage.md.
    W = updated(case, task, [(replace(belief, xi=[belief.gamma]), *rest) for belief, *rest in samples])
    for lane, (belief, *_) in enumerate(samples):
        after = get_belief(W, task.layout, LANES, lane, case)
        assert after.gamma == after.xi[0]
        assert after.gamma[1] != belief.gamma[1]


def test_it_is_finite_far_from_the_prior():
    """The rate of γ moves to 1e33 with this sample: the prior rate is then lost in the new one."""
    case, task, free_energy = traced(ITERATIONS)
    belief, found = random_belief(case, np.random.default_rng(6)), np.empty((ITERATIONS, LANES))
    W = updated(case, task, [(belief, [0.0], [1e20])] * LANES)
    free_energy(W, found.ravel())
    expected = update(case.plant, case.model.n_states, belief, [0.0], [1e20], ITERATIONS)
    np.testing.assert_allclose(found[:, 0], np.sum(expected.free_energies, axis=0), rtol=1e-9)
