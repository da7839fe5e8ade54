"""Code generation for an environment: plant, true coefficients, reward and observation of any model, across lanes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from itertools import combinations
from typing import Any

from duffing_env.kernel_stages.input_limits import limited_inputs_source
from duffing_env.rewards.log_determinant import log_det_and_density
from duffing_env.rewards.named_rewards import REWARDS
from duffing_env.storage.kernel_spec import (
    KernelSpec,
    applied_row,
    block_layout,
    estimated_expressions,
    last_input_entries,
    model_input_rows,
    noise_draw_rows,
    noise_std_rows,
    observation_bounds,
    parameter_names,
)
from estimator.compilation.scalar_jit import scalar_jit
from estimator.compilation.simd import LANES, source_digest, source_folders
from estimator.engine.kernels import RUNTIME_FUNCTIONS
from estimator.engine.source_cache import load_generated
from estimator.engine.storage_layout import belief_rows
from estimator.models.model import Model


@scalar_jit
def capped_error(ratio):
    """Relative error of an estimate, capped at 1, from its ratio to the truth."""
    deviation = abs(ratio - 1.0)
    return deviation if deviation < 1.0 else 1.0


_COMPILED_NAMES = {**RUNTIME_FUNCTIONS, "capped_error": capped_error}


@cache
def generated_functions(spec: KernelSpec) -> Any:
    """The compiled functions of a kind of experiment, as attributes by the names in `_environment_source`."""
    digests = (spec.belief_model.digest, spec.plant_model and spec.plant_model.digest)
    key = source_digest(source_folders(__file__)) + repr((spec[2:], digests))
    return load_generated(
        spec.belief_model.name, "environment", key, lambda: _environment_source(spec), _COMPILED_NAMES
    )


def _environment_source(spec: KernelSpec) -> str:
    """The source of all functions, each with a docstring."""
    from estimator.engine.printer_numba import print_lane_loop

    row_of = block_layout(spec)

    def loop(name: str, doc: str, lines: Any, results: Mapping[str, str], *uniform: str, one: bool = False) -> str:
        return print_lane_loop(name, lines, results, row_of, LANES, uniform, doc=doc, single_lane=one)

    def plant_loop(name: str, doc: str, lines: Any, results: Mapping[str, str], *uniform: str) -> str:
        noises = {name: row_of[row] for name, row in noise_std_rows(spec.truth_model).items()}
        plant_rows = {**row_of, **model_input_rows(spec, spec.truth_model, row_of), **noises}
        return print_lane_loop(name, lines, results, plant_rows, LANES, uniform, doc=doc)

    source = _true_coefficients_source(spec, loop) + _step_outcome_source(spec, loop) + _observation_source(spec)
    if spec.plant_model is not None:
        source += _plant_source(spec.plant_model, spec.degree, plant_loop)
    source += _random_walk_source(spec.belief_model, loop) + limited_inputs_source(spec, loop)
    hook_source = REWARDS[spec.reward_hooks].hook_source if spec.reward_hooks else None
    return source + (hook_source(spec, loop) if hook_source else "")


def _random_walk_source(model: Model, loop: Any) -> str:
    """``add_random_walk(W, variances)``: add the variances of a sample's random walk to the coefficients'."""
    from estimator.engine.symbolic import symbol

    names = list(model.coefficients)
    lines = [(f"V_{c}", symbol(f"P_{c}_{c}") + symbol(f"WALK_{c}")) for c in names]
    results = {f"P_{c}_{c}": f"V_{c}" for c in names}
    source = loop("add_random_walk_lanes", "The coefficients walk.", lines, results, *(f"WALK_{c}" for c in names))
    arguments = ", ".join(f"variances[{i}]" for i in range(len(names)))
    return source + f"@scalar_jit\ndef add_random_walk(W, variances):\n    add_random_walk_lanes(W, {arguments})\n"


def _plant_source(model: Model, degree: int, loop: Any) -> str:
    """``step_plant``: the plant over a sample with its noise, or over one Runge-Kutta step; ``measure_<k>``: a sensor.

    The step of a difference equation includes its first sensor.
    """
    from estimator.engine import symbolic
    from estimator.engine.inputs_at_end import inputs_at_end

    names = {**{x: f"X_{x}" for x in model.states}, **{c: f"TRUE_{c}" for c in model.coefficients}}
    lines, results = symbolic.propagate_state(model, degree, names)
    derivatives, symbol = symbolic.differentiate(model), symbolic.symbol
    noises = list(noise_std_rows(model))
    draws = [tuple(map(symbol, rows)) for rows in noise_draw_rows(model)]
    w, v = draws[0]
    ends = {str(written): value for written, value in inputs_at_end(model, degree).items()}
    after: dict[str, Any] = {}
    for a, x in enumerate(model.states):
        kick = _noise_of_state(model, a, symbol(noises[0]), draws)
        # A slope may hold an input, which is taken at the end of the sample.
        kick = symbolic.substitute([("", kick)], names | ends)[0][1]
        lines.append((f"K_{x}", symbol(results[names[x]]) + kick))
        after[x] = symbol(f"K_{x}")
    results = {names[x]: f"K_{x}" for x in model.states}
    source = ""
    for k, (y, output_expression) in enumerate(zip(model.outputs, derivatives.outputs, strict=True)):
        noise = (v, w)[k % 2] * symbol(noises[1 + k])
        state_rows = names if model.is_continuous or k else {**names, **after}
        value = symbolic.substitute([("", output_expression)], state_rows | ends)[0][1] + noise
        if model.is_continuous or k:
            source += loop(f"measure_{k}", "A sensor.", [("SHOWN", value)], {f"Y_{y}": "SHOWN"})
        else:
            lines.append(("SHOWN", value))
            results |= {f"Y_{y}": "SHOWN"}
    substep_arguments = ("TAU", "length", "root", "root_3") if model.is_continuous else ()
    return source + loop("step_plant", "The plant moves.", lines, results, *substep_arguments)


def _noise_of_state(model: Model, a: int, strength: Any, draws: Sequence[tuple[Any, Any]]) -> Any:
    """What the process noise adds to state ``a`` over a step, from two standard normal numbers of each source.

    A state takes the increment of the noise over a step of length h; a state that the noise reaches only through other
    states takes the integral. For white noise both are drawn jointly. With independent noises a state takes both.
    """
    from estimator.engine import symbolic

    derivatives, symbol, total = symbolic.differentiate(model), symbolic.symbol, symbolic.ZERO
    for effect, (w, v) in zip(symbolic.noise_effects(model), draws, strict=False):
        if not model.is_continuous:
            total += strength * effect[a] * w
            continue
        h = symbol("length")
        through = sum(derivatives.jacobian[a][k] * strength * effect[k] for k in range(model.n_states))
        direct, integral = h * w, h * h / 2 * w
        if not model.held:
            direct, integral = symbol("root") * w, h * symbol("root") / 2 * (w + v / symbol("root_3"))
        if effect[a] == 0:
            total += through * integral
        else:
            total += strength * effect[a] * direct + (through * integral if model.independent_noise else 0)
    return total


def _true_coefficients_source(spec: KernelSpec, loop: Any) -> str:
    """``set_true_coefficients(W, j, step)``: lane j's coefficients in the equations of plant and belief.

    It also stores the inverse of each true parameter, so that no sample divides to compare an estimate with the truth.
    """
    from estimator.engine import symbolic
    from estimator.engine.expression_parser import parse_expression

    parameter_symbols = {p: symbolic.symbol(p) for p in parameter_names(spec.truth_model)}
    lines, results = [], {}
    # Each equation on its own: a plant's coefficients must not depend on the believed model, to the last bit.
    for tag, model in zip("WX", {spec.truth_model: None, spec.belief_model: None}, strict=False):
        coefficient_values = {}
        for c in model.coefficients:
            text = model.inverse[c] if model.inverse else c
            value = parse_expression(text, {**parameter_symbols, "step": symbolic.symbol("step")}, model)
            coefficient_values[f"V_{c}"] = symbolic.substitute(
                [("", value)], {p: f"PARAM_{p}" for p in parameter_symbols}
            )[0][1]
            results[f"TRUE_{c}"] = f"V_{c}"
        lines += symbolic.eliminate_common_subexpressions(coefficient_values, tag)
    for p in estimated_expressions(spec.belief_model):
        lines.append((f"V_INVERSE_TRUE_{p}", 1 / symbolic.symbol(f"PARAM_{p}")))
        results[f"INVERSE_TRUE_{p}"] = f"V_INVERSE_TRUE_{p}"
    return loop("set_true_coefficients", "The true coefficients, of the parameters.", lines, results, "step", one=True)


def _belief_beside_truth(spec: KernelSpec) -> tuple[Any, Any]:
    """Assign ``NEW_LOG_DET``, and ``NEW_LOG_DENSITY`` and ``NEW_PARAMETER_ERROR`` at the truth; and their validity."""
    import sympy as sp

    from estimator.engine import symbolic
    from estimator.engine.expression_parser import parse_expression

    symbol, model = symbolic.symbol, spec.belief_model
    deviations = {c: symbol(f"TRUE_{c}") - symbol(c) for c in model.coefficients}
    lines, determinant, square, is_sound = log_det_and_density(model, deviations)
    lines.append(("NEW_LOG_DET", sp.Function("log")(determinant)))
    lines.append(("NEW_LOG_DENSITY", -(symbol("NEW_LOG_DET") + square) / 2))
    coefficient_symbols = {c: symbol(c) for c in model.coefficients} | {"step": symbol("step")}
    capped_error_symbol = sp.Function("capped_error")
    ratios = {
        f"RATIO_{p}": parse_expression(text, coefficient_symbols, model) * symbol(f"INVERSE_TRUE_{p}")
        for p, text in estimated_expressions(model).items()
    }
    lines += symbolic.eliminate_common_subexpressions(ratios, "RW")
    lines.append(("NEW_PARAMETER_ERROR", sum(capped_error_symbol(symbol(r)) for r in ratios) / len(ratios)))
    return lines, is_sound


def _step_outcome_source(spec: KernelSpec, loop: Any) -> str:
    """``evaluate_belief(W, j, step)``: a new belief beside the truth; ``finish_step(W, ...)``: reward and flags."""
    import sympy as sp

    from estimator.engine.symbolic import symbol

    model = spec.belief_model
    lines, is_sound = _belief_beside_truth(spec)
    result_rows = {name: f"NEW_{name}" for name in ("LOG_DET", "LOG_DENSITY", "PARAMETER_ERROR")}
    source = loop("evaluate_belief", "Compare lane j's belief with its truth.", lines, result_rows, "step", one=True)
    select, is_positive, is_finite = (sp.Function(name) for name in ("select", "positive", "finite"))
    variances = {f"P_{name}_{name}" for name in model.names}
    checked_rows = [name for name in belief_rows(model) if not name.startswith("P_") or name in variances]
    checked_rows += [f"X_{x}" for x in spec.truth_model.states] + [f"Y_{y}" for y in model.outputs]
    total = sum(
        (symbol(name) for name in checked_rows),
        symbol("NEW_LOG_DENSITY") + symbol("NEW_PARAMETER_ERROR") + symbol("HOOK_REWARD"),
    )
    spreads = [symbol(f"P_{x}_{x}") for x in model.states] if spec.factorisation == "structured" else []
    lines.append(("TOTAL", total))
    is_valid = is_sound * is_finite(symbol("TOTAL")) * sp.Mul(*(is_positive(s + sp.Float(1e-300)) for s in spreads))
    is_valid *= sp.Mul(*(is_positive(symbol(name)) for name in belief_rows(model)[-2 - 2 * model.n_outputs :]))
    is_off_record = symbol("OFF_RECORD")
    lines += [("SOUND", is_valid), ("BROKEN", 1 - symbol("SOUND")), ("VOID", symbol("BROKEN") + is_off_record)]
    for name in ("LOG_DET", "LOG_DENSITY", "PARAMETER_ERROR"):
        lines.append((f"E_{name}", select(symbol("VOID"), symbol(name), symbol(f"NEW_{name}"))))
    lines.append(("E_HOOK_REWARD", select(symbol("VOID"), sp.S.Zero, symbol("HOOK_REWARD"))))
    lines.append(("GAIN", (symbol("LOG_DET") - symbol("E_LOG_DET")) / 2))
    lines.append(("POSTERIOR", symbol("E_LOG_DENSITY") - symbol("LOG_DENSITY")))
    weight_names = ("information_weight", "posterior_weight", "error_weight", "hook_weight")
    reward_terms = (
        symbol("GAIN"),
        symbol("POSTERIOR"),
        symbol("PARAMETER_ERROR") - symbol("E_PARAMETER_ERROR"),
        symbol("E_HOOK_REWARD"),
    )
    reward = sum(symbol(weight) * value for weight, value in zip(weight_names, reward_terms, strict=True))
    # In two lines: SymPy would square the factors, and the square of the input alone may overflow.
    cost_roots = [f"sqrt_input_cost_{i}" for i in model.inputs]
    for i, root in zip(model.inputs, cost_roots, strict=True):
        lines.append((f"EFFORT_{i}", symbol(root) * symbol(applied_row(i))))
        reward -= symbol(f"EFFORT_{i}") ** 2
    first_sensor, *further = model.outputs
    limits = {first_sensor: "max_output"} | {y: f"limit_{y}" for y in further}
    is_beyond_limit = is_positive(symbol("VOID"))
    for y, limit in limits.items():
        is_beyond_limit += is_positive(sp.Abs(symbol(f"Y_{y}")) - symbol(limit))
    is_at_horizon = sp.Function("reaches")(symbol("LATER"), symbol("horizon"))
    lines += [("PAID", reward), ("STOPPED", is_positive(is_beyond_limit)), ("LATER", symbol("ELAPSED_SAMPLES") + 1)]
    lines.append(("OVER", (1 - symbol("STOPPED")) * is_at_horizon))
    results = {
        "LOG_DET": "E_LOG_DET",
        "LOG_DENSITY": "E_LOG_DENSITY",
        "PARAMETER_ERROR": "E_PARAMETER_ERROR",
        "REWARD": "PAID",
    }
    results |= {"INFORMATION_GAIN": "GAIN", "LOG_POSTERIOR_GAIN": "POSTERIOR", "TERMINATED": "STOPPED"}
    results |= {"TRUNCATED": "OVER", "DIVERGED": "BROKEN", "ELAPSED_SAMPLES": "LATER"}
    uniform = ("step", "max_output", "horizon")
    doc = "The reward of a sample, and whether it ends the episode; a broken belief pays nothing and ends it."
    source += loop(
        "finish_step_lanes", doc, lines, results, *uniform, *cost_roots, *map(limits.get, further), *weight_names
    )
    arrays = {"sqrt_input_cost": len(cost_roots), "sensor_limits": len(further), "weights": len(weight_names)}
    given = [*uniform, *(f"{array}[{k}]" for array, size in arrays.items() for k in range(size))]
    signature = ", ".join(["W", *uniform, *arrays])
    return source + f"@scalar_jit\ndef finish_step({signature}):\n    finish_step_lanes(W, {', '.join(given)})\n"


def _observation_source(spec: KernelSpec) -> str:
    """``observe(W, B, ...)``: the observation into the rows of a block ``B``, relative to the prior and the limits."""
    import sympy as sp

    from estimator.engine.printer_numba import print_lane_loop
    from estimator.engine.symbolic import symbol, symmetric_entry

    model = spec.belief_model
    coefficients, order = list(model.coefficients), list(model.names)
    log = sp.Function("log")
    entries: dict[str, Any] = {}
    lines: Any = [(f"I_STD_{c}", 1 / sp.sqrt(symbol(f"P_{c}_{c}"))) for c in coefficients]
    for c in coefficients:
        entries[f"mean_{c}"] = (symbol(c) - symbol(f"PRIOR_{c}")) * symbol(f"SCALE_{c}")
    for c in coefficients:
        entries[f"log_std_{c}"] = log(symbol(f"P_{c}_{c}") * symbol(f"SCALE_{c}") ** 2) / 2
    for c, d in combinations(coefficients, 2):
        entries[f"corr_{c}_{d}"] = symmetric_entry("P", c, d, order) * symbol(f"I_STD_{c}") * symbol(f"I_STD_{d}")
    entries["log_gamma"] = log(symbol("GAMMA_SHAPE") / symbol("GAMMA_RATE")) - symbol("LOG_gamma")
    for y in model.outputs:
        entries[f"log_xi_{y}"] = log(symbol(f"XI_SHAPE_{y}") / symbol(f"XI_RATE_{y}")) - symbol(f"LOG_xi_{y}")
    for x in model.states:
        entries[f"state_{x}"] = symbol(x) * symbol("per_output")
    for entry, i in zip(last_input_entries(model), model.inputs, strict=True):
        entries[entry] = symbol(applied_row(i)) * symbol(f"PER_{i}")
    for y in model.outputs:
        entries[f"last_{y}"] = symbol(f"Y_{y}") * symbol("per_output")
    # One division serves all lanes where a number does not differ between them; both entries end at exactly 0.
    entries["time_left"] = (symbol("horizon") - symbol("ELAPSED_SAMPLES")) * symbol("per_horizon")
    entries["budget_left"] = 1 - symbol("ENERGY_SPENT") / symbol("budget")
    clip = sp.Function("clip")
    bounds = observation_bounds(model)
    for name, value in entries.items():
        low, high = (sp.Float(bound) for bound in bounds[name])
        lines += [(f"B_{name}", value), (f"V_{name}", clip(symbol(f"B_{name}"), low, high))]
    uniform = [f"{letter}_{c}" for letter in ("PRIOR", "SCALE") for c in coefficients]
    uniform += ["LOG_gamma", *(f"LOG_xi_{y}" for y in model.outputs)]
    per_input, scales = [f"PER_{i}" for i in model.inputs], ["per_output", "horizon", "per_horizon", "budget"]
    rows = {f"OBS_{name}": row for row, name in enumerate(entries)}
    source = print_lane_loop(
        "observe_lanes", lines, {f"OBS_{name}": f"V_{name}" for name in entries}, block_layout(spec), LANES,
        (*uniform, *per_input, *scales), doc="The observation, in rows.", shared_rows=rows,
    )  # fmt: skip
    n, k = model.n_states, model.n_coefficients
    prior_arguments = [*(f"prior[{n + i}]" for i in range(k)), *(f"inverse_std[{i}]" for i in range(k))]
    prior_arguments += [f"log_precisions[{i}]" for i in range(1 + model.n_outputs)]
    input_arguments = [f"1.0 / max_input[{i}]" for i in range(len(per_input))]
    arguments = ", ".join(["W", "B", *prior_arguments, *input_arguments, *scales])
    signature = ", ".join(["W", "B", "prior", "inverse_std", "log_precisions", "max_input", *scales])
    return source + f"@scalar_jit\ndef observe({signature}):\n    observe_lanes({arguments})\n"
