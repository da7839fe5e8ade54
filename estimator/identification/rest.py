"""Where a spring rests, and how stiff it is there: a constant force moves a spring away from its inflection."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from estimator.belief import Belief

#: Standard deviations by which the stiffness at rest differs from a for sure; and by what part of it, or by how many
#: standard deviations of a itself, that matters.
_SURE, _MATTERS, _OFF = 5.0, 1e-3, 3.0


class Rest(NamedTuple):
    """A spring at rest.

    Attributes:
        place: displacement from the inflection, where a x + b x³ + u0 = 0.
        stiffness: a + 3 b x² there; mean and standard deviation.
        quadratic: 3 b x, of the force that grows with the square of the displacement from rest; likewise.
        is_symmetric: whether the stiffness is a as far as can be told, or as far as matters.
    """

    place: float
    stiffness: tuple[float, float]
    quadratic: tuple[float, float]
    is_symmetric: bool


def at_rest(belief: Belief) -> Rest | None:
    """The rest of a spring nearest to its inflection, to first order in the parameters; None of one with two wells."""
    names = list(belief.model.physical)
    mean, cov = belief.physical()
    known = dict(zip(names, mean, strict=True))
    a, b, u0 = (float(known[name]) for name in ("a", "b", "u0"))
    if a <= 0:
        return None
    roots = np.roots([b, 0.0, a, u0]) if b else np.array([-u0 / a])
    real = roots[np.abs(roots.imag) < 1e-9 * (1 + np.abs(roots.real))].real
    if not len(real):
        return None
    x = float(real[np.argmin(np.abs(real))])
    k = a + 3 * b * x**2
    if k <= 0:
        return None
    # Slopes by a, b and u0: of the place, then of what follows from it.
    place = -np.array([x, x**3, 1.0]) / k
    slopes = np.array([np.array([1.0, 3 * x**2, 0.0]) + 6 * b * x * place, np.array([0.0, 3 * x, 0.0]) + 3 * b * place])
    at = [names.index(name) for name in ("a", "b", "u0")]
    own = np.ix_(at, at)
    stds = np.sqrt(np.maximum(np.einsum("ki,ij,kj->k", slopes, cov[own], slopes), 0.0))
    away = slopes[0] - np.array([1.0, 0.0, 0.0])
    differs = abs(k - a), float(np.sqrt(max(away @ cov[own] @ away, 0.0)))
    matters = min(_MATTERS * a, _OFF * float(np.sqrt(cov[at[0], at[0]])))
    symmetric = differs[0] < _SURE * differs[1] or differs[0] < matters
    return Rest(x, (k, float(stds[0])), (3 * b * x, float(stds[1])), bool(symmetric))
