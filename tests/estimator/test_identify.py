"""Many records at once: the beliefs of one estimator after the other, and the likelihood of Eq. (1) by matrices."""

import gymnasium as gym
import numpy as np
import pytest

from estimator import NLARX, Belief, ContinuousBelief, OnlineEstimator, Prior, continuous_prior
from estimator.identify import identify
from estimator.information import fisher_information, follow
from estimator.maximum_a_posteriori import maximum_a_posteriori
from estimator.models.duffing import duffing

NOISES = (5e-4, 5e-4)
LENGTHS = [40, 7, 40] + 31 * [25]  # more than a block of lanes


def records(track, samples=40, systems=34, seed=0):
    """Uniform inputs and the outputs of a track's plant (n, T), and its systems."""
    envs = gym.make_vec(track, num_envs=systems, vectorization_mode="vector_entry_point", max_output=50.0)
    envs.reset(seed=seed)
    rng = np.random.default_rng(seed)
    u, y = np.empty((2, systems, samples))
    for t in range(samples):
        actions = rng.uniform(-1, 1, (systems, 1)).astype(np.float32)
        envs.step(actions)
        u[:, t], y[:, t] = envs._batch.quantity("u"), envs._batch.quantity("y")
    return u, y, envs


def with_ends(u, y):
    u, y = u.copy(), y.copy()
    for row, length in enumerate(LENGTHS):
        u[row, length:] = y[row, length:] = np.nan
    return u, y


@pytest.mark.parametrize("factorisation", ["structured", "mean_field"])
def test_beliefs_are_those_of_one_estimator_after_the_other(factorisation):
    u, y, _ = records("duffing_env/Amplitude-v0")
    prior = Prior.silverbox_twin()
    start = Belief(prior.to_record(factorisation=factorisation), factorisation)
    beliefs = identify(*with_ends(u, y), start)
    assert len(beliefs) == len(LENGTHS)
    for row, (belief, length) in enumerate(zip(beliefs, LENGTHS, strict=True)):
        estimator = OnlineEstimator(NLARX(input_delay=0), prior, factorisation)
        estimator.run(u[row, :length], y[row, :length])
        np.testing.assert_allclose(belief.record, estimator.belief.record, rtol=1e-6, atol=1e-15)
        assert belief._kind == estimator.belief._kind


def test_by_the_physical_equation_beliefs_are_those_of_the_environment():
    u, y, envs = records("duffing_env/Continuous-v0")
    beliefs = identify(u, y, continuous_prior())
    for row, belief in enumerate(beliefs):
        np.testing.assert_allclose(belief.record, envs.belief(row).record, rtol=1e-9, atol=1e-15)
    ended = identify(*with_ends(u, y), continuous_prior())
    assert ended[0] == beliefs[0]
    assert ended[1].entropy() > beliefs[1].entropy()


def test_what_is_no_record_is_refused():
    start = continuous_prior()
    with pytest.raises(ValueError, match=r"one shape \(n, T\)"):
        identify(np.zeros(3), np.zeros(3), start)
    with pytest.raises(ValueError, match="must be a Belief or a ContinuousBelief"):
        identify(np.zeros((1, 3)), np.zeros((1, 3)), Prior.silverbox_twin())


