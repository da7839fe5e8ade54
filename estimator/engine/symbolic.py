"""Symbolic differentiation of a model by SymPy, as lists of assignments.

All that the engine compiles is a list of assignments ``(name, expression)`` in the order of execution: the model's
expressions and derivatives, Runge-Kutta steps, Kalman updates, and the reverse derivative of these
(`estimator.engine.reverse_mode`). Names of the engine
begin with a capital letter:

==========  ===========================================================================================
``M_i``     state i after the sample, before its process noise
``F_i_j``   its derivative with respect to quantity j (a state before the sample, or a coefficient)
``Q_i_k``   covariance of states i and k by process noise of unit strength
``P_i_j``   covariance of quantities i and j before the sample; ``P_PRED_i_j`` is the predicted one
``U_i_k``   input i over the sample: tap k of a difference equation, or coefficient of τ^k in [0, 1]
==========  ===========================================================================================
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache

import sympy as sp

from estimator.engine.expression_parser import parse_expression
from estimator.engine.storage_layout import (
    held_noise_rows,
    input_row,
    integrator_rows,
    noise_ratio_rows,
    stage_input,
    stage_input_rate,
    stage_inputs,
)
from estimator.models.model import Model

Assignments = list[tuple[str, sp.Expr]]

ZERO, ONE, HALF = sp.S.Zero, sp.S.One, sp.S.Half

# Functions that `estimator.engine.printer_numba` writes out, without branches; `estimator.engine.branch_functions` has
# those with derivatives.

#: ``is_present(x)``: 0 where x is NaN, else 1.
is_present = sp.Function("present")
#: ``is_negative(x)``: 1 where x is negative or NaN, else 0.
is_negative = sp.Function("below")
#: ``where_valid(x, a, b, c, d, e)``: x where a, b and c are positive and d and e are not negative, else NaN.
where_valid = sp.Function("where_valid")
#: ``zero_if_finite(x)``: 0, or NaN where x is not finite.
zero_if_finite = sp.Function("zero_if_finite")
#: ``log1p(x)``: log(1 + x), exact where x is small.
log1p = sp.Function("log1p")


class Program(Assignments):
    """A growing list of assignments."""

    def assign(self, name: str, expression: sp.Expr) -> sp.Expr:
        """Assign an expression to a name and return the name's symbol; a symbol or number is returned as it is."""
        if expression.is_Number or expression.is_Symbol:
            return expression
        self.append((name, expression))
        return symbol(name)


def symbol(name: str) -> sp.Symbol:
    """The real symbol of a name."""
    return sp.Symbol(name, real=True)


def symmetric_entry(matrix: str, first: str, second: str, order: Sequence[str]) -> sp.Symbol:
    """The symbol of a symmetric matrix's entry, with the two names sorted by ``order``."""
    if order.index(first) > order.index(second):
        first, second = second, first
    return symbol(f"{matrix}_{first}_{second}")


@dataclass(frozen=True)
class ModelDerivatives:
    """A model's expressions and derivatives, in symbols.

    Attributes:
        moves: the rates or next states.
        jacobian: (n, movers) derivatives of ``moves`` with respect to `Model.dynamic_names`; all others are 0.
        noise: coefficient of the unit noise in each state's rate or next value.
        outputs: output of each sensor.
        output_slopes: gradient of each output by all states and coefficients.
    """

    moves: tuple[sp.Expr, ...]
    jacobian: tuple[tuple[sp.Expr, ...], ...]
    noise: tuple[sp.Expr, ...]
    outputs: tuple[sp.Expr, ...]
    output_slopes: tuple[tuple[sp.Expr, ...], ...]


