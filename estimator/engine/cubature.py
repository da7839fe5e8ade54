"""Sigma-point prediction of a Gaussian belief, as assignments: the cubature rule of degree 3.

(Arasaratnam and Haykin 2009, doi:10.1109/TAC.2009.2019800; an unscented transform whose centre has no weight.)

The factor L of the covariance, L Lᵀ = P, begins with the *movers*, the quantities on which the dynamics depend. The
points lie along its columns times √n, n the number of active columns. A mover that has variance 0, or depends linearly
on movers before it, leaves a column of zeros without weight. All lanes run through all columns. Rows:

====================  ==============================================================================
``L_c_i``             entry i of column c of √n L
``WEIGHT_c``          weight of each of the two points along column c
``POINT_i``           coefficient i at the current point; its state is in ``M_i``
``IMAGE_p_i``         state i after the sample at point p: 2 c along column c, 2 c + 1 against it
``INDEFINITE_COUNT``  count of indefinite covariances since the row was last set to 0
====================  ==============================================================================
"""

from __future__ import annotations

import sympy as sp

from estimator.engine import symbolic
from estimator.engine.branch_functions import select
from estimator.engine.storage_layout import cubature_order, input_row
from estimator.engine.symbolic import (
    HALF,
    ONE,
    ZERO,
    Assignments,
    Propagation,
    differentiate,
    is_negative,
    substitute,
    symbol,
    symmetric_entry,
)
from estimator.models.model import Model

#: Pivot of the factorisation, as a fraction of the variance, up to which a column counts as linearly dependent [1].
PIVOT_TOLERANCE = 1e-14


def cubature_columns(model: Model) -> tuple[Assignments, dict[str, str]]:
    """The columns of √n L, their weights, and a test of P: assignments and results by row.

    A column is inactive where its pivot is at most `PIVOT_TOLERANCE` of the variance. P is no covariance where a pivot
    is below minus that, or where an inactive column is correlated with another quantity.
    """
    names, m = cubature_order(model), len(model.dynamic_names)
    covariance = lambda i, j: symmetric_entry("P", i, j, model.names)  # noqa: E731
    lines: Assignments = []

    def assign(name: str, expression: sp.Expr) -> sp.Expr:
        lines.append((name, expression))
        return symbol(name)

    factor: dict[tuple[int, str], sp.Symbol] = {}
    active, faults = [], []
    for c, j in enumerate(names):
        variance = covariance(j, j)
        tolerance = assign(f"TOLERANCE_{c}", PIVOT_TOLERANCE * variance)
        pivot = assign(f"PIVOT_{c}", variance - sum((factor[d, j] ** 2 for d in range(c)), ZERO))
        is_active = assign(f"IS_ACTIVE_{c}", select(pivot - tolerance, ONE, ZERO))
        inverse = assign(f"PIVOT_ROOT_INVERSE_{c}", is_active / sp.sqrt(select(is_active, pivot, ONE)))
        faults.append(is_negative(pivot + tolerance))
        factor[c, j] = assign(f"FACTOR_{c}_{j}", pivot * inverse)
        for i in names[c + 1 :]:
            rest = covariance(i, j) - sum((factor[d, i] * factor[d, j] for d in range(c)), ZERO)
            rest = assign(f"SCHUR_{c}_{i}", rest)
            factor[c, i] = assign(f"FACTOR_{c}_{i}", rest * inverse)
            faults.append(is_negative(tolerance * covariance(i, i) - (ONE - is_active) * rest**2))
        active.append(is_active)
    n_active = assign("N_ACTIVE", sum(active[:m], ZERO))
    radius = assign("RADIUS", sp.sqrt(select(n_active, n_active, ONE)))
    point_weight = assign("POINT_WEIGHT", HALF / select(n_active, n_active, ONE))
    results = {}
    for c in range(m):
        # With no active column, two points stay at the mean.
        weight = point_weight * active[c] if c else point_weight * select(n_active, active[0], ONE)
        results[f"WEIGHT_{c}"] = str(assign(f"WEIGHT_{c}_e", weight))
        for i in names[:c]:
            results[f"L_{c}_{i}"] = "0.0"
        for i in names[c:]:
            results[f"L_{c}_{i}"] = str(assign(f"SCALED_{c}_{i}", radius * factor[c, i]))
    results["INDEFINITE_COUNT"] = str(assign("INDEFINITE_COUNT_e", symbol("INDEFINITE_COUNT") + sum(faults, ZERO)))
    return lines, results


