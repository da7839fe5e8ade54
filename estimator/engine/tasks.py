"""The tasks that the engine compiles for a model: update, imagination, plant, path, free run.

Each gives compiled functions over a block ``W`` (`estimator.lanes`), and the layout of its rows. What stands in a block
of ``lanes`` systems is what `layout` lists; whoever needs more rows adds them behind.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import combinations_with_replacement
from typing import Any

import numpy as np

from estimator import elementary
from estimator.engine import cache as stored
from estimator.lanes import LANES, inlined, rows
from estimator.models.model import Model


@inlined
def present(value):
    """1 for a number, 0 for NaN."""
    return 1.0 if value == value else 0.0


@inlined
def select(condition, first, second):
    """``first`` where the condition is positive."""
    return first if condition > 0.0 else second


@inlined
def sqrt(value):
    """Square root."""
    return np.sqrt(value)


#: What generated code may use.
NAMES = {
    "present": present, "select": select, "sqrt": sqrt, "log": elementary.log,
    **{name: getattr(elementary, name) for name in ("sin", "cos", "exp", "tanh")},
}  # fmt: skip


def belief_names(model: Model) -> list[str]:
    """The flat record of a belief: means, upper triangle of the covariance, shapes and rates of the noises."""
    covariances = [f"P_{i}_{j}" for i, j in combinations_with_replacement(model.names, 2)]
    return [*model.names, *covariances, *noise_names(model)]


def noise_names(model: Model) -> list[str]:
    """Names of the noises' Gamma beliefs: γ first, then ξ of each sensor."""
    return ["GAMMA_SHAPE", "GAMMA_RATE", *(f"XI_{part}_{y}" for y in model.outputs for part in ("SHAPE", "RATE"))]


def input_rows(model: Model, degree: int) -> list[str]:
    """The input over a sample: taps of a difference equation, or coefficients of the polynomial in τ."""
    return [f"U_{k}" for k in range(model.taps if not model.is_continuous else degree + 1)]


def carried_names(model: Model) -> list[str]:
    """What a differential equation carries over a sample; nothing for a difference equation."""
    if not model.is_continuous:
        return []
    names = [f"M_{i}" for i in model.states]
    names += [f"S_{i}_{j}" for i in model.states for j in model.names]
    if model.held:
        return [*names, *(f"D_{i}" for i in model.states)]
    return [*names, *(f"N_{i}_{k}" for i, k in combinations_with_replacement(model.states, 2))]


def layout(model: Model, degree: int) -> dict[str, int]:
    """Rows of an estimator's block: the belief, the sample, and what is carried over it."""
    outputs = [f"Y_{y}" for y in model.outputs]
    return rows(" ".join([*belief_names(model), *input_rows(model, degree), *outputs, *carried_names(model)]))


@dataclass(frozen=True)
class Update:
    """The belief update of a model.

    Attributes:
        update: ``update(W)``: every lane's belief, with its rows ``U_k`` and ``Y_<sensor>``.
        layout: rows of the block.
        lanes: systems in it.
        traced: rows that hold, per iteration and sensor, what the free energy needs; see `free_energies`.
    """

    update: Any
    layout: Mapping[str, int]
    lanes: int
    traced: Sequence[str] = ()


def structured(
    model: Model,
    degree: int = 0,
    *,
    iterations: int = 3,
    lanes: int = LANES,
    within: Mapping[str, int] | None = None,
    trace: bool = False,
    missing: bool = False,
) -> Update:
    """The structured update to first order: q(states, coefficients) Gaussian, q(γ) and q(ξ) Gamma.

    Args:
        model: whose belief.
        degree: of the input's polynomial over a sample, for a differential equation: 0 held, 1 linear, 5 a spline.
        iterations: variational iterations per sample, 1 to 100.
        lanes: systems in a block.
        within: a layout that holds all rows of `layout`; its own where it is None.
        trace: leave what the free energy of every iteration needs, in further rows.
        missing: outputs that are NaN move the state and teach nothing.
    """
    return _structured(model, degree, iterations, lanes, _frozen(within), trace, missing)


