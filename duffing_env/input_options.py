"""Options of the inputs: a number for all inputs, or one for each by its name or in the model's order."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from estimator.models.model import Model
from estimator.support.argument_checks import MAX_MAGNITUDE, check_number, short_repr
from estimator.support.array_types import FloatArray

#: A number for all inputs, or numbers by the names of the inputs or in their order.
ByInput = float | Mapping[str, float] | Sequence[float]


def check_has_inputs(model: Model) -> None:
    """Refuse a model without inputs, on which an agent would have nothing to choose.

    Raises:
        ValueError: naming the model.
    """
    if not model.inputs:
        raise ValueError(
            f"model must have an input for an environment, whose action it is, but {model.name!r} has none; name one "
            "in its inputs"
        )


def checked_by_input(
    name: str, value: object, model: Model, maximum: float = MAX_MAGNITUDE
) -> float | dict[str, float]:
    """An option of the inputs: the number for all, as it is given, or a number for each input by its name.

    Args:
        name: of the option.
        value: a positive number, a mapping of input to number, or a sequence of a number for each input.
        model: with the inputs.
        maximum: largest number.

    Raises:
        ValueError: naming the option, for another thing, an input that is missing or unknown, or a bad number.
    """
    inputs = list(model.inputs)
    if isinstance(value, Mapping):
        fits, numbers = set(value) == set(inputs), dict(value)
    elif isinstance(value, Sequence | np.ndarray) and not isinstance(value, str | bytes) and np.ndim(value) == 1:
        fits, numbers = len(value) == len(inputs), dict(zip(inputs, value, strict=False))
    else:
        check_number(name, value, maximum=maximum)
        return value  # type: ignore[return-value]
    if not fits:
        raise ValueError(
            f"{name} must be a number, or give one for each of the inputs {inputs}, but is {short_repr(value)}"
        )
    for one, number in numbers.items():
        check_number(f"{name} of {one}", number, maximum=maximum)
    return {one: float(numbers[one]) for one in inputs}


def numbers_by_input(value: float | Mapping[str, float] | None, model: Model, missing: float = np.inf) -> FloatArray:
    """(inputs,) numbers of a checked option, in the model's order; ``missing`` for None."""
    numbers = value if isinstance(value, Mapping) else dict.fromkeys(model.inputs, missing if value is None else value)
    return np.array([numbers[name] for name in model.inputs], dtype=np.float64)
