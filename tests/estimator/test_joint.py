"""The joint update against a plain twin with whole matrices, and against the lanes' update on the paper's model."""

from dataclasses import dataclass

import numpy as np
import pytest
from twins import (
    Moments,
    block_of,
    expected_log_gaussian,
    expected_log_normal,
    gamma_divergence,
    gaussian_entropy,
    random_prior,
    records_of,
)

from estimator import SILVERBOX_TWIN, Prior, to_coefficients
from estimator.inference import joint, update

STATES, SIZE = 2, 6


@dataclass
class Step:
    """All that one sample needs: a belief, a linear transition, a readout and an output."""

    mean: np.ndarray
    cov: np.ndarray
    noises: np.ndarray
    moved: np.ndarray
    jacobian: np.ndarray
    walk: np.ndarray
    readout: np.ndarray
    direction: np.ndarray
    innovation: float


def draw(rng):
    """A step at random, whose standard deviations spread over three decades and whose correlations are any."""
    std = np.exp(rng.uniform(np.log(1e-3), np.log(1.0), SIZE))
    factor = rng.standard_normal((SIZE, SIZE + 2))
    cov = factor @ factor.T
    cov *= np.outer(std, std) / np.sqrt(np.outer(np.diag(cov), np.diag(cov)))
    readout, direction = rng.standard_normal(SIZE), rng.standard_normal(STATES)
    direction /= readout[:STATES] @ direction  # scaled so that it moves the output by w
    shapes, stds = np.exp(rng.uniform(0.0, 5.0, 2)), np.exp(rng.uniform(np.log(1e-3), 0.0, 2))
    noises = np.array([shapes[0], shapes[0] * stds[0] ** 2, shapes[1], shapes[1] * stds[1] ** 2])
    walk = 0.1 * std[STATES:] ** 2
    return Step(
        rng.standard_normal(SIZE), cov, noises, rng.standard_normal(STATES), rng.standard_normal((STATES, SIZE)),
        walk, readout, direction, rng.standard_normal(),
    )  # fmt: skip


def taken(step, iterations):
    """What the module makes of a step: mean, cov, noises, free energies, and the variance of the innovation."""
    mean, cov, noises = step.mean.copy(), step.cov.copy(), step.noises.copy()
    joint.predict(mean, cov, step.moved, step.jacobian, step.walk, np.empty((STATES, SIZE)))
    trace = np.empty(iterations)
    total = joint.correct(
        mean, cov, step.readout, step.direction, step.innovation, noises, iterations, trace, np.empty(SIZE)
    )  # fmt: skip
    return mean, cov, noises, trace, total


def twin(step, iterations):
    """The same, on the joint Gaussian of the predicted state s and the process noise w, with v = y - h (s + g w)."""
    F = np.vstack([step.jacobian, np.eye(SIZE)[STATES:]])
    s = np.concatenate([step.moved, step.mean[STATES:]])
    P = F @ step.cov @ F.T + np.diag(np.concatenate([np.zeros(STATES), step.walk]))
    g = np.concatenate([step.direction, np.zeros(SIZE - STATES)])
    h = np.append(step.readout, step.readout @ g)  # of (s, w)
    gamma, xi = (a0, b0), (a1, b1) = tuple(step.noises[:2]), tuple(step.noises[2:])
    free_energies = []
    for _ in range(iterations):
        q, r = gamma[1] / gamma[0], xi[1] / xi[0]
        cov = np.zeros((SIZE + 1, SIZE + 1))
        cov[:-1, :-1], cov[-1, -1] = P, q
        total = h @ cov @ h + r
        gain = cov @ h / total
        shift = gain * step.innovation
        cov = cov - np.outer(gain, h @ cov)
        w_power = shift[-1] ** 2 + cov[-1, -1]
        v_power = (step.innovation - h @ shift) ** 2 + h @ cov @ h
        gamma, xi = (a0 + 0.5, b0 + w_power / 2), (a1 + 0.5, b1 + v_power / 2)
        free_energies.append(
            -gaussian_entropy(cov)
            - expected_log_gaussian((s + shift[:-1], cov[:-1, :-1]), (s, P))
            - expected_log_normal(w_power, gamma)
            - expected_log_normal(v_power, xi)
            + gamma_divergence(gamma, (a0, b0))
            + gamma_divergence(xi, (a1, b1))
        )
    onto = np.column_stack([np.eye(SIZE), g])
    mean = s + onto @ shift
    return mean, onto @ cov @ onto.T, np.array([*gamma, *xi]), np.array(free_energies), total


@pytest.mark.parametrize("iterations", [1, 3, 10])
def test_a_step_equals_its_twin(iterations):
    rng = np.random.default_rng(iterations)
    for _ in range(50):
        step = draw(rng)
        (mean, cov, noises, trace, total), expected = taken(step, iterations), twin(step, iterations)
        std = np.sqrt(np.diag(expected[1]))
        size = np.maximum(std, np.abs(expected[0]))
        np.testing.assert_allclose(mean / size, expected[0] / size, atol=1e-10)
        np.testing.assert_allclose(cov / np.outer(std, std), expected[1] / np.outer(std, std), atol=1e-8)
        np.testing.assert_allclose(noises, expected[2], rtol=1e-9)
        np.testing.assert_allclose(trace, expected[3], rtol=1e-9, atol=1e-9)
        assert total == pytest.approx(expected[4], rel=1e-12)
        np.testing.assert_array_equal(cov, cov.T)