@cache
def differentiate(model: Model) -> ModelDerivatives:
    """Parse and differentiate a model.

    Raises:
        ValueError: for text that is not an expression, or has a name that is not the model's; and for a model with time
            in seconds.
    """
    if model.time != "sample":
        raise ValueError(
            f"model must count time in samples here, but {model.name!r} counts seconds; make a prior by "
            f"estimator.rigs.stated_units.prior_in_units, whose model does"
        )
    symbols = {name: symbol(name) for name in (*model.names, *model.input_ages, *model.acting_inputs)}
    moves = tuple(parse_expression(text, symbols, model) for text in model.update_expressions)
    without_input = {name: symbols[name] for name in model.names}
    noise = tuple(parse_expression(text, without_input, model) for text in model.noise)
    outputs = tuple(parse_expression(text, symbols, model) for text in model.outputs.values())
    jacobian = tuple(tuple(sp.diff(move, symbols[name]) for name in model.dynamic_names) for move in moves)
    output_slopes = tuple(tuple(sp.diff(shown, symbols[name]) for name in model.names) for shown in outputs)
    return ModelDerivatives(moves, jacobian, noise, outputs, output_slopes)


def noise_effects(model: Model) -> list[tuple[sp.Expr, ...]]:
    """Effect g of each source of process noise of unit strength on the states, in `Model.noise_sources` order."""
    noise = differentiate(model).noise
    if not model.independent_noise:
        return [noise]
    states = list(model.states)
    return [
        tuple(effect if state == source else ZERO for state, effect in zip(states, noise, strict=True))
        for source in model.noise_sources
    ]


def sum_over_sources(
    model: Model, effects: Sequence[Sequence[sp.Expr]], noise_ratios: bool = False
) -> tuple[tuple[sp.Expr, ...], ...]:
    """Σ g gᵀ over the sources' effects g, each times its ``VARIANCE_RATIO_<source>`` if the ratios vary."""
    ratios = [symbol(row) for row in noise_ratio_rows(model)] if noise_ratios else []
    weights = ratios or [ONE] * len(effects)
    n = range(model.n_states)
    pairs = list(zip(weights, effects, strict=True))
    return tuple(tuple(sum((w * g[a] * g[b] for w, g in pairs), ZERO) for b in n) for a in n)


def eliminate_common_subexpressions(expressions: Mapping[str, sp.Expr], prefix: str) -> Assignments:
    """Assignments of ``expressions`` with common subexpressions assigned first, as ``prefix_0``, ``prefix_1``, ..."""
    symbols = sp.numbered_symbols(f"{prefix}_", real=True)
    parts, reduced = sp.cse(list(expressions.values()), symbols=symbols, optimizations=None)
    return [*((str(name), expression) for name, expression in parts), *zip(expressions, reduced, strict=True)]


def substitute(assignments: Iterable[tuple[str, sp.Expr]], replacements: Mapping[str, sp.Expr | str]) -> Assignments:
    """Assignments with names replaced by other names, or by expressions."""
    mapping = {symbol(old): symbol(new) if isinstance(new, str) else new for old, new in replacements.items()}
    return [(str(mapping.get(symbol(name), name)), expression.xreplace(mapping)) for name, expression in assignments]


@dataclass(frozen=True)
class Propagation:
    """The dynamics over a sample, in symbols.

    Attributes:
        state: M, the state after the sample.
        jacobian: F; empty if the predicted covariance is given as ``P_PRED_i_j`` instead of F P Fᵀ.
        noise_cov: Q, the covariance of process noise of unit strength.
        is_psd: whether Q is positive semi-definite by construction.
    """

    state: tuple[sp.Expr, ...]
    jacobian: tuple[tuple[sp.Expr, ...], ...]
    noise_cov: tuple[tuple[sp.Expr, ...], ...]
    is_psd: bool = True


