"""A differential equation over a sample, by Runge-Kutta steps, with its sensitivities and its process noise.

The sensitivities S are moved by exactly the derivative of the step's arithmetic, which is linear in them. With J the
slopes of the rates at a stage, by the states and by the coefficients, and H the derivative of where the step ends by
the rates of that stage,

    H_D = h/6,   H_C = h/3 + h H_D J_D,   H_B = h/3 + h/2 H_C J_C,   H_A = h/6 + h/2 H_B J_B,
    S_E = S + Σ H J [S; 1].

To take every column of S through the stages on its own is twice the work, and more than registers hold.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import sympy as sp

from estimator.engine import derive, emit
from estimator.engine.derive import Assignments, Lines, calculus, input_over_step, pair, runge_kutta, shared, symbol
from estimator.engine.rows import carried_names, pairs
from estimator.models.model import Model

#: Of each stage, in parts of a step: what its rates count at the end, and how far they move the next stage.
_STAGES = {"A": (sp.Rational(1, 6), sp.S.Half), "B": (sp.Rational(1, 3), sp.S.Half),
           "C": (sp.Rational(1, 3), sp.S.One), "D": (sp.Rational(1, 6), sp.S.Zero)}  # fmt: skip

#: Runge-Kutta steps of the state over a sample that is only imagined: the first number where the model takes as many or
#: more, else the second. What is linear takes one step, whose stages are begin, middle and end of the sample. Two steps
#: are wrong by more than the noise where a period has five samples (tests/agents/test_imagination.py), and peaks then
#: lie beyond where they are planned.
_STEPS, _FEWER = 4, 2

#: Process noise that is held over a sample moves the state as one more coefficient would.
_HELD = "HELD"

_Slopes = dict[tuple[str, str], sp.Expr]


def motion_source(
    model: Model,
    degree: int,
    place: Mapping[str, int],
    lanes: int,
    given: Mapping[str, Any] | None = None,
    span: sp.Expr = sp.S.One,
) -> str:
    """Source of ``begin(W)`` and ``move(W, T)``, which carry a state over a sample.

    Args:
        model: whose state; of a difference equation the source is empty.
        degree: of the input's polynomial.
        place: rows of the block.
        lanes: systems in it.
        given: the input ``U_k`` in other rows.
        span: length of the sample, in sampling steps.
    """
    if not model.is_continuous:
        return ""
    start = {name: emit.text_of(value) for name, value in derive.carried_at_start(model).items()}
    moved = {name: f"{name}_E" for name in carried_names(model)}
    step = derive.renamed(motion_step(model, degree, span), given or {})
    source = emit.lane_loop("begin", [], start, place, lanes, doc="The point that moves, at the mean.")
    told = "One Runge-Kutta step, from T in [0, 1) of a sample on."
    return source + emit.lane_loop("move", step, moved, place, lanes, ("T",), told)


def motion_step(model: Model, degree: int, span: sp.Expr = sp.S.One) -> Assignments:
    """One step of all that is carried (`estimator.engine.rows.carried_names`), from ``<name>`` to ``<name>_E``."""
    states, h = list(model.states), span * sp.Rational(1, model.substeps)
    stage, slopes = _stage(model)
    moving = [f"M_{i}" for i in states] + ([] if model.held else pairs("N", states))
    lines = Lines(input_over_step(degree, model.substeps) + runge_kutta(moving, stage, model.substeps, span))
    total: _Slopes = dict.fromkeys(slopes, sp.S.Zero)
    through: _Slopes = {}
    for tag in "DCBA":
        counts, reach = _STAGES[tag]
        weight = {}
        for i in states:
            for k in states:
                value = (counts * h if i == k else sp.S.Zero) + reach * h * through.get((i, k), sp.S.Zero)
                weight[i, k] = lines.put(f"H_{i}_{k}_{tag}", value)
        assigned = {name for name, _ in stage}
        for i, j in slopes:
            at = [symbol(f"J_{k}_{j}_{tag}") if f"J_{k}_{j}" in assigned else slopes[k, j] for k in states]
            product = sum((weight[i, k] * slope for k, slope in zip(states, at, strict=True)), sp.S.Zero)
            through[i, j] = lines.put(f"HJ_{i}_{j}_{tag}", product) if j in states else product
            total[i, j] += through[i, j]
    for i in states:
        for k in states:
            total[i, k] = lines.put(f"WHOLE_{i}_{k}", total[i, k] + (1 if i == k else 0))
    for i, j in slopes:
        columns = {k: symbol(f"D_{k}" if j == _HELD else f"S_{k}_{j}") for k in states}
        moved = sum((total[i, k] * columns[k] for k in states), sp.S.Zero)
        lines.append((f"{columns[i]}_E", moved if j in states else moved + total[i, j]))
    return lines


def _stage(model: Model) -> tuple[Assignments, _Slopes]:
    """Rates ``K_<name>`` of state and noise at the carried values and the input u, and slopes of the state's.

    Slopes that the stages do not share are assigned too, as ``J_<state>_<cause>``.
    """
    c, states = calculus(model), list(model.states)
    at = {symbol(i): symbol(f"M_{i}") for i in states}
    n = len(states)
    named = {f"K_M_{i}": move.xreplace(at) for i, move in zip(states, c.moves, strict=True)}
    by = [[slope.xreplace(at) for slope in row] for row in c.by]
    noise = [e.xreplace(at) for e in c.noise]
    slopes = {(i, j): by[a][b] for b, j in enumerate(model.movers) for a, i in enumerate(states)}
    if model.held:
        slopes |= {(i, _HELD): noise[a] for a, i in enumerate(states)}
    changing = {symbol("u"), *at.values()}
    named |= {f"J_{i}_{j}": slope for (i, j), slope in slopes.items() if slope.free_symbols & changing}
    for a in range(n):
        for b in range(a, 0 if model.held else n):
            spread = sum(
                by[a][k] * pair("N", states[k], states[b], states) + by[b][k] * pair("N", states[k], states[a], states)
                for k in range(n)
            )
            named[f"K_N_{states[a]}_{states[b]}"] = spread + noise[a] * noise[b]
    return shared(named, "W"), slopes


def coarse_path(model: Model, degree: int) -> tuple[Assignments, dict[str, str]]:
    """The state over a sample that is only imagined, in some Runge-Kutta steps: where it is in the middle, at the end.

    Returns:
        The assignments, and their names of ``MIDDLE_<state>`` and ``END_<state>``.
    """
    steps = _STEPS if model.substeps >= _STEPS else _FEWER
    step = derive.plain_step(replace(model, substeps=steps), degree)
    lines, points = Lines(), [{i: i for i in model.states}]
    for s in range(steps):
        own = {name: f"{name}_{s}" for name, _ in step}
        begin = {f"M_{i}": name for i, name in points[-1].items()}
        lines += derive.renamed(step, {**own, **begin, "T": sp.Rational(s, steps)})
        points.append({i: own[f"M_{i}_E"] for i in model.states})
    middle = {f"MIDDLE_{i}": name for i, name in points[steps // 2].items()}
    return lines, middle | {f"END_{i}": name for i, name in points[-1].items()}


def coarse_motion(model: Model, degree: int) -> tuple[Assignments, derive.Moved]:
    """A sample of a differential equation that is only imagined: M, S and N, where the path (`coarse_path`) is known.

    The sensitivities take one step, through the slopes at the start, middle and end of the sample, which is much less
    work than the path's. With H of its stages and g what unit noise adds to the rates, N is Simpson's rule:

        N = 6 H_A g gᵀ H_Aᵀ + 3/2 (H_B + H_C) g gᵀ (H_B + H_C)ᵀ + 6 H_D g gᵀ H_Dᵀ.
    """
    states = list(model.states)
    lines = Lines(derive.renamed(input_over_step(degree, 1), {"T": sp.S.Zero}))
    points = {tag: {i: symbol(f"{at}{i}") for i in states} for tag, at in (("A", ""), ("B", "MIDDLE_"), ("D", "END_"))}
    end = {symbol(i): value for i, value in points["D"].items()}
    noise = [g.xreplace(end) for g in calculus(model).noise]
    slopes = {tag: _slopes_at(model, tag, point, symbol(f"V_{tag}"), lines) for tag, point in points.items()}
    slopes["C"] = slopes["B"]
    through: _Slopes = {}
    total: _Slopes = dict.fromkeys(slopes["A"], sp.S.Zero)
    kicks: dict[str, list[sp.Expr]] = {}
    for tag in "DCBA":
        counts, reach = _STAGES[tag]
        H = {(i, k): lines.put(f"H_{i}_{k}_{tag}", (counts if i == k else 0) + reach * through.get((i, k), sp.S.Zero))
             for i in states for k in states}  # fmt: skip
        for i, j in total:
            product = sum((H[i, k] * slopes[tag][k, j] for k in states), sp.S.Zero)
            through[i, j] = lines.put(f"HJ_{i}_{j}_{tag}", product) if j in states else product
            total[i, j] += through[i, j]
        kicks[tag] = [sum((H[i, k] * g for k, g in zip(states, noise, strict=True)), sp.S.Zero) for i in states]
    by = {(i, j): lines.put(f"S_{i}_{j}", total[i, j] + (1 if i == j else 0)) for i, j in total}
    kicks["B"] = [b + c for b, c in zip(kicks["B"], kicks["C"], strict=True)]
    shares = {"A": sp.Integer(6), "B": sp.Rational(3, 2), "D": sp.Integer(6)}
    kicks = {tag: [lines.put(f"KICK_{i}_{tag}", k) for i, k in zip(states, kicks[tag], strict=True)] for tag in shares}
    spread = {}
    for a, i in enumerate(states):
        for b, k in enumerate(states[a:], a):
            value = sum((share * kicks[tag][a] * kicks[tag][b] for tag, share in shares.items()), sp.S.Zero)
            spread[i, k] = spread[k, i] = lines.put(f"N_{i}_{k}", by[i, _HELD] * by[k, _HELD] if model.held else value)
    return lines, derive.Moved(
        tuple(points["D"].values()),
        tuple(tuple(by[i, j] if j in model.movers else sp.S.Zero for j in model.names) for i in states),
        tuple(tuple(spread[i, k] for k in states) for i in states),
    )


def _slopes_at(model: Model, tag: str, point: Mapping[str, sp.Expr], u: sp.Expr, lines: Lines) -> _Slopes:
    """Slopes of the rates at a state and an input; what they have in common is assigned, with a tag."""
    stage, slopes = _stage(model)
    stage = [(name, value) for name, value in stage if not name.startswith("K_")]
    own = {name: f"{name}_{tag}" for name, _ in stage}
    there = {f"M_{i}": value for i, value in point.items()} | {"u": u}
    lines += derive.renamed(stage, {**own, **there})
    named = [("", symbol(f"J_{i}_{j}") if f"J_{i}_{j}" in own else value) for (i, j), value in slopes.items()]
    return dict(zip(slopes, (value for _, value in derive.renamed(named, {**own, **there})), strict=True))
