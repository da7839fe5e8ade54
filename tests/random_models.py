"""Models drawn at random: 1 to 5 states, 1 to 3 inputs, 1 to 3 sensors, and every function of the language."""

import numpy as np

from estimator.models.model import Model

#: Terms that hardly exceed their arguments, so that a state that decays stays near one.
_TERMS = (
    "sin({a})", "cos({a})", "exp(-({a})**2)", "log(1 + ({a})**2)", "sqrt(1 + ({a})**2)", "tanh({a})", "atan({a})",
    "abs({a})", "sign({a})", "min({a}, {b})", "max({a}, {b}, -0.1)", "where({a} < {b}, {a}, 0.5*({b}))",
    "bend*({a})/(1 + ({b})**2)", "({a})*cos(pi*({b}))",
)  # fmt: skip


def random_model(seed: int) -> tuple[Model, np.ndarray]:
    """A stable model, and the middle of its coefficients.

    Every state decays, is driven by an input and has noise. The terms of `_TERMS` come one after the other with the
    seed, so that any fourteen seeds have them all. Odd seeds are differential equations, held or interpolated by their
    `interpolation`.
    """
    rng = np.random.default_rng(seed)
    n_states, n_inputs, n_sensors = rng.integers(1, [6, 4, 4])
    continuous, between = bool(seed % 2), interpolation(seed)
    states = [f"x{i}" for i in range(n_states)]
    inputs = [f"u{i}" for i in range(n_inputs)]
    coefficients = {f"c{i}": rng.uniform(0.5, 0.8) for i in range(n_states)}

    def argument() -> str:
        state, other = rng.choice(states), rng.choice([*states, *inputs])
        return f"{rng.uniform(0.3, 1.0):.2f}*{state} - {rng.uniform(0.3, 1.0):.2f}*{other}"

    def drive(i: int) -> str:
        if continuous:
            parts = [f"{u} + 0.1*derivative({u})" if between == "linear" else u for u in inputs[i::n_states]]
        else:
            parts = [f"{u}[-{i % 3}]" if i % 3 else u for u in inputs[i::n_states]]
        return " + ".join(parts) or inputs[0]

    rows = []
    for i, state in enumerate(states):
        term = _TERMS[(seed + i) % len(_TERMS)].format(a=argument(), b=argument())
        gain = f"g{i}"
        coefficients[gain] = rng.uniform(0.1, 0.3)
        kept = f"-c{i}*{state}" if continuous else f"{state} - c{i}*{state}"
        rows.append(f"{kept} + {gain}*({term}) + 0.3*({drive(i)})")
    outputs = {"y0": "x0"}
    for i in range(1, n_sensors):
        outputs[f"y{i}"] = f"{states[i % n_states]} + 0.2*({_TERMS[(seed + i + 5) % len(_TERMS)]})".format(
            a=argument(), b=argument()
        )
    if rng.random() < 0.5:
        outputs["y0"] = f"x0 + 0.1*{inputs[-1]}"
    model = Model(
        name=f"random_{seed}",
        states=dict.fromkeys(states, "V"),
        inputs=dict.fromkeys(inputs, "V"),
        coefficients=dict.fromkeys(coefficients, "1"),
        constants={"bend": float(rng.uniform(0.5, 1.5))},
        noise=tuple(rng.choice(["1", "0.5", "sqrt(1 + x0**2)", "bend"], n_states).tolist()),
        outputs=outputs,
        independent_noise=bool(rng.random() < 0.3),
        substeps=int(rng.integers(1, 4)) if continuous else 1,
        **{"rates" if continuous else "next_state": tuple(rows)},
    )
    return model, np.array(list(coefficients.values()))


def interpolation(seed: int) -> str:
    """How the inputs of a random model go between samples."""
    return "linear" if seed % 4 == 3 else "zero_order"