def _frozen(within: Mapping[str, int] | None) -> tuple[tuple[str, int], ...] | None:
    return None if within is None else tuple(within.items())


@cache
def _structured(
    model: Model, degree: int, iterations: int, lanes: int, within: Any, trace: bool, missing: bool
) -> Update:
    if not 1 <= iterations <= 100:
        raise ValueError(f"iterations must be from 1 to 100, but is {iterations}; 3 are enough")
    place = dict(within) if within is not None else layout(model, degree)
    traced = trace_names(model, iterations) if trace else []
    place |= rows(" ".join(t for t in traced if t not in place), start=max(place.values()) + 1)

    def make() -> str:
        from estimator.engine import algebra, derive, emit

        if model.is_continuous:
            lines, moved = [], derive.carried_at_end(model)
        else:
            lines, moved = derive.difference_step(model)
        more, results = algebra.update(model, moved, degree, iterations, trace, missing)
        source = _motion_source(model, degree, place, lanes)
        source += "@jit\n" + emit.lane_loop("finish", lines + more, results, place, lanes, doc="Predict and condition.")
        return source + _composed("update", model)

    key = repr((model.digest, degree, iterations, lanes, sorted(place.items()), trace, missing))
    code = stored.load(model.name, "update", key, make, NAMES)
    return Update(code.update, place, lanes, tuple(traced))


def trace_names(model: Model, iterations: int) -> list[str]:
    """Rows that `structured` leaves for the free energy, per sensor."""
    names = []
    for k in range(model.n_outputs):
        names += [f"TRACE_{k}_{what}" for what in ("mean", "innovation", "variance", "shown")]
        names += [f"TRACE_{k}_{what}_{i}" for i in range(iterations) for what in ("q", "r")]
    return names


def _motion_source(model: Model, degree: int, place: Mapping[str, int], lanes: int) -> str:
    """Source of ``begin(W)`` and ``move(W, T)``, which carry a state over a sample; empty for a difference equation."""
    from estimator.engine import derive, emit

    if not model.is_continuous:
        return ""
    start = {name: emit.text_of(value) for name, value in derive.carried_at_start(model).items()}
    moved = {name: f"{name}_e" for name in derive.carried(model)}
    source = "@jit\n" + emit.lane_loop("begin", [], start, place, lanes, doc="The point that moves, at the mean.")
    step = derive.motion_step(model, degree)
    return source + "@jit\n" + emit.lane_loop(
        "move", step, moved, place, lanes, ("T",), doc="One Runge-Kutta step, from T in [0, 1) of a sample on."
    )  # fmt: skip


def _composed(name: str, model: Model, finish: str = "finish(W)", arguments: str = "W") -> str:
    """Source of the whole sample: begin, all steps, finish."""
    if not model.is_continuous:
        return f"@jit\ndef {name}({arguments}):\n    {finish}\n"
    return (
        f"@jit\ndef {name}({arguments}):\n    begin(W)\n    for s in range({model.substeps}):\n"
        f"        move(W, s / {model.substeps})\n    {finish}\n"
    )


@dataclass(frozen=True)
class Path:
    """A path at known coefficients: likelihood, Fisher information, and gradient by the inputs.

    Attributes:
        sample: ``sample(W, Q, R_<sensor>...)``: one sample of every lane.
        layout: rows of the block: the coefficients, the input, outputs, ``LIVE``, the path and what it adds up.
        lanes: systems in it.
        pieces: for one system, ``begin(W)``, ``move(W, T)``, ``finish(W, Q, R...)`` and their reverses
            ``move_back(W, A, T)`` and ``finish_back(W, A, Q, R...)``; None where no gradient is asked for.
    """

    sample: Any
    layout: Mapping[str, int]
    lanes: int
    pieces: Any = None


