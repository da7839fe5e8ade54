"""The structured variational update: a Kalman step on states and coefficients, in turn with q(γ) and each q(ξ)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.special import digamma, gammaln

from reference.filters import EPS, Plant, Step, input_seen, jacobian, moved, sample, seen, spread


@dataclass(frozen=True)
class Belief:
    """Mean (m,) and covariance (m, m) of states and coefficients; (shape, rate) of γ, and of ξ by sensor."""

    mean: np.ndarray
    cov: np.ndarray
    gamma: tuple[float, float]
    xi: list[tuple[float, float]]


@dataclass
class Outcome:
    """The result of an update.

    Attributes:
        belief: after it.
        compile_free_energies: by sensor and iteration [nats]; nothing for a sensor whose output is missing.
        scale: (m,) standard deviations as predicted: what errors are measured in.
        condition: by how much rounding is enlarged: sums of absolute values over what they cancel to.
    """

    belief: Belief
    free_energies: list[list[float]] = field(default_factory=list)
    scale: np.ndarray = field(default_factory=lambda: np.zeros(0))
    condition: float = 1.0


def first_order(plant: Plant, n: int, belief: Belief, inputs: Sequence[float]):
    """Mean and covariance after a sample, without its process noise, and the sizes of the terms that they sum."""
    step = sample(plant, n, belief.mean, inputs)
    F = step.jacobian
    mean = np.concatenate([step.moved, belief.mean[n:]])
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
    along = np.sqrt(len(unknown)) * np.linalg.solve(factor, cov[unknown]).T  # regression of all quantities on them
    points = belief.mean[:, None] + np.hstack([along, -along])
    images = points.copy()
    images[:n] = moved(plant, points[:n], points[n:], inputs)
    mean = images.mean(axis=1)
    deviations = images - mean[:, None]
    after = deviations @ deviations.T / points.shape[1]
    after[n:, n:] = cov[n:, n:]
    # The factor is as good as a rounding of the covariance; differences of images lose the digits of their mean.
    std = np.sqrt(np.diag(after))
    sure = std <= 10 * EPS * np.abs(images).max(axis=1)  # all images are the same
    std[sure] = after[sure, :] = after[:, sure] = 0.0
    lost = np.max(np.abs(images).max(axis=1)[std > 0] / std[std > 0], initial=0.0)
    return mean, after, (1 + lost) * np.outer(std, std)


def update(
    plant: Plant,
    n: int,
    belief: Belief,
    inputs: Sequence[float],
    y: Sequence[float],
    iterations: int,
    movers: Sequence[int] | None = None,
) -> Outcome:
    """The update of a belief by one sample.

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
    N = np.zeros_like(cov)
    N[:n, :n] = spread(plant, belief.mean[:n], belief.mean[n:], inputs)
    u = input_seen(plant, inputs)
    shows = lambda x: plant.show(x[:n], x[n:], u)  # noqa: E731
    return _condition_on_outputs(belief, mean, cov, size, N, shows, y, iterations)


def structured_update(prior: Any, step: Step, y: float, iterations: int) -> tuple[Any, float]:
    """The update by one output that shows the first state.

    Args:
        prior: the belief before: any dataclass with ``mean``, ``cov``, ``gamma`` and ``xi``, both (shape, rate).
        step: from its mean.
        y: the output.
        iterations: variational iterations.

    Returns:
        The posterior, of the prior's class, and the sample's free energy [nats].
    """
    n = len(step.moved)
    mean = np.concatenate([step.moved, prior.mean[n:]])
    cov = step.jacobian @ prior.cov @ step.jacobian.T
    N = np.zeros_like(cov)
    N[:n, :n] = step.noise
    belief = Belief(prior.mean, prior.cov, prior.gamma, [prior.xi])
    outcome = _condition_on_outputs(belief, mean, cov, np.abs(cov), N, lambda x: [x[0]], [y], iterations)
    after = outcome.belief
    posterior = replace(prior, mean=after.mean, cov=(after.cov + after.cov.T) / 2, gamma=after.gamma, xi=after.xi[0])
    return posterior, outcome.free_energies[0][-1]


def _condition_on_outputs(
    belief: Belief,
    mean: np.ndarray,
    cov: np.ndarray,
    size: np.ndarray,
    N: np.ndarray,
    shows: Callable,
    y: Sequence[float],
    iterations: int,
) -> Outcome:
    """Update of a predicted belief by outputs; ``mean`` and ``cov`` are without process noise.

    The update goes sensor by sensor. The first sensor that shows process noise informs q(γ), with the whole variance N.
    """
    gamma, xi = belief.gamma, list(belief.xi)
    readouts = jacobian(shows, mean)
    teller = next((k for k, h in enumerate(readouts) if h @ N @ h > 0), None)
    if teller is None:
        cov, size = cov + gamma[1] / gamma[0] * N, size + gamma[1] / gamma[0] * np.abs(N)
    condition, scale, energies = 1.0, np.zeros(len(mean)), []
    for k in range(len(y)):
        h, expected = jacobian(shows, mean)[k], shows(mean)[k]
        s = h @ cov @ h
        shown = h @ N @ h if k == teller else 0.0
        is_seen = not np.isnan(y[k])
        e = y[k] - expected if is_seen else 0.0
        q0, r0 = shown * gamma[1], xi[k][1]
        g_shape, n_shape = gamma[0] + 0.5, xi[k][0] + 0.5
        next_q, next_r = q0 / gamma[0], r0 / xi[k][0]
        q, r, g_rate, n_rate = next_q, next_r, q0, r0
        energies.append([])
        for _ in range(iterations if is_seen else 1):
            q, r = next_q, next_r
            if not is_seen:
                break
            S = s + q + r
            # Moments of w and v given y, from the joint Gaussian of (w, v) and the innovation.
            w, v = q * e / S, r * e / S
            g_rate, n_rate = q0 + 0.5 * (w**2 + q - q**2 / S), r0 + 0.5 * (v**2 + r - r**2 / S)
            energies[-1].append(free_energy(e, s, q, r, (gamma[0], q0), xi[k], shown > 0))
            next_q, next_r = g_rate / g_shape, n_rate / n_shape
        if k == teller:
            cov, size = cov + q / shown * N, size + q / shown * np.abs(N)
            if is_seen:
                gamma = g_shape, g_rate / shown
        scale = np.maximum(scale, np.sqrt(np.maximum(np.diag(cov), 0.0)))
        known = np.where(scale > 0, scale, np.inf)
        condition = max(condition, (size / np.outer(known, known)).max())
        if is_seen:
            xi[k] = n_shape, n_rate
            gain, S, cov = seen(cov, r, h)
            condition *= max(
                1.0, (np.abs(h) @ size @ np.abs(h) + r) / S, (np.abs(y[k]) + np.abs(expected)) / np.sqrt(S)
            )
            mean = mean + gain * e
    return Outcome(Belief(mean, cov, gamma, xi), energies, scale, condition)


def free_energy(e, s, q, r, gamma, xi, with_process) -> float:
    """Free energy of one sensor's output, from expectations and divergences one by one.

    At the Gaussian that noise variances q and r make, with q(γ) and q(ξ) that follow from it: E[-log p(y, w, x)] and
    the entropies, with ½ log 2πS + e²/2S the Gaussian's own evidence at q and r.
    """

    def part(v, prior):
        """The terms that change where log v becomes E[-log precision] and 1/v its mean, and the Gamma's divergence."""
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
