"""A model's motion without noise, at known coefficients, compiled for one system: what simple rules look at.

Besides the motion itself these are four things that every model has, and that Eq. (2) and Eq. (1) call by other names:

- the *velocity* of the first sensor: its derivative by time without input. Of a difference equation that keeps the last
  value of what the sensor shows it is the change since; of another, the change that comes without input.
- the *gain*: how an input first shows, in the lowest derivative by time (or the first of the next samples) that depends
  on it: η of Eq. (2), δ²/m of Eq. (1).
- the *regressors*: derivatives of the moves by the coefficients.
- the *linear part*: derivatives of the moves by the states, at rest.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from typing import Any

from estimator.compilation.simd import number_rows
from estimator.engine.expected_update import input_history_rows, input_polynomial
from estimator.engine.kernels import RUNTIME_FUNCTIONS
from estimator.engine.source_cache import load_generated
from estimator.engine.storage_layout import integrator_rows
from estimator.models.model import Model

#: Runge-Kutta steps per sample of a plan that climbs by gradient, and of a glance at the motion. A filter needs an
#: integration error far below the posterior's standard deviation, because it adds up over a record. A plan does not: it
#: compares inputs, all imagined alike, by what they teach.
_COARSE_SUBSTEPS = 2


@dataclass(frozen=True)
class NoiseFreeResponse:
    """The motion of a model; all functions are of one system, or of as many as there are lanes, in a flat block ``W``.

    Of several systems in a block, the quantity in row r of lane j is ``W[r * lanes + j]`` (`estimator.compilation.simd`).
    The input of a sample stands in row ``INPUT``; older ones, where the model looks at them, in ``LAST_INPUT`` and
    ``OLDER_INPUT``, and move on by themselves.

    Attributes:
        output_now: ``output_now(W)``: leaves in ``NOW`` what the first sensor shows now, without input, and its ``VELOCITY`` and
            ``GAIN``.
        output_after: ``output_after(W)``: leaves in ``SHOWN`` what it would show after the sample.
        step: ``step(W)``: a sample; leaves ``SHOWN``, and in ``PHI_<coefficient>`` its derivatives by the coefficients.
        regressors: ``regressors(W)``: the regressors, over all moves, into ``E_<coefficient>``.
        linearise: ``linearise(W)``: the linear part into ``A_<state>_<state>``.
        layout: rows of the block: states, coefficients, inputs, results.
        is_odd: whether everything changes its sign with states and input.
    """

    output_now: Any
    output_after: Any
    step: Any
    regressors: Any
    linearise: Any
    layout: Mapping[str, int]
    is_odd: bool


def with_coarse_substeps(model: Model) -> Model:
    """The model with the steps of a plan that climbs by gradient, and of a glance at the motion."""
    return replace(model, substeps=min(_COARSE_SUBSTEPS, model.substeps)) if model.is_continuous else model


@cache
def compile_noise_free_response(model: Model, degree: int = 0, lag: int = 0, lanes: int = 1) -> NoiseFreeResponse:
    """The motion of a model; arguments as `estimator.engine.expected_update.compile_expected_update`, and the systems in a block."""
    coarse = with_coarse_substeps(model)
    names = [*model.names, "INPUT", "LAST_INPUT", "OLDER_INPUT", "NOW", "VELOCITY", "GAIN", "SHOWN"]
    names += [f"{letter}_{c}" for letter in ("PHI", "E") for c in model.coefficients]
    names += [f"A_{i}_{j}" for i in model.states for j in model.states]
    layout = number_rows(*names, *integrator_rows(model))
    key = repr((coarse.digest, degree, lag, lanes))
    code = load_generated(
        model.name, "motion", key, lambda: _source(coarse, degree, lag, lanes, layout), RUNTIME_FUNCTIONS
    )
    return NoiseFreeResponse(
        code.output_now, code.output_after, code.step, code.regressors, code.linearise, layout, code.IS_ODD
    )


def _source(model: Model, degree: int, lag: int, lanes: int, layout: Mapping[str, int]) -> str:
    from estimator.engine import printer_numba, symbolic, variational_rk4

    derivatives, symbol = symbolic.differentiate(model), symbolic.symbol
    input_values = input_polynomial(model, degree, lag)

    def loop(name: str, doc: str, lines: Any, results: Mapping[str, str], *uniform: str) -> str:
        return printer_numba.print_lane_loop(
            name, symbolic.substitute(lines, input_values), results, layout, lanes, uniform, doc=doc
        )

    shown, velocity, gain = _output_velocity_and_gain(model)
    values = {"NOW_e": shown, "VELOCITY_e": velocity, "GAIN_e": gain}
    source = loop(
        "output_now",
        "The sensor now.",
        symbolic.eliminate_common_subexpressions(values, "W"),
        {n.removesuffix("_e"): n for n in values},
    )
    source += variational_rk4.print_integrator(model, degree, layout, lanes, input_values=input_values)
    source += _step_source(model, degree, lag, loop)
    constant_input = {symbol("u1"): symbol("u"), symbol("u2"): symbol("u")}
    summed = {
        f"R_{c}": sum(m.diff(symbol(c)) for m in derivatives.moves).xreplace(constant_input) for c in model.coefficients
    }
    lines = symbolic.substitute(symbolic.eliminate_common_subexpressions(summed, "W"), {"u": "INPUT"})
    source += loop("regressors", "The regressors.", lines, {f"E_{c}": f"R_{c}" for c in model.coefficients})
    rest = {symbol(name): 0 for name in (*model.states, "u", "u1", "u2")}
    slopes = {
        f"L_{i}_{j}": slope.subs(rest)
        for i, row in zip(model.states, derivatives.jacobian, strict=True)
        for j, slope in zip(model.states, row, strict=False)
    }
    results = {f"A_{name[2:]}": name for name in slopes}
    source += loop("linearise", "The linear part.", list(slopes.items()), results)
    mirrored = {symbol(name): -symbol(name) for name in (*model.states, "u", "u1", "u2")}
    is_odd = all((e + e.xreplace(mirrored)).expand() == 0 for e in (*derivatives.moves, *derivatives.outputs))
    return source + f"IS_ODD = {is_odd}\n"


def _step_source(model: Model, degree: int, lag: int, loop: Any) -> str:
    """``output_after`` and ``step``."""
    from estimator.engine import printer_numba, symbolic

    derivatives, symbol, states = symbolic.differentiate(model), symbolic.symbol, list(model.states)
    inputs = input_history_rows(model, degree, lag)
    source, (lines, propagation) = "", symbolic.propagate_sample(model)
    if model.is_continuous:
        point = {f"M_{x}": f"M_{x}_E" for x in states}
        source += loop("move_state", "As move, of the state alone.", symbolic.state_rk4_step(model, degree), point, "T")
    at = dict(zip(map(symbol, states), propagation.state, strict=True)) | {
        symbol("u"): symbolic.input_at_end(model, degree)
    }
    shown = derivatives.outputs[0].xreplace(at)
    output_slope = [slope.xreplace(at) for slope in derivatives.output_slopes[0]]
    n = len(states)
    phi = [
        sum((output_slope[a] * propagation.jacobian[a][n + b] for a in range(n)), output_slope[n + b])
        for b in range(model.n_coefficients)
    ]
    source += loop("output", "What the sensor will show.", [*lines, ("SHOWN_e", shown)], {"SHOWN": "SHOWN_e"})
    more = [("SHOWN_e", shown), *((f"PHI_{c}_e", e) for c, e in zip(model.coefficients, phi, strict=True))]
    more += [(f"END_{x}", value) for x, value in zip(states, propagation.state, strict=True)]
    results = {row: f"{row}_e" for row in ("SHOWN", *(f"PHI_{c}" for c in model.coefficients))}
    results |= {x: f"END_{x}" for x in states}
    results |= {older: newer for newer, older in pairwise(inputs)}
    source += loop("finish", "What the sensor shows, by the coefficients too.", [*lines, *more], results)
    for name, move, end in (("output_after", "move_state", "output"), ("step", "move", "finish")):
        source += printer_numba.print_sample(f"{name}(W)", model, f"{end}(W)", move)
    return source


def _output_velocity_and_gain(model: Model) -> tuple[Any, Any, Any]:
    """What the first sensor shows without input, its velocity, and its gain."""
    import sympy as sp

    from estimator.engine.symbolic import differentiate, symbol

    derivatives, u = differentiate(model), symbol("u")
    constant_input = {symbol(name): u for name in ("u1", "u2")}
    moves = dict(zip(map(symbol, model.states), (m.xreplace(constant_input) for m in derivatives.moves), strict=True))
    shown = derivatives.outputs[0].xreplace({u: sp.S.Zero})

    def later(value: Any) -> Any:
        """The derivative by time, or the value one sample later."""
        if model.is_continuous:
            return sum(value.diff(x) * rate for x, rate in moves.items())
        return value.xreplace(moves)

    gain, value = sp.S.Zero, shown
    for _ in range(model.n_states + 1):
        value = later(value)
        gain = value.diff(u)
        if gain != 0:
            break
        value = value.subs(u, 0)
    gain = gain.subs(u, 0) if gain != 0 else sp.S.One
    if model.is_continuous:
        return shown, later(shown).subs(u, 0), gain
    kept = [x for x, move in moves.items() if move == shown]
    return shown, shown - kept[0] if kept else later(shown).subs(u, 0) - shown, gain
