"""A path of one system and its reverse, for the gradient by the inputs: scalars in tuples, over many samples.

The same arithmetic as `estimator.engine.tasks.path` without outputs. Tuples, because what a sample begins with then
stays in registers; a block in memory that is written and read again at once is two to three times slower.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from itertools import combinations_with_replacement
from typing import Any

from estimator.engine import cache as stored
from estimator.engine.rows import carried_names, input_rows, path_names, path_results
from estimator.engine.tasks import NAMES
from estimator.models.model import Model


@cache
def pieces(model: Model, degree: int = 0) -> Any:
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
        - ``gather(F, precision, total)``: the lower triangle of the matrix Λ + F.
        - ``seed(inverse)``: a zero G, and H where J = ½ log det(Λ + F).
        - ``back(G, H, C, U, N, shown, tape, t)``: G before sample t, from that after it and the adjoint of what the
          first sensor shows; and the slopes of J by ``now``, ``last`` and ``older``.
        - ``n_path``, ``n_tape``: numbers in P, and of one sample on the tape.

    Raises:
        ValueError: for another degree.
    """
    if degree not in (0, 1):
        raise ValueError(f"degree must be 0 or 1, but is {degree}; a spline's input is not known sample by sample")
    key = repr((model.digest, degree))
    return stored.load(model.name, "gradient", key, lambda: _source(model, degree), NAMES)


def _source(model: Model, degree: int) -> str:
    from estimator.engine import derive, emit
    from estimator.engine.path import path_sample

    coefficients, carried = list(model.coefficients), carried_names(model)
    path_rows, inputs = path_names(model), input_rows(model, degree)
    information = [row for row in path_results(model) if row.startswith("F_")]
    noises = ["Q", *(f"R_{y}" for y in model.outputs)]
    shown = f"SHOWN_{next(iter(model.outputs))}"
    before, moved = derive.moved(model)
    live = {derive.symbol("LIVE"): derive.sp.S.One}
    more, results = path_sample(model, moved, degree, observed=False)
    lines = [(name, e.xreplace(live)) for name, e in [*before, *more]]
    path_after = [results.get(row, row) for row in path_rows]
    held: dict[str, Sequence[str]] = {"P": path_rows, "F": information, **({"M": carried} if carried else {})}
    held |= {"C": coefficients, "U": inputs, "N": noises}
    after = [path_after, [results.get(row, row) for row in information], [results[shown], results["SPREAD"]]]
    source = emit.scalar_function("finish", lines, after, held, doc="Predict and see.")
    followed = {row: results[row] for row in (*path_rows, *information, shown) if row in results}
    adjoints = {"G": [f"G_{row}" for row in path_rows], "H": [f"G_{row}" for row in information]}
    held = {**{name: names for name, names in held.items() if name != "F"}, **adjoints, "S": [f"G_{shown}"]}
    groups = [path_rows, carried, inputs] if carried else [path_rows, inputs]
    source += _reverse("finish_back", lines, followed, groups, held)
    if carried:
        source += _motion(model, degree, carried, path_rows)
    return source + _frame(model, degree, carried, path_rows, information)


def _motion(model: Model, degree: int, carried: list[str], path_rows: list[str]) -> str:
    """Source of what carries a differential equation over a sample, and of its reverse."""
    from estimator.engine import derive, emit, sensitivity

    held = {"M": carried, "C": list(model.coefficients), "U": input_rows(model, degree)}
    start = [emit.text_of(value) for value in derive.carried_at_start(model).values()]
    step, moves = sensitivity.motion_step(model, degree), {name: f"{name}_E" for name in carried}
    source = emit.scalar_function("start", [], [start], {"P": path_rows}, doc="The point that moves.")
    source += emit.scalar_function("move", step, [list(moves.values())], held, ("T",), "A Runge-Kutta step.")
    adjoints = {"GM": [f"G_{name}" for name in carried], "GU": [f"G_{name}" for name in held["U"]]}
    source += _reverse("move_back", step, moves, [carried, held["U"]], {**held, **adjoints}, ("T",), held["U"])
    # The point begins at the path's states, with slopes and noise that are constants.
    states = list(model.states)
    results = [f"G_M_{i}" for i in states] + [f"G_{row}" for row in path_rows[len(states) :]]
    arguments = {"G": [f"G_{row}" for row in path_rows], "GM": adjoints["GM"]}
    return source + emit.scalar_function("start_back", [], [results], arguments, doc="Reverse of start.")


def _reverse(
    name: str,
    lines: Any,
    results: Mapping[str, str],
    groups: Sequence[Sequence[str]],
    held: Mapping[str, Sequence[str]],
    uniform: Sequence[str] = (),
    added: Sequence[str] = (),
) -> str:
    """Source of the reverse of assignments (`reversed_lines`), which returns adjoints by tuple, those of ``groups``."""
    from estimator.engine import emit

    back, found = reversed_lines(lines, results, [row for group in groups for row in group], added)
    outcome = [[found[f"G_{row}"] for row in group] for group in groups]
    return emit.scalar_function(name, back, outcome, held, uniform, "The reverse derivative.")