def propagate_difference_equation(model: Model, noise_ratios: bool = False) -> tuple[Assignments, Propagation]:
    """M, F and Q of a difference equation: the next state and its derivatives."""
    c = differentiate(model)
    inputs = {written: input_row(*tap) for written, tap in model.input_ages.items()}
    named = {f"M_{i}": move for i, move in zip(model.states, c.moves, strict=True)}
    for i, row in zip(model.states, c.jacobian, strict=True):
        named |= {f"F_{i}_{j}": slope for j, slope in zip(model.dynamic_names, row, strict=True)}
    lines = substitute(eliminate_common_subexpressions(named, "CSE"), inputs)
    # A number or a bare symbol needs no assignment.
    trivial = {name: e for name, e in lines if name.startswith(("M_", "F_")) and (e.is_Number or e.is_Symbol)}
    lines = [(name, e) for name, e in lines if name not in trivial]
    value = lambda name: trivial.get(name, symbol(name))  # noqa: E731
    is_dynamic = dict.fromkeys(model.names, False) | dict.fromkeys(model.dynamic_names, True)
    jacobian = tuple(
        tuple(value(f"F_{i}_{j}") if is_dynamic[j] else sp.S.Zero for j in model.names) for i in model.states
    )
    noise = sum_over_sources(model, noise_effects(model), noise_ratios)
    return lines, Propagation(tuple(value(f"M_{i}") for i in model.states), jacobian, noise)


def integrator_start(model: Model) -> dict[str, sp.Expr]:
    """The integrator's quantities at the start of a sample."""
    start: dict[str, sp.Expr] = dict.fromkeys(integrator_rows(model), sp.S.Zero)
    for i in model.states:
        start |= {f"M_{i}": symbol(i), f"F_{i}_{i}": sp.S.One}
    return start


def integrator_end(model: Model, noise_ratios: bool = False) -> Propagation:
    """The dynamics over a sample, from the integrator's quantities at its end."""
    states = list(model.states)
    jacobian = tuple(
        tuple(symbol(f"F_{i}_{j}") if j in model.dynamic_names else sp.S.Zero for j in model.names) for i in states
    )
    if model.held:
        columns = [[symbol(row) for row in rows] for rows in held_noise_rows(model)]
        noise = sum_over_sources(model, columns, noise_ratios)
    else:
        noise = tuple(tuple(symmetric_entry("Q", i, k, states) for k in states) for i in states)
    return Propagation(tuple(symbol(f"M_{i}") for i in states), jacobian, noise, is_psd=model.held)


def propagate_sample(model: Model, noise_ratios: bool = False) -> tuple[Assignments, Propagation]:
    """The assignments at the end of a sample, and the dynamics over it.

    Args:
        model: the equation.
        noise_ratios: whether the rows `estimator.engine.storage_layout.noise_ratio_rows` scale the sources' variances.
    """
    if model.is_continuous:
        return [], integrator_end(model, noise_ratios)
    return propagate_difference_equation(model, noise_ratios)


def runge_kutta_4(
    variables: Sequence[str],
    rate_assignments: Assignments,
    model: Model,
    step_length: sp.Expr,
    sample_length: sp.Expr = sp.S.One,
) -> Assignments:
    """One Runge-Kutta step of order 4, from ``variables`` to ``<name>_END``.

    Names of its four stages end with ``_A`` to ``_D``, which no name of a model does.

    Args:
        variables: names that are integrated.
        rate_assignments: assignments of their rates ``RATE_<name>`` in the names and the inputs.
        model: the equation, for the names of its inputs, whose values at the stages `input_at_stages` assigns.
        step_length: length of the step, as a fraction of the sample.
        sample_length: length of the sample, in sampling steps.
    """
    h = sample_length * step_length
    lines: Assignments = []
    rates: list[dict[str, sp.Expr]] = []
    for k, fraction in enumerate((sp.S.Zero, sp.S.Half, sp.S.Half, sp.S.One)):
        tag = "ABCD"[k]
        at: dict[str, sp.Expr | str] = {**stage_inputs(model, tag if k != 2 else "B")}
        for name in variables:
            if k:
                lines.append((f"{name}_{tag}", symbol(name) + fraction * h * rates[-1][name]))
                at[name] = f"{name}_{tag}"
        rename = {name: f"{name}_{tag}" for name, _ in rate_assignments}
        stage_rates: dict[str, sp.Expr] = {}
        for name, expression in substitute(rate_assignments, {**rename, **at}):
            if name.startswith("RATE_") and (expression.is_Symbol or expression.is_Number):
                stage_rates[name[len("RATE_") : -len(tag) - 1]] = expression
            else:
                lines.append((name, expression))
                if name.startswith("RATE_"):
                    stage_rates[name[len("RATE_") : -len(tag) - 1]] = symbol(name)
        rates.append(stage_rates)
    k1, k2, k3, k4 = rates
    sixth = h / 6
    return lines + [
        (f"{name}_END", symbol(name) + sixth * (k1[name] + 2 * k2[name] + 2 * k3[name] + k4[name]))
        for name in variables
    ]


