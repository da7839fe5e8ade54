"""The log determinant of a belief's covariance and the log density at a point, as symbolic assignments to generate."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from estimator.models.model import Model

#: Smallest determinant that has a logarithm: below it, numbers lose digits.
_MIN_DETERMINANT = 2.0**-1000

#: Largest determinant that has a logarithm.
_MAX_DETERMINANT = 2.0**1000


def log_det_and_density(
    model: Model,
    deviations: Mapping[str, Any] | None = None,
    covariance_entries: Mapping[str, Any] | None = None,
    prefix: str = "L",
) -> tuple[Any, Any, Any, Any]:
    """Assignments of an L D Lᵀ factorisation of the coefficients' covariance.

    Args:
        model: model with these coefficients.
        deviations: coefficient to its deviation from the mean, for the density; None for no density.
        covariance_entries: ``P_i_j`` to the expression in its place.
        prefix: prefix of the assigned names.

    Returns:
        The assignments, and in symbols the determinant, the squared deviation in units of the covariance, and 1 where
        all pivots are positive and the determinant has a logarithm.
    """
    import sympy as sp

    from estimator.engine.symbolic import symbol, symmetric_entry
    from estimator.engine.symbolic_ldl import ldl_factorise

    names = list(model.coefficients)
    covariance_symbol = lambda i, k: symmetric_entry("P", names[k], names[i], model.names)  # noqa: E731
    covariance = {(i, k): covariance_symbol(i, k) for i in range(len(names)) for k in range(i + 1)}
    factors = ldl_factorise(
        {place: (covariance_entries or {}).get(str(e), e) for place, e in covariance.items()}, len(names), prefix
    )
    lines, square = [*factors.lines], sp.S.Zero
    whitened: list[Any] = []
    for i, name in enumerate(names if deviations else ()):
        assert deviations is not None
        lines.append((f"{prefix}Z_{i}", deviations[name] - sum(factors.lower[i, m] * whitened[m] for m in range(i))))
        whitened.append(symbol(f"{prefix}Z_{i}"))
        square += whitened[i] ** 2 * factors.inverse[i]
    determinant = symbol(f"{prefix}DET")
    lines.append((f"{prefix}DET", factors.determinant))
    check = sp.Function("positive")
    is_sound = sp.Mul(*(check(p) for p in factors.pivots))
    is_sound *= check(determinant - sp.Float(_MIN_DETERMINANT)) * check(sp.Float(_MAX_DETERMINANT) - determinant)
    return lines, determinant, square, is_sound
