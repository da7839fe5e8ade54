"""Equilibrium of a spring and its stiffness there: a constant force moves a spring away from its inflection."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from estimator.belief import Belief

#: Standard deviations by which the stiffness at rest differs from a in an asymmetric spring.
_MIN_STDS_OF_DIFFERENCE = 5.0

#: Smallest difference that matters, as a fraction of a.
_MIN_RELATIVE_DIFFERENCE = 1e-3

#: Smallest difference that matters, in standard deviations of a.
_MIN_STDS_OF_STIFFNESS = 3.0


class SpringEquilibrium(NamedTuple):
    """The equilibrium of a spring.

    Attributes:
        displacement_from_inflection: displacement x from the inflection, where a x + b x³ + u0 = 0.
        stiffness: mean and standard deviation of the stiffness there, a + 3 b x².
        quadratic: mean and standard deviation of the quadratic stiffness there, 3 b x.
        is_symmetric: whether the stiffness there agrees with a, or differs by less than matters.
    """

    displacement_from_inflection: float
    stiffness: tuple[float, float]
    quadratic: tuple[float, float]
    is_symmetric: bool


def find_equilibrium(belief: Belief) -> SpringEquilibrium | None:
    """The equilibrium nearest to the inflection, to first order in the parameters; None of a spring with two wells."""
    names = list(belief.model.physical)
    mean, cov = belief.physical()
    parameters = dict(zip(names, mean, strict=True))
    a, b, u0 = (float(parameters[name]) for name in ("a", "b", "u0"))
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
    # Derivatives by a, b and u0, of the displacement and then of both stiffnesses.
    displacement_slope = -np.array([x, x**3, 1.0]) / k
    jacobian = np.array(
        [
            np.array([1.0, 3 * x**2, 0.0]) + 6 * b * x * displacement_slope,
            np.array([0.0, 3 * x, 0.0]) + 3 * b * displacement_slope,
        ]
    )
    at = [names.index(name) for name in ("a", "b", "u0")]
    parameter_block = np.ix_(at, at)
    stds = np.sqrt(np.maximum(np.einsum("ki,ij,kj->k", jacobian, cov[parameter_block], jacobian), 0.0))
    difference_slope = jacobian[0] - np.array([1.0, 0.0, 0.0])
    difference = abs(k - a), float(np.sqrt(max(difference_slope @ cov[parameter_block] @ difference_slope, 0.0)))
    relevant_difference = min(_MIN_RELATIVE_DIFFERENCE * a, _MIN_STDS_OF_STIFFNESS * float(np.sqrt(cov[at[0], at[0]])))
    symmetric = difference[0] < _MIN_STDS_OF_DIFFERENCE * difference[1] or difference[0] < relevant_difference
    return SpringEquilibrium(x, (k, float(stds[0])), (3 * b * x, float(stds[1])), bool(symmetric))
