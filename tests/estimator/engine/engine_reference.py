"""What the engine has to give: the equations with matrices, in plain NumPy, for a plant of ordinary functions.

Derivatives are taken by a complex step: with f analytic, Im f(x + iε)/ε is its derivative to rounding for ε = 1e-30,
and through an integrator it is the derivative of the integrator's own arithmetic.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

EPS = np.finfo(float).eps
_STEP = 1e-30


@dataclass(frozen=True)
class Plant:
    """A model as ordinary functions of a state z (n,), coefficients c (K,) and the input.

    Attributes:
        move: the rates ``f(z, c, u)`` of a differential equation, or the next state ``f(z, c, taps)``.
        show: what the sensors show, ``f(z, c, u)`` -> (sensors,).
        noise: how unit process noise moves the state, ``f(z, c)`` -> (n,).
        substeps: Runge-Kutta steps per sample; 0 for a difference equation.
        held: whether the noise is constant over a sample.
    """

    move: Callable
    show: Callable
    noise: Callable
    substeps: int = 0
    held: bool = False


def jacobian(f: Callable, x: np.ndarray) -> np.ndarray:
    """Derivative of f at x, one column per entry of x."""
    return np.column_stack([np.imag(f(x + 1j * _STEP * e)) / _STEP for e in np.eye(len(x))])


def runge_kutta(f: Callable, x: np.ndarray, substeps: int) -> np.ndarray:
    """x after a sample in which x' = f(x, t), t from 0 to 1."""
    h = 1 / substeps
    for s in range(substeps):
        t = s * h
        k1 = f(x, t)
        k2 = f(x + h / 2 * k1, t + h / 2)
        k3 = f(x + h / 2 * k2, t + h / 2)
        k4 = f(x + h * k3, t + h)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return x


def polynomial(inputs: Sequence[float], t: float) -> float:
    """The input at a time t in [0, 1] of the sample."""
    return sum(u * t**k for k, u in enumerate(inputs))


def moved(plant: Plant, z: np.ndarray, c: np.ndarray, inputs: Sequence[float]) -> np.ndarray:
    """The state after a sample."""
    if not plant.substeps:
        return np.array(plant.move(z, c, inputs))
    return runge_kutta(lambda z, t: np.array(plant.move(z, c, polynomial(inputs, t))), z, plant.substeps)


def spread(plant: Plant, z: np.ndarray, c: np.ndarray, inputs: Sequence[float]) -> np.ndarray:
    """N (n, n), the covariance that unit process noise gives the state over a sample."""
    n = len(z)
    if not plant.substeps:
        g = np.array(plant.noise(z, c))
        return np.outer(g, g)

    def rates(x: np.ndarray, t: float) -> np.ndarray:
        z, u = x[:n], polynomial(inputs, t)
        f = lambda z: np.array(plant.move(z, c, u))  # noqa: E731
        slope, g = jacobian(f, z), np.array(plant.noise(z, c))
        if plant.held:
            return np.concatenate([f(z), slope @ x[n:] + g])
        N = x[n:].reshape(n, n)
        return np.concatenate([f(z), (slope @ N + N @ slope.T + np.outer(g, g)).ravel()])

    end = runge_kutta(rates, np.concatenate([z, np.zeros(n if plant.held else n * n)]), plant.substeps)[n:]
    return np.outer(end, end) if plant.held else sound(end.reshape(n, n))


def sound(N: np.ndarray) -> np.ndarray:
    """N, where it is a covariance; else its variances, row by row with the nearest covariances that they can have.

    Truncation makes it none where slopes are steep, and where states go along with one another to a high order.
    """
    N, n = N.copy(), len(N)
    N[np.diag_indices(n)] = np.maximum(np.diag(N), 0.0)
    rest = N.copy()
    for a in range(n - 1):
        largest = np.sqrt(np.maximum(rest[a, a], 0.0) * np.maximum(np.diag(rest), 0.0))
        kept = np.where(np.arange(n) > a, np.clip(rest[a], -largest, largest), rest[a])
        N[a] += kept - rest[a]
        N[:, a] = N[a]
        rest[a] = rest[:, a] = kept
        if rest[a, a] > 0:
            rest = rest - np.outer(kept, kept) / rest[a, a]
    return N


def input_seen(plant: Plant, inputs: Sequence[float]) -> float:
    """The input that a sensor sees at the end of a sample: the newest tap, or the polynomial there."""
    return polynomial(inputs, 1.0) if plant.substeps else inputs[0]


@dataclass
class Belief:
    """Mean (m,) and covariance (m, m) of states and coefficients; (shape, rate) of γ, and of ξ by sensor."""

    mean: np.ndarray
    cov: np.ndarray
    gamma: tuple[float, float]
    xi: list[tuple[float, float]]


@dataclass
class Outcome:
    """What an update leaves.

    Attributes:
        belief: after it.
        free_energies: by sensor and iteration [nats]; nothing for a sensor whose output is missing.
        scale: (m,) standard deviations as predicted: what errors are measured in.
        condition: by how much rounding is enlarged: sums of absolute values over what they cancel to.
    """

    belief: Belief
    free_energies: list[list[float]] = field(default_factory=list)
    scale: np.ndarray = field(default_factory=lambda: np.zeros(0))
    condition: float = 1.0


