"""Plain NumPy twins of the kernels: one update with matrices, straight from the equations.

They share no code and no formula with the kernels: where a kernel updates by rank one, a twin builds the precision
matrix and inverts it; where a kernel has a closed form for a divergence, a twin uses the general one.
"""

from dataclasses import dataclass

import numpy as np
from estimator.record import LAYOUT, N_ROWS, QUANTITIES, RECORD
from scipy.special import digamma, gammaln

from estimator.lanes import LANES

TIE = 1e12  # precision of the identity between the second component of z_t and the first of z_{t-1}
LOG_2PI = np.log(2 * np.pi)


@dataclass(frozen=True)
class Moments:
    """A belief: Gaussian over (x_t, x_{t-1}, x_{t-2}, θ1, θ2, θ3, η), and Gamma (shape, rate) of γ and of ξ."""

    mean: np.ndarray  # (7,)
    cov: np.ndarray  # (7, 7)
    gamma: tuple[float, float]
    xi: tuple[float, float]

    @classmethod
    def of_record(cls, record):
        value = dict(zip(RECORD, record, strict=True))
        cov = np.zeros((7, 7))
        for i, first in enumerate(QUANTITIES):
            for j, second in enumerate(QUANTITIES[i:], start=i):
                cov[i, j] = cov[j, i] = value[f"P_{first}_{second}"]
        return cls(
            np.array([value[name] for name in QUANTITIES]),
            cov,
            (value["g_shape"], value["g_rate"]),
            (value["n_shape"], value["n_rate"]),
        )

    def to_record(self):
        value = dict(zip(QUANTITIES, self.mean, strict=True))
        for i, first in enumerate(QUANTITIES):
            value |= {f"P_{first}_{second}": self.cov[i, j] for j, second in enumerate(QUANTITIES) if j >= i}
        value |= dict(zip(("g_shape", "g_rate", "n_shape", "n_rate"), self.gamma + self.xi, strict=True))
        return np.array([value[name] for name in RECORD])


def mean_field_step(prior, u, y, iterations, as_published=False, nonlinear=True):
    """The six updates of the published experiment, ``iterations`` times.

    Returns:
        The posterior (mean field knows neither cross-covariances nor x_{t-2}: both are 0), and the free energy after
        each iteration.
    """
    S, s = np.array([[0.0, 0.0], [1.0, 0.0]]), np.array([1.0, 0.0])
    theta = [3, 4, 5] if nonlinear else [3, 5]

    def features(z):
        return np.array([z[0], z[0] ** 3, z[1]] if nonlinear else z)

    def state_slope(m_theta, z):
        slopes = np.array([[1.0, 0.0], [3 * z[0] ** 2, 0.0], [0.0, 1.0]])
        return m_theta @ (slopes if nonlinear else slopes[[0, 2]])

    def W(precision):
        return np.diag([precision, TIE])

    prior_theta = prior.mean[theta], prior.cov[np.ix_(theta, theta)]
    prior_eta = prior.mean[6:], prior.cov[6:, 6:]
    prior_z = prior.mean[:2], prior.cov[:2, :2]
    W_theta, W_z = np.linalg.inv(prior_theta[1]), np.linalg.inv(prior_z[1])
    w_eta = 1 / prior_eta[1][0, 0]
    gamma, xi = prior.gamma, prior.xi
    m_theta, m_eta, m_last, m_z = prior_theta[0], prior_eta[0][0], prior_z[0], prior_z[0]
    free_energies = []
    for _ in range(iterations):
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

    mean, cov = np.zeros(7), np.zeros((7, 7))
    mean[:2], mean[theta], mean[6] = m_z, m_theta, m_eta
    cov[:2, :2], cov[np.ix_(theta, theta)], cov[6, 6] = V_z, V_theta, V_eta[0, 0]
    return Moments(mean, cov, gamma, xi), np.array(free_energies)


