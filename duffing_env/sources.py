"""What the engine generates for an environment: plant, judgement, reward and observation of any model, across lanes."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from itertools import combinations
from typing import Any

from duffing_env.layout import Kind, estimated, inputs_of, layout_of, noise_rows, observation_bounds, parameter_names
from duffing_env.rewards import REWARDS
from estimator.engine import cache as stored
from estimator.engine.rows import belief_names
from estimator.engine.tasks import NAMES
from estimator.lanes import LANES, source_digest, sources_of
from estimator.models.model import Model
from estimator.straight import straight


@straight
def capped(ratio):
    """Relative error of an estimate, at most 1, from its ratio to the truth."""
    deviation = abs(ratio - 1.0)
    return deviation if deviation < 1.0 else 1.0


_NAMES = {**NAMES, "capped": capped}

#: Bounds of a determinant that has a logarithm: below, numbers lose digits.
_SMALLEST, _LARGEST = 2.0**-1000, 2.0**1000


@cache
def parts(kind: Kind) -> Any:
    """The compiled functions of a kind of experiment: see `_source` for their names."""
    digests = (kind.belief.digest, kind.plant and kind.plant.digest)
    key = source_digest(sources_of(__file__)) + repr((kind[2:], digests))
    return stored.load(kind.belief.name, "environment", key, lambda: _source(kind), _NAMES)


def _source(kind: Kind) -> str:
    """All functions; each says what it does."""
    from estimator.engine.emit import lane_loop

    place = layout_of(kind)

    def loop(name: str, doc: str, lines: Any, results: Mapping[str, str], *uniform: str, one: bool = False) -> str:
        return lane_loop(name, lines, results, place, LANES, uniform, doc=doc, one=one)

    def plant_loop(name: str, doc: str, lines: Any, results: Mapping[str, str], *uniform: str) -> str:
        noises = {name: place[row] for name, row in noise_rows(kind.truth).items()}
        within = {**place, **inputs_of(kind, kind.truth, place), **noises}
        return lane_loop(name, lines, results, within, LANES, uniform, doc=doc)

    source = _truth(kind, loop) + _judgement(kind, loop) + _observation(kind)
    if kind.plant is not None:
        source += _plant(kind.plant, kind.degree, plant_loop)
    source += _walk(kind.belief, loop)
    return source + (REWARDS[kind.work].work.source(kind, loop) if kind.work else "")


def _walk(model: Model, loop: Any) -> str:
    """``walk(W, variances)``: let the coefficients walk at random before a sample."""
    from estimator.engine.derive import symbol

    names = list(model.coefficients)
    lines = [(f"V_{c}", symbol(f"P_{c}_{c}") + symbol(f"WALK_{c}")) for c in names]
    results = {f"P_{c}_{c}": f"V_{c}" for c in names}
    source = loop("walk_lanes", "The coefficients walk.", lines, results, *(f"WALK_{c}" for c in names))
    told = ", ".join(f"variances[{i}]" for i in range(len(names)))
    return source + f"@straight\ndef walk(W, variances):\n    walk_lanes(W, {told})\n"


def _plant(model: Model, degree: int, loop: Any) -> str:
    """``plant``: the plant over a sample with its noise, or over a Runge-Kutta step of it; and its sensors.

    A difference equation shows its first sensor as well; other sensors are ``sense_<k>``.
    """
    from estimator.engine import derive

    names = {**{x: f"X_{x}" for x in model.states}, **{c: f"TRUE_{c}" for c in model.coefficients}}
    lines, results = derive.state_step(model, degree, names)
    found, symbol = derive.calculus(model), derive.symbol
    noises = list(noise_rows(model))
    strength, w, v = symbol(noises[0]), symbol("NOISE_w"), symbol("NOISE_v")
    after: dict[str, Any] = {}
    for a, x in enumerate(model.states):
        kick = strength * found.noise[a] * w
        if model.is_continuous:
            # The increment of the noise over a step of length h, and where it reaches a state only through others, its
            # integral; of white noise the two are drawn jointly.
            h = symbol("length")
            through = sum(found.by[a][k] * strength * found.noise[k] for k in range(model.n_states))
            direct, integral = h * w, h * h / 2 * w
            if not model.held:
                direct, integral = symbol("root") * w, h * symbol("root") / 2 * (w + v / symbol("root_3"))
            kick = strength * found.noise[a] * direct if found.noise[a] != 0 else through * integral
        kick = derive.renamed([("", kick)], names)[0][1]
        lines.append((f"K_{x}", symbol(results[names[x]]) + kick))
        after[x] = symbol(f"K_{x}")
    results = {names[x]: f"K_{x}" for x in model.states}
    end = derive.input_at_end(model, degree)
    source = ""
    for k, (y, shown) in enumerate(zip(model.outputs, found.outputs, strict=True)):
        noise = (v, w)[k % 2] * symbol(noises[1 + k])
        now = names if model.is_continuous or k else {**names, **after}
        value = derive.renamed([("", shown)], {**now, "u": end})[0][1] + noise
        if model.is_continuous or k:
            source += loop(f"sense_{k}", "A sensor.", [("SHOWN", value)], {f"Y_{y}": "SHOWN"})
        else:
            lines.append(("SHOWN", value))
            results |= {f"Y_{y}": "SHOWN"}
    told = ("T", "length", "root", "root_3") if model.is_continuous else ()
    return source + loop("plant", "The plant moves.", lines, results, *told)


def _truth(kind: Kind, loop: Any) -> str:
    """``settle_truth(W, j, step)``: the coefficients of lane j's plant, in the equations of plant and belief.

    And what estimates are multiplied by to be compared with its parameters: every sample would divide otherwise.
    """
    from estimator.engine import derive

    known = {p: derive.symbol(p) for p in parameter_names(kind.truth)}
    lines, results = [], {}
    # Each equation on its own: a plant's coefficients must not depend on what else is believed, to the last bit.
    for tag, model in zip("WX", {kind.truth: None, kind.belief: None}, strict=False):
        own = {}
        for c in model.coefficients:
            text = model.inverse[c] if model.inverse else c
            value = derive.parse(text, {**known, "step": derive.symbol("step")}, model.name)
            own[f"V_{c}"] = derive.renamed([("", value)], {p: f"PARAM_{p}" for p in known})[0][1]
            results[f"TRUE_{c}"] = f"V_{c}"
        lines += derive.shared(own, tag)
    for p in estimated(kind.belief):
        lines.append((f"V_PER_{p}", 1 / derive.symbol(f"PARAM_{p}")))
        results[f"PER_{p}"] = f"V_PER_{p}"
    return loop("settle_truth", "The true coefficients, of the parameters.", lines, results, "step", one=True)


def log_det_and_density(
    model: Model, at: Mapping[str, Any] | None = None, entries: Mapping[str, Any] | None = None, tag: str = "L"
) -> tuple[Any, Any, Any, Any]:
    """Assignments of an L D Lᵀ factorisation of the coefficients' covariance.

    Args:
        model: whose coefficients.
        at: coefficient to the deviation at which the density is asked for; None for none.
        entries: ``P_i_j`` to what stands in its place.
        tag: of the names that are assigned.

    Returns:
        The assignments, and in symbols the determinant, the squared deviation in units of the covariance, and 1 where
        all pivots are positive and the determinant has a logarithm.
    """
    import sympy as sp

    from estimator.engine.derive import pair, symbol
    from estimator.engine.factor import factorise

    names = list(model.coefficients)
    of = lambda i, k: pair("P", names[k], names[i], model.names)  # noqa: E731
    believed = {(i, k): of(i, k) for i in range(len(names)) for k in range(i + 1)}
    found = factorise({place: (entries or {}).get(str(e), e) for place, e in believed.items()}, len(names), tag)
    lines, square = [*found.lines], sp.S.Zero
    whitened: list[Any] = []
    for i, name in enumerate(names if at else ()):
        assert at is not None
        lines.append((f"{tag}Z_{i}", at[name] - sum(found.below[i, m] * whitened[m] for m in range(i))))
        whitened.append(symbol(f"{tag}Z_{i}"))
        square += whitened[i] ** 2 * found.inverse[i]
    determinant = symbol(f"{tag}DET")
    lines.append((f"{tag}DET", found.determinant))
    check = sp.Function("positive")
    sound = sp.Mul(*(check(p) for p in found.pivots))
    sound *= check(determinant - sp.Float(_SMALLEST)) * check(sp.Float(_LARGEST) - determinant)
    return lines, determinant, square, sound


def _standing(kind: Kind) -> tuple[Any, Any]:
    """Assignments of ``NEW_LOG_DET``, ``NEW_LOG_DENSITY`` and ``NEW_ERROR`` beside the truth; and soundness."""
    import sympy as sp

    from estimator.engine import derive

    symbol, model = derive.symbol, kind.belief
    deviations = {c: symbol(f"TRUE_{c}") - symbol(c) for c in model.coefficients}
    lines, determinant, square, sound = log_det_and_density(model, deviations)
    lines.append(("NEW_LOG_DET", sp.Function("log")(determinant)))
    lines.append(("NEW_LOG_DENSITY", -(symbol("NEW_LOG_DET") + square) / 2))
    known = {c: symbol(c) for c in model.coefficients} | {"step": symbol("step")}
    error = sp.Function("capped")
    ratios = {
        f"RATIO_{p}": derive.parse(text, known, model.name) * symbol(f"PER_{p}") for p, text in estimated(model).items()
    }
    lines += derive.shared(ratios, "RW")
    lines.append(("NEW_ERROR", sum(error(symbol(r)) for r in ratios) / len(ratios)))
    return lines, sound


def _judgement(kind: Kind, loop: Any) -> str:
    """``appraise(W, j, step)`` for a new belief or truth, and ``settle(W, ...)``, what a step gave and what it ends."""
    import sympy as sp

    from estimator.engine.derive import symbol

    model = kind.belief
    lines, sound = _standing(kind)
    kept = {name: f"NEW_{name}" for name in ("LOG_DET", "LOG_DENSITY", "ERROR")}
    source = loop("appraise", "Measure lane j's belief beside its truth.", lines, kept, "step", one=True)
    select, check, is_finite = (sp.Function(name) for name in ("select", "positive", "finite"))
    variances = {f"P_{name}_{name}" for name in model.names}
    every = [name for name in belief_names(model) if not name.startswith("P_") or name in variances]
    every += [f"X_{x}" for x in kind.truth.states] + [f"Y_{y}" for y in model.outputs]
    total = sum((symbol(name) for name in every), symbol("NEW_LOG_DENSITY") + symbol("NEW_ERROR") + symbol("WORK"))
    spreads = [symbol(f"P_{x}_{x}") for x in model.states] if kind.factorisation == "structured" else []
    lines.append(("TOTAL", total))
    good = sound * is_finite(symbol("TOTAL")) * sp.Mul(*(check(s + sp.Float(1e-300)) for s in spreads))
    good *= sp.Mul(*(check(symbol(name)) for name in belief_names(model)[-2 - 2 * model.n_outputs :]))
    off = symbol("OFF_RECORD")
    lines += [("SOUND", good), ("BROKEN", 1 - symbol("SOUND")), ("VOID", symbol("BROKEN") + off)]
    for name in ("LOG_DET", "LOG_DENSITY", "ERROR"):
        lines.append((f"E_{name}", select(symbol("VOID"), symbol(name), symbol(f"NEW_{name}"))))
    lines.append(("E_WORK", select(symbol("VOID"), sp.S.Zero, symbol("WORK"))))
    lines.append(("GAIN", (symbol("LOG_DET") - symbol("E_LOG_DET")) / 2))
    lines.append(("POSTERIOR", symbol("E_LOG_DENSITY") - symbol("LOG_DENSITY")))
    weighed = ("w_gain", "w_posterior", "w_error", "w_work")
    given = (symbol("GAIN"), symbol("POSTERIOR"), symbol("ERROR") - symbol("E_ERROR"), symbol("E_WORK"))
    paid = sum(symbol(weight) * value for weight, value in zip(weighed, given, strict=True))
    # In two lines, because SymPy squares the factors, and the input's square alone may overflow.
    lines.append(("EFFORT", symbol("input_price") * symbol("INPUT")))
    paid -= symbol("EFFORT") ** 2
    first = next(iter(model.outputs))
    beyond = check(symbol("VOID")) + check(sp.Abs(symbol(f"Y_{first}")) - symbol("max_output"))
    ended = sp.Function("reaches")(symbol("LATER"), symbol("horizon"))
    lines += [("PAID", paid), ("STOPPED", check(beyond)), ("LATER", symbol("ELAPSED") + 1)]
    lines.append(("OVER", (1 - symbol("STOPPED")) * ended))
    results = {"LOG_DET": "E_LOG_DET", "LOG_DENSITY": "E_LOG_DENSITY", "ERROR": "E_ERROR", "REWARD": "PAID"}
    results |= {"INFORMATION_GAIN": "GAIN", "LOG_POSTERIOR_GAIN": "POSTERIOR", "TERMINATED": "STOPPED"}
    results |= {"TRUNCATED": "OVER", "DIVERGED": "BROKEN", "ELAPSED": "LATER"}
    uniform = ("step", "max_output", "horizon", "input_price", *weighed)
    doc = "What a sample gave, and whether it ends the episode; a belief that is broken gives nothing and ends it."
    return source + loop("settle", doc, lines, results, *uniform)


def _observation(kind: Kind) -> str:
    """``observe(W, B, ...)``: the observation into the rows of a block ``B``; its prior is told entry by entry."""
    import sympy as sp

    from estimator.engine.derive import pair, symbol
    from estimator.engine.emit import lane_loop

    model = kind.belief
    coefficients, order = list(model.coefficients), list(model.names)
    log = sp.Function("log")
    values: dict[str, Any] = {}
    lines: Any = [(f"I_STD_{c}", 1 / sp.sqrt(symbol(f"P_{c}_{c}"))) for c in coefficients]
    for c in coefficients:
        values[f"mean_{c}"] = (symbol(c) - symbol(f"PRIOR_{c}")) * symbol(f"SCALE_{c}")
    for c in coefficients:
        values[f"log_std_{c}"] = log(symbol(f"P_{c}_{c}") * symbol(f"SCALE_{c}") ** 2) / 2
    for c, d in combinations(coefficients, 2):
        values[f"corr_{c}_{d}"] = pair("P", c, d, order) * symbol(f"I_STD_{c}") * symbol(f"I_STD_{d}")
    values["log_gamma"] = log(symbol("GAMMA_SHAPE") / symbol("GAMMA_RATE")) - symbol("LOG_gamma")
    for y in model.outputs:
        values[f"log_xi_{y}"] = log(symbol(f"XI_SHAPE_{y}") / symbol(f"XI_RATE_{y}")) - symbol(f"LOG_xi_{y}")
    for x in model.states:
        values[f"state_{x}"] = symbol(x) * symbol("per_output")
    values["last_input"] = symbol("INPUT") * symbol("per_input")
    for y in model.outputs:
        values[f"last_{y}"] = symbol(f"Y_{y}") * symbol("per_output")
    # Of what does not change from lane to lane one division is enough; both are exactly 0 at the end.
    values["time_left"] = (symbol("horizon") - symbol("ELAPSED")) * symbol("per_horizon")
    values["budget_left"] = 1 - symbol("SPENT") / symbol("budget")
    clip = sp.Function("clip")
    bounds = observation_bounds(model)
    for name, value in values.items():
        low, high = (sp.Float(bound) for bound in bounds[name])
        lines += [(f"B_{name}", value), (f"V_{name}", clip(symbol(f"B_{name}"), low, high))]
    uniform = [f"{letter}_{c}" for letter in ("PRIOR", "SCALE") for c in coefficients]
    uniform += ["LOG_gamma", *(f"LOG_xi_{y}" for y in model.outputs)]
    scales = ["per_output", "per_input", "horizon", "per_horizon", "budget"]
    rows = {f"OBS_{name}": row for row, name in enumerate(values)}
    source = lane_loop(
        "observe_lanes", lines, {f"OBS_{name}": f"V_{name}" for name in values}, layout_of(kind), LANES,
        (*uniform, *scales), doc="The observation, in rows.", beside=rows,
    )  # fmt: skip
    n, k = model.n_states, model.n_coefficients
    told = [*(f"prior[{n + i}]" for i in range(k)), *(f"inverse_std[{i}]" for i in range(k))]
    told += [f"log_precisions[{i}]" for i in range(1 + model.n_outputs)]
    arguments = ", ".join(["W", "B", *told, *scales])
    signature = ", ".join(["W", "B", "prior", "inverse_std", "log_precisions", *scales])
    return source + f"@straight\ndef observe({signature}):\n    observe_lanes({arguments})\n"