def first_order(plant: Plant, n: int, belief: Belief, inputs: Sequence[float]):
    """Mean and covariance after a sample, without its process noise, and the sizes of the terms that they sum."""
    motion = lambda x: moved(plant, x[:n], x[n:], inputs)  # noqa: E731
    m = len(belief.mean)
    F = np.eye(m)
    F[:n] = jacobian(motion, belief.mean)
    mean = np.concatenate([motion(belief.mean), belief.mean[n:]])
    return mean, F @ belief.cov @ F.T, np.abs(F) @ np.abs(belief.cov) @ np.abs(F).T


def cubature(plant: Plant, n: int, belief: Belief, inputs: Sequence[float], movers: Sequence[int]):
    """The same by the cubature rule over the unknown of the ``movers``, the others being conditionally Gaussian."""
    cov = belief.cov
    unknown: list[int] = []
    for i in movers:
        trial = [*unknown, i]
        sub = cov[np.ix_(trial, trial)]
        given = sub[-1, -1] - (sub[-1, :-1] @ np.linalg.solve(sub[:-1, :-1], sub[:-1, -1]) if unknown else 0.0)
        if given > 1e-12 * sub[-1, -1]:
            unknown = trial
    factor = np.linalg.cholesky(cov[np.ix_(unknown, unknown)])
    along = np.sqrt(len(unknown)) * np.linalg.solve(factor, cov[unknown]).T  # how all quantities go along with them
    points = belief.mean[:, None] + np.hstack([along, -along])
    images = points.copy()
    images[:n] = np.column_stack([moved(plant, p[:n], p[n:], inputs) for p in points.T])
    mean = images.mean(axis=1)
    deviations = images - mean[:, None]
    predicted = deviations @ deviations.T / points.shape[1]
    predicted[n:, n:] = cov[n:, n:]
    # The factor is as good as a rounding of the covariance; differences of images lose the digits of their mean.
    std = np.sqrt(np.diag(predicted))
    sure = std <= 10 * EPS * np.abs(images).max(axis=1)  # all images are the same
    std[sure] = predicted[sure, :] = predicted[:, sure] = 0.0
    lost = np.max(np.abs(images).max(axis=1)[std > 0] / std[std > 0], initial=0.0)
    return mean, predicted, (1 + lost) * np.outer(std, std)


def update(
    plant: Plant,
    n: int,
    belief: Belief,
    inputs: Sequence[float],
    y: Sequence[float],
    iterations: int,
    movers: Sequence[int] | None = None,
) -> Outcome:
    """The structured update of a belief by one sample.

    Args:
        plant: its equations.
        n: number of states.
        belief: before.
        inputs: taps, or coefficients of the polynomial.
        y: output by sensor; NaN where it is missing.
        iterations: variational iterations.
        movers: quantities that get sigma points; to first order where None.
    """
    if movers is None:
        mean, cov, size = first_order(plant, n, belief, inputs)
    else:
        mean, cov, size = cubature(plant, n, belief, inputs, movers)
    m = len(mean)
    z, c = belief.mean[:n], belief.mean[n:]
    N = np.zeros((m, m))
    N[:n, :n] = spread(plant, z, c, inputs)
    u = input_seen(plant, inputs)
    gamma, xi = belief.gamma, list(belief.xi)
    shows = lambda x, k: np.array([plant.show(x[:n], x[n:], u)[k]])  # noqa: E731
    readouts = [jacobian(lambda x, k=k: shows(x, k), mean)[0] for k in range(len(y))]
    teller = next((k for k, h in enumerate(readouts) if h @ N @ h > 0), None)
    if teller is None:
        cov, size = cov + gamma[1] / gamma[0] * N, size + gamma[1] / gamma[0] * np.abs(N)
    condition, scale, energies = 1.0, np.zeros(m), []
    for k in range(len(y)):
        h = jacobian(lambda x, k=k: shows(x, k), mean)[0]
        expected = shows(mean, k)[0]
        s = h @ cov @ h
        shown = h @ N @ h if k == teller else 0.0
        seen = not np.isnan(y[k])
        e = y[k] - expected if seen else 0.0
        q0, r0 = shown * gamma[1], xi[k][1]
        g_shape, n_shape = gamma[0] + 0.5, xi[k][0] + 0.5
        next_q, next_r = q0 / gamma[0], r0 / xi[k][0]
        q, r, g_rate, n_rate = next_q, next_r, q0, r0
        energies.append([])
        for _ in range(iterations if seen else 1):
            q, r = next_q, next_r
            if not seen:
                break
            S = s + q + r
            # Moments of w and v given y, from the joint Gaussian of (w, v) and the innovation.
            w, v = q * e / S, r * e / S
            g_rate, n_rate = q0 + 0.5 * (w**2 + q - q**2 / S), r0 + 0.5 * (v**2 + r - r**2 / S)
            energies[-1].append(free_energy(e, s, q, r, (gamma[0], q0), xi[k], shown > 0))
            next_q, next_r = g_rate / g_shape, n_rate / n_shape
        if k == teller:
            cov, size = cov + q / shown * N, size + q / shown * np.abs(N)
            if seen:
                gamma = g_shape, g_rate / shown
        scale = np.maximum(scale, np.sqrt(np.maximum(np.diag(cov), 0.0)))
        known = np.where(scale > 0, scale, np.inf)
        condition = max(condition, (size / np.outer(known, known)).max())
        if seen:
            xi[k] = n_shape, n_rate
            S = h @ cov @ h + r
            condition *= max(
                1.0, (np.abs(h) @ size @ np.abs(h) + r) / S, (np.abs(y[k]) + np.abs(expected)) / np.sqrt(S)
            )
            gain = cov @ h / S
            mean = mean + gain * e
            cov = cov - np.outer(gain, gain) * S
    return Outcome(Belief(mean, cov, gamma, xi), energies, scale, condition)


