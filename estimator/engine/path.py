"""The packed algebra of a path: the Kalman filter of a model linearised along its own trajectory, as assignments."""

from __future__ import annotations

import sympy as sp

from estimator.engine.algebra import HALF, ZERO
from estimator.engine.derive import Assignments, Lines, Moved, calculus, input_at_end, pair, symbol
from estimator.engine.emit import text_of
from estimator.engine.rows import path_results
from estimator.models.model import Model


def path_sample(model: Model, moved: Moved, degree: int, observed: bool) -> tuple[Assignments, dict[str, str]]:
    """One sample of the Kalman filter of the model linearised along its own trajectory, at known coefficients.

    With Z the sensitivities of the state's mean, A its slope by the state and B by the coefficients (both in S),

        V⁻ = A V Aᵀ + q N,   Z⁻ = A Z + B;   per sensor  s = h Z⁻ + ∂y/∂c,  F += s sᵀ/S,  Z = Z⁻ - K s.

    Names besides `path_names` and `path_results` of `estimator.engine.rows`: ``Q``, ``R_<sensor>`` and ``LIVE``, 0
    where the sample is not counted.

    Args:
        model: whose equation.
        moved: the motion over the sample.
        degree: of the input's polynomial.
        observed: whether the filter follows the outputs ``Y_<sensor>``, or the response without noise. The latter
            leaves what the sensors show in ``SHOWN_<sensor>``, and the first one's predictive variance in ``SPREAD``.
    """
    states, coefficients = list(model.states), list(model.coefficients)
    n, lines = len(states), Lines()
    put = lines.put
    mean = dict(zip(states, moved.state, strict=True))
    cov: dict[tuple[str, str], sp.Expr] = {}
    for a, i in enumerate(states):
        row = {
            k: put(f"B_{i}_{k}", sum((moved.by[a][m] * pair("V", states[m], k, states) for m in range(n)), ZERO))
            for k in states
        }
        for b in range(a, n):
            total = sum((moved.by[b][m] * row[states[m]] for m in range(n)), symbol("Q") * moved.noise[a][b])
            cov[i, states[b]] = put(f"W_{i}_{states[b]}", total)
    sense = {
        (i, c): put(
            f"X_{i}_{c}", sum((moved.by[a][m] * symbol(f"Z_{states[m]}_{c}") for m in range(n)), moved.by[a][n + b])
        )
        for a, i in enumerate(states)
        for b, c in enumerate(coefficients)
    }
    at = lambda i, k: cov[(i, k) if states.index(i) <= states.index(k) else (k, i)]  # noqa: E731
    found = calculus(model)
    results: dict[str, str] = {}
    totals = {name: symbol(name) for name in path_results(model)}
    for k, sensor in enumerate(model.outputs):
        tag = str(k)
        here = {symbol(i): value for i, value in mean.items()} | {symbol("u"): input_at_end(model, degree)}
        shown = put(f"Y{tag}", found.outputs[k].xreplace(here))
        h = [slope.xreplace(here) for slope in found.readouts[k]]
        c = {i: put(f"C{tag}_{i}", sum((h[m] * at(i, states[m]) for m in range(n)), ZERO)) for i in states}
        spread = put(f"G{tag}", sum((h[m] * c[states[m]] for m in range(n)), ZERO))
        variance = put(f"S{tag}", spread + symbol(f"R_{sensor}"))
        weight = put(f"L{tag}", 1 / variance)
        told = {
            name: put(f"T{tag}_{name}", sum((h[m] * sense[states[m], name] for m in range(n)), h[n + b]))
            for b, name in enumerate(coefficients)
        }
        counted = put(f"I{tag}", symbol("LIVE") * weight)
        weighed = {name: put(f"U{tag}_{name}", counted * told[name]) for name in coefficients}
        for b, name in enumerate(coefficients):
            for other in coefficients[b:]:
                totals[f"F_{name}_{other}"] += weighed[name] * told[other]
        error = put(f"E{tag}", symbol(f"Y_{sensor}") - shown) if observed else ZERO
        if observed:
            misfit = put(f"D{tag}", counted * error**2)
            totals["LOSS"] += HALF * (misfit - symbol("LIVE") * sp.log(weight))
            totals["MISFIT"] += misfit
            for name in coefficients:
                totals[f"SLOPE_{name}"] -= weighed[name] * error
            results[f"SPREAD_{sensor}"] = text_of(spread)
        elif k == 0:
            results["SPREAD"] = text_of(variance)
        results[f"SHOWN_{sensor}"] = text_of(shown)
        gain = {i: put(f"K{tag}_{i}", weight * c[i]) for i in states}
        mean = {i: put(f"J{tag}_{i}", mean[i] + gain[i] * error) for i in states}
        sense = {(i, name): put(f"O{tag}_{i}_{name}", sense[i, name] - gain[i] * told[name]) for i, name in sense}
        cov = {(i, j): put(f"P{tag}_{i}_{j}", value - gain[i] * c[j]) for (i, j), value in cov.items()}
    results |= {i: text_of(mean[i]) for i in states}
    results |= {f"V_{i}_{j}": text_of(value) for (i, j), value in cov.items()}
    results |= {f"Z_{i}_{name}": text_of(value) for (i, name), value in sense.items()}
    for name, total in totals.items():
        if total != symbol(name):
            results[name] = text_of(put(f"{name}_e", total))
    return lines, results
