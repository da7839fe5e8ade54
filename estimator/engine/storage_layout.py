"""Layout of the engine's blocks: names of their rows, in order."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import combinations_with_replacement
from typing import NamedTuple

from estimator.compilation.simd import number_rows
from estimator.models.expression import names_in, parse
from estimator.models.model import MAX_INPUT_AGE, Model

#: Number of states from which the record likelihood is written as loops over packed arrays. With fewer, straight lines
#: compile in as little time and run faster (`benchmarks.compile_time`).
MIN_PACKED_STATES = 5


def upper_triangle_names(matrix: str, names: Iterable[str]) -> list[str]:
    """Names of the upper triangle of a symmetric matrix, row by row."""
    return [f"{matrix}_{i}_{j}" for i, j in combinations_with_replacement(names, 2)]


def belief_rows(model: Model) -> list[str]:
    """The flat record of a belief: means, upper triangle of the covariance, shape and rate of γ and of each ξ."""
    sensors = [f"XI_{part}_{y}" for y in model.outputs for part in ("SHAPE", "RATE")]
    return [*model.names, *upper_triangle_names("P", model.names), "GAMMA_SHAPE", "GAMMA_RATE", *sensors]


def first_input_row(layout: Mapping[str, int], model: Model) -> int:
    """Number of the first row of the inputs in a layout, which follow one another; 0 for a model without inputs."""
    return min((layout[input_row(i, 0)] for i in model.inputs), default=0)


class InputRow(NamedTuple):
    """A row of the inputs over a sample: an input at one time, or its difference between two times.

    Attributes:
        name: name of the row.
        channel: number of the input in the model's order.
        age: age of the value in the row [samples]; 0 is the newest.
        subtracted_age: age of the value that is subtracted; None for no difference.
    """

    name: str
    channel: int
    age: int
    subtracted_age: int | None = None


def input_row(name: str, k: int) -> str:
    """The row of an input's tap k, or of its coefficient of τ^k over a sample."""
    return f"U_{name}_{k}"


def stage_input(name: str, tag: str) -> str:
    """The name of an input's value at the stage ``A``, ``B`` or ``D`` of a Runge-Kutta step."""
    return f"U_AT_{name}_{tag}"


def stage_input_rate(name: str, tag: str) -> str:
    """The name of an input's time derivative at a stage of a Runge-Kutta step, per sample."""
    return f"U_RATE_AT_{name}_{tag}"


def stage_inputs(model: Model, tag: str) -> dict[str, str]:
    """Inputs and their derivatives in a differential equation, to their names at a stage of a Runge-Kutta step."""
    names = (stage_input, stage_input_rate)
    return {written: names[order](name, tag) for written, (name, order) in model.acting_inputs.items()}


def input_history_row(name: str, age: int) -> str:
    """The row of an input's value of an age, 0 to 2 samples, where a block keeps the last values themselves."""
    return f"{('INPUT', 'LAST_INPUT', 'OLDER_INPUT')[age]}_{name}"


def input_rows(model: Model, degree: int) -> list[str]:
    """The inputs over a sample, one after the other: taps of a difference equation, or coefficients of a polynomial.

    The polynomial is in τ, and its coefficient of τ⁰ comes first.
    """
    return [
        input_row(name, k)
        for name, taps in model.taps.items()
        for k in range(degree + 1 if model.is_continuous else taps)
    ]


def known_inputs(model: Model, degree: int, lag: int = 0) -> list[InputRow]:
    """Which values of an input enter which row of `input_rows`, for all code that feeds a model sample by sample.

    Args:
        model: the equation.
        degree: degree of the input's polynomial over a sample of a differential equation: 0 is held at the newest
            value, 1 goes linearly from the last value to the newest.
        lag: age of the newest value that acts in a difference equation [samples]: 1 where it takes the last of inputs
            that go linearly from one value to the next. Values older than `MAX_INPUT_AGE` count as of that age.

    Raises:
        ValueError: for another degree: the polynomial then needs more values than these.
    """
    if degree not in (0, 1):
        raise ValueError(f"degree must be 0 or 1, but is {degree}; a spline needs the whole record")
    found = []
    for channel, (name, taps) in enumerate(model.taps.items()):
        if not model.is_continuous:
            found += [InputRow(input_row(name, k), channel, min(k + lag, MAX_INPUT_AGE)) for k in range(taps)]
        elif degree == 0:
            found.append(InputRow(input_row(name, 0), channel, 0))
        else:
            found += [InputRow(input_row(name, 0), channel, 1), InputRow(input_row(name, 1), channel, 0, 1)]
    return found


