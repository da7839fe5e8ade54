"""Two of the tasks that the engine compiles for a model: the update of a belief, and the path of the states.

Each gives compiled functions over a block ``W`` (`estimator.lanes`), and the layout of its rows. What stands in a block
of ``lanes`` systems is what `layout` lists; whoever needs more rows adds them behind.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from estimator import elementary
from estimator.engine import cache as stored
from estimator.engine.rows import carried_names, layout, movers_first, path_layout, point_names, trace_names
from estimator.inference import EXPECTATIONS, MOST_ITERATIONS
from estimator.lanes import LANES, rows
from estimator.models.model import GENERATED_FUNCTIONS, Model
from estimator.straight import straight
from estimator.support.argument_checks import check_choice, check_integer


@straight
def sqrt(value):
    """Square root."""
    return np.sqrt(value)


#: What generated code may use.
NAMES = {"sqrt": sqrt} | {name: getattr(elementary, name) for name in GENERATED_FUNCTIONS if name != "sqrt"}


@dataclass(frozen=True)
class Update:
    """The belief update of a model.

    Attributes:
        update: ``update(W)``: every lane's belief, with its rows ``U_k`` and ``Y_<sensor>``.
        layout: rows of the block.
        check: with sigma points, ``check(W)``: counts in the row ``UNSOUND`` whether a lane's covariance is not
            positive semi-definite. The update does so with the belief that it is given.
    """

    update: Any
    layout: Mapping[str, int]
    check: Any = None


def structured(
    model: Model,
    degree: int = 0,
    *,
    iterations: int = 3,
    lanes: int = LANES,
    within: Mapping[str, int] | None = None,
    trace: bool = False,
    missing: bool = False,
    expectations: str = "first_order",
) -> Update:
    """The structured update: q(states, coefficients) Gaussian, q(γ) and q(ξ) Gamma.

    Args:
        model: whose belief.
        degree: of the input's polynomial over a sample, for a differential equation: 0 held, 1 linear, 5 a spline.
        iterations: variational iterations per sample, 1 to 100.
        lanes: systems in a block.
        within: a layout that holds all rows of `layout`; its own where it is None.
        trace: leave what the free energy of every iteration needs, in further rows.
        missing: outputs that are NaN move the state and teach nothing.
        expectations: how the belief is moved: ``first_order`` or ``sigma_points`` (`estimator.engine.points`). The
            latter counts in the row ``UNSOUND`` where it meets a covariance that is not positive semi-definite.

    Raises:
        ValueError: for iterations out of range, or other expectations.
    """
    frozen = None if within is None else tuple(within.items())
    return _structured(model, degree, iterations, lanes, frozen, trace, missing, expectations)


@cache
def _structured(
    model: Model, degree: int, iterations: int, lanes: int, within: Any, trace: bool, missing: bool, expectations: str
) -> Update:
    check_integer("iterations", iterations, MOST_ITERATIONS)
    check_choice("expectations", expectations, EXPECTATIONS)
    points = expectations == "sigma_points"
    place = dict(within) if within is not None else layout(model, degree)
    more_rows = [*(trace_names(model, iterations) if trace else ()), *(point_names(model) if points else ())]
    place |= rows(*(row for row in more_rows if row not in place), start=max(place.values()) + 1)

    def make() -> str:
        from estimator.engine import algebra, derive, emit, sensitivity
        from estimator.engine.points import moments

        lines, moved = moments(model) if points else derive.moved(model)
        more, results = algebra.update(model, moved, degree, iterations, trace, missing)
        # Every layer of functions is compiled: what a difference equation finishes is all of its update.
        whole = not (points or model.is_continuous)
        name = "update" if whole else "finish"
        finish = emit.lane_loop(name, lines + more, results, place, lanes, doc="Predict and condition.")
        if whole:
            return finish
        if points:
            return finish + _points_source(model, degree, place, lanes)
        motion = sensitivity.motion_source(model, degree, place, lanes)
        return motion + finish + emit.sample("update(W)", model, "finish(W)")

    key = repr((model.digest, degree, iterations, lanes, sorted(place.items()), trace, missing, expectations))
    code = stored.load(model.name, "update", key, make, NAMES)
    return Update(code.update, place, code.spread if points else None)


def _points_source(model: Model, degree: int, place: Mapping[str, int], lanes: int) -> str:
    """Source of ``spread(W)``, and of ``update(W)`` that takes all points through the sample."""
    from estimator.engine import derive, emit, points, sensitivity

    names = movers_first(model)
    by_point: dict[str, int | str] = dict(place)
    by_point |= {f"L_C_{i}": f"{place[f'L_0_{names[0]}']} + C*{len(names)} + {k}" for k, i in enumerate(names)}
    first = place[f"I_0_{next(iter(model.states))}"]
    by_point |= {f"I_P_{i}": f"{first} + P*{model.n_states} + {k}" for k, i in enumerate(model.states)}

    def loop(name: str, lines: Any, results: Any, uniform: tuple[str, ...], doc: str) -> str:
        return emit.lane_loop(name, lines, results, by_point, lanes, uniform, doc)

    source = loop("spread", *points.spread(model), (), "Columns of the covariance's factor, and their weights.")
    if not model.is_continuous:
        sample = points.point_sample(model)
        source += loop("carry", *sample, ("C", "SIGN", "P"), "One point over the sample.")
        return source + _looped(model, "", "        carry(W, P // 2, 1.0 - 2.0 * (P % 2), P)\n")
    noise = [name for name in carried_names(model) if name[0] != "S"]
    start = {i: emit.text_of(value) for i, value in derive.carried_at_start(model).items() if i in noise}
    source += loop("begin", [], start, (), "The mean, and its process noise.")
    step = sensitivity.motion_step(model, degree)
    source += loop("drift", step, {i: f"{i}_E" for i in noise}, ("T",), "One Runge-Kutta step of mean and noise.")
    source += loop("place", *points.point(model), ("C", "SIGN"), "A point at the start of the sample.")
    step, moved = points.point_step(model, degree), {f"M_{i}": f"M_{i}_E" for i in model.states}
    source += loop("move", step, moved, ("T",), "One Runge-Kutta step of a point.")
    source += loop("keep", [], {f"I_P_{i}": f"M_{i}" for i in model.states}, ("P",), "A point at the end.")
    n = model.substeps
    noisy = f"    begin(W)\n    for s in range({n}):\n        drift(W, s / {n})\n"
    body = "        place(W, P // 2, 1.0 - 2.0 * (P % 2))\n"
    body += f"        for s in range({n}):\n            move(W, s / {n})\n        keep(W, P)\n"
    return source + _looped(model, noisy, body)


def _looped(model: Model, before: str, body: str) -> str:
    """Source of ``update(W)`` over all sigma points."""
    head = f"@straight\ndef update(W):\n    spread(W)\n{before}    for P in range({2 * len(model.movers)}):\n"
    return head + body + "    finish(W)\n"


@dataclass(frozen=True)
class Path:
    """A path at known coefficients: likelihood and Fisher information; `estimator.engine.gradient` has the gradient.

    Attributes:
        sample: ``sample(W)``: one sample of every lane.
        layout: rows of the block: the coefficients, the input, outputs, ``LIVE``, the variances ``Q`` and
            ``R_<sensor>`` of the noises, the path and what it adds up.
        lanes: systems in it.
    """

    sample: Any
    layout: Mapping[str, int]
    lanes: int


@cache
def path(model: Model, degree: int = 0, *, observed: bool, lanes: int = LANES, timed: bool = False) -> Path:
    """The path of a model (`estimator.engine.path.path_sample`).

    Args:
        model: whose equation.
        degree: of the input's polynomial over a sample.
        observed: whether the filter follows outputs.
        lanes: systems in a block.
        timed: whether each sample of a differential equation has a length of its own, in the row ``SPAN``.
    """
    place = path_layout(model, degree, observed, timed)

    def make() -> str:
        from estimator.engine import derive, emit, sensitivity
        from estimator.engine.algebra import ONE
        from estimator.engine.path import path_sample

        lines, moved = derive.moved(model)
        more, results = path_sample(model, moved, degree, observed)
        span = derive.symbol("SPAN") if timed else ONE
        source = sensitivity.motion_source(model, degree, place, lanes, span=span)
        source += emit.lane_loop("finish", lines + more, results, place, lanes, doc="Predict and see.")
        return source + emit.sample("sample(W)", model, "finish(W)")

    key = repr((model.digest, degree, observed, lanes, timed))
    return Path(stored.load(model.name, "path", key, make, NAMES).sample, place, lanes)
