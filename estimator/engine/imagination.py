"""What a model's belief expects of inputs, compiled: one expected sample in every lane, and what has been learned.

The structured update (`estimator.engine.tasks`) with E[γ] and E[ξ] fixed and every output as it is expected: the means
follow the trajectory without noise, and the joint covariance of states and coefficients contracts as it would. So what
one sample teaches is not counted again by the next. The coefficients' means stay, and are the same in all lanes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import Any

from estimator.engine import cache as stored
from estimator.engine.rows import pairs
from estimator.engine.tasks import NAMES
from estimator.lanes import LANES, rows
from estimator.models.model import Model

#: What a belief that is no longer finite knows: less than any other, and still a number to compare with.
LOST = -1e300


@dataclass(frozen=True)
class Imagination:
    """The imagination of a model.

    The newest input of a sample stands in row ``INPUT``; older ones, where the model looks at them, in ``LAST_INPUT``
    and ``OLDER_INPUT``, and move on by themselves.

    Attributes:
        advance: ``advance(W, record, walk)``: one expected sample in every lane. Means of the coefficients and of the
            noises' precisions are those of a belief's record; ``walk`` (K,) are variances by which the coefficients
            walk before the sample. Leaves in ``SHOWN`` what the first sensor is expected to show, in ``SPREAD`` the
            variance of that output, and in ``SURPRISE`` that by which the output before it, if that was imagined too,
            moves what is expected.
        judge: ``judge(W, M, s)``: leaves ½ log det(C⁻¹ + s² M Mᵀ) in ``KNOWN``, with C the coefficients' covariance and
            M (K, K), lower triangular, the factor of the information that is still to come; `LOST` where C is no
            covariance any more.
        layout: rows of the block. The first are all that stands for a plan between two samples: the states, their joint
            covariance with the coefficients (``P_i_j``), the inputs, ``COST``, and ``BEGUN``, which is 0 before the
            first sample. Then, of a differential equation, the states in the middle of the last sample and at its end
            (``MIDDLE_i``, ``END_i``). ``COST``, ``SCORE``, ``MARGIN``, ``NEAR`` and ``CELL`` are the caller's.
        kept: number of these first rows.
    """

    advance: Any
    judge: Any
    layout: Mapping[str, int]
    kept: int


@cache
def imagination(model: Model, degree: int = 0, lag: int = 0) -> Imagination:
    """The imagination of a model.

    Args:
        model: whose belief.
        degree: of the input over a sample of a differential equation: 0 held, 1 linear from the last input to this one.
        lag: 1 where a difference equation takes every input a sample later.

    Raises:
        ValueError: for another degree or lag.
    """
    if degree not in (0, 1) or lag not in (0, 1) or (model.is_continuous and lag):
        raise ValueError(f"degree and lag must be 0 or 1, and lag 0 for a differential equation: {degree}, {lag}")
    inputs = inputs_of(model, degree, lag)
    kept = [*model.states, *pairs("P", model.names), *inputs, "COST", "BEGUN"]
    between = [f"{at}_{i}" for at in ("MIDDLE", "END") for i in model.states] if model.is_continuous else []
    place = rows(*kept, *between, "SHOWN", "SPREAD", "SURPRISE", "KNOWN", "SCORE", "MARGIN", "NEAR", "CELL")
    key = repr((model.digest, degree, lag))
    code = stored.load(model.name, "imagination", key, lambda: _source(model, degree, lag, inputs, place), NAMES)
    return Imagination(code.advance, code.judge, place, len(kept))


def inputs_of(model: Model, degree: int, lag: int) -> list[str]:
    """Rows of the inputs that a sample depends on, newest first."""
    older = degree if model.is_continuous else min(2, model.taps - 1 + lag)
    return ["INPUT", "LAST_INPUT", "OLDER_INPUT"][: older + 1]


def fed(model: Model, degree: int, lag: int) -> dict[str, Any]:
    """The input over a sample, ``U_k``, in symbols of those rows."""
    from estimator.engine.derive import symbol

    inputs = [symbol(name) for name in inputs_of(model, degree, lag)]
    if model.is_continuous:
        return {"U_0": inputs[0]} if degree == 0 else {"U_0": inputs[1], "U_1": inputs[0] - inputs[1]}
    return {f"U_{k}": inputs[min(k + lag, len(inputs) - 1)] for k in range(model.taps)}


def _source(model: Model, degree: int, lag: int, inputs: list[str], place: Mapping[str, int]) -> str:
    from estimator.engine import algebra, derive, emit, sensitivity

    symbol, coefficients = derive.symbol, list(model.coefficients)
    given = fed(model, degree, lag)
    lines, moved = sensitivity.coarse_motion(model, degree) if model.is_continuous else derive.difference_step(model)
    more, results = algebra.expected_sample(model, moved, degree)
    # The coefficients walk before the sample, so that what it does begins with the wider covariance.
    walked = {f"P_{c}_{c}": f"WALKED_{c}" for c in coefficients}
    wider = [(walked[f"P_{c}_{c}"], symbol(f"P_{c}_{c}") + symbol(f"WALK_{c}")) for c in coefficients]
    lines = wider + derive.renamed([*lines, *more], {**walked, **given})
    results = {row: walked.get(value, value) for row, value in results.items()}
    results = {**walked, **results, **{older: newer for newer, older in pairwise(inputs)}}
    noises = ["Q", *(f"R_{y}" for y in model.outputs)]
    uniform = [*coefficients, *noises, *(f"WALK_{c}" for c in coefficients)]
    source = emit.lane_loop("expect", lines, results, place, LANES, uniform, doc="One expected sample.")
    if model.is_continuous:
        # In a loop of its own: each step waits for the one before, and meanwhile processors take those of other lanes.
        path, points = sensitivity.coarse_path(model, degree)
        path = derive.renamed(path, given)
        source += emit.lane_loop("travel", path, points, place, LANES, coefficients, "Where the sample leads to.")
    # What the loops want of a record.
    n, k = model.n_states, model.n_coefficients
    first = (n + k) + (n + k) * (n + k + 1) // 2
    means = ", ".join(f"record[{n + c}]" for c in range(k))
    told = [f"record[{first + 2 * i + 1}] / record[{first + 2 * i}]" for i in range(1 + model.n_outputs)]
    told += [f"walk[{c}]" for c in range(k)]
    go = f"    travel(W, {means})\n" if model.is_continuous else ""
    source += f"@straight\ndef advance(W, record, walk):\n{go}    expect(W, {means}, {', '.join(told)})\n"
    return source + _judgement(model, place)


def _judgement(model: Model, place: Mapping[str, int]) -> str:
    """Source of ``judge``: det(C⁻¹ + M Mᵀ) is det(I + Mᵀ C M) / det C."""
    import sympy as sp

    from estimator.engine import derive, emit
    from estimator.engine.algebra import select
    from estimator.engine.factor import factorise

    symbol, names = derive.symbol, list(model.coefficients)
    k = len(names)
    cov = [[derive.pair("P", i, j, names) for j in names] for i in names]
    factor = [[symbol(f"M_{i}_{j}") if j <= i else sp.S.Zero for j in range(k)] for i in range(k)]
    lines: derive.Assignments = []
    product = {}  # C M, below the diagonal and on it: the rest is not needed for the upper triangle of Mᵀ (C M)
    for j in range(k):
        for i in range(j, k):
            lines.append((f"C_{i}_{j}", sum(cov[i][m] * factor[m][j] for m in range(j, k))))
            product[i, j] = symbol(f"C_{i}_{j}")
    told = {}
    for i in range(k):
        for j in range(i + 1):
            entry = sum(factor[m][i] * product[m, j] for m in range(i, k)) + (1 if i == j else 0)
            lines.append((f"A_{i}_{j}", entry))
            told[i, j] = symbol(f"A_{i}_{j}")
    to_come = factorise(told, k, "J", known=True)
    now = factorise({(i, j): cov[j][i] for i in range(k) for j in range(i + 1)}, k, "N", known=True)
    # Divisions take longest, so the two share them.
    both = dict(zip(map(str, to_come.inverse), zip(to_come.pivots, now.pivots, strict=True), strict=True))
    for (name, value), (name_now, value_now) in zip(to_come.lines, now.lines, strict=True):
        if name in both:
            first, second = both[name]
            lines.append((f"SHARED_{name}", 1 / (first * second)))
            value, value_now = symbol(f"SHARED_{name}") * second, symbol(f"SHARED_{name}") * first
        lines += [(name, value), (name_now, value_now)]
    lines += [("NOW", now.determinant), ("RATIO", to_come.determinant / symbol("NOW"))]
    ratio = symbol("RATIO")
    # `log` is that of positive, normal numbers; comparisons with NaN do not hold.
    known = select(1e300 - ratio, sp.Function("log")(ratio) / 2, sp.Float(LOST))
    known = select(symbol("NOW"), select(ratio - 1e-300, known, sp.Float(LOST)), sp.Float(LOST))
    lines.append(("NATS", known))
    uniform = [str(factor[i][j]) for i in range(k) for j in range(i + 1)]
    source = emit.lane_loop("judge_lanes", lines, {"KNOWN": "NATS"}, place, LANES, uniform, doc="What will be known.")
    told_entries = ", ".join(f"scale * M[{i}, {j}]" for i in range(k) for j in range(i + 1))
    return source + f"@jit\ndef judge(W, M, scale):\n    judge_lanes(W, {told_entries})\n"