def n_older_inputs(model: Model, degree: int, lag: int = 0) -> dict[str, int]:
    """Number of each input's values before the newest one that `known_inputs` has."""
    oldest = [0] * model.n_inputs
    for row in known_inputs(model, degree, lag):
        oldest[row.channel] = max(oldest[row.channel], row.age, row.subtracted_age or 0)
    return dict(zip(model.inputs, oldest, strict=True))


def held_noise_rows(model: Model) -> list[list[str]]:
    """Rows of the state's derivative with respect to each held noise, by source and state."""
    tags = [f"_{source}" for source in model.noise_sources] if model.independent_noise else [""]
    return [[f"NOISE_INPUT{tag}_{i}" for i in model.states] for tag in tags] if model.held else []


def noise_ratio_rows(model: Model) -> list[str]:
    """Rows of the ratio of each source's variance to the declared one; none where one source drives all states."""
    return [f"VARIANCE_RATIO_{source}" for source in model.noise_sources]


def integrator_rows(model: Model) -> list[str]:
    """The integrator's quantities in a differential equation: M, F and Q, or NOISE_INPUT where the noise is held.

    Empty for a difference equation.
    """
    if not model.is_continuous:
        return []
    names = [f"M_{i}" for i in model.states] + [f"F_{i}_{j}" for i in model.states for j in model.dynamic_names]
    held = [row for rows in held_noise_rows(model) for row in rows]
    noise = held if model.held else upper_triangle_names("Q", model.states)
    return names + noise


def update_layout(model: Model, degree: int) -> dict[str, int]:
    """Rows of an estimator's block: the belief, the sample, and the integrator."""
    outputs = [f"Y_{y}" for y in model.outputs]
    return number_rows(*belief_rows(model), *input_rows(model, degree), *outputs, *integrator_rows(model))


def cubature_order(model: Model) -> list[str]:
    """States and coefficients in the order of the rows of the covariance's factor L: movers first."""
    return [*model.dynamic_names, *(name for name in model.names if name not in model.dynamic_names)]


def cubature_rows(model: Model) -> list[str]:
    """Rows of the sigma points (`estimator.engine.cubature`)."""
    columns, movers = range(len(model.dynamic_names)), model.dynamic_names
    images = [f"IMAGE_{p}_{i}" for p in range(2 * len(columns)) for i in model.states]
    at_point = [f"POINT_{i}" for i in movers if i not in model.states]
    factor = [f"L_{c}_{i}" for c in columns for i in cubature_order(model)]
    return [*factor, *(f"WEIGHT_{c}" for c in columns), *at_point, *images, "INDEFINITE_COUNT"]


def trace_rows(model: Model, iterations: int) -> list[str]:
    """Rows of the belief update with the terms of the free energy, per sensor."""
    names = []
    for k in range(model.n_outputs):
        names += [f"TRACE_{k}_{what}" for what in ("mean", "innovation", "variance", "shown")]
        names += [f"TRACE_{k}_{what}_{i}" for i in range(iterations) for what in ("q", "r")]
    return names


def linearised_filter_rows(model: Model) -> list[str]:
    """State of the linearised filter: mean, covariance P, and sensitivities DX to the coefficients."""
    sensitivities = [f"DX_{i}_{c}" for i in model.states for c in model.coefficients]
    return [*model.states, *upper_triangle_names("P", model.states), *sensitivities]


def likelihood_total_rows(model: Model) -> list[str]:
    """Totals of the linearised filter: minus the log likelihood, its gradient, the Fisher information, and Σ ν²/S."""
    return [
        "LOSS",
        *(f"GRADIENT_{c}" for c in model.coefficients),
        *upper_triangle_names("INFORMATION", model.coefficients),
        "NIS",
    ]


