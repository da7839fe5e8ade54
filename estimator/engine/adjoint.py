"""A path of one system and its reverse, for the gradient by the inputs: scalars in tuples, over many samples.

The same arithmetic as `estimator.engine.kernels.compile_linearised_filter` without outputs. Tuples, because what a sample begins with then
stays in registers; a block in memory that is written and read again at once is two to three times slower.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from itertools import combinations_with_replacement
from typing import Any

from estimator.engine.kernels import RUNTIME_FUNCTIONS
from estimator.engine.source_cache import load_generated
from estimator.engine.storage_layout import filter_state_rows, input_rows, integrator_rows, likelihood_rows
from estimator.models.model import Model


@cache
def compile_adjoint(model: Model, degree: int = 0) -> Any:
    """Compiled functions of a path, along the response without noise.

    P is the path: states, covariance V (upper triangle) and sensitivities Z (row by row); F the information's upper
    triangle; C the coefficients, U the input over a sample, N the variances of the noises. G and H are the adjoints of
    P and F. A tape (T, n_tape) keeps what samples begin with.

    Args:
        model: whose equation.
        degree: of the input's polynomial over a sample, 0 or 1.

    Returns:
        A namespace of

        - ``begin(start)``: P and a zero F, from an array that holds P; ``coefficients(values)``: C, and
          ``noises(values)``: N, from arrays.
        - ``lay(now, last, older)``: U from the inputs, newest first.
        - ``step(P, F, C, U, N, tape, t)``: P and F after sample t; what the first sensor shows, and its variance.
        - ``add_information(F, precision, total)``: the lower triangle of the matrix Λ + F.
        - ``seed_adjoint(inverse)``: a zero G, and H where J = ½ log det(Λ + F).
        - ``backward(G, H, C, U, N, shown, tape, t)``: G before sample t, from that after it and the adjoint of what the
          first sensor shows; and the slopes of J by ``now``, ``last`` and ``older``.
        - ``n_path``, ``n_tape``: numbers in P, and of one sample on the tape.

    Raises:
        ValueError: for another degree.
    """
    if degree not in (0, 1):
        raise ValueError(f"degree must be 0 or 1, but is {degree}; a spline's input is not known sample by sample")
    key = repr((model.digest, degree))
    return load_generated(model.name, "gradient", key, lambda: _source(model, degree), RUNTIME_FUNCTIONS)


def _source(model: Model, degree: int) -> str:
    from estimator.engine import printer_numba, symbolic
    from estimator.engine.linearised_filter import linearised_filter_step

    coefficients, integrated = list(model.coefficients), integrator_rows(model)
    path_rows, inputs = filter_state_rows(model), input_rows(model, degree)
    information = [row for row in likelihood_rows(model) if row.startswith("F_")]
    noises = ["Q", *(f"R_{y}" for y in model.outputs)]
    shown = f"SHOWN_{next(iter(model.outputs))}"
    before, propagation = symbolic.propagate_sample(model)
    always_counted = {symbolic.symbol("LIVE"): symbolic.sp.S.One}
    more, results = linearised_filter_step(model, propagation, degree, follows_outputs=False)
    lines = [(name, e.xreplace(always_counted)) for name, e in [*before, *more]]
    path_after = [results.get(row, row) for row in path_rows]
    tuple_contents: dict[str, Sequence[str]] = {
        "P": path_rows,
        "F": information,
        **({"M": integrated} if integrated else {}),
    }
    tuple_contents |= {"C": coefficients, "U": inputs, "N": noises}
    after = [path_after, [results.get(row, row) for row in information], [results[shown], results["SPREAD"]]]
    source = printer_numba.print_scalar_function("finish", lines, after, tuple_contents, doc="Predict and see.")
    outputs_kept = {row: results[row] for row in (*path_rows, *information, shown) if row in results}
    adjoints = {"G": [f"G_{row}" for row in path_rows], "H": [f"G_{row}" for row in information]}
    tuple_contents = {
        **{name: names for name, names in tuple_contents.items() if name != "F"},
        **adjoints,
        "S": [f"G_{shown}"],
    }
    groups = [path_rows, integrated, inputs] if integrated else [path_rows, inputs]
    source += _reverse_source("finish_back", lines, outputs_kept, groups, tuple_contents)
    if integrated:
        source += _integrator_source(model, degree, integrated, path_rows)
    return source + _sample_source(model, degree, integrated, path_rows, information)


def _integrator_source(model: Model, degree: int, integrated: list[str], path_rows: list[str]) -> str:
    """Source of what carries a differential equation over a sample, and of its reverse."""
    from estimator.engine import printer_numba, symbolic, variational_rk4

    tuple_contents = {"M": integrated, "C": list(model.coefficients), "U": input_rows(model, degree)}
    start = [printer_numba.print_expression(value) for value in symbolic.integrator_start(model).values()]
    step, moves = variational_rk4.variational_rk4_step(model, degree), {name: f"{name}_E" for name in integrated}
    source = printer_numba.print_scalar_function("start", [], [start], {"P": path_rows}, doc="The point that moves.")
    source += printer_numba.print_scalar_function(
        "move", step, [list(moves.values())], tuple_contents, ("T",), "A Runge-Kutta step."
    )
    adjoints = {"GM": [f"G_{name}" for name in integrated], "GU": [f"G_{name}" for name in tuple_contents["U"]]}
    source += _reverse_source(
        "move_back",
        step,
        moves,
        [integrated, tuple_contents["U"]],
        {**tuple_contents, **adjoints},
        ("T",),
        tuple_contents["U"],
    )
    # The point begins at the path's states, with slopes and noise that are constants.
    states = list(model.states)
    results = [f"G_M_{i}" for i in states] + [f"G_{row}" for row in path_rows[len(states) :]]
    arguments = {"G": [f"G_{row}" for row in path_rows], "GM": adjoints["GM"]}
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
    """Source of the reverse of assignments (`with_reverse`), which returns adjoints by tuple, those of ``result_groups``."""
    from estimator.engine import printer_numba

    back, found = with_reverse(lines, results, [row for group in result_groups for row in group], accumulated)
    outcome = [[found[f"G_{row}"] for row in group] for group in result_groups]
    return printer_numba.print_scalar_function(name, back, outcome, tuple_contents, uniform, "The reverse derivative.")


def with_reverse(
    lines: Any, results: Mapping[str, str], inputs: Sequence[str], accumulated: Sequence[str] = ()
) -> tuple[Any, dict[str, str]]:
    """Assignments, then their reverse: adjoints of what stands before them, from those of the results.

    Args:
        lines: forward.
        results: row to the name that holds its value. The adjoint of a row is ``G_<row>``.
        inputs: rows whose adjoints are asked for.
        accumulated: of these, those whose adjoints have come from elsewhere already.

    Returns:
        All lines, and the names that hold the adjoints that are asked for.
    """
    from estimator.engine import printer_numba, symbolic

    # A result that is a number, the row itself or another result's passes its adjoint on by a line of its own.
    forward = list(lines)
    assigned = {target for target, _ in forward}
    seeds: dict[str, str] = {}
    for row, value in results.items():
        if value in assigned and value not in seeds:
            seeds[value] = f"G_{row}"
        else:
            copied = symbolic.sp.Float(float(value)) if printer_numba.is_numeral(value) else symbolic.symbol(value)
            forward.append((f"{row}_copy", copied))
            seeds[f"{row}_copy"] = f"G_{row}"
    back = symbolic.reverse_mode_derivative(forward, inputs, seeds)
    adjoint_before = {f"G_{row}": f"BG_{row}" for row in inputs}
    split = len(back) - len(inputs)  # the adjoints that are wanted come last, and have names of their own from here on
    ends = [
        (adjoint_before[target], e + (symbolic.symbol(target) if target.removeprefix("G_") in accumulated else 0))
        for target, e in back[split:]
    ]
    return [*forward, *back[:split], *ends], adjoint_before


def _sample_source(
    model: Model, degree: int, integrated: list[str], path_rows: list[str], information: list[str]
) -> str:
    """Source of the whole sample, forward and back, and of what begins and ends a path."""
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
    # ∂J/∂F is half the inverse, and an entry beside the diagonal stands for two.
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
