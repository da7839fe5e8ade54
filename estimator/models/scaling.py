"""Models in stated units and seconds, rewritten in numbers near one and in samples.

An expression of the rewritten model has ``size*name`` in place of each name. Sizes of states and coefficients are
powers of two, so that these products are exact, and the rewritten model computes the numbers of the model in its own
units, but for overflow.
"""

from __future__ import annotations

import ast
import math
from collections.abc import Mapping
from dataclasses import replace

from estimator.models.expression import input_derivative, replace_names
from estimator.models.model import Model
from estimator.support.argument_checks import check_mapping, check_number

#: Samples in which a state changes by its size, for the size of its rate.
_SAMPLES_PER_SIZE = 8.0


def power_of_two(size: float) -> float:
    """The power of two nearest to a positive size, in ratio."""
    return 2.0 ** round(math.log2(size))


def state_sizes(
    model: Model, step: float, channel_sizes: Mapping[str, float], given: Mapping[str, float] | None = None
) -> dict[str, float]:
    """Sizes of the states, as powers of two.

    A state that a sensor shows has the sensor's size, and so have other states in its unit. The unit ``m/s`` of a state
    in ``m`` has an eighth of that state's size per sample, and ``m/s²`` an eighth of that. A state in the unit of an
    input has the input's size; any other state has the size 1.

    Args:
        model: the model, with time in seconds or samples.
        step: sampling step [s].
        channel_sizes: input or sensor to the size of its numbers, in its unit; some of them.
        given: state to its size, in its unit, instead.

    Raises:
        ValueError: for an unknown state, or a size that is not positive.
    """
    check_mapping("sizes", given or {})
    for state, size in (given or {}).items():
        if state not in model.states:
            raise ValueError(f"sizes must be of {list(model.states)}, but one is of {state!r}; leave it out")
        check_number(f"sizes[{state!r}]", size, 1e-30, 1e30)
    rate = 1 / (_SAMPLES_PER_SIZE * (step if model.time == "s" else 1.0))
    shown = {text.strip(): channel_sizes[y] for y, text in model.outputs.items() if y in channel_sizes}
    shown |= given or {}
    of_unit = {unit: channel_sizes[i] for i, unit in model.inputs.items() if unit and i in channel_sizes}
    for state, size in shown.items():
        unit = model.states.get(state, "")
        for k, suffix in enumerate(("", "/s", "/s²")):
            of_unit[f"{unit}{suffix}"] = size * rate**k
    found = {state: shown.get(state, of_unit.get(_plain(unit), 1.0)) for state, unit in model.states.items()}
    return {state: power_of_two(size) for state, size in found.items()}


def _plain(unit: str) -> str:
    """A unit with the usual spelling of squares."""
    return unit.replace("/s**2", "/s²").replace("/s^2", "/s²").replace("/s2", "/s²")


def scale_model(model: Model, step: float, sizes: Mapping[str, float]) -> Model:
    """The model in numbers near one, with time in samples.

    Its parameters (`Model.physical`) are the model's, or the coefficients where it has none, in the stated units.
    The strength of its process noise is in parts of the first sensor's size.

    Args:
        model: the model, with time in seconds or samples.
        step: sampling step [s].
        sizes: state, coefficient, input or sensor to its size, the number that becomes 1; 1 for the others.

    Raises:
        ValueError: for a step that is no positive number.
    """
    check_number("step", step, 1e-30, 1e30, "give the seconds between samples")
    seconds = float(step) if model.time == "s" else 1.0
    factors = {name: sizes.get(name, 1.0) for name in (*model.names, *model.inputs)}
    factors |= {written: factors[name] for written, (name, _) in model.input_ages.items()}
    factors |= {input_derivative(name): factors[name] / seconds for name in model.inputs}
    strength = sizes.get(next(iter(model.outputs)), 1.0) * (seconds if model.held else math.sqrt(seconds))

    def scaled(text: str, factor: float) -> str:
        """An expression of scaled quantities, times a factor."""
        replacements: dict[str, ast.expr] = {
            name: ast.BinOp(ast.Constant(size), ast.Mult(), ast.parse(name, mode="eval").body)
            for name, size in factors.items()
            if size != 1
        }
        found = replace_names(text, replacements, model.name)
        return found if factor == 1 else f"{factor!r}*({found})"

    updates = tuple(
        scaled(text, (seconds if model.is_continuous else 1.0) / factors[state])
        for state, text in zip(model.states, model.update_expressions, strict=True)
    )
    noise = tuple(scaled(text, strength / factors[x]) for x, text in zip(model.states, model.noise, strict=True))
    physical = model.physical or {name: name for name in model.coefficients}
    inverse = model.inverse or physical
    return replace(
        model,
        time="sample",
        rates=updates if model.is_continuous else (),
        next_state=() if model.is_continuous else updates,
        noise=noise,
        outputs={y: scaled(text, 1 / sizes.get(y, 1.0)) for y, text in model.outputs.items()},
        physical={name: scaled(text, 1.0) for name, text in physical.items()},
        dimensions=model.dimensions or dict(model.coefficients),
        inverse={c: text if factors[c] == 1 else f"{1 / factors[c]!r}*({text})" for c, text in inverse.items()},
    )