def free_energy(e, s, q, r, gamma, xi, with_process) -> float:
    """Free energy of one sensor's output, from expectations and divergences one by one.

    At the Gaussian that noise variances q and r make, with q(γ) and q(ξ) that follow from it: E[-log p(y, w, x)] and
    the entropies, with ½ log 2πS + e²/2S the Gaussian's own evidence at q and r.
    """
    from scipy.special import digamma, gammaln

    def part(v, prior):
        """What changes where log v becomes E[-log precision] and 1/v its mean, and the Gamma's divergence."""
        shape0, rate0 = prior
        power = (v * e / S) ** 2 + v - v**2 / S
        shape, rate = shape0 + 0.5, rate0 + 0.5 * power
        divergence = (shape - shape0) * digamma(shape) - gammaln(shape) + gammaln(shape0)
        divergence += shape0 * (np.log(rate) - np.log(rate0)) + shape * (rate0 - rate) / rate
        moved = -0.5 * (digamma(shape) - np.log(rate)) + 0.5 * shape / rate * power
        assumed = 0.5 * np.log(v) + 0.5 * power / v
        return moved - assumed + divergence

    S = s + q + r
    total = 0.5 * np.log(2 * np.pi * S) + 0.5 * e**2 / S + part(r, xi)
    return total + (part(q, gamma) if with_process else 0.0)


@dataclass
class Walk:
    """A path at known coefficients.

    Attributes:
        loss: minus the log likelihood, without the constant; 0 where outputs are not followed.
        slope: (K,) its slope, the gains held.
        information: (K, K).
        shown: (samples, sensors) what the sensors are expected to show.
        state, cov, sensitivity: at the end.
        growth: largest factor by which an error of the state has grown between any two samples.
    """

    loss: float
    slope: np.ndarray
    information: np.ndarray
    shown: np.ndarray
    state: np.ndarray
    cov: np.ndarray
    sensitivity: np.ndarray
    growth: float


def path(plant: Plant, z, V, c, inputs, Q: float, R: Sequence[float], y=None) -> Walk:
    """The Kalman filter of the model linearised along its own trajectory, with sensitivities at held gains.

    Args:
        plant: its equations.
        z, V: state and covariance before the first sample.
        c: coefficients.
        inputs: by sample.
        Q, R: variances of the noises.
        y: outputs by sample and sensor; None where the trajectory is followed without them.
    """
    n, K = len(z), len(c)
    Z, F, slope, loss, shown = np.zeros((n, K)), np.zeros((K, K)), np.zeros(K), 0.0, []
    transitions: list[np.ndarray] = [np.eye(n)]
    growth = 1.0
    for t, taps in enumerate(inputs):
        S = jacobian(lambda x, taps=taps: moved(plant, x[:n], x[n:], taps), np.concatenate([z, c]))
        N, A = spread(plant, z, c, taps), S[:, :n]
        z, V, Z = moved(plant, z, c, taps), A @ V @ A.T + Q * N, A @ Z + S[:, n:]
        u = input_seen(plant, taps)
        shown.append([])
        for k, r in enumerate(R):
            show = lambda x, k=k, u=u: np.array([plant.show(x[:n], x[n:], u)[k]])  # noqa: E731
            at = np.concatenate([z, c])
            slopes = jacobian(show, at)[0]
            h, total = slopes[:n], slopes[:n] @ Z + slopes[n:]
            variance = h @ V @ h + r
            shown[-1].append(show(at)[0])
            e = 0.0 if y is None else y[t][k] - shown[-1][-1]
            F = F + np.outer(total, total) / variance
            if y is not None:
                loss += 0.5 * (e**2 / variance + np.log(variance))
                slope = slope - total * e / variance
            gain = V @ h / variance
            z, Z, V = z + gain * e, Z - np.outer(gain, total), V - np.outer(gain, gain) * variance
            A = A - np.outer(gain, h @ A)
        transitions = [A @ earlier for earlier in transitions] + [np.eye(n)]
        growth = max(growth, *(np.abs(m).sum(axis=1).max() for m in transitions))
    return Walk(loss, slope, F, np.array(shown), z, V, Z, growth)
