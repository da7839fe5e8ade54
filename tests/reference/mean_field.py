"""The paper's mean field in plain NumPy: one update with matrices, directly from the equations.

It shares no code and no formula with `estimator.inference.mean_field`: where that updates by rank one, this builds the
precision matrix and inverts it; where that has a closed form for a divergence, this uses the general one.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import digamma, gammaln

from estimator.inference import mean_field

TIE = 1e12  # precision of the identity between the second component of z_t and the first of z_{t-1}
LOG_2PI = np.log(2 * np.pi)
LAYOUT = mean_field.mean_field_layout()
UPPER = np.triu_indices(6)
SIZE = 31  # of a record: means, upper triangle, shapes and rates


@dataclass(frozen=True)
class Moments:
    """A belief: Gaussian over (x_t, x_{t-1}, θ1, θ2, θ3, η), and Gamma (shape, rate) of γ and of ξ."""

    mean: np.ndarray  # (6,)
    cov: np.ndarray  # (6, 6)
    gamma: tuple[float, float]
    xi: tuple[float, float]

    @classmethod
    def of_record(cls, record):
        cov = np.zeros((6, 6))
        cov[UPPER] = cov.T[UPPER] = record[6:27]
        return cls(record[:6].copy(), cov, tuple(record[27:29]), tuple(record[29:]))

    def to_record(self):
        return np.concatenate([self.mean, self.cov[UPPER], self.gamma, self.xi])


def mean_field_step(prior, u, y, iterations, as_published=False, nonlinear=True, evaluated=None):
    """The six updates of the published experiment, ``iterations`` times.

    Returns:
        The posterior (mean field knows no cross-covariances: they are 0), and the free energy after each iteration, or
        after the last ``evaluated`` ones alone.
    """
    S, s = np.array([[0.0, 0.0], [1.0, 0.0]]), np.array([1.0, 0.0])
    theta = [2, 3, 4] if nonlinear else [2, 4]

    def features(z):
        return np.array([z[0], z[0] ** 3, z[1]] if nonlinear else z)

    def state_slope(m_theta, z):
        slopes = np.array([[1.0, 0.0], [3 * z[0] ** 2, 0.0], [0.0, 1.0]])
        return m_theta @ (slopes if nonlinear else slopes[[0, 2]])

    def W(precision):
        return np.diag([precision, TIE])

    prior_theta = prior.mean[theta], prior.cov[np.ix_(theta, theta)]
    prior_eta = prior.mean[5:], prior.cov[5:, 5:]
    prior_z = prior.mean[:2], prior.cov[:2, :2]
    W_theta, W_z = np.linalg.inv(prior_theta[1]), np.linalg.inv(prior_z[1])
    w_eta = 1 / prior_eta[1][0, 0]
    gamma, xi = prior.gamma, prior.xi
    m_theta, m_eta, m_last, m_z = prior_theta[0], prior_eta[0][0], prior_z[0], prior_z[0]
    free_energies = []
    for i in range(iterations):
        E_gamma, E_xi = gamma[0] / gamma[1], xi[0] / xi[1]

        w = w_eta + E_gamma * u**2
        m_eta = (w_eta * prior_eta[0][0] + E_gamma * u * (m_z[0] - m_theta @ features(m_last))) / w
        V_eta = np.array([[1 / w]])

        J_theta = features(m_last)
        V_theta = np.linalg.inv(W_theta + E_gamma * np.outer(J_theta, J_theta))
        m_theta = V_theta @ (W_theta @ prior_theta[0] + E_gamma * J_theta * (m_z[0] - m_eta * u))

        transition = S @ m_last + s * (m_theta @ J_theta + m_eta * u)
        V_z = np.linalg.inv(W(E_gamma) + E_xi * np.outer(s, s))
        m_z = V_z @ (W(E_gamma) @ transition + E_xi * y * s)

        J_x = state_slope(m_theta, m_last)
        offset = 0.0 if as_published else m_theta @ features(m_last) - J_x @ m_last
        A = S + np.outer(s, J_x)
        V_last = np.linalg.inv(W_z + A.T @ W(E_gamma) @ A)
        m_last = V_last @ (W_z @ prior_z[0] + A.T @ W(E_gamma) @ (m_z - s * (m_eta * u + offset)))

        J_theta, J_x = features(m_last), state_slope(m_theta, m_last)
        B = (m_z[0] - m_theta @ J_theta - m_eta * u) ** 2 + V_z[0, 0]
        B += J_x @ V_last @ J_x + J_theta @ V_theta @ J_theta + u**2 * V_eta[0, 0]
        D = (y - m_z[0]) ** 2 + V_z[0, 0]
        gamma = prior.gamma[0] + 0.5, prior.gamma[1] + (B + m_last[0] ** 2 * as_published) / 2
        xi = prior.xi[0] + 0.5, prior.xi[1] + D / 2

        if evaluated is not None and i < iterations - evaluated:
            continue
        tie = (m_z[1] - m_last[0]) ** 2 + V_z[1, 1] + V_last[0, 0]
        free_energies.append(
            gaussian_divergence((m_theta, V_theta), prior_theta)
            + gaussian_divergence((np.array([m_eta]), V_eta), prior_eta)
            + gaussian_divergence((m_last, V_last), prior_z)
            + gamma_divergence(gamma, prior.gamma)
            + gamma_divergence(xi, prior.xi)
            - gaussian_entropy(V_z)
            - expected_log_normal(B, gamma)
            - 0.5 * (np.log(TIE) - LOG_2PI - TIE * tie)
            - expected_log_normal(D, xi)
        )

    mean, cov = np.zeros(6), np.zeros((6, 6))
    mean[:2], mean[theta], mean[5] = m_z, m_theta, m_eta
    cov[:2, :2], cov[np.ix_(theta, theta)], cov[5, 5] = V_z, V_theta, V_eta[0, 0]
    return Moments(mean, cov, gamma, xi), np.array(free_energies)


def gaussian_entropy(cov):
    return 0.5 * (len(cov) * (LOG_2PI + 1) + np.linalg.slogdet(cov)[1])


def expected_log_gaussian(q, p):
    """E_q log p of two Gaussians (mean, covariance)."""
    (m, V), (m0, V0) = q, p
    spread = np.trace(np.linalg.solve(V0, V)) + (m - m0) @ np.linalg.solve(V0, m - m0)
    return -0.5 * (len(m) * LOG_2PI + np.linalg.slogdet(V0)[1] + spread)


def gaussian_divergence(q, p):
    return -gaussian_entropy(q[1]) - expected_log_gaussian(q, p)


def gamma_divergence(q, p):
    """KL[q || p] of two Gammas (shape, rate)."""
    (a, b), (a0, b0) = q, p
    return (a - a0) * digamma(a) - gammaln(a) + gammaln(a0) + a0 * (np.log(b) - np.log(b0)) + a * (b0 - b) / b


def expected_log_normal(power, precision):
    """E log N(e | 0, 1/p) where E[e²] is ``power`` and p ~ Gamma ``precision`` = (shape, rate)."""
    shape, rate = precision
    return 0.5 * (digamma(shape) - np.log(rate) - LOG_2PI - shape / rate * power)


def random_prior(rng, nonlinear=True):
    """A random belief with correlated factors, at the scale of the Silverbox."""
    mean = rng.normal([0.1, 0.1, 1.4, -2.0, -0.9, 0.4], [0.2, 0.2, 0.4, 2.0, 0.2, 0.2])
    std = np.exp(rng.uniform(np.log(1e-3), np.log(0.3), 6))
    factor = rng.standard_normal((6, 8))
    cov = factor @ factor.T
    cov *= np.outer(std, std) / np.sqrt(np.outer(np.diag(cov), np.diag(cov)))
    blocks = np.zeros((6, 6))
    for block in (slice(0, 2), slice(2, 5), slice(5, 6)):
        blocks[block, block] = 1.0
    cov *= blocks
    if not nonlinear:
        mean[3] = cov[3, :] = cov[:, 3] = 0.0
    gamma_shape, xi_shape = np.exp(rng.uniform(np.log(1.0), np.log(1e3), 2))
    process_std, measurement_std = np.exp(rng.uniform(np.log(1e-3), np.log(1e-1), 2))
    return Moments(mean, cov, (gamma_shape, gamma_shape * process_std**2), (xi_shape, xi_shape * measurement_std**2))


def draw_variances(rng, precision, draws):
    """Noise variances (draws,) whose precision is Gamma (shape, rate)."""
    shape, rate = precision
    return 1 / rng.gamma(shape, 1 / rate, draws)


def block_of(records, u, y, lanes):
    """A block (rows * lanes,) of records (lanes, SIZE), inputs (lanes,) and outputs (lanes,)."""
    block = np.zeros((len(LAYOUT), lanes))
    block[:SIZE] = np.transpose(records)
    block[LAYOUT["U_u_0"]], block[LAYOUT["Y_y"]] = u, y
    return block.reshape(-1)


def records_of(block, lanes):
    """The records (lanes, SIZE) in a block."""
    return block.reshape(-1, lanes)[:SIZE].T.copy()


def assert_same_moments(actual, expected, rtol=1e-9):
    """Means and covariances agree to ``rtol`` of their standard deviations and sizes, noises to ``rtol``."""
    std = np.sqrt(np.diag(expected.cov))
    size = np.maximum(std, np.abs(expected.mean))
    assert (np.abs(actual.mean - expected.mean) <= rtol * size).all()
    assert (np.abs(actual.cov - expected.cov) <= rtol * np.outer(std, std)).all()
    np.testing.assert_allclose(actual.gamma, expected.gamma, rtol=rtol)
    np.testing.assert_allclose(actual.xi, expected.xi, rtol=rtol)
