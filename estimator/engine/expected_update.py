"""Predicted belief under planned inputs, for experiment design: one sample without data in every SIMD lane.

The update is the structured one (`estimator.engine.kernels`) with E[γ] and E[ξ] fixed and every output equal to its
prediction: the means follow the noise-free trajectory, and the joint covariance of states and coefficients contracts as
with data. The coefficients' means stay, and are the same in all lanes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

from estimator.compilation.simd import LANES, number_rows
from estimator.engine.kernels import RUNTIME_FUNCTIONS
from estimator.engine.source_cache import load_generated
from estimator.engine.storage_layout import input_history_row, known_inputs, n_older_inputs, upper_triangle_names
from estimator.models.model import Model

#: Information [nats] of a belief that has diverged: finite, and below all others.
DIVERGED_SCORE = -1e300


@dataclass(frozen=True)
class ExpectedUpdate:
    """The predicted belief of a model, in SIMD lanes.

    The newest value of an input is in row ``INPUT_<input>``. Older ones, if the model has them, are in
    ``LAST_INPUT_<input>`` and ``OLDER_INPUT_<input>``; ``advance`` shifts them.

    Attributes:
        advance: ``advance(W, record, walk)``: one sample without data in every lane. ``record`` is the flat record of a
            belief, for the means of the coefficients and precisions; ``walk`` (K,) are the variances of the
            coefficients' random walk before the sample. It writes the predicted output of the first sensor into
            ``Y_PRED``, its variance into ``S_PRED``, and into ``PENDING_VARIANCE`` the variance by which
            the output before, if it was predicted too, will shift the prediction.
        final_information: ``final_information(W, M, s)``: writes ½ log det(C⁻¹ + s² M Mᵀ) [nats] into
            ``INFORMATION``, with C the coefficients' covariance and M (K, K), lower triangular, the factor of the
            information beyond the plan; `DIVERGED_SCORE` where C is no covariance.
        layout: row number of each quantity. The first rows are the memory of a plan between two samples: the states,
            the joint covariance ``P_i_j`` of states and coefficients, the inputs, ``COST``, and ``HAS_PENDING``,
            which is 0 before the first sample. A differential equation adds its states in the middle and at the end of
            the last sample (``MIDDLE_i``, ``END_i``). ``COST``, ``SCORE``, ``MARGIN``, ``NEAR`` and ``CELL`` are the
            caller's.
        kept: number of rows of that memory.
    """

    advance: Any
    final_information: Any
    layout: Mapping[str, int]
    kept: int


@cache
def compile_expected_update(model: Model, degree: int = 0, lag: int = 0) -> ExpectedUpdate:
    """Compile the predicted belief of a model.

    Args:
        model: the equation.
        degree: degree of the input over a sample of a differential equation: 0 held, 1 linear from the last input.
        lag: delay of the inputs of a difference equation, 0 or 1 sample.

    Raises:
        ValueError: for another degree or lag.
    """
    if degree not in (0, 1) or lag not in (0, 1) or (model.is_continuous and lag):
        raise ValueError(
            f"degree and lag must be 0 or 1, and lag 0 for a differential equation, but are {degree} and {lag}"
        )
    inputs = input_history_rows(model, degree, lag)
    state_rows = [*model.states, *upper_triangle_names("P", model.names), *inputs, "COST", "HAS_PENDING"]
    trajectory_rows = [f"{at}_{i}" for at in ("MIDDLE", "END") for i in model.states] if model.is_continuous else []
    layout = number_rows(
        *state_rows,
        *trajectory_rows,
        "Y_PRED",
        "S_PRED",
        "PENDING_VARIANCE",
        "INFORMATION",
        "SCORE",
        "MARGIN",
        "NEAR",
        "CELL",
    )
    key = repr((model.digest, degree, lag))
    code = load_generated(
        model.name, "imagination", key, lambda: _source(model, degree, lag, inputs, layout), RUNTIME_FUNCTIONS
    )
    return ExpectedUpdate(code.advance, code.final_information, layout, len(state_rows))


def input_history_rows(model: Model, degree: int, lag: int) -> list[str]:
    """Rows of the inputs of a sample, one input after the other, each newest first."""
    return [input_history_row(i, age) for i, n in n_older_inputs(model, degree, lag).items() for age in range(n + 1)]


def shifted_history(model: Model, degree: int, lag: int) -> dict[str, str]:
    """Row of each older input to the row whose value it takes after the sample."""
    older = n_older_inputs(model, degree, lag)
    return {input_history_row(i, age + 1): input_history_row(i, age) for i, n in older.items() for age in range(n)}


def input_coefficients_from_history(model: Model, degree: int, lag: int) -> dict[str, Any]:
    """Rows of `input_rows`, in symbols of `input_history_rows`."""
    from estimator.engine.symbolic import symbol

    inputs = list(model.inputs)
    values = {}
    for row in known_inputs(model, degree, lag):
        values[row.name] = symbol(input_history_row(inputs[row.channel], row.age))
        if row.subtracted_age is not None:
            values[row.name] -= symbol(input_history_row(inputs[row.channel], row.subtracted_age))
    return values


def _source(model: Model, degree: int, lag: int, inputs: list[str], layout: Mapping[str, int]) -> str:
    from estimator.engine import gaussian_update, printer_numba, symbolic, variational_rk4

    symbol, coefficients = symbolic.symbol, list(model.coefficients)
    input_values = input_coefficients_from_history(model, degree, lag)
    lines, propagation = (
        variational_rk4.coarse_propagation(model, degree)
        if model.is_continuous
        else symbolic.propagate_difference_equation(model)
    )
    more, results = gaussian_update.update_without_data(model, propagation, degree)
    # The random walk of the coefficients comes before the sample, which begins with the wider covariance.
    walked = {f"P_{c}_{c}": f"WALKED_{c}" for c in coefficients}
    wider = [(walked[f"P_{c}_{c}"], symbol(f"P_{c}_{c}") + symbol(f"WALK_{c}")) for c in coefficients]
    lines = wider + symbolic.substitute([*lines, *more], {**walked, **input_values})
    results = {row: walked.get(value, value) for row, value in results.items()}
    results = {**walked, **results, **shifted_history(model, degree, lag)}
    noises = ["PROCESS_VARIANCE", *(f"R_{y}" for y in model.outputs)]
    uniform = [*coefficients, *noises, *(f"WALK_{c}" for c in coefficients)]
    source = printer_numba.print_lane_loop(
        "expect", lines, results, layout, LANES, uniform, doc="One sample without data."
    )
    if model.is_continuous:
        # In a loop of its own: each step waits for the one before, and the processor takes other lanes meanwhile.
        path, points = variational_rk4.coarse_trajectory(model, degree)
        path = symbolic.substitute(path, input_values)
        source += printer_numba.print_lane_loop(
            "travel", path, points, layout, LANES, coefficients, "The noise-free trajectory over the sample."
        )
    # Entries of a belief's record: means, then covariance, then shape and rate of each precision.
    n, k = model.n_states, model.n_coefficients
    first = (n + k) + (n + k) * (n + k + 1) // 2
    means = ", ".join(f"record[{n + c}]" for c in range(k))
    uniform_values = [f"record[{first + 2 * i + 1}] / record[{first + 2 * i}]" for i in range(1 + model.n_outputs)]
    uniform_values += [f"walk[{c}]" for c in range(k)]
    travel_call = f"    travel(W, {means})\n" if model.is_continuous else ""
    expect_call = f"    expect(W, {means}, {', '.join(uniform_values)})\n"
    source += f"@scalar_jit\ndef advance(W, record, walk):\n{travel_call}{expect_call}"
    return source + _information_source(model, layout)


def _information_source(model: Model, layout: Mapping[str, int]) -> str:
    """Source of ``final_information``: det(C⁻¹ + M Mᵀ) is det(I + Mᵀ C M) / det C."""
    import sympy as sp

    from estimator.engine import printer_numba, symbolic
    from estimator.engine.branch_functions import select
    from estimator.engine.symbolic_ldl import ldl_factorise

    symbol, names = symbolic.symbol, list(model.coefficients)
    k = len(names)
    cov = [[symbolic.symmetric_entry("P", i, j, names) for j in names] for i in names]
    factor = [[symbol(f"FACTOR_{i}_{j}") if j <= i else sp.S.Zero for j in range(k)] for i in range(k)]
    lines: symbolic.Assignments = []
    product = {}  # the lower triangle of C M, which is enough for Mᵀ (C M)
    for j in range(k):
        for i in range(j, k):
            lines.append((f"P_FACTOR_{i}_{j}", sum(cov[i][m] * factor[m][j] for m in range(j, k))))
            product[i, j] = symbol(f"P_FACTOR_{i}_{j}")
    future_entries = {}
    for i in range(k):
        for j in range(i + 1):
            entry = sum(factor[m][i] * product[m, j] for m in range(i, k)) + (1 if i == j else 0)
            lines.append((f"WITH_FUTURE_{i}_{j}", entry))
            future_entries[i, j] = symbol(f"WITH_FUTURE_{i}_{j}")
    with_future = ldl_factorise(future_entries, k, "FUTURE_", allow_zero_pivots=True)
    now = ldl_factorise(
        {(i, j): cov[j][i] for i in range(k) for j in range(i + 1)}, k, "PRESENT_", allow_zero_pivots=True
    )
    # Divisions take longest, so the two factorisations share them.
    both = dict(zip(map(str, with_future.inverse), zip(with_future.pivots, now.pivots, strict=True), strict=True))
    for (name, value), (name_now, value_now) in zip(with_future.lines, now.lines, strict=True):
        if name in both:
            first, second = both[name]
            lines.append((f"SHARED_INVERSE_{name}", 1 / (first * second)))
            value, value_now = symbol(f"SHARED_INVERSE_{name}") * second, symbol(f"SHARED_INVERSE_{name}") * first
        lines += [(name, value), (name_now, value_now)]
    lines += [("PRESENT_DET", now.determinant), ("DET_RATIO", with_future.determinant / symbol("PRESENT_DET"))]
    ratio = symbol("DET_RATIO")
    # `log` is for positive, normal numbers; comparisons with NaN are false.
    known = select(1e300 - ratio, sp.Function("log")(ratio) / 2, sp.Float(DIVERGED_SCORE))
    known = select(
        symbol("PRESENT_DET"),
        select(ratio - 1e-300, known, sp.Float(DIVERGED_SCORE)),
        sp.Float(DIVERGED_SCORE),
    )
    lines.append(("NATS", known))
    uniform = [str(factor[i][j]) for i in range(k) for j in range(i + 1)]
    source = printer_numba.print_lane_loop(
        "final_information_lanes",
        lines,
        {"INFORMATION": "NATS"},
        layout,
        LANES,
        uniform,
        doc="Information about the coefficients.",
    )
    factor_entries = ", ".join(f"scale * M[{i}, {j}]" for i in range(k) for j in range(i + 1))
    return source + f"@jit\ndef final_information(W, M, scale):\n    final_information_lanes(W, {factor_entries})\n"
