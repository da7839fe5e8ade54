"""Rig files from a record or from answers to questions: sampling step, units, limits and prior intervals."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from estimator.identification.data.record_files import read_record_file
from estimator.identification.data.text_tables import read_table
from estimator.models.duffing import DERIVATIVE_ORDER_OF_SENSOR
from estimator.models.interpolation import INTERPOLATION_DEGREES
from estimator.rigs.channel import Channel
from estimator.rigs.rig import Rig
from estimator.rigs.units import conversion_factor, to_si_unit
from estimator.support.argument_checks import mask_control_codes

Answer = TypeVar("Answer")

#: Answer that leaves a value out.
_NOT_KNOWN = "not known"


def rig_text_from_record(
    path: Path, step: float | None = None, input_column: str | None = None, output_column: str | None = None
) -> tuple[str, str]:
    """The rig file for a record, and sentences about the source of its columns, step and units.

    The step is of the column of times; units and kind are of the names of the columns, but in SI units without prefix,
    so that results are in kg and N/m also where a column is in mm. A MAT file has none of these.

    Args:
        path: of a CSV or MAT file.
        step: sampling step [s]; None: by the times.
        input_column: name of the input's column or variable; None: one of the usual names.
        output_column: name of the output's, likewise.

    Raises:
        ValueError: where neither the caller nor the file gives the step, or the file is malformed.
        FileNotFoundError: if there is no such file.
    """
    if not path.exists():
        raise FileNotFoundError(
            f"from must be a CSV or MAT file, or the name of a rig that ships, but there is no {path}"
        )
    if not path.is_file():
        raise ValueError(f"from must be a CSV or MAT file, but is {path}; leave --from out, and answer the questions")
    if path.suffix.lower() == ".mat":
        if step is None:
            raise ValueError(f"{path} must be a CSV file to have a step, but is a MAT file; add --step SECONDS")
        rig = Rig(step, input=Channel(column=input_column), output=Channel(column=output_column))
        columns = read_record_file(path, rig)[0].columns
        sentences = [columns.sentence(rig.output.kind, is_kind_known=False)] if columns else []
        sentences.append(_sampling_step_sentence(step, "--step"))
        return rig.to_toml(f", from {mask_control_codes(path.name)}"), "\n".join(sentences)
    table = read_table(path, input_column, output_column)
    step_of_times = table.step()
    if step is None and step_of_times is None:
        raise ValueError(
            f"{path} must have a column of times, such as 'time [s]', but has {list(table.names)}; rename one, or add "
            f"--step SECONDS"
        )
    if step is not None and step_of_times is not None and abs(step_of_times / step - 1) > 0.01:
        raise ValueError(
            f"{path}: times are {step_of_times:.6g} s apart, but the step is {step:.6g} s; correct one of them"
        )
    step_source = "--step"
    if step is None:
        # Times are rounded, so that the last digits of their mean difference are wrong.
        step = float(f"{step_of_times:.6g}")
        step_source = f"the times in {table.names[table.time_column or 0]:.60}" if table.names else "the first column"
    known_kind = table.output_kind()
    kind = known_kind or "displacement"
    columns = table.column_names()
    sentences = [columns.sentence(kind, known_kind is not None), _sampling_step_sentence(step, step_source)]
    input_unit, output_unit = (
        None if place is None else table.unit(place) for place in (table.input_column, table.output_column)
    )
    # The file names a column that was not chosen by its name, so that the user can check it.
    is_written = bool(table.names) and columns.reason != "name"
    column_names = [name if is_written else None for name in (columns.input, columns.output)]
    # The unit g of an input may be a force.
    si_units = [
        one if one in (None, "g") and k == 0 else to_si_unit(one or "1")[1]
        for k, one in enumerate((input_unit, output_unit))
    ]
    output = Channel(si_units[1] or "1", kind=kind, column=output_column or column_names[1])
    rig = Rig(step, input=Channel(si_units[0] or "1", column=input_column or column_names[0]), output=output)
    for name, one, base in zip(("input", "output"), (input_unit, output_unit), si_units, strict=True):
        if one and base and conversion_factor(one, base) != 1.0:
            sentences.append(f"The {name} is in {one}, and converted to {base}: results are in SI units.")
    note = "" if table.names else ", which names no column: units, kind and times in seconds are guessed"
    return rig.to_toml(f", from {mask_control_codes(path.name)}{note}"), "\n".join(sentences)


def _sampling_step_sentence(step: float, source: str) -> str:
    """A sentence with the sampling step and its source."""
    return f"The sampling step is {step:.6g} s ({1 / step:.6g} Hz), by {source}."


def ask_for_rig() -> Rig:
    """Ask for a rig on the terminal.

    Raises:
        ValueError: at the end of the input.
    """
    print("An empty answer takes the value in parentheses; Ctrl-C ends it.")
    try:
        step = _ask_until_valid("Sampling step in seconds, or rate such as 1000 Hz", None, _parse_sampling_step)
        interpolation = _ask_until_valid(
            f"Input between samples: {', '.join(INTERPOLATION_DEGREES)}",
            "zero_order",
            _parse_choice(INTERPOLATION_DEGREES),
        )
        input_channel = Channel(_ask_until_valid("Unit of the input", "N", lambda words: Channel(words).unit))
        limit = _ask_until_valid("Largest input, in either direction", _NOT_KNOWN, _parse_positive)
        kind = _ask_until_valid(
            f"Output: {', '.join(DERIVATIVE_ORDER_OF_SENSOR)}",
            "displacement",
            _parse_choice(DERIVATIVE_ORDER_OF_SENSOR),
        )
        unit = _ask_until_valid(
            "Unit of the output",
            ("m", "m/s", "m/s²")[DERIVATIVE_ORDER_OF_SENSOR[kind]],
            lambda words: Channel(words).unit,
        )
        output_range = _ask_until_valid("Largest output before an experiment must stop", _NOT_KNOWN, _parse_positive)
        rig = Rig(
            step,
            interpolation,
            0,
            Channel(input_channel.unit, limit=limit),
            Channel(unit, kind=kind, range=output_range),
        )
        print("Prior intervals of m, c, a and b: two numbers, between which it is with 90 %.")
        guess = {}
        for name in "mcab":
            interval = _ask_until_valid(
                f"{name} [{rig.scales.unit(rig.model.dimensions[name])}]",
                _NOT_KNOWN,
                _parse_mass_interval if name == "m" else _parse_interval,
            )
            if interval is None:
                return rig
            guess[name] = interval
    except EOFError:
        raise ValueError("rig init asks, but nobody answers; run it in a terminal, or add --from data.csv") from None
    return Rig.from_dict({**rig.to_dict(), "guess": guess})


def _ask_until_valid(question: str, default: str | None, parse: Callable[[str], Answer]) -> Answer:
    """Ask until the answer can be parsed."""
    shown = f"{question} ({default}): " if default is not None else f"{question}: "
    while True:
        answer = input(shown).strip() or default
        try:
            if answer:
                return parse(answer)
        except ValueError as error:
            print(f"  {error}")


def _parse_number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"must be a number, but is {text!r:.40}") from None


def _parse_sampling_step(text: str) -> float:
    per_second = text.lower().endswith("hz")
    value = _parse_positive(text[:-2] if per_second else text) or 0.0
    return 1 / value if per_second else value


def _parse_positive(text: str) -> float | None:
    if text == _NOT_KNOWN:
        return None
    value = _parse_number(text)
    if not 0 < value < math.inf:
        raise ValueError(f"must be positive, but is {text}")
    return value


def _parse_interval(text: str) -> list[float] | None:
    if text == _NOT_KNOWN:
        return None
    ends = [_parse_number(word) for word in text.replace(",", " ").split()]
    if len(ends) != 2 or not ends[0] < ends[1]:
        raise ValueError(f"must be two numbers, the lower one first, but is {text}")
    return ends


def _parse_mass_interval(text: str) -> list[float] | None:
    ends = _parse_interval(text)
    if ends is not None and ends[0] <= 0:
        raise ValueError(f"must be positive, but begins at {ends[0]:g}")
    return ends


def _parse_choice(choices: dict[str, int]) -> Callable[[str], str]:
    def parse(text: str) -> str:
        if text not in choices:
            raise ValueError(f"must be one of {', '.join(choices)}, but is {text}")
        return text

    return parse