def point_names(model: Model) -> dict[str, str]:
    """Mover to its name at the current point."""
    return {i: f"M_{i}" if i in model.states else f"POINT_{i}" for i in model.dynamic_names}


def place_point(model: Model) -> tuple[Assignments, dict[str, str]]:
    """The point at ``SIGN`` times the column ``L_C`` from the mean."""
    lines = [(f"{to}_e", symbol(i) + symbol("SIGN") * symbol(f"L_C_{i}")) for i, to in point_names(model).items()]
    return lines, {to: f"{to}_e" for to in point_names(model).values()}


def propagate_point(model: Model, degree: int) -> Assignments:
    """One Runge-Kutta step of a point."""
    coefficients = {i: to for i, to in point_names(model).items() if i not in model.states}
    return substitute(symbolic.state_rk4_step(model, degree), coefficients)


def propagate_point_difference(model: Model) -> tuple[Assignments, dict[str, str]]:
    """A sample of a difference equation, from the point at ``SIGN`` times ``L_C`` from the mean to ``IMAGE_P``."""
    lines, _ = place_point(model)
    named = {f"NEXT_{i}": move for i, move in zip(model.states, differentiate(model).moves, strict=True)}
    inputs = {written: input_row(*tap) for written, tap in model.input_ages.items()}
    lines += substitute(named.items(), inputs | {i: f"{to}_e" for i, to in point_names(model).items()})
    return lines, {f"IMAGE_P_{i}": f"NEXT_{i}" for i in model.states}


def point_moments(model: Model) -> tuple[Assignments, Propagation]:
    """Mean and covariance P⁻ of the points after the sample; the process noise covariance is evaluated at the mean."""
    states, m = list(model.states), len(model.dynamic_names)
    lines: Assignments = []
    weight = [symbol(f"WEIGHT_{c}") for c in range(m)]
    image = lambda p, i: symbol(f"IMAGE_{p}_{i}")  # noqa: E731
    for i in states:
        lines.append(
            (f"MIDDLE_{i}", sum((weight[c] * (image(2 * c, i) + image(2 * c + 1, i)) for c in range(m)), ZERO))
        )
        lines += [(f"DEVIATION_{p}_{i}", image(p, i) - symbol(f"MIDDLE_{i}")) for p in range(2 * m)]
        lines += [(f"DIFFERENCE_{c}_{i}", weight[c] * (image(2 * c, i) - image(2 * c + 1, i))) for c in range(m)]
    deviation = lambda p, i: symbol(f"DEVIATION_{p}_{i}")  # noqa: E731
    for a, i in enumerate(states):
        for k in states[a:]:
            total = sum((weight[p // 2] * deviation(p, i) * deviation(p, k) for p in range(2 * m)), ZERO)
            lines.append((f"P_PRED_{i}_{k}", total))
        for j in model.coefficients:
            total = sum((symbol(f"DIFFERENCE_{c}_{i}") * symbol(f"L_{c}_{j}") for c in range(m)), ZERO)
            lines.append((f"P_PRED_{i}_{j}", total))
    at_mean = symbolic.propagate_sample(model)[1]
    return lines, Propagation(tuple(symbol(f"MIDDLE_{i}") for i in states), (), at_mean.noise_cov, at_mean.is_psd)
