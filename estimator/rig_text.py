"""The file of a rig, for people: TOML with comments."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from estimator.rig import Channel, Rig

_EQUATION = "#   m x'' + c x' + a x + b x³ = u - u0 + w,   seen: {seen} + y0 + noise"
_SEEN = {"displacement": "x", "velocity": "x'", "acceleration": "x''"}
_INTERPOLATION = '# Of the input between samples: "zero_order": held, as by a converter; "linear"; "spline": smooth.'

_SWITCHES = (
    "# y[k] is the acceleration just before the input goes from u[k-1] to u[k], where it is held (docs/own_data.md)."
)
_UNITS = '  # such as "N", "V", "mm" or "m/s"; "1" is a pure number'


def text_of(rig: Rig, told: str = "") -> str:
    """The file of a rig, with comments; what is not known stands there as a comment to be filled in.

    Args:
        rig: the rig.
        told: where its numbers are from.
    """
    source, sink = rig.input, rig.output
    lines = [
        f"# A rig{told}. Read by: duffing-env identify, and Rig.from_file.",
        _EQUATION.format(seen=_SEEN[sink.kind]),
        "",
        f"step = {float(rig.step)!r}  # s between samples",
        _INTERPOLATION,
        f"interpolation = {_quoted(rig.interpolation)}",
        f"delay = {rig.delay:.12g}  # samples by which the input acts later",
        "",
        "[input]",
        f"unit = {_quoted(source.unit)}{_UNITS if source.unit == '1' else ''}",
        *_column(source),
        _known("limit", source.limit, "never exceeded, in either direction"),
        *_given("lag", source.lag, "s, time constant of a first-order lag between what is recorded and what acts"),
        *_given("noise", source.noise, "standard deviation of what disturbs the force"),
        *_given("offset", source.offset or None, "u0, a first value"),
        "",
        "[output]",
        f"unit = {_quoted(sink.unit)}{_UNITS if sink.unit == '1' else ''}",
        *_column(sink),
        f"kind = {_quoted(sink.kind)}  # displacement, velocity or acceleration",
        *([_SWITCHES] if sink.kind == "acceleration" else []),
        _known("range", sink.range, "an experiment stops outside of it, in either direction"),
        _known("noise", sink.noise, "standard deviation of the sensor's noise, where you know it"),
        *_given("offset", sink.offset or None, "y0, a first value"),
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


def _column(channel: Channel) -> list[str]:
    return [] if channel.column is None else [f"column = {_quoted(channel.column)}  # in the records' files"]


def _known(name: str, value: float | None, meaning: str) -> str:
    return f"# {name} = ...  # {meaning}" if value is None else f"{name} = {float(value)!r}  # {meaning}"


def _given(name: str, value: float | None, meaning: str) -> list[str]:
    return [] if value is None else [_known(name, value, meaning)]


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)
