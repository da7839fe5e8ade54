"""Checks of a rig's channels: its inputs, one or by name, and its output."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from estimator.rigs.channel import Channel
from estimator.rigs.units import sensor_kind_of_unit
from estimator.support.argument_checks import check_choice, did_you_mean, short_repr

#: Interpolations that allow an input with a lag.
_LAG_INTERPOLATIONS = ("zero_order", "linear")


def checked_inputs(given: object, interpolation: str) -> Channel | dict[str, Channel]:
    """The input channel, or the channels by the names of inputs, from channels or tables of their values.

    Raises:
        ValueError: naming the channel and the fault.
    """
    if not has_named_channels(given):
        return _checked_input(given, "input", interpolation)
    assert isinstance(given, Mapping)
    for name in given:
        if not isinstance(name, str) or not name.isidentifier():
            raise ValueError(f"input must have names of a model's inputs, but has {short_repr(name)}; rename it")
    return {name: _checked_input(one, f"input.{name}", interpolation) for name, one in given.items()}


def has_named_channels(given: object) -> bool:
    """Whether a rig's input is a mapping of names to channels, or to tables of their values."""
    return isinstance(given, Mapping) and bool(given) and all(isinstance(v, Channel | Mapping) for v in given.values())


def checked_output(given: object) -> Channel:
    """The output channel, from a channel or a table of its values.

    Raises:
        ValueError: naming the channel and the fault.
    """
    output = _to_channel(given, "output", "range")
    if output.lag is not None:
        raise ValueError(f"output must have no lag, but has {output.lag}; a lag is of the input")
    if (kind := sensor_kind_of_unit(output.unit)) not in (None, output.kind):
        raise ValueError(f"output.kind must be {kind!r} with the unit {output.unit}, but is {output.kind!r}; mend one")
    return output


def _checked_input(given: object, label: str, interpolation: str) -> Channel:
    channel = _to_channel(given, label, "limit")
    if channel.lag is not None:
        check_choice("interpolation (for an input with a lag)", interpolation, _LAG_INTERPOLATIONS)
    if channel.kind != "displacement":
        raise ValueError(f"{label} must have no kind, but has {channel.kind!r}; kind is of the output")
    return channel


def _to_channel(given: object, label: str, right: str) -> Channel:
    """A channel whose bound has the right name, ``limit`` or ``range``."""
    other = "range" if right == "limit" else "limit"
    bound = given.get(other) if isinstance(given, Mapping) else getattr(given, other, None)
    if bound is not None:
        raise ValueError(f"{label} must have no {other}, but has {short_repr(bound)}; use {right}")
    if isinstance(given, Mapping):
        check_keys(Channel, given, label)
        try:
            return Channel(**given)
        except ValueError as error:  # its message begins with the name of a key
            key, _, rest = str(error).partition(" ")
            raise ValueError(
                f"{label}.{key} {rest.removeprefix('of an input ').removeprefix('of an output ')}"
            ) from error
    if not isinstance(given, Channel):
        raise ValueError(f"{label} must be a Channel, but is {given!r:.60}; use Channel('N', limit=20)")
    return given


def check_keys(cls: Any, mapping: object, label: str) -> None:
    """Refuse what is no dictionary of the fields of a class.

    Raises:
        ValueError: naming the key, and the nearest one.
    """
    if not isinstance(mapping, Mapping):
        raise ValueError(f"{label} must be a table of names and values, but is {mapping!r:.60}")
    known = [one.name for one in fields(cls)]
    for key in mapping:
        if key not in known:
            raise ValueError(f"{label} must have keys of {known}, but has {key!r:.60}{did_you_mean(key, known)}")