def path_layout(model: Model, degree: int, observed: bool) -> dict[str, int]:
    """Rows of a path's block."""
    shown = [f"{'Y' if observed else 'SHOWN'}_{y}" for y in model.outputs]
    states, coefficients = list(model.states), list(model.coefficients)
    upper = combinations_with_replacement
    return rows(
        " ".join([*states, *(f"V_{i}_{k}" for i, k in upper(states, 2))]),
        " ".join(f"Z_{i}_{c}" for i in states for c in coefficients),
        " ".join(["LOSS", *(f"SLOPE_{c}" for c in coefficients), *(f"F_{c}_{d}" for c, d in upper(coefficients, 2))]),
        " ".join([*coefficients, *input_rows(model, degree), *shown, "LIVE", *carried_names(model)]),
    )


@cache
def path(model: Model, degree: int = 0, *, observed: bool, lanes: int = LANES, gradient: bool = False) -> Path:
    """The path of a model (`estimator.engine.algebra.path_sample`).

    Args:
        model: whose equation.
        degree: of the input's polynomial over a sample.
        observed: whether the filter follows outputs.
        lanes: systems in a block; 1 where a gradient is asked for.
        gradient: whether to generate the reverse.
    """
    place = path_layout(model, degree, observed)
    noises = ("Q", *(f"R_{y}" for y in model.outputs))
    if gradient and (observed or lanes != 1):
        raise ValueError("gradient is for the response without noise of one system: observed=False, lanes=1")

    def make() -> str:
        from estimator.engine import algebra, derive, emit

        if model.is_continuous:
            lines, moved = [], derive.carried_at_end(model)
        else:
            lines, moved = derive.difference_step(model)
        more, results = algebra.path_sample(model, moved, degree, observed)
        lines += more
        source = _motion_source(model, degree, place, lanes)
        source += "@jit\n" + emit.lane_loop("finish", lines, results, place, lanes, noises, doc="Predict and see.")
        arguments = ", ".join(noises)
        source += _composed("sample", model, f"finish(W, {arguments})", f"W, {arguments}")
        if gradient:
            inputs = input_rows(model, degree)
            states = algebra.path_names(model)
            before = derive.carried(model) if model.is_continuous else []
            source += _reversed_source("finish_back", lines, results, [*states, *before], inputs, place, noises)
            if model.is_continuous:
                moves = {name: f"{name}_e" for name in before}
                step = derive.motion_step(model, degree)
                source += _reversed_source("move_back", step, moves, before, inputs, place, ("T",))
        return source

    key = repr((model.digest, degree, observed, lanes, gradient))
    code = stored.load(model.name, "path", key, make, NAMES)
    return Path(code.sample, place, lanes, code if gradient else None)


def _reversed_source(
    name: str,
    lines: Any,
    results: Mapping[str, str],
    overwritten: Sequence[str],
    added: Sequence[str],
    place: Mapping[str, int],
    uniform: Sequence[str],
) -> str:
    """Source of the reverse of assignments: adjoints of rows before, from those after, both in the block ``A``.

    Args:
        name: of the function.
        lines: forward.
        results: row to the name that holds its value.
        overwritten: rows whose adjoints are replaced.
        added: rows whose adjoints add up over several calls.
        place: the layout.
        uniform: further arguments.
    """
    from estimator.engine import derive, emit

    # A result that is a number, or the row itself, passes its adjoint on without a line.
    forward = list(lines)
    assigned = {target for target, _ in forward}
    seeds: dict[str, str] = {}
    for row, value in results.items():
        if value in assigned and value not in seeds:
            seeds[value] = f"G_{row}"
        else:
            copy = f"{row}_copy"
            forward.append((copy, derive.symbol(value) if not emit.is_number(value) else emit.number(value)))
            seeds[copy] = f"G_{row}"
    wanted = [*overwritten, *added]
    back = derive.reverse(forward, wanted, seeds)
    back = [(f"B{target}" if target in {f"G_{w}" for w in wanted} else target, e) for target, e in back]
    outcome = {f"G_{row}": f"BG_{row}" for row in overwritten}
    summed = [(f"SG_{row}", derive.symbol(f"G_{row}") + derive.symbol(f"BG_{row}")) for row in added]
    outcome |= {f"G_{row}": f"SG_{row}" for row in added}
    return "@jit\n" + emit.lane_loop(
        name, [*forward, *back, *summed], outcome, place, 1, uniform, doc="The reverse derivative."
    )  # fmt: skip
