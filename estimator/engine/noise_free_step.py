"""Noise-free response of a model at known coefficients, with velocity, gain, regressors and linearisation, compiled.

These quantities exist for every model:

- the *velocity*: the time derivative of the first sensor's output without input. For a difference equation with the
  last output among its states it is the change since the last sample; for another, the next change without input.
- the *gain*: the slope, with respect to the input, of the lowest time derivative of the output (or the earliest next
  output) that depends on the input: η of Eq. (2), δ²/m of Eq. (1). Of several inputs it is the
  slope with respect to all, which change alike.
- the *regressors*: derivatives of the rates or next states with respect to the coefficients.
- the *linear part*: their derivatives with respect to the states, at rest.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

from estimator.compilation.simd import number_rows
from estimator.engine.expected_update import input_coefficients_from_history, shifted_history
from estimator.engine.kernels import RUNTIME_FUNCTIONS
from estimator.engine.source_cache import load_generated
from estimator.engine.storage_layout import input_history_row, integrator_rows
from estimator.models.model import MAX_INPUT_AGE, Model

#: Runge-Kutta steps per sample in gradient-based planning. A filter needs more, since its integration errors add up
#: over a record; a plan compares inputs, all with the same error.
_COARSE_SUBSTEPS = 2


@dataclass(frozen=True)
class NoiseFreeStep:
    """The noise-free response of a model, for the systems of a block ``W`` (`estimator.compilation.simd`).

    The newest value of an input is in row ``INPUT_<input>``. Older ones, if the model has them, are in
    ``LAST_INPUT_<input>`` and ``OLDER_INPUT_<input>``; ``step`` shifts them.

    Attributes:
        output_now: ``output_now(W)``: writes the first sensor's output without input into ``NOW``, with its
            ``VELOCITY`` and ``GAIN``.
        output_after: ``output_after(W)``: writes the output after the sample into ``Y_PRED``; the state stays.
        step: ``step(W)``: one sample; writes ``Y_PRED`` and its derivatives ``PHI_<coefficient>``.
        regressors: ``regressors(W)``: writes the regressors, summed over all states, into ``REGRESSOR_<coefficient>``.
        linearise: ``linearise(W)``: writes the linear part into ``A_<state>_<state>``.
        layout: row number of each quantity: states, coefficients, inputs and results.
        is_odd: whether rates (or next states) and outputs are odd functions of states and input.
    """

    output_now: Any
    output_after: Any
    step: Any
    regressors: Any
    linearise: Any
    layout: Mapping[str, int]
    is_odd: bool


def with_coarse_substeps(model: Model) -> Model:
    """The model with the integrator steps of gradient-based planning."""
    return replace(model, substeps=min(_COARSE_SUBSTEPS, model.substeps)) if model.is_continuous else model


@cache
def compile_noise_free_step(model: Model, degree: int = 0, lag: int = 0, lanes: int = 1) -> NoiseFreeStep:
    """Compile the noise-free response of a model.

    Args:
        model: the equation.
        degree: as for `estimator.engine.expected_update.compile_expected_update`.
        lag: likewise.
        lanes: lanes of a block.
    """
    coarse = with_coarse_substeps(model)
    names = [
        *model.names,
        *(input_history_row(i, age) for i in model.inputs for age in range(MAX_INPUT_AGE + 1)),
        "NOW",
        "VELOCITY",
        "GAIN",
        "Y_PRED",
    ]
    names += [f"{letter}_{c}" for letter in ("PHI", "REGRESSOR") for c in model.coefficients]
    names += [f"A_{i}_{j}" for i in model.states for j in model.states]
    layout = number_rows(*names, *integrator_rows(model))
    key = repr((coarse.digest, degree, lag, lanes))
    code = load_generated(
        model.name, "motion", key, lambda: _source(coarse, degree, lag, lanes, layout), RUNTIME_FUNCTIONS
    )
    return NoiseFreeStep(
        code.output_now, code.output_after, code.step, code.regressors, code.linearise, layout, code.IS_ODD
    )


def _source(model: Model, degree: int, lag: int, lanes: int, layout: Mapping[str, int]) -> str:
    from estimator.engine import printer_numba, symbolic, variational_rk4

    derivatives, symbol = symbolic.differentiate(model), symbolic.symbol
    input_values = input_coefficients_from_history(model, degree, lag)

    def loop(name: str, doc: str, lines: Any, results: Mapping[str, str], *uniform: str) -> str:
        return printer_numba.print_lane_loop(
            name, symbolic.substitute(lines, input_values), results, layout, lanes, uniform, doc=doc
        )

    shown, velocity, gain = _output_velocity_and_gain(model)
    values = {"NOW_e": shown, "VELOCITY_e": velocity, "GAIN_e": gain}
    source = loop(
        "output_now",
        "The output now, without input.",
        symbolic.eliminate_common_subexpressions(values, "CSE"),
        {n.removesuffix("_e"): n for n in values},
    )
    source += variational_rk4.print_integrator(model, degree, layout, lanes, input_values=input_values)
    source += _step_source(model, degree, lag, loop)
    constant_input: dict[Any, Any] = {symbol(written): symbol(i) for written, (i, _) in model.input_ages.items()}
    constant_input |= {symbol(written): symbolic.ZERO for written, (_, order) in model.acting_inputs.items() if order}
    summed = {
        f"SUM_{c}": sum(m.diff(symbol(c)) for m in derivatives.moves).xreplace(constant_input)
        for c in model.coefficients
    }
    lines = symbolic.substitute(
        symbolic.eliminate_common_subexpressions(summed, "CSE"), {i: input_history_row(i, 0) for i in model.inputs}
    )
    source += loop("regressors", "The regressors.", lines, {f"REGRESSOR_{c}": f"SUM_{c}" for c in model.coefficients})
    rest = {symbol(name): 0 for name in (*model.states, *model.input_ages, *model.acting_inputs)}
    slopes = {
        f"SLOPE_{i}_{j}": slope.subs(rest)
        for i, row in zip(model.states, derivatives.jacobian, strict=True)
        for j, slope in zip(model.states, row, strict=False)
    }
    results = {f"A_{name.removeprefix('SLOPE_')}": name for name in slopes}
    source += loop("linearise", "The linear part.", list(slopes.items()), results)
    mirrored = {symbol(name): -symbol(name) for name in (*model.states, *model.input_ages, *model.acting_inputs)}
    is_odd = all((e + e.xreplace(mirrored)).expand() == 0 for e in (*derivatives.moves, *derivatives.outputs))
    return source + f"IS_ODD = {is_odd}\n"


def _step_source(model: Model, degree: int, lag: int, loop: Any) -> str:
    """Source of ``output_after`` and ``step``."""
    from estimator.engine import printer_numba, symbolic
    from estimator.engine.inputs_at_end import inputs_at_end

    derivatives, symbol, states = symbolic.differentiate(model), symbolic.symbol, list(model.states)
    source, (lines, propagation) = "", symbolic.propagate_sample(model)
    if model.is_continuous:
        point = {f"M_{x}": f"M_{x}_END" for x in states}
        source += loop(
            "move_state",
            "One Runge-Kutta step of the state alone.",
            symbolic.state_rk4_step(model, degree),
            point,
            "TAU",
        )
    at = dict(zip(map(symbol, states), propagation.state, strict=True)) | inputs_at_end(model, degree)
    shown = derivatives.outputs[0].xreplace(at)
    output_slope = [slope.xreplace(at) for slope in derivatives.output_slopes[0]]
    n = len(states)
    phi = [
        sum((output_slope[a] * propagation.jacobian[a][n + b] for a in range(n)), output_slope[n + b])
        for b in range(model.n_coefficients)
    ]
    source += loop("output", "The output after the sample.", [*lines, ("Y_PRED_e", shown)], {"Y_PRED": "Y_PRED_e"})
    more = [("Y_PRED_e", shown), *((f"PHI_{c}_e", e) for c, e in zip(model.coefficients, phi, strict=True))]
    more += [(f"END_{x}", value) for x, value in zip(states, propagation.state, strict=True)]
    results = {row: f"{row}_e" for row in ("Y_PRED", *(f"PHI_{c}" for c in model.coefficients))}
    results |= {x: f"END_{x}" for x in states}
    results |= shifted_history(model, degree, lag)
    source += loop("finish", "The output after the sample, and its derivatives.", [*lines, *more], results)
    for name, move, end in (("output_after", "move_state", "output"), ("step", "move", "finish")):
        source += printer_numba.print_sample(f"{name}(W)", model, f"{end}(W)", move)
    return source


def _output_velocity_and_gain(model: Model) -> tuple[Any, Any, Any]:
    """The first sensor's output without input, its velocity and its gain."""
    import sympy as sp

    from estimator.engine.symbolic import differentiate, symbol

    derivatives, u = differentiate(model), symbol("u")
    constant_input = {symbol(written): u for written in model.input_ages}
    constant_input |= {symbol(written): sp.S.Zero for written, (_, order) in model.acting_inputs.items() if order}
    moves = dict(zip(map(symbol, model.states), (m.xreplace(constant_input) for m in derivatives.moves), strict=True))
    shown = derivatives.outputs[0].xreplace({**constant_input, u: sp.S.Zero})

    def later(value: Any) -> Any:
        """The time derivative, or the value one sample later."""
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