def reversed_lines(
    lines: Any, results: Mapping[str, str], wanted: Sequence[str], added: Sequence[str] = ()
) -> tuple[Any, dict[str, str]]:
    """Assignments, then their reverse: adjoints of what stands before them, from those of the results.

    Args:
        lines: forward.
        results: row to the name that holds its value. The adjoint of a row is ``G_<row>``.
        wanted: rows whose adjoints are asked for.
        added: of these, those whose adjoints have come from elsewhere already.

    Returns:
        All lines, and the names that hold the adjoints that are asked for.
    """
    from estimator.engine import derive, emit

    # A result that is a number, the row itself or another result's passes its adjoint on by a line of its own.
    forward = list(lines)
    assigned = {target for target, _ in forward}
    seeds: dict[str, str] = {}
    for row, value in results.items():
        if value in assigned and value not in seeds:
            seeds[value] = f"G_{row}"
        else:
            copied = derive.sp.Float(float(value)) if emit.is_number(value) else derive.symbol(value)
            forward.append((f"{row}_copy", copied))
            seeds[f"{row}_copy"] = f"G_{row}"
    back = derive.reverse(forward, wanted, seeds)
    before = {f"G_{row}": f"BG_{row}" for row in wanted}
    split = len(back) - len(wanted)  # the adjoints that are wanted come last, and have names of their own from here on
    ends = [
        (before[target], e + (derive.symbol(target) if target.removeprefix("G_") in added else 0))
        for target, e in back[split:]
    ]
    return [*forward, *back[:split], *ends], before


def _frame(model: Model, degree: int, carried: list[str], path_rows: list[str], information: list[str]) -> str:
    """Source of the whole sample, forward and back, and of what begins and ends a path."""
    n, m, k = len(path_rows), len(carried), model.n_coefficients
    inputs = len(input_rows(model, degree))
    taken = lambda array, count, first="": f"({''.join(f'{array}[{first}{i}], ' for i in range(count))})"  # noqa: E731
    zeros = lambda count: f"({'0.0, ' * count})"  # noqa: E731
    is_line = model.is_continuous and degree == 1
    laid = (
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
        f"@straight\ndef begin(start):\n    return {taken('start', n)}, {zeros(len(information))}\n"
        f"@straight\ndef coefficients(values):\n    return {taken('values', k)}\n"
        f"@straight\ndef noises(values):\n    return {taken('values', 1 + model.n_outputs)}\n"
        f"@straight\ndef lay(now, last, older):\n    return {laid}\n"
        f"@jit\ndef gather(F, precision, total):\n{fill}"
        f"@jit\ndef seed(inverse):\n    return {zeros(n)}, ({seeds},)\n"
    )
    if not carried:
        return source + (
            f"@jit\ndef step(P, F, C, U, N, tape, t):\n{kept}    P, F, (shown, spread) = finish(P, F, C, U, N)\n"
            "    return P, F, shown, spread\n"
            "@jit\ndef back(G, H, C, U, N, shown, tape, t):\n"
            f"    P = {taken('tape', n, 't, ')}\n    G, U = finish_back(P, C, U, N, G, H, (shown,))\n"
            f"    return G, {slopes}\n"
        )
    kept_point = "".join(f"    tape[t, place + {i}] = M[{i}]\n" for i in range(m))
    return source + (
        f"@jit\ndef keep(M, tape, t, place):\n{kept_point}"
        f"@jit\ndef point(tape, t, place):\n    return {taken('tape', m, 't, place + ')}\n"
        f"@jit\ndef step(P, F, C, U, N, tape, t):\n{kept}    M = start(P)\n"
        f"    for s in range({model.substeps}):\n        keep(M, tape, t, {n} + {m} * s)\n"
        f"        M = move(M, C, U, s / {model.substeps})\n    keep(M, tape, t, {n + model.substeps * m})\n"
        "    P, F, (shown, spread) = finish(P, F, M, C, U, N)\n    return P, F, shown, spread\n"
        "@jit\ndef back(G, H, C, U, N, shown, tape, t):\n"
        f"    P, M, V = {taken('tape', n, 't, ')}, point(tape, t, {n + model.substeps * m}), U\n"
        "    G, GM, U = finish_back(P, M, C, V, N, G, H, (shown,))\n"
        f"    for s in range({model.substeps - 1}, -1, -1):\n"
        f"        GM, U = move_back(point(tape, t, {n} + {m} * s), C, V, GM, U, s / {model.substeps})\n"
        f"    G = start_back(G, GM)\n    return G, {slopes}\n"
    )
