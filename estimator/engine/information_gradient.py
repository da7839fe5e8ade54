"""Gradient of the predicted Fisher information with respect to the inputs, by the adjoint method, for one system.

The arithmetic is `estimator.engine.kernels.compile_linearised_filter` without outputs. The quantities are scalars in
tuples, which stay in registers: a block in memory takes two to three times as long.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cache
from itertools import combinations_with_replacement
from typing import Any

from estimator.engine.kernels import RUNTIME_FUNCTIONS
from estimator.engine.source_cache import load_generated
from estimator.engine.storage_layout import input_rows, integrator_rows, likelihood_total_rows, linearised_filter_rows
from estimator.models.model import Model


@dataclass(frozen=True)
class Adjoint:
    """Compiled functions of the linearised filter along the noise-free response, forward and backward.

    P is the filter's state: means, covariance (upper triangle) and sensitivities (row by row). F is the upper triangle
    of the Fisher information, C the coefficients, U the input over a sample, N the noise variances. G and H are the
    adjoints of P and F. A tape (T, n_tape) stores the start of every sample.

    Attributes:
        begin: ``begin(start)``: P from an array, and a zero F.
        coefficients: ``coefficients(values)``: C from an array.
        noises: ``noises(values)``: N from an array.
        input_coefficients: ``input_coefficients(now, last, older)``: U from the inputs, newest first.
        step: ``step(P, F, C, U, N, tape, t)``: P and F after sample t, and mean and variance of the first sensor.
        add_information: ``add_information(F, precision, total)``: writes the lower triangle of Λ + F into ``total``.
        seed_adjoint: ``seed_adjoint(inverse)``: a zero G, and H of J = ½ log det(Λ + F), from the inverse of Λ + F.
        backward: ``backward(G, H, C, U, N, shown, tape, t)``: G before sample t from G after it, and the slopes of J
            with respect to ``now``, ``last`` and ``older``. ``shown`` is the adjoint of the first sensor's mean.
        n_path: numbers in P.
        n_tape: numbers per sample on the tape.
    """

    begin: Any
    coefficients: Any
    noises: Any
    input_coefficients: Any
    step: Any
    add_information: Any
    seed_adjoint: Any
    backward: Any
    n_path: int
    n_tape: int


@cache
def compile_adjoint(model: Model, degree: int = 0) -> Adjoint:
    """Compile the adjoint of a model.

    Args:
        model: the equation.
        degree: degree of the input's polynomial over a sample, 0 or 1.

    Raises:
        ValueError: for another degree.
    """
    if degree not in (0, 1):
        raise ValueError(f"degree must be 0 or 1, but is {degree}; a spline needs the whole record")
    key = repr((model.digest, degree))
    code = load_generated(model.name, "gradient", key, lambda: _source(model, degree), RUNTIME_FUNCTIONS)
    return Adjoint(**{field.name: getattr(code, field.name) for field in fields(Adjoint)})


def _source(model: Model, degree: int) -> str:
    from estimator.engine import printer_numba, symbolic
    from estimator.engine.linearised_filter import linearised_filter_step

    coefficients, integrated = list(model.coefficients), integrator_rows(model)
    path_rows, inputs = linearised_filter_rows(model), input_rows(model, degree)
    information = [row for row in likelihood_total_rows(model) if row.startswith("INFORMATION_")]
    noises = ["PROCESS_VARIANCE", *(f"R_{y}" for y in model.outputs)]
    shown = f"Y_PRED_{next(iter(model.outputs))}"
    before, propagation = symbolic.propagate_sample(model)
    always_counted = {symbolic.symbol("IS_COUNTED"): symbolic.sp.S.One}
    more, results = linearised_filter_step(model, propagation, degree, follows_outputs=False)
    lines = [(name, e.xreplace(always_counted)) for name, e in [*before, *more]]
    path_after = [results.get(row, row) for row in path_rows]
    tuple_contents: dict[str, Sequence[str]] = {
        "P": path_rows,
        "F": information,
        **({"M": integrated} if integrated else {}),
    }
    tuple_contents |= {"C": coefficients, "U": inputs, "N": noises}
    after = [path_after, [results.get(row, row) for row in information], [results[shown], results["S_PRED"]]]
    source = printer_numba.print_scalar_function(
        "finish", lines, after, tuple_contents, doc="Predict, and add the information."
    )
    outputs_kept = {row: results[row] for row in (*path_rows, *information, shown) if row in results}
    adjoints = {"G": [f"ADJ_{row}" for row in path_rows], "H": [f"ADJ_{row}" for row in information]}
    tuple_contents = {
        **{name: names for name, names in tuple_contents.items() if name != "F"},
        **adjoints,
        "S": [f"ADJ_{shown}"],
    }
    groups = [path_rows, integrated, inputs] if integrated else [path_rows, inputs]
    source += _reverse_source("finish_back", lines, outputs_kept, groups, tuple_contents)
    if integrated:
        source += _integrator_source(model, degree, integrated, path_rows)
    return source + _sample_source(model, degree, integrated, path_rows, information)


def _integrator_source(model: Model, degree: int, integrated: list[str], path_rows: list[str]) -> str:
    """Source of the integrator of a differential equation over a sample, and of its reverse."""
    from estimator.engine import printer_numba, symbolic, variational_rk4

    tuple_contents = {"M": integrated, "C": list(model.coefficients), "U": input_rows(model, degree)}
    start = [printer_numba.print_expression(value) for value in symbolic.integrator_start(model).values()]
    step, moves = variational_rk4.variational_rk4_step(model, degree), {name: f"{name}_END" for name in integrated}
    source = printer_numba.print_scalar_function(
        "start", [], [start], {"P": path_rows}, doc="The integrator at the start of a sample."
    )
    source += printer_numba.print_scalar_function(
        "move", step, [list(moves.values())], tuple_contents, ("TAU",), "A Runge-Kutta step."
    )
    adjoints = {"GM": [f"ADJ_{name}" for name in integrated], "GU": [f"ADJ_{name}" for name in tuple_contents["U"]]}
    source += _reverse_source(
        "move_back",
        step,
        moves,
        [integrated, tuple_contents["U"]],
        {**tuple_contents, **adjoints},
        ("TAU",),
        tuple_contents["U"],
    )
    # The integrator begins at the filter's states, with constant slopes and noise.
    states = list(model.states)
    results = [f"ADJ_M_{i}" for i in states] + [f"ADJ_{row}" for row in path_rows[len(states) :]]
    arguments = {"G": [f"ADJ_{row}" for row in path_rows], "GM": adjoints["GM"]}
    return source + printer_numba.print_scalar_function("start_back", [], [results], arguments, doc="Reverse of start.")


def _reverse_source(
    name: str,
    lines: Any,
    results: Mapping[str, str],
    result_groups: Sequence[Sequence[str]],
    tuple_contents: Mapping[str, Sequence[str]],
    uniform: Sequence[str] = (),
    accumulated: Sequence[str] = (),
) -> str:
    """Source of the reverse of assignments (`with_reverse`): it returns a tuple of adjoints for each result group."""
    from estimator.engine import printer_numba

    back, found = with_reverse(lines, results, [row for group in result_groups for row in group], accumulated)
    outcome = [[found[f"ADJ_{row}"] for row in group] for group in result_groups]
    return printer_numba.print_scalar_function(name, back, outcome, tuple_contents, uniform, "The reverse derivative.")


def with_reverse(
    lines: Any, results: Mapping[str, str], inputs: Sequence[str], accumulated: Sequence[str] = ()
) -> tuple[Any, dict[str, str]]:
    """Append the reverse derivative to assignments.

    Args:
        lines: the forward assignments.
        results: row to the name of its value. The adjoint of a row is ``ADJ_<row>``.
        inputs: rows whose adjoints are wanted.
        accumulated: rows among ``inputs`` whose adjoints are added to an earlier value.

    Returns:
        All assignments, and ``ADJ_<row>`` of each input to the name of its value.
    """
    from estimator.engine import printer_numba, symbolic
    from estimator.engine.reverse_mode import reverse_mode_derivative

    # A result that is a number, a row or the value of another result gets a line of its own, with its own adjoint.
    forward = list(lines)
    assigned = {target for target, _ in forward}
    seeds: dict[str, str] = {}
    for row, value in results.items():
        if value in assigned and value not in seeds:
            seeds[value] = f"ADJ_{row}"
        else:
            copied = symbolic.sp.Float(float(value)) if printer_numba.is_numeral(value) else symbolic.symbol(value)
            forward.append((f"{row}_copy", copied))
            seeds[f"{row}_copy"] = f"ADJ_{row}"
    back = reverse_mode_derivative(forward, inputs, seeds)
    adjoint_before = {f"ADJ_{row}": f"ADJ_BEFORE_{row}" for row in inputs}
    split = len(back) - len(inputs)  # the wanted adjoints come last, and get new names
    ends = [
        (adjoint_before[target], e + (symbolic.symbol(target) if target.removeprefix("ADJ_") in accumulated else 0))
        for target, e in back[split:]
    ]
    return [*forward, *back[:split], *ends], adjoint_before


def _sample_source(
    model: Model, degree: int, integrated: list[str], path_rows: list[str], information: list[str]
) -> str:
    """Source of the functions of `Adjoint`."""
    n, m, k = len(path_rows), len(integrated), model.n_coefficients
    inputs = len(input_rows(model, degree))
    tuple_of = lambda array, count, first="": f"({''.join(f'{array}[{first}{i}], ' for i in range(count))})"  # noqa: E731
    zeros = lambda count: f"({'0.0, ' * count})"  # noqa: E731
    is_line = model.is_continuous and degree == 1
    input_tuple = (
        "(last, now - last,)" if is_line else f"({''.join(f'{name}, ' for name in ('now', 'last', 'older')[:inputs])})"
    )
    slopes = "U[1], U[0] - U[1], 0.0" if is_line else ", ".join([*(f"U[{i}]" for i in range(inputs)), "0.0", "0.0"][:3])
    upper = list(combinations_with_replacement(range(k), 2))
    kept = "".join(f"    tape[t, {i}] = P[{i}]\n" for i in range(n))
    fill = "".join(f"    total[{j}, {i}] = precision[{j}, {i}] + F[{p}]\n" for p, (i, j) in enumerate(upper))
    # ∂J/∂F is half the inverse; an entry off the diagonal counts twice.
    seeds = ", ".join(f"{'0.5 * ' if i == j else ''}inverse[{j}, {i}]" for i, j in upper)
    source = (
        f"n_path, n_tape = {n}, {n + (model.substeps + 1) * m}\n"
        f"@scalar_jit\ndef begin(start):\n    return {tuple_of('start', n)}, {zeros(len(information))}\n"
        f"@scalar_jit\ndef coefficients(values):\n    return {tuple_of('values', k)}\n"
        f"@scalar_jit\ndef noises(values):\n    return {tuple_of('values', 1 + model.n_outputs)}\n"
        f"@scalar_jit\ndef input_coefficients(now, last, older):\n    return {input_tuple}\n"
        f"@jit\ndef add_information(F, precision, total):\n{fill}"
        f"@jit\ndef seed_adjoint(inverse):\n    return {zeros(n)}, ({seeds},)\n"
    )
    if not integrated:
        return source + (
            f"@jit\ndef step(P, F, C, U, N, tape, t):\n{kept}    P, F, (shown, spread) = finish(P, F, C, U, N)\n"
            "    return P, F, shown, spread\n"
            "@jit\ndef backward(G, H, C, U, N, shown, tape, t):\n"
            f"    P = {tuple_of('tape', n, 't, ')}\n    G, U = finish_back(P, C, U, N, G, H, (shown,))\n"
            f"    return G, {slopes}\n"
        )
    kept_point = "".join(f"    tape[t, place + {i}] = M[{i}]\n" for i in range(m))
    return source + (
        f"@jit\ndef keep(M, tape, t, place):\n{kept_point}"
        f"@jit\ndef point(tape, t, place):\n    return {tuple_of('tape', m, 't, place + ')}\n"
        f"@jit\ndef step(P, F, C, U, N, tape, t):\n{kept}    M = start(P)\n"
        f"    for s in range({model.substeps}):\n        keep(M, tape, t, {n} + {m} * s)\n"
        f"        M = move(M, C, U, s / {model.substeps})\n    keep(M, tape, t, {n + model.substeps * m})\n"
        "    P, F, (shown, spread) = finish(P, F, M, C, U, N)\n    return P, F, shown, spread\n"
        "@jit\ndef backward(G, H, C, U, N, shown, tape, t):\n"
        f"    P, M, V = {tuple_of('tape', n, 't, ')}, point(tape, t, {n + model.substeps * m}), U\n"
        "    G, GM, U = finish_back(P, M, C, V, N, G, H, (shown,))\n"
        f"    for s in range({model.substeps - 1}, -1, -1):\n"
        f"        GM, U = move_back(point(tape, t, {n} + {m} * s), C, V, GM, U, s / {model.substeps})\n"
        f"    G = start_back(G, GM)\n    return G, {slopes}\n"
    )