def structured_step(prior, u, y, iterations, nonlinear=True):
    """A Kalman step on the joint Gaussian of (x_{t+1}, x_t, x_{t-1}, θ, η), in turn with the updates of γ and ξ.

    Returns:
        The posterior, and the free energy after each iteration.
    """
    known = [0, 1, 3, 4, 5, 6] if nonlinear else [0, 1, 3, 5, 6]  # (x_t, x_{t-1}, θ, η) in the last belief
    joint = [0, 1, 2, *known[2:]]  # (x_{t+1}, x_t, x_{t-1}, θ, η) in the new one
    mean, cov = prior.mean[known], prior.cov[np.ix_(known, known)]
    x, x_last, (t1, t2, t3, eta) = prior.mean[0], prior.mean[1], prior.mean[3:]

    slope = [t1 + 3 * t2 * x**2, t3, x, x**3, x_last, u]
    slope = np.array(slope if nonlinear else [*slope[:3], *slope[4:]])
    offset = t1 * x + t2 * x**3 + t3 * x_last + eta * u - slope @ mean
    T = np.vstack([slope, np.eye(len(known))])
    to_w = np.array([1.0, *-slope])  # w = to_w @ joint - offset
    to_x = np.eye(len(joint))[0]

    gamma, xi = prior.gamma, prior.xi
    free_energies = []
    for _ in range(iterations):
        q, r = gamma[1] / gamma[0], xi[1] / xi[0]
        m = T @ mean + offset * to_x
        P = T @ cov @ T.T + q * np.outer(to_x, to_x)
        gain = P @ to_x / (to_x @ P @ to_x + r)
        m = m + gain * (y - to_x @ m)
        P = P - np.outer(gain, to_x @ P)

        w_power = (to_w @ m - offset) ** 2 + to_w @ P @ to_w
        v_power = (y - to_x @ m) ** 2 + to_x @ P @ to_x
        gamma = prior.gamma[0] + 0.5, prior.gamma[1] + w_power / 2
        xi = prior.xi[0] + 0.5, prior.xi[1] + v_power / 2
        free_energies.append(
            -gaussian_entropy(P)
            - expected_log_gaussian((m[1:], P[1:, 1:]), (mean, cov))
            - expected_log_normal(w_power, gamma)
            - expected_log_normal(v_power, xi)
            + gamma_divergence(gamma, prior.gamma)
            + gamma_divergence(xi, prior.xi)
        )

    new_mean, new_cov = np.zeros(7), np.zeros((7, 7))
    new_mean[joint], new_cov[np.ix_(joint, joint)] = m, P
    return Moments(new_mean, new_cov, gamma, xi), np.array(free_energies)


def runge_kutta(state, parameters, last_u, u, substeps):
    """(x, x') after a sample of x'' = g u - c x' - k x - b x³, and the covariance that noise of γ = 1 brings it.

    Time is counted in samples. Also of complex numbers.

    Args:
        state: (2,) before it.
        parameters: (4,) k, b, c, g.
        last_u, u: input at both ends; it goes linearly from one to the other.
        substeps: steps of Runge and Kutta's method of order 4.

    Returns:
        (2,), and (2, 2): N of N' = A N + N Aᵀ + diag(0, 3), A the Jacobian of the right-hand side.
    """
    k, b, c, g = parameters

    def slope(tau, whole):
        (x, v), N = whole[0], whole[1:]
        A = np.array([[0.0, 1.0], [-k - 3 * b * x**2, -c]])
        force = g * (last_u + tau * (u - last_u))
        return np.vstack([[v, force - c * v - k * x - b * x**3], A @ N + N @ A.T + np.diag([0.0, 3.0])])

    whole, h = np.vstack([state, np.zeros((2, 2))]), 1 / substeps
    for n in range(substeps):
        k1 = slope(n * h, whole)
        k2 = slope((n + 0.5) * h, whole + h / 2 * k1)
        k3 = slope((n + 0.5) * h, whole + h / 2 * k2)
        k4 = slope((n + 1) * h, whole + h * k3)
        whole = whole + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return whole[0], whole[1:]


