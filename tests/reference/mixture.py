"""A mixture of beliefs, one for each hypothesis about the noises.

A belief is any dataclass with ``mean``, ``cov``, ``gamma`` and ``xi``, both (shape, rate).
"""

from dataclasses import replace

import numpy as np
from scipy.special import logsumexp

#: Fraction of the weight that every sample distributes evenly over all members [1].
FORGOTTEN = 1e-6


def hypotheses(prior, ratios: int) -> list:
    """Three levels of both noises together beside ``ratios`` of one to the other, from 1/30 to 30 of the prior's."""
    (g, g_rate), (n, n_rate) = prior.gamma, prior.xi
    total, ratio = g_rate / g + n_rate / n, np.sqrt(g_rate / g / (n_rate / n))
    members = []
    for level in (1 / 3, 1, 3):
        for factor in np.geomspace(1 / 30, 30, ratios):
            share = (ratio * factor) ** 2 / (1 + (ratio * factor) ** 2)
            q, r = level**2 * total * share, level**2 * total * (1 - share)
            members.append(replace(prior, gamma=(g, g * q), xi=(n, n * r)))
    return members


def weighed(weights: np.ndarray, energies) -> tuple[np.ndarray, float]:
    """Weights after a sample whose free energies are (members,), and the free energy of the mixture [nats]."""
    before = np.log((1 - FORGOTTEN) * weights + FORGOTTEN / len(weights))
    energy = -logsumexp(before - np.asarray(energies))
    return np.exp(before - energies + energy), energy


def mixed(weights: np.ndarray, members):
    """One belief with the moments of a mixture; a noise's variance has the relative variance 1/shape."""
    mean = sum(w * m.mean for w, m in zip(weights, members, strict=True))
    cov = sum(w * (m.cov + np.outer(m.mean - mean, m.mean - mean)) for w, m in zip(weights, members, strict=True))
    noises = {}
    for name in ("gamma", "xi"):
        shapes, rates = np.array([getattr(m, name) for m in members]).T
        variances = rates / shapes
        average = weights @ variances
        shape = average**2 / (weights @ (variances**2 / shapes + variances**2) - average**2)
        noises[name] = (shape, shape * average)
    return replace(members[0], mean=mean, cov=cov, **noises)