def input_at_stages(model: Model, degree: int, step_length: sp.Expr) -> Assignments:
    """`stage_inputs` at the start, middle and end of a Runge-Kutta step, whose length is a fraction of the sample.

    Raises:
        ValueError: for a model with the derivative of an input that is held (degree 0).
    """
    check_input_is_continuous(model, degree)
    lines = []
    for tag, fraction in (("A", sp.S.Zero), ("B", sp.S.Half), ("D", sp.S.One)):
        if degree and model.inputs:
            lines.append((f"TAU_{tag}", symbol("TAU") + fraction * step_length))
        for i in model.inputs:
            value: sp.Expr = symbol(input_row(i, degree))
            for k in range(degree - 1, -1, -1):
                value = symbol(input_row(i, k)) + symbol(f"TAU_{tag}") * value
            lines.append((stage_input(i, tag), value))
        for i, order in model.acting_inputs.values():
            if order:
                value = sp.S.Zero
                for k in range(degree, 0, -1):
                    value = k * symbol(input_row(i, k)) + symbol(f"TAU_{tag}") * value
                lines.append((stage_input_rate(i, tag), value))
    return lines


def check_input_is_continuous(model: Model, degree: int) -> None:
    """Refuse the derivative of an input that jumps from sample to sample.

    Raises:
        ValueError: with the remedy.
    """
    derivatives = [written for written, (_, order) in model.acting_inputs.items() if order]
    if derivatives and degree == 0:
        raise ValueError(
            f"interpolation must be 'linear', 'look_ahead' or 'spline' for {model.name}, which uses {derivatives[0]}, "
            f"but is 'zero_order': a held input has no derivative where it jumps"
        )


def state_rk4_step(model: Model, degree: int) -> Assignments:
    """One Runge-Kutta step of the state alone."""
    at = {symbol(i): symbol(f"M_{i}") for i in model.states}
    rates = {f"RATE_M_{i}": move.xreplace(at) for i, move in zip(model.states, differentiate(model).moves, strict=True)}
    step = sp.Rational(1, model.substeps)
    stages = runge_kutta_4([f"M_{i}" for i in model.states], eliminate_common_subexpressions(rates, "CSE"), model, step)
    return input_at_stages(model, degree, step) + stages


def propagate_state(model: Model, degree: int, row_of: Mapping[str, str]) -> tuple[Assignments, dict[str, str]]:
    """The state alone over a sample, or over one Runge-Kutta step, in renamed quantities.

    Args:
        model: the equation.
        degree: degree of the input's polynomial.
        row_of: state or coefficient to its name in the assignments.

    Returns:
        The assignments, and each renamed state to the name of its next value.
    """
    if model.is_continuous:
        mapping = {**row_of, **{f"M_{x}": row_of[x] for x in model.states}}
        lines = substitute(state_rk4_step(model, degree), mapping)
        return lines, {row_of[x]: f"M_{x}_END" for x in model.states}
    lines, propagation = propagate_difference_equation(model)
    results = {}
    for x, value in zip(model.states, propagation.state, strict=True):
        lines.append((f"NEXT_{x}", value))
        results[row_of[x]] = f"NEXT_{x}"
    return substitute(lines, row_of), results
