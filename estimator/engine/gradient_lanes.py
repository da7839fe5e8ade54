"""Paths of many systems and their reverse, for the gradient of what they tell together: in lanes, over many samples.

The arithmetic is that of `estimator.engine.gradient`, whose one system is in registers. Here as many systems as there
are lanes follow the same inputs, each with coefficients, noises and a start of its own.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

from estimator.engine import cache as stored
from estimator.engine.gradient import reversed_lines
from estimator.engine.rows import carried_names, input_rows, path_layout, path_names
from estimator.engine.tasks import NAMES
from estimator.lanes import LANES
from estimator.models.model import Model


@dataclass(frozen=True)
class Paths:
    """Compiled functions of blocks ``W`` and ``A`` of the same layout; ``A`` holds the adjoints of the rows of ``W``.

    A tape (T, n_tape) keeps what samples begin with.

    Attributes:
        follow: ``follow(W, tape, t)``: sample t of every lane.
        back: ``back(W, A, tape, t)``: the reverse of sample t, whose input is in ``W``. In ``A`` the path's rows have
            the adjoints after it, and receive those before it; the information's rows and what the first sensor shows
            have theirs; the rows of the input receive theirs.
        layout: rows of a block, as `estimator.engine.tasks.Path` has them.
        n_tape: numbers of one sample on the tape.
    """

    follow: Any
    back: Any
    layout: Mapping[str, int]
    n_tape: int


@cache
def paths(model: Model, degree: int = 0) -> Paths:
    """The paths of a model, along the response without noise; ``degree`` as in `estimator.engine.gradient.pieces`."""
    place = path_layout(model, degree, observed=False)
    key = repr((model.digest, degree))
    code = stored.load(model.name, "gradient-lanes", key, lambda: _source(model, degree, place), NAMES)
    return Paths(code.follow, code.back, place, code.n_tape)


def _source(model: Model, degree: int, place: Mapping[str, int]) -> str:
    from estimator.engine import derive, emit, sensitivity
    from estimator.engine.path import path_sample

    path_rows, carried, inputs = path_names(model), carried_names(model), input_rows(model, degree)
    lines, moved = derive.moved(model)
    more, results = path_sample(model, moved, degree, observed=False)
    lines = [*lines, *more]
    shown = f"SHOWN_{next(iter(model.outputs))}"
    source = emit.lane_loop("finish", lines, results, place, LANES, doc="Predict and see.")
    told = [row for row in results if row.startswith("F_")]
    followed = {row: results[row] for row in (*path_rows, *told, shown) if row in results}
    wanted = [*path_rows, *carried, *inputs]
    back, adjoints = reversed_lines(lines, followed, wanted)
    source += emit.lane_loop("finish_back", back, adjoints, place, LANES, doc="The reverse derivative.")
    n, m, steps = len(path_rows), len(carried), model.substeps
    if carried:
        source += sensitivity.motion_source(model, degree, place, LANES)
        step, ends = sensitivity.motion_step(model, degree), {name: f"{name}_E" for name in carried}
        back, adjoints = reversed_lines(step, ends, [*carried, *inputs], inputs)
        source += emit.lane_loop("move_back", back, adjoints, place, LANES, ("T",), "The reverse of a step.")
        started = {f"G_{i}": f"G_M_{i}" for i in model.states}
        source += emit.lane_loop("begin_back", [], started, place, LANES, doc="The reverse of begin.")
    return source + _frame(n * LANES, m * LANES, place[carried[0]] * LANES if carried else 0, steps)


def _frame(path: int, carried: int, at: int, steps: int) -> str:
    """Source of a whole sample, forward and back: so many numbers of the path, so many carried ones, and where."""
    source = (
        f"n_tape = {path + (steps + 1) * carried if carried else path}\n"
        "@jit\ndef keep(W, first, tape, t, place, count):\n"
        "    for i in range(count):\n        tape[t, place + i] = W[first + i]\n"
        "@jit\ndef lay(W, first, tape, t, place, count):\n"
        "    for i in range(count):\n        W[first + i] = tape[t, place + i]\n"
    )
    if not carried:
        return source + (
            f"@jit\ndef follow(W, tape, t):\n    keep(W, 0, tape, t, 0, {path})\n    finish(W)\n"
            f"@jit\ndef back(W, A, tape, t):\n    lay(W, 0, tape, t, 0, {path})\n    finish_back(W, A)\n"
        )
    return source + (
        f"@jit\ndef follow(W, tape, t):\n    keep(W, 0, tape, t, 0, {path})\n    begin(W)\n"
        f"    for s in range({steps}):\n        keep(W, {at}, tape, t, {path} + {carried} * s, {carried})\n"
        f"        move(W, s / {steps})\n"
        f"    keep(W, {at}, tape, t, {path + carried * steps}, {carried})\n    finish(W)\n"
        f"@jit\ndef back(W, A, tape, t):\n    lay(W, 0, tape, t, 0, {path})\n"
        f"    lay(W, {at}, tape, t, {path + carried * steps}, {carried})\n    finish_back(W, A)\n"
        f"    for s in range({steps - 1}, -1, -1):\n        lay(W, {at}, tape, t, {path} + {carried} * s, {carried})\n"
        f"        move_back(W, A, s / {steps})\n    begin_back(W, A)\n"
    )