def likelihood_by_differences(psi, u, y, q, r, state_variance):
    """-log likelihood of one record by a filter with matrices, whose slopes are differences of its own steps."""
    state, P, loss, last_u = np.zeros(2), state_variance * np.eye(2), 0.0, 0.0

    def move(state, last_u, u):
        k, b, c, g = psi
        for s in range(64):
            h, rise = 1 / 64, u - last_u
            inputs = [last_u + (s + f) * h * rise for f in (0, 0.5, 1)]

            def slope(z, v):
                return np.array([z[1], g * v - c * z[1] - k * z[0] - b * z[0] ** 3])

            k1 = slope(state, inputs[0])
            k2 = slope(state + h / 2 * k1, inputs[1])
            k3 = slope(state + h / 2 * k2, inputs[1])
            k4 = slope(state + h * k3, inputs[2])
            state = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        return state

    def spread(state, last_u, u):
        """Covariance of white noise of intensity 3 over the sample, by its midpoints, and the slope of the motion."""
        pieces, N, A = 200, np.zeros((2, 2)), np.eye(2)
        for s in range(pieces):
            v = last_u + (s + 0.5) / pieces * (u - last_u)
            drift = np.array([[0, 1], [-psi[0] - 3 * psi[1] * state[0] ** 2, -psi[2]]])
            state = state + (1 / pieces) * np.array(
                [state[1], psi[3] * v - psi[2] * state[1] - psi[0] * state[0] - psi[1] * state[0] ** 3]
            )
            step = np.eye(2) + drift / pieces + drift @ drift / pieces**2 / 2
            N = step @ N @ step.T + np.diag([0, 3 / pieces])
            A = step @ A
        return N, A

    for u_t, y_t in zip(u, y, strict=True):
        N, A = spread(state, last_u, u_t)
        state, P, last_u = move(state, last_u, u_t), A @ P @ A.T + q * N, u_t
        variance, innovation = P[0, 0] + r, y_t - state[0]
        loss += 0.5 * (innovation**2 / variance + np.log(variance))
        gain = P[:, 0] / variance
        state, P = state + gain * innovation, P - np.outer(gain, P[0])
    return loss


def test_the_likelihood_and_its_slope_are_those_of_a_filter_with_matrices():
    u, y, envs = records("duffing_env/Continuous-v0", samples=25, systems=2)
    psi = ContinuousBelief.coefficients_of(envs.truth) * [1.02, 0.97, 1.1, 0.99]
    q, r, start = NOISES[0] ** 2, NOISES[1] ** 2, 1e-6
    loss, slope, information = follow(duffing(), psi, u, y[:, :, None], (q, r), start * np.eye(2), 1)
    for row in range(2):
        assert loss[row] == pytest.approx(likelihood_by_differences(psi[row], u[row], y[row], q, r, start), rel=2e-2)
        for k in range(4):
            step = 1e-4 * psi[row, k] * np.eye(4)[k]
            up, down = (likelihood_by_differences(psi[row] + s * step, u[row], y[row], q, r, start) for s in (1, -1))
            assert slope[row, k] * step[k] == pytest.approx((up - down) / 2, rel=0.05)
    np.testing.assert_allclose(information, np.swapaxes(information, 1, 2), rtol=1e-12)
    assert (np.linalg.eigvalsh(information[0]) > 0).all()


def test_the_auditor_of_the_physical_equation_is_calibrated():
    u, y, envs = records("duffing_env/Continuous-v0", samples=256, systems=200, seed=1)
    truth = ContinuousBelief.coefficients_of(envs.truth)
    fit = maximum_a_posteriori(duffing(), u, y, continuous_prior(), *NOISES, "linear")
    assert fit.converged.mean() > 0.98
    error, std = fit.mean - truth, np.sqrt(np.diagonal(fit.cov, axis1=1, axis2=2))
    assert 0.86 < np.mean(np.abs(error) < 1.645 * std) < 0.94
    units = fit.cov / (std[:, :, None] * std[:, None, :])
    nees = np.einsum("ni,ni->n", error / std, np.linalg.solve(units, (error / std)[..., None])[..., 0]) / 4
    assert 0.85 < nees.mean() < 1.15
    # It ends where the environment's own estimator does, but for what that one has to learn of the noises.
    own = np.array([envs.belief(row).coefficients_mean for row in range(200)])
    assert np.median(np.abs(own - fit.mean) / std) < 0.5
    information = fisher_information(duffing(), truth, u, *NOISES, y=y, interpolation="linear")
    gained = np.linalg.slogdet(np.linalg.inv(continuous_prior().coefficients_cov) + information)[1] / 2
    assert gained.mean() == pytest.approx(-np.linalg.slogdet(fit.cov)[1].mean() / 2, abs=0.3)
