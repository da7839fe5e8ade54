"""Runge-Kutta integration of a differential equation with its variational equations and process noise covariance.

The sensitivities F follow the exact derivative of the step's arithmetic, which is linear in them. With J the Jacobian
of the rates at a stage, by states and coefficients, and H (``END_BY_RATE``) the derivative of the step's end by the
rates of that stage,

    H_D = h/6,   H_C = h/3 + h H_D J_D,   H_B = h/3 + h/2 H_C J_C,   H_A = h/6 + h/2 H_B J_B,
    F_END = F + Σ H J [F; 1].

Integrating every column of F through the stages would be twice the work, and exceed the registers.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import sympy as sp

from estimator.engine import printer_numba, symbolic
from estimator.engine.storage_layout import held_noise_rows, integrator_rows, stage_inputs, upper_triangle_names
from estimator.engine.symbolic import (
    Assignments,
    Program,
    differentiate,
    eliminate_common_subexpressions,
    input_at_stages,
    noise_effects,
    runge_kutta_4,
    sum_over_sources,
    symbol,
    symmetric_entry,
)
from estimator.models.model import Model

#: Stage to the weight of its rates at the end of the step, and their weight in the next stage [steps].
_STAGE_WEIGHTS = {"A": (sp.Rational(1, 6), sp.S.Half), "B": (sp.Rational(1, 3), sp.S.Half),
           "C": (sp.Rational(1, 3), sp.S.One), "D": (sp.Rational(1, 6), sp.S.Zero)}  # fmt: skip

#: Runge-Kutta steps of the state over a sample that is only imagined: the first number where the model takes as many or
#: more, else the second. What is linear takes one step, whose stages are begin, middle and end of the sample. Two steps
#: are wrong by more than the noise at five samples per period (tests/agents/test_belief_rollout.py), and peaks then
#: lie beyond where they are planned.
_COARSE_STEPS, _MIN_COARSE_STEPS = 4, 2

#: Runge-Kutta steps over a predicted sample, for all other models.
_MIN_COARSE_STEPS = 2

#: Name of a held process noise, which has a column of sensitivities as a coefficient has, before its source's number.
_HELD_NOISE = "HELD"

_Slopes = dict[tuple[str, str], sp.Expr]


def print_integrator(
    model: Model,
    degree: int,
    layout: Mapping[str, int],
    lanes: int,
    input_values: Mapping[str, Any] | None = None,
    sample_length: sp.Expr = sp.S.One,
    noise_ratios: bool = False,
    step_length: sp.Expr | None = None,
) -> str:
    """Source of ``begin(W)`` and ``move(W, TAU)``, which integrate a sample; or of ``move(W, TAU, STEP)``.

    Args:
        model: the equation; the source is empty for a difference equation.
        degree: degree of the input's polynomial.
        layout: row number of each quantity.
        lanes: lanes of the block.
        input_values: ``U_<input>_<k>`` to an expression in other rows.
        sample_length: length of the sample, in sampling steps.
        noise_ratios: as for `estimator.engine.symbolic.propagate_sample`.
        step_length: as for `variational_rk4_step`; an argument of ``move``.
    """
    if not model.is_continuous:
        return ""
    start = {name: printer_numba.print_expression(value) for name, value in symbolic.integrator_start(model).items()}
    stepped = {name: f"{name}_END" for name in integrator_rows(model)}
    step = variational_rk4_step(model, degree, sample_length, noise_ratios, step_length)
    step = symbolic.substitute(step, input_values or {})
    source = printer_numba.print_lane_loop(
        "begin", [], start, layout, lanes, doc="The integrator at the start of a sample."
    )
    doc = "One Runge-Kutta step, from TAU in [0, 1) of the sample on."
    uniform = ("TAU",) if step_length is None else ("TAU", str(step_length))
    return source + printer_numba.print_lane_loop("move", step, stepped, layout, lanes, uniform, doc)


def variational_rk4_step(
    model: Model,
    degree: int,
    sample_length: sp.Expr = sp.S.One,
    noise_ratios: bool = False,
    step_length: sp.Expr | None = None,
) -> Assignments:
    """One Runge-Kutta step of `estimator.engine.storage_layout.integrator_rows`, from ``<name>`` to ``<name>_END``.

    Args:
        model: the equation.
        degree: degree of the input's polynomial.
        sample_length: length of the sample, in sampling steps.
        noise_ratios: as for `estimator.engine.symbolic.propagate_sample`.
        step_length: symbol of the step's length, as a fraction of the sample; None for the model's own number of steps.
    """
    states, fraction = list(model.states), sp.Rational(1, model.substeps) if step_length is None else step_length
    h = sample_length * fraction
    stage, slopes = _stage_rates_and_slopes(model, noise_ratios)
    held_columns = {f"{_HELD_NOISE}{s}": rows for s, rows in enumerate(held_noise_rows(model))}
    plain_variables = [f"M_{i}" for i in states] + ([] if model.held else upper_triangle_names("Q", states))
    lines = Program(
        input_at_stages(model, degree, fraction) + runge_kutta_4(plain_variables, stage, model, fraction, sample_length)
    )
    total: _Slopes = dict.fromkeys(slopes, sp.S.Zero)
    stage_slopes: _Slopes = {}
    for tag in "DCBA":
        counts, reach = _STAGE_WEIGHTS[tag]
        weight = {}
        for i in states:
            for k in states:
                value = (counts * h if i == k else sp.S.Zero) + reach * h * stage_slopes.get((i, k), sp.S.Zero)
                weight[i, k] = lines.assign(f"END_BY_RATE_{i}_{k}_{tag}", value)
        assigned = {name for name, _ in stage}
        for i, j in slopes:
            at = [symbol(f"J_{k}_{j}_{tag}") if f"J_{k}_{j}" in assigned else slopes[k, j] for k in states]
            product = sum((weight[i, k] * slope for k, slope in zip(states, at, strict=True)), sp.S.Zero)
            stage_slopes[i, j] = lines.assign(f"END_BY_STATE_{i}_{j}_{tag}", product) if j in states else product
            total[i, j] += stage_slopes[i, j]
    for i in states:
        for k in states:
            total[i, k] = lines.assign(f"F_STEP_{i}_{k}", total[i, k] + (1 if i == k else 0))
    for i, j in slopes:
        names = held_columns.get(j) or [f"F_{k}_{j}" for k in states]
        columns = dict(zip(states, map(symbol, names), strict=True))
        column = sum((total[i, k] * columns[k] for k in states), sp.S.Zero)
        lines.append((f"{columns[i]}_END", column if j in states else column + total[i, j]))
    return lines


def _stage_rates_and_slopes(model: Model, noise_ratios: bool = False) -> tuple[Assignments, _Slopes]:
    """Rates ``RATE_<name>`` of the state and its noise covariance, and the Jacobian of the state's rates.

    Entries of the Jacobian that differ between the stages are assigned too, as ``J_<state>_<quantity>``.
    """
    c, states = differentiate(model), list(model.states)
    at = {symbol(i): symbol(f"M_{i}") for i in states}
    n = len(states)
    named = {f"RATE_M_{i}": move.xreplace(at) for i, move in zip(states, c.moves, strict=True)}
    jacobian = [[slope.xreplace(at) for slope in row] for row in c.jacobian]
    effects = [[e.xreplace(at) for e in effect] for effect in noise_effects(model)]
    noise = sum_over_sources(model, effects, noise_ratios)
    slopes = {(i, j): jacobian[a][b] for b, j in enumerate(model.dynamic_names) for a, i in enumerate(states)}
    if model.held:
        for s, effect in enumerate(effects):
            slopes |= {(i, f"{_HELD_NOISE}{s}"): effect[a] for a, i in enumerate(states)}
    changing = {*map(symbol, model.acting_inputs), *at.values()}
    named |= {f"J_{i}_{j}": slope for (i, j), slope in slopes.items() if slope.free_symbols & changing}
    for a in range(n):
        for b in range(a, 0 if model.held else n):
            noise_rate = sum(
                jacobian[a][k] * symmetric_entry("Q", states[k], states[b], states)
                + jacobian[b][k] * symmetric_entry("Q", states[k], states[a], states)
                for k in range(n)
            )
            named[f"RATE_Q_{states[a]}_{states[b]}"] = noise_rate + noise[a][b]
    return eliminate_common_subexpressions(named, "CSE"), slopes


def coarse_trajectory(model: Model, degree: int) -> tuple[Assignments, dict[str, str]]:
    """The noise-free state over a predicted sample, in few Runge-Kutta steps.

    Returns:
        The assignments, and ``MIDDLE_<state>`` and ``END_<state>`` to the names of their values.
    """
    steps = _COARSE_STEPS if model.substeps >= _COARSE_STEPS else _MIN_COARSE_STEPS
    step = symbolic.state_rk4_step(replace(model, substeps=steps), degree)
    lines, trajectory = Program(), [{i: i for i in model.states}]
    for s in range(steps):
        step_names = {name: f"{name}_{s}" for name, _ in step}
        begin = {f"M_{i}": name for i, name in trajectory[-1].items()}
        lines += symbolic.substitute(step, {**step_names, **begin, "TAU": sp.Rational(s, steps)})
        trajectory.append({i: step_names[f"M_{i}_END"] for i in model.states})
    middle = {f"MIDDLE_{i}": name for i, name in trajectory[steps // 2].items()}
    return lines, middle | {f"END_{i}": name for i, name in trajectory[-1].items()}


def coarse_propagation(model: Model, degree: int) -> tuple[Assignments, symbolic.Propagation]:
    """M, F and Q of a predicted sample of a differential equation, along `coarse_trajectory`.

    The sensitivities take one step, with the Jacobians at the start, middle and end of the sample. With H of its stages
    and g the coefficient of unit noise in the rates, Q follows Simpson's rule, summed over the sources:

        Q = 6 H_A g gᵀ H_Aᵀ + 3/2 (H_B + H_C) g gᵀ (H_B + H_C)ᵀ + 6 H_D g gᵀ H_Dᵀ.
    """
    states = list(model.states)
    lines = Program(symbolic.substitute(input_at_stages(model, degree, sp.S.One), {"TAU": sp.S.Zero}))
    points = {tag: {i: symbol(f"{at}{i}") for i in states} for tag, at in (("A", ""), ("B", "MIDDLE_"), ("D", "END_"))}
    end = {symbol(i): value for i, value in points["D"].items()}
    effects = [[g.xreplace(end) for g in effect] for effect in noise_effects(model)]
    slopes = {tag: _slopes_at(model, tag, point, lines) for tag, point in points.items()}
    slopes["C"] = slopes["B"]
    stage_slopes: _Slopes = {}
    total: _Slopes = dict.fromkeys(slopes["A"], sp.S.Zero)
    noise_slopes: dict[str, list[list[sp.Expr]]] = {}
    for tag in "DCBA":
        counts, reach = _STAGE_WEIGHTS[tag]
        H = {}
        for i in states:
            for k in states:
                value = (counts if i == k else 0) + reach * stage_slopes.get((i, k), sp.S.Zero)
                H[i, k] = lines.assign(f"END_BY_RATE_{i}_{k}_{tag}", value)
        for i, j in total:
            product = sum((H[i, k] * slopes[tag][k, j] for k in states), sp.S.Zero)
            stage_slopes[i, j] = lines.assign(f"END_BY_STATE_{i}_{j}_{tag}", product) if j in states else product
            total[i, j] += stage_slopes[i, j]
        noise_slopes[tag] = [
            [sum((H[i, k] * g for k, g in zip(states, effect, strict=True)), sp.S.Zero) for i in states]
            for effect in effects
        ]
    jacobian = {(i, j): lines.assign(f"F_{i}_{j}", total[i, j] + (1 if i == j else 0)) for i, j in total}
    noise_slopes["B"] = [
        [b + c for b, c in zip(*columns, strict=True)]
        for columns in zip(noise_slopes["B"], noise_slopes["C"], strict=True)
    ]
    simpson_weights = {"A": sp.Integer(6), "B": sp.Rational(3, 2), "D": sp.Integer(6)}
    noise_slopes = {
        tag: [
            [lines.assign(f"NOISE_EFFECT{s}_{i}_{tag}", k) for i, k in zip(states, column, strict=True)]
            for s, column in enumerate(noise_slopes[tag])
        ]
        for tag in simpson_weights
    }
    held_effects = [[jacobian[i, f"{_HELD_NOISE}{s}"] for i in states] for s in range(len(effects) * model.held)]
    held_cov = sum_over_sources(model, held_effects)
    noise_cov = {}
    for a, i in enumerate(states):
        for b, k in enumerate(states[a:], a):
            value = sum(
                (
                    share * column[a] * column[b]
                    for tag, share in simpson_weights.items()
                    for column in noise_slopes[tag]
                ),
                sp.S.Zero,
            )
            noise_cov[i, k] = noise_cov[k, i] = lines.assign(f"Q_{i}_{k}", held_cov[a][b] if model.held else value)
    return lines, symbolic.Propagation(
        tuple(points["D"].values()),
        tuple(tuple(jacobian[i, j] if j in model.dynamic_names else sp.S.Zero for j in model.names) for i in states),
        tuple(tuple(noise_cov[i, k] for k in states) for i in states),
    )


def _slopes_at(model: Model, tag: str, point: Mapping[str, sp.Expr], lines: Program) -> _Slopes:
    """Jacobian of the rates at a state and the stage's inputs; common parts are assigned to ``lines``, with a tag."""
    stage, slopes = _stage_rates_and_slopes(model)
    stage = [(name, value) for name, value in stage if not name.startswith("RATE_")]
    tagged = {name: f"{name}_{tag}" for name, _ in stage}
    values_at = {f"M_{i}": value for i, value in point.items()} | {
        u: symbol(value) for u, value in stage_inputs(model, tag).items()
    }
    lines += symbolic.substitute(stage, {**tagged, **values_at})
    named = [("", symbol(f"J_{i}_{j}") if f"J_{i}_{j}" in tagged else value) for (i, j), value in slopes.items()]
    return dict(zip(slopes, (value for _, value in symbolic.substitute(named, {**tagged, **values_at})), strict=True))