def linearised_filter_layout(
    model: Model, degree: int, follows_outputs: bool, variable_step: bool = False, noise_ratios: bool = False
) -> dict[str, int]:
    """Rows of the linearised filter's block; ``SAMPLE_LENGTH`` is the length of a sample, if it varies.

    With ``noise_ratios``, `noise_ratio_rows` follow the noise variances.
    """
    seen = [f"{what}_{y}" for what in ("Y", "Y_PRED", "HPH") for y in model.outputs]
    shown = seen if follows_outputs else [*(f"Y_PRED_{y}" for y in model.outputs), "S_PRED"]
    given = [
        *model.coefficients,
        *input_rows(model, degree),
        *shown,
        "IS_COUNTED",
        "PROCESS_VARIANCE",
        *(f"R_{y}" for y in model.outputs),
        *(noise_ratio_rows(model) if noise_ratios else ()),
    ]
    given += ["SAMPLE_LENGTH"] if variable_step else []
    return number_rows(*linearised_filter_rows(model), *likelihood_total_rows(model), *given, *integrator_rows(model))


def is_packed(model: Model) -> bool:
    """Whether a model's linearised filter is written as loops over packed arrays (`estimator.engine.packed_filter`)."""
    return model.n_states >= MIN_PACKED_STATES


def slope_entries(model: Model) -> list[tuple[str, str]]:
    """Entries (state, quantity) of the Jacobian of the rates or next states that may differ from 0."""
    used = [names_in(parse(text, model.name)) for text in model.update_expressions]
    return [(i, j) for i, names in zip(model.states, used, strict=True) for j in model.dynamic_names if j in names]


def packed_rows(model: Model) -> list[str]:
    """Rows between the steps of a packed filter, matrix after matrix, each row by row.

    ===================  ==============================================================================
    ``RATE_i``           rate of state i at a stage; ``STATE_END_i`` the state at the end of the step
    ``EFFECT_s_i``       effect of the process noise on state i at stage s
    ``SLOPE_s_i_j``      Jacobian of the rates at stage s: the entries that may differ from 0
    ``END_BY_i_j``       derivative of the step's end by quantity j; ``IDENTITY_i_k`` the unit matrix
    ``F_i_j``            F, here for a difference equation only
    ``COV_i_k``          the covariance, square, or the process noise's at a stage
    ``PRODUCT_i_k``      a Jacobian times it
    ``NOISE_i_k``        Q, its upper triangle; ``NOISE_END_i_k`` at the end of the step
    ``MEAN_i``           mean of state i; ``CROSS_COV_i`` its covariance with a sensor's output
    ``OUTPUT_BY_c``      derivative of a sensor's output by coefficient c
    ===================  ==============================================================================
    """
    states, movers, n_stages = list(model.states), list(model.dynamic_names), 4

    def square(letter: str, columns: Iterable[str] = states) -> list[str]:
        return [f"{letter}_{i}_{j}" for i in states for j in list(columns)]

    def by_stage(letter: str, names: Iterable[str]) -> list[str]:
        return [f"{letter}_{s}_{name}" for s in range(n_stages) for name in list(names)]

    rows = [] if model.is_continuous else square("F", movers)
    if model.is_continuous:
        rows += [f"RATE_{i}" for i in states] + [f"STATE_END_{i}" for i in states]
        rows += by_stage("SLOPE", [f"{i}_{j}" for i, j in slope_entries(model)]) + by_stage("EFFECT", states)
        rows += square("IDENTITY") + square("END_BY", movers)
        rows += [f"HELD_END{r}_{i}" for r in range(len(held_noise_rows(model))) for i in states]
        rows += square("NOISE_END")
    rows += square("COV") + square("PRODUCT") + square("NOISE")
    rows += [f"{letter}_{i}" for letter in ("MEAN", "CROSS_COV") for i in states]
    rows += [f"OUTPUT_BY_{c}" for c in model.coefficients]
    return [*rows, "S_INVERSE", "S_INVERSE_COUNTED", "INNOVATION", *(f"OUTPUT_SLOPE_{i}" for i in model.names)]