def test_free_energy_never_rises_over_the_iterations():
    rng = np.random.default_rng(20)
    falls = []
    for _ in range(300):
        trace = taken(draw(rng), 10)[3]
        assert np.diff(trace).max() <= 1e-12 * max(1.0, abs(trace[0]))
        falls.append(trace[0] - trace[-1])
    assert max(falls) > 1.0  # there was something to minimise


def test_a_missing_output_moves_the_belief_and_teaches_nothing():
    step = draw(np.random.default_rng(21))
    step.innovation = np.nan
    mean, cov, noises, trace, _ = taken(step, 3)
    F = np.vstack([step.jacobian, np.eye(SIZE)[STATES:]])
    g = np.concatenate([step.direction, np.zeros(SIZE - STATES)])
    spread = np.diag(np.concatenate([np.zeros(STATES), step.walk]))
    expected = F @ step.cov @ F.T + spread + step.noises[1] / step.noises[0] * np.outer(g, g)
    np.testing.assert_array_equal(mean, np.concatenate([step.moved, step.mean[STATES:]]))
    np.testing.assert_allclose(cov, expected, rtol=1e-10)
    np.testing.assert_array_equal(noises, step.noises)
    np.testing.assert_array_equal(trace, 0.0)


def joint_run(prior, u, y, iterations):
    """The paper's model by the joint update: states x_t and x_{t-1}, with its F written out by hand.

    Yields:
        Mean and covariance of (x_t, x_{t-1}, θ1, θ2, θ3, η), the noises, and the free energies, after each sample.
    """
    mean, cov = np.delete(prior.mean, 2), np.delete(np.delete(prior.cov, 2, 0), 2, 1)
    noises, trace = np.array([*prior.gamma, *prior.xi]), np.empty(iterations)
    readout, direction = np.eye(6)[0], np.array([1.0, 0.0])
    for u_t, y_t in zip(u, y, strict=True):
        x, x_last, t1, t2, t3, eta = mean
        moved = np.array([t1 * x + t2 * x**3 + t3 * x_last + eta * u_t, x])
        jacobian = np.array([[t1 + 3 * t2 * x**2, t3, x, x**3, x_last, u_t], [1.0, 0.0, 0.0, 0.0, 0.0, 0.0]])
        joint.predict(mean, cov, moved, jacobian, np.zeros(4), np.empty((2, 6)))
        joint.correct(mean, cov, readout, direction, y_t - mean[0], noises, iterations, trace, np.empty(6))
        yield mean, cov, noises, trace


def lanes_run(prior, u, y, iterations):
    """The same by the lanes' update, without its third lag."""
    record, trace = prior.to_record(), np.empty(iterations)
    for u_t, y_t in zip(u, y, strict=True):
        block = block_of([record] * 32, u_t, y_t)
        update(block, True, iterations, False, trace)
        record = records_of(block)[0]
        moments = Moments.of_record(record)
        cov = np.delete(np.delete(moments.cov, 2, 0), 2, 1)
        yield np.delete(moments.mean, 2), cov, np.array([*moments.gamma, *moments.xi]), trace


@pytest.mark.slow  # both have twins of their own; eleven seconds of compilation
def test_on_the_paper_s_model_it_is_the_lanes_update():
    """Over 400 samples that a twin of the circuit made, and from beliefs of any kind over a few."""
    rng = np.random.default_rng(22)
    c = to_coefficients(SILVERBOX_TWIN)
    u, x = rng.uniform(-0.15, 0.15, 400), np.zeros(402)
    for t in range(400):
        x[t + 2] = c.theta1 * x[t + 1] + c.theta2 * x[t + 1] ** 3 + c.theta3 * x[t] + c.eta * u[t]
        x[t + 2] += 5e-4 * rng.standard_normal()
    y = x[2:] + 5e-4 * rng.standard_normal(400)
    records = [(Moments.of_record(Prior.silverbox_twin().to_record()), u, y, 1e-7)]
    records += [(random_prior(rng), rng.normal(0, 0.1, 3), rng.normal(0, 0.2, 3), 1e-9) for _ in range(20)]
    for prior, u, y, tolerance in records:
        for ours, theirs in zip(joint_run(prior, u, y, 3), lanes_run(prior, u, y, 3), strict=True):
            std = np.sqrt(np.diag(theirs[1]))
            size = np.maximum(std, np.abs(theirs[0]))
            np.testing.assert_allclose(ours[0] / size, theirs[0] / size, atol=tolerance)
            np.testing.assert_allclose(ours[1] / np.outer(std, std), theirs[1] / np.outer(std, std), atol=tolerance)
            np.testing.assert_allclose(ours[2], theirs[2], rtol=tolerance)
            np.testing.assert_allclose(ours[3], theirs[3], rtol=tolerance, atol=tolerance)
