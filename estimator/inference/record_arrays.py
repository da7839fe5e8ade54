"""Inputs and outputs of records as arrays with a last axis for the channels; one channel may omit it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from estimator.models.model import Model
from estimator.support.argument_checks import to_finite_series, to_float_array, to_scalar
from estimator.support.array_types import FloatArray


def inputs_by_channel(model: Model, u: npt.ArrayLike) -> FloatArray:
    """Inputs (T, inputs) or (n, T, inputs); one input omits the last axis.

    A model without inputs takes (T, 0) or (n, T, 0), which have the length of the record.

    Raises:
        ValueError: for another shape, or anything but numbers.
    """
    inputs = to_float_array("u", u)
    if model.n_inputs == 1:
        if inputs.ndim not in (1, 2):
            raise ValueError(f"u must have shape (T,) or (n, T), but has {inputs.shape}")
        return inputs[..., None]
    if inputs.ndim not in (2, 3) or inputs.shape[-1] != model.n_inputs:
        shapes = f"(T, {model.n_inputs}) or (n, T, {model.n_inputs})"
        raise ValueError(
            f"u must have shape {shapes}, with a last axis for the inputs {list(model.inputs)}, but has {inputs.shape}"
        )
    return inputs


def outputs_by_sensor(model: Model, inputs: FloatArray, y: npt.ArrayLike) -> FloatArray:
    """Outputs (..., T, p) paired with inputs (..., T, inputs); one sensor may omit the last axis.

    Raises:
        ValueError: for another shape.
    """
    outputs, samples = to_float_array("y", y), inputs.shape[:-1]
    if model.n_outputs == 1 and outputs.shape == samples:
        outputs = outputs[..., None]
    if outputs.shape != (*samples, model.n_outputs):
        raise ValueError(
            f"u and y must have one shape, (T,) or (n, T), and y a last axis for several sensors, but have "
            f"{samples} and {outputs.shape}; transpose or cut one"
        )
    return outputs


def finite_channels(
    name: str, values: npt.ArrayLike | None, channels: int, what: str, allow_nan: bool = False
) -> FloatArray:
    """A finite record (T, channels), copied; one channel omits the last axis.

    Args:
        name: of the argument, for messages.
        values: (T,) of one channel, else (T, channels).
        channels: number of them.
        what: of which there is a column each, for messages.
        allow_nan: whether it may hold NaN.

    Raises:
        ValueError: for nothing, another shape, or numbers that are not finite.
    """
    if values is None:
        raise ValueError(f"{name} must be given for {channels} channels, but is None; pass an array")
    if channels == 1:
        return to_finite_series(name, values, allow_nan)[:, None]
    shape = np.shape(values)
    if len(shape) != 2 or shape[1] != channels:
        raise ValueError(f"{name} must have shape (T, {channels}), a column for each {what}, but has {shape}")
    flat = np.ma.reshape(values, -1) if isinstance(values, np.ma.MaskedArray) else np.reshape(values, -1)
    return to_finite_series(name, flat, allow_nan).reshape(shape)


def sample_of_channels(name: str, value: npt.ArrayLike | None, channels: int) -> FloatArray:
    """One sample as a finite record of one: (1,) of one channel, else (1, channels).

    Raises:
        ValueError: for another shape, or numbers that are not finite.
    """
    if value is None:
        value = ()
    if channels == 1:
        return to_finite_series(name, [to_scalar(name, value)])
    return finite_channels(name, np.reshape(to_finite_series(name, value), (1, -1)), channels, "channel")
