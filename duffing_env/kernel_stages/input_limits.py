"""The actions of a block as inputs within their limits: amplitude and slew of each input, and one energy of all.

An input that is asked for goes through three limits, in this order:

1. its amplitude: the action is clipped to [-1, 1], times the input's ``max_input``;
2. its slew: it changes by at most its ``max_slew`` from the input before;
3. the energy: Σ u² over the samples so far and over all inputs, each in its own unit, never exceeds the budget. The
   inputs of a sample that ask for more than the rest of the budget are scaled by one factor, so their direction stays.
   This limit comes last and wins over the slew: without energy there is no input, however large the last one was.

An only input is clipped to the square root of the rest.
"""

from __future__ import annotations

from typing import Any

from duffing_env.kernel_stages import plant_stages
from duffing_env.storage.kernel_spec import KernelSpec, applied_row, block_layout, input_places, requested_row, rise_row
from estimator.compilation.simd import LANES, jit_closure, lanewise
from estimator.engine.storage_layout import input_history_row

#: Part of the affordable energy that a scaled sample leaves: rounding of factor, squares and sum is below 2⁻⁴⁷ of it
#: for up to 50 inputs.
_ENERGY_MARGIN = 2.0**-47


def limited_inputs_source(spec: KernelSpec, loop: Any) -> str:
    """``limit_inputs(W, budget, max_slew)`` of several inputs; empty for one, which `plant_stages.limit_input` limits.

    Args:
        spec: kind of experiment.
        loop: loop printer of `duffing_env.kernel_stages.generated_environment_functions`.
    """
    import sympy as sp

    from estimator.engine.symbolic import symbol

    names = list(spec.truth_model.inputs)
    if len(names) == 1:
        return ""
    clip, select, is_positive = (sp.Function(name) for name in ("clip", "select", "positive"))
    lines: Any = []
    for i in names:
        asked, last, slew = symbol(requested_row(i)), symbol(applied_row(i)), symbol(f"max_slew_{i}")
        lines += [(f"LOW_{i}", last - slew), (f"HIGH_{i}", last + slew)]
        lines.append((f"ASKED_{i}", clip(asked, symbol(f"LOW_{i}"), symbol(f"HIGH_{i}"))))
    asked_energy = sum(symbol(f"ASKED_{i}") ** 2 for i in names)
    lines.append(("ASKED_ENERGY", asked_energy))
    lines.append(("LEFT", symbol("budget") - symbol("ENERGY_SPENT")))
    lines.append(("AFFORDABLE", select(is_positive(symbol("LEFT")), symbol("LEFT"), sp.S.Zero)))
    lines.append(("EXCESS", symbol("ASKED_ENERGY") - symbol("AFFORDABLE")))
    scaled = sp.sqrt(symbol("AFFORDABLE") / symbol("ASKED_ENERGY")) * sp.Float(1.0 - _ENERGY_MARGIN)
    lines.append(("FACTOR", select(is_positive(symbol("EXCESS")), scaled, sp.S.One)))
    results: dict[str, str] = {}
    for i in names:
        newest, last, older = (input_history_row(i, age) for age in range(3))
        lines.append((f"APPLIED_{i}", symbol("FACTOR") * symbol(f"ASKED_{i}")))
        lines += [(f"CHANGE_{i}", symbol(f"APPLIED_{i}") - symbol(newest))]
        lines += [(f"NEWEST_{i}", symbol(newest)), (f"LAST_{i}", symbol(last))]
        results |= {older: f"LAST_{i}", last: f"NEWEST_{i}", newest: f"APPLIED_{i}", rise_row(i): f"CHANGE_{i}"}
    # The energies of a sample are added up before they are added to the energy so far, so that one rounding remains.
    lines.append(("APPLIED_ENERGY", sum(symbol(f"APPLIED_{i}") ** 2 for i in names)))
    lines.append(("SPENT", symbol("ENERGY_SPENT") + symbol("APPLIED_ENERGY")))
    results["ENERGY_SPENT"] = "SPENT"
    source = loop(
        "limit_inputs_lanes", "The inputs within their limits.", lines, results, "budget",
        *(f"max_slew_{i}" for i in names),
    )  # fmt: skip
    slews = ", ".join(f"max_slew[{k}]" for k in range(len(names)))
    return source + f"@scalar_jit\ndef limit_inputs(W, budget, max_slew):\n    limit_inputs_lanes(W, budget, {slews})\n"


def compile_input(spec: KernelSpec, generated: Any) -> Any:
    """``apply_input(W, actions, lane, max_input, budget, max_slew)``: the actions of a block as limited inputs.

    Args:
        spec: kind of experiment.
        generated: functions of `duffing_env.kernel_stages.generated_environment_functions`.
    """
    first, stride = input_places(spec, requested_row)
    count = spec.truth_model.n_inputs
    if count == 1:
        return _compile_single_input(spec, first)
    limit_inputs = generated.limit_inputs

    @jit_closure(spec.name)
    def apply_inputs(W, actions, lane, max_input, budget, max_slew):
        for i in range(count):
            for j in range(LANES):
                action = max(-1.0, min(1.0, actions[(lane + j) * count + i]))
                W[first + i * stride + j] = max_input[i] * action
        limit_inputs(W, budget, max_slew)

    return apply_inputs


def _compile_single_input(spec: KernelSpec, requested_input: int) -> Any:
    (name,) = spec.truth_model.inputs
    row_of = block_layout(spec)
    history = dict(
        zip(("INPUT", "LAST_INPUT", "OLDER_INPUT"), (input_history_row(name, a) for a in range(3)), strict=True)
    )
    rows = history | {"RISE": rise_row(name), "REQUESTED_INPUT": requested_row(name)}
    layout = {**row_of, **{argument: row_of[row] for argument, row in rows.items()}}
    limited_rows = "INPUT LAST_INPUT OLDER_INPUT RISE ENERGY_SPENT"
    limit_input = lanewise(layout, limited_rows, uniform="budget max_slew")(plant_stages.limit_input)

    @jit_closure(spec.name)
    def apply_input(W, actions, lane, max_input, budget, max_slew):
        largest = max_input[0]
        for j in range(LANES):
            W[requested_input + j] = largest * max(-1.0, min(1.0, actions[lane + j]))
        limit_input(W, budget, max_slew[0])

    return apply_input
