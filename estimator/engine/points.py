"""Sigma points, as assignments: a belief's motion by the cubature rule of degree 3.

(Arasaratnam and Haykin 2009, doi:10.1109/TAC.2009.2019800; an unscented transform whose centre has no weight.)

The points lie along the columns of √pairs L, L Lᵀ = P over the *movers*, the quantities on which the motion depends;
the other rows of L say how the rest goes along. A mover of variance 0, or one that depends on those before it, leaves a
column of zeros without weight: all lanes run through all columns, each with the weights that it has. Rows:

============  ======================================================================================
``L_c_i``     column c of √pairs L at quantity i
``WEIGHT_c``  of each of the two points along column c
``X_i``       coefficient i at the point that moves; its state is in ``M_i``
``I_p_i``     state i after the motion, at point p: 2 c in the direction of column c, 2 c + 1 against it
``UNSOUND``   how often a covariance was not positive semi-definite, since it was last set to 0
============  ======================================================================================
"""

from __future__ import annotations

import sympy as sp

from estimator.engine import derive
from estimator.engine.algebra import HALF, ONE, ZERO, select
from estimator.engine.derive import Assignments, Moved, calculus, pair, renamed, symbol
from estimator.engine.rows import movers_first
from estimator.models.model import Model

#: What rounding leaves of the variance of a dimension that depends on those before it, as a part of that variance.
ROUNDING = 1e-14

#: 1 for what is negative or no number, else 0.
below = sp.Function("below")


def spread(model: Model) -> tuple[Assignments, dict[str, str]]:
    """The columns of √pairs L and their weights, and whether P is a covariance: assignments and results by row.

    A column is dead where its pivot is within `ROUNDING` of the variance. P is not a covariance where a pivot is
    below that, or a dead column still goes along with another quantity.
    """
    names, m = movers_first(model), len(model.movers)
    covariance = lambda i, j: pair("P", i, j, model.names)  # noqa: E731
    lines: Assignments = []

    def put(name: str, expression: sp.Expr) -> sp.Expr:
        lines.append((name, expression))
        return symbol(name)

    factor: dict[tuple[int, str], sp.Symbol] = {}
    alive, faults = [], []
    for c, j in enumerate(names):
        variance = covariance(j, j)
        margin = put(f"MARGIN_{c}", ROUNDING * variance)
        pivot = put(f"PIVOT_{c}", variance - sum((factor[d, j] ** 2 for d in range(c)), ZERO))
        lives = put(f"LIVES_{c}", select(pivot - margin, ONE, ZERO))
        inverse = put(f"INVERSE_{c}", lives / sp.sqrt(select(lives, pivot, ONE)))
        faults.append(below(pivot + margin))
        factor[c, j] = put(f"FACTOR_{c}_{j}", pivot * inverse)
        for i in names[c + 1 :]:
            rest = covariance(i, j) - sum((factor[d, i] * factor[d, j] for d in range(c)), ZERO)
            rest = put(f"REST_{c}_{i}", rest)
            factor[c, i] = put(f"FACTOR_{c}_{i}", rest * inverse)
            faults.append(below(margin * covariance(i, i) - (ONE - lives) * rest**2))
        alive.append(lives)
    pairs = put("PAIRS", sum(alive[:m], ZERO))
    width = put("WIDTH", sp.sqrt(select(pairs, pairs, ONE)))
    each = put("EACH", HALF / select(pairs, pairs, ONE))
    results = {}
    for c in range(m):
        # Where everything is known, two points at the mean move with it.
        weight = each * alive[c] if c else each * select(pairs, alive[0], ONE)
        results[f"WEIGHT_{c}"] = str(put(f"WEIGHT_{c}_e", weight))
        for i in names[:c]:
            results[f"L_{c}_{i}"] = "0.0"
        for i in names[c:]:
            results[f"L_{c}_{i}"] = str(put(f"WIDE_{c}_{i}", width * factor[c, i]))
    results["UNSOUND"] = str(put("UNSOUND_e", symbol("UNSOUND") + sum(faults, ZERO)))
    return lines, results


def at_point(model: Model) -> dict[str, str]:
    """Names of the movers at a point."""
    return {i: f"M_{i}" if i in model.states else f"X_{i}" for i in model.movers}


def point(model: Model) -> tuple[Assignments, dict[str, str]]:
    """The point at ``SIGN`` times the column ``L_C`` from the mean."""
    lines = [(f"{to}_e", symbol(i) + symbol("SIGN") * symbol(f"L_C_{i}")) for i, to in at_point(model).items()]
    return lines, {to: f"{to}_e" for to in at_point(model).values()}


def point_step(model: Model, degree: int) -> Assignments:
    """One Runge-Kutta step of a point."""
    coefficients = {i: to for i, to in at_point(model).items() if i not in model.states}
    return renamed(derive.plain_step(model, degree), coefficients)


def point_sample(model: Model) -> tuple[Assignments, dict[str, str]]:
    """A whole sample of a difference equation, from the point at ``SIGN`` times ``L_C`` to its image ``I_P``."""
    lines, _ = point(model)
    named = {f"NEXT_{i}": move for i, move in zip(model.states, calculus(model).moves, strict=True)}
    inputs = {"u": "U_0", "u1": "U_1", "u2": "U_2"}
    lines += renamed(named.items(), inputs | {i: f"{to}_e" for i, to in at_point(model).items()})
    return lines, {f"I_P_{i}": f"NEXT_{i}" for i in model.states}


def moments(model: Model) -> tuple[Assignments, Moved]:
    """Mean and covariance Q of the images, without process noise, whose covariance is that at the mean."""
    states, m = list(model.states), len(model.movers)
    lines: Assignments = []
    weight = [symbol(f"WEIGHT_{c}") for c in range(m)]
    image = lambda p, i: symbol(f"I_{p}_{i}")  # noqa: E731
    for i in states:
        lines.append(
            (f"MIDDLE_{i}", sum((weight[c] * (image(2 * c, i) + image(2 * c + 1, i)) for c in range(m)), ZERO))
        )
        lines += [(f"OFF_{p}_{i}", image(p, i) - symbol(f"MIDDLE_{i}")) for p in range(2 * m)]
        lines += [(f"LEAN_{c}_{i}", weight[c] * (image(2 * c, i) - image(2 * c + 1, i))) for c in range(m)]
    off = lambda p, i: symbol(f"OFF_{p}_{i}")  # noqa: E731
    for a, i in enumerate(states):
        for k in states[a:]:
            total = sum((weight[p // 2] * off(p, i) * off(p, k) for p in range(2 * m)), ZERO)
            lines.append((f"Q_{i}_{k}", total))
        for j in model.coefficients:
            total = sum((symbol(f"LEAN_{c}_{i}") * symbol(f"L_{c}_{j}") for c in range(m)), ZERO)
            lines.append((f"Q_{i}_{j}", total))
    carried = derive.moved(model)[1]
    return lines, Moved(tuple(symbol(f"MIDDLE_{i}") for i in states), (), carried.noise, carried.is_sound)
