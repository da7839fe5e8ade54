"""The rig file: TOML with comments, and with unknown values as comments to fill in."""

from __future__ import annotations

import json
from collections.abc import Mapping
from itertools import chain

from estimator.rigs.channel import Channel

_EQUATION_COMMENT = "#   m x'' + c x' + a x + b x³ = u - u0 + w,   y = {output} + y0 + noise"
_SYMBOL_OF_KIND = {"displacement": "x", "velocity": "x'", "acceleration": "x''"}
_INTERPOLATION_COMMENT = (
    '# Interpolation of the input: "zero_order": held, as by a converter; "linear"; "spline": smooth.'
)

_ACCELERATION_COMMENT = (
    "# With a held input, y[k] is the acceleration just before the input changes to u[k] (docs/own_data.md)."
)
_UNIT_COMMENT = '  # such as "N", "V", "mm" or "m/s"; "1" is a pure number'


def rig_file_text(
    step: float,
    interpolation: str,
    delay: float,
    inputs: Channel | Mapping[str, Channel],
    output_channel: Channel,
    guess: Mapping[str, tuple[float, float]] | None,
    units_of_guess: Mapping[str, str],
    provenance: str = "",
) -> str:
    """The text of a rig file, with comments; an unknown value is a comment to fill in.

    Args:
        step: sampling step [s].
        interpolation: of the input.
        delay: of the input [samples].
        inputs: the input, or several by name.
        output_channel: the output.
        guess: parameter to its 90 % interval, or None.
        units_of_guess: parameter to its unit; empty for a rig that has no guess.
        provenance: source of the numbers, for the first line, such as ``", from record.csv"``.
    """
    tables = {"input": inputs} if isinstance(inputs, Channel) else {f"input.{i}": one for i, one in inputs.items()}
    lines = [
        f"# A rig{provenance}. Read by: duffing-env identify, and Rig.from_file.",
        *([_EQUATION_COMMENT.format(output=_SYMBOL_OF_KIND[output_channel.kind])] if units_of_guess else []),
        "",
        f"step = {float(step)!r}  # s between samples",
        _INTERPOLATION_COMMENT,
        f"interpolation = {_quote(interpolation)}",
        f"delay = {delay:.12g}  # samples, of the input",
        "",
        *chain.from_iterable(_input_lines(*titled) for titled in tables.items()),
        "[output]",
        f"unit = {_quote(output_channel.unit)}{_UNIT_COMMENT if output_channel.unit == '1' else ''}",
        *_column_lines(output_channel),
        f"kind = {_quote(output_channel.kind)}  # displacement, velocity or acceleration",
        *([_ACCELERATION_COMMENT] if output_channel.kind == "acceleration" else []),
        _value_or_placeholder("range", output_channel.range, "an experiment stops outside of it, in either direction"),
        _value_or_placeholder("noise", output_channel.noise, "standard deviation of the sensor's noise, if known"),
        *_optional_lines("offset", output_channel.offset or None, "y0, a guess"),
    ]
    if units_of_guess:
        lines += [
            "",
            "# Your guess: the ends of an interval that holds each parameter with a probability of 90 %.",
            "# identify does not need it.",
        ]
    if guess is None and units_of_guess:
        lines += ["# [guess]", *(f"# {name} = [low, high]  # {unit}" for name, unit in units_of_guess.items())]
    elif guess is not None:
        lines.append("[guess]")
        lines += [f"{name} = [{low!r}, {high!r}]  # {units_of_guess[name]}" for name, (low, high) in guess.items()]
    return "\n".join([*lines, ""])


def _input_lines(title: str, channel: Channel) -> list[str]:
    """The table of an input, with an empty line after it."""
    return [
        f"[{title}]",
        f"unit = {_quote(channel.unit)}{_UNIT_COMMENT if channel.unit == '1' else ''}",
        *_column_lines(channel),
        _value_or_placeholder("limit", channel.limit, "never exceeded, in either direction"),
        *_optional_lines(
            "lag", channel.lag, "s, time constant of a first-order lag between the recorded and the acting input"
        ),
        *_optional_lines("noise", channel.noise, "standard deviation of the disturbance of the force"),
        *_optional_lines("offset", channel.offset or None, "u0, a guess"),
        "",
    ]


def _column_lines(channel: Channel) -> list[str]:
    return [] if channel.column is None else [f"column = {_quote(channel.column)}  # in the files of the records"]


def _value_or_placeholder(name: str, value: float | None, meaning: str) -> str:
    return f"# {name} = ...  # {meaning}" if value is None else f"{name} = {float(value)!r}  # {meaning}"


def _optional_lines(name: str, value: float | None, meaning: str) -> list[str]:
    return [] if value is None else [_value_or_placeholder(name, value, meaning)]


def _quote(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)