def continuous_step(prior, last_u, u, y, iterations, substeps):
    """A Kalman step on the joint Gaussian of (x, x', k, b, c, g), in turn with the updates of γ and ξ.

    The joint Gaussian has the sample's process noise (w, w') beside the state before it. The Jacobian is the imaginary
    part of a complex step, exact to rounding.

    Returns:
        The posterior, and the free energy after each iteration.
    """
    known = [0, 1, 3, 4, 5, 6]
    mean, cov = prior.mean[known], prior.cov[np.ix_(known, known)]
    moved, noise = runge_kutta(mean[:2], mean[2:], last_u, u, substeps)
    jacobian = np.eye(6)
    for i in range(6):
        nudged = mean + 1e-30j * np.eye(6)[i]
        jacobian[:2, i] = runge_kutta(nudged[:2], nudged[2:], last_u, u, substeps)[0].imag / 1e-30
    T = np.hstack([jacobian, np.eye(6)[:, :2]])  # from (state and parameters before, w, w') to those after
    gamma, xi = prior.gamma, prior.xi
    free_energies = []
    for _ in range(iterations):
        q, r = gamma[1] / gamma[0], xi[1] / xi[0]
        P = np.zeros((8, 8))
        P[:6, :6], P[6:, 6:] = cov, q * noise
        S = T[0] @ P @ T[0] + r
        gain = P @ T[0] / S
        deviation = gain * (y - moved[0])
        posterior = P - np.outer(gain, T[0] @ P)
        w_power = (deviation[6] ** 2 + posterior[6, 6]) / noise[0, 0]
        v_power = (y - moved[0] - T[0] @ deviation) ** 2 + T[0] @ posterior @ T[0]
        gamma = prior.gamma[0] + 0.5, prior.gamma[1] + w_power / 2
        xi = prior.xi[0] + 0.5, prior.xi[1] + v_power / 2
        # w' given w is as before the sample, and falls out.
        q_known, p_known = posterior[:7, :7], P[:6, :6]
        free_energies.append(
            -gaussian_entropy(q_known)
            - expected_log_gaussian((deviation[:6], q_known[:6, :6]), (np.zeros(6), p_known))
            - expected_log_normal(w_power, gamma)
            + 0.5 * np.log(noise[0, 0])
            - expected_log_normal(v_power, xi)
            + gamma_divergence(gamma, prior.gamma)
            + gamma_divergence(xi, prior.xi)
        )
    new_mean, new_cov = np.zeros(7), np.zeros((7, 7))
    new_mean[known] = [*moved, *mean[2:]] + T @ deviation
    new_cov[np.ix_(known, known)] = T @ posterior @ T.T
    return Moments(new_mean, new_cov, gamma, xi), np.array(free_energies)


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


def random_prior(rng, factorisation="structured", nonlinear=True):
    """A belief at random, of quantities and noises about as large as those of the Silverbox, correlated at will."""
    mean = rng.normal([0.1, 0.1, 0.1, 1.4, -2.0, -0.9, 0.4], [0.2, 0.2, 0.2, 0.4, 2.0, 0.2, 0.2])
    std = np.exp(rng.uniform(np.log(1e-3), np.log(0.3), 7))
    factor = rng.standard_normal((7, 9))
    cov = factor @ factor.T
    cov *= np.outer(std, std) / np.sqrt(np.outer(np.diag(cov), np.diag(cov)))
    if factorisation == "mean_field":
        blocks = np.zeros((7, 7))
        for block in (slice(0, 2), slice(3, 6), slice(6, 7)):
            blocks[block, block] = 1.0
        mean[2] = 0.0
        cov *= blocks
    if not nonlinear:
        mean[4] = cov[4, :] = cov[:, 4] = 0.0
    gamma_shape, xi_shape = np.exp(rng.uniform(np.log(1.0), np.log(1e3), 2))
    process_std, measurement_std = np.exp(rng.uniform(np.log(1e-3), np.log(1e-1), 2))
    return Moments(mean, cov, (gamma_shape, gamma_shape * process_std**2), (xi_shape, xi_shape * measurement_std**2))


def draw_variances(rng, precision, draws):
    """Noise variances (draws,) whose precision is Gamma (shape, rate)."""
    shape, rate = precision
    return 1 / rng.gamma(shape, 1 / rate, draws)


def block_of(records, u, y, last_u=0.0):
    """A block (N_ROWS * LANES,) of LANES records (LANES, RECORD_SIZE), inputs (LANES,) and outputs (LANES,)."""
    block = np.zeros((N_ROWS, LANES))
    block[: len(RECORD)] = np.transpose(records)
    block[LAYOUT["u"]], block[LAYOUT["y"]], block[LAYOUT["last_u"]] = u, y, last_u
    return block.reshape(-1)


def records_of(block):
    """The records (LANES, RECORD_SIZE) in a block."""
    return block.reshape(N_ROWS, LANES)[: len(RECORD)].T.copy()


def assert_same_moments(actual, expected, rtol=1e-9):
    """Means and covariances agree to ``rtol`` of their standard deviations and sizes, noises to ``rtol``."""
    std = np.sqrt(np.diag(expected.cov))
    size = np.maximum(std, np.abs(expected.mean))
    assert (np.abs(actual.mean - expected.mean) <= rtol * size).all()
    assert (np.abs(actual.cov - expected.cov) <= rtol * np.outer(std, std)).all()
    np.testing.assert_allclose(actual.gamma, expected.gamma, rtol=rtol)
    np.testing.assert_allclose(actual.xi, expected.xi, rtol=rtol)
