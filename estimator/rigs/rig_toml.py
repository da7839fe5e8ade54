"""The file of a rig, for people: TOML with comments."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from estimator.rigs.rig import Channel, Rig

_EQUATION_COMMENT = "#   m x'' + c x' + a x + b x³ = u - u0 + w,   seen: {seen} + y0 + noise"
_SYMBOL_OF_KIND = {"displacement": "x", "velocity": "x'", "acceleration": "x''"}
_INTERPOLATION_COMMENT = (
    '# Of the input between samples: "zero_order": held, as by a converter; "linear"; "spline": smooth.'
)

_ACCELERATION_COMMENT = (
    "# y[k] is the acceleration just before the input goes from u[k-1] to u[k], where it is held (docs/own_data.md)."
)
_UNIT_COMMENT = '  # such as "N", "V", "mm" or "m/s"; "1" is a pure number'


def to_toml(rig: Rig, provenance: str = "") -> str:
    """The file of a rig, with comments; what is not known stands there as a comment to be filled in.

    Args:
        rig: the rig.
        provenance: where its numbers are from.
    """
    source, sink = rig.input, rig.output
    lines = [
        f"# A rig{provenance}. Read by: duffing-env identify, and Rig.from_file.",
        _EQUATION_COMMENT.format(seen=_SYMBOL_OF_KIND[sink.kind]),
        "",
        f"step = {float(rig.step)!r}  # s between samples",
        _INTERPOLATION_COMMENT,
        f"interpolation = {_quote(rig.interpolation)}",
        f"delay = {rig.delay:.12g}  # samples by which the input acts later",
        "",
        "[input]",
        f"unit = {_quote(source.unit)}{_UNIT_COMMENT if source.unit == '1' else ''}",
        *_column_lines(source),
        _value_or_placeholder("limit", source.limit, "never exceeded, in either direction"),
        *_optional_lines(
            "lag", source.lag, "s, time constant of a first-order lag between what is recorded and what acts"
        ),
        *_optional_lines("noise", source.noise, "standard deviation of what disturbs the force"),
        *_optional_lines("offset", source.offset or None, "u0, a first value"),
        "",
        "[output]",
        f"unit = {_quote(sink.unit)}{_UNIT_COMMENT if sink.unit == '1' else ''}",
        *_column_lines(sink),
        f"kind = {_quote(sink.kind)}  # displacement, velocity or acceleration",
        *([_ACCELERATION_COMMENT] if sink.kind == "acceleration" else []),
        _value_or_placeholder("range", sink.range, "an experiment stops outside of it, in either direction"),
        _value_or_placeholder("noise", sink.noise, "standard deviation of the sensor's noise, where you know it"),
        *_optional_lines("offset", sink.offset or None, "y0, a first value"),
        "",
        "# What you believe before any record: a low and a high end for each, which hold it with 90 %.",
        "# identify needs none of it.",
    ]
    units = {name: rig.scales.unit(rig.model.dimensions[name]) for name in "mcab"}
    if rig.guess is None:
        lines += ["# [guess]", *(f"# {name} = [low, high]  # {units[name]}" for name in units)]
    else:
        lines.append("[guess]")
        lines += [f"{name} = [{low!r}, {high!r}]  # {units[name]}" for name, (low, high) in rig.guess.items()]
    return "\n".join([*lines, ""])


def _column_lines(channel: Channel) -> list[str]:
    return [] if channel.column is None else [f"column = {_quote(channel.column)}  # in the records' files"]


def _value_or_placeholder(name: str, value: float | None, meaning: str) -> str:
    return f"# {name} = ...  # {meaning}" if value is None else f"{name} = {float(value)!r}  # {meaning}"


def _optional_lines(name: str, value: float | None, meaning: str) -> list[str]:
    return [] if value is None else [_value_or_placeholder(name, value, meaning)]


def _quote(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)
