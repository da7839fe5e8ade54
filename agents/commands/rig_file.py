"""Rig files from a record, or from answers."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

from estimator.checks import printable
from estimator.identification.records import read
from estimator.identification.tables import read_table
from estimator.models.duffing import KINDS
from estimator.rig import INTERPOLATIONS, Channel, Rig
from estimator.rig_text import text_of
from estimator.units import coherent, conversion

_UNKNOWN = "not known"


def from_record(
    path: Path, step: float | None = None, source: str | None = None, sink: str | None = None
) -> tuple[str, str]:
    """The file for a record, and what was taken from where: the step, and units that are not the columns'.

    The step is that of its column of times; units and kind are those of the names of its columns, but as SI has them
    without a prefix, so that results are in kg and N/m also where a column is in mm. A MAT file tells none of these.

    Args:
        path: of a CSV or MAT file.
        step: sampling step [s]; None: that of the times.
        source: name of the input's column or variable; None: one of the usual.
        sink: of the output's, likewise.

    Raises:
        ValueError: where neither the caller nor the file gives the step, or the file is not as it must be.
        FileNotFoundError: if there is no such file.
    """
    if not path.exists():
        raise FileNotFoundError(
            f"from must be a CSV or MAT file, or the name of a rig that ships, but there is no {path}"
        )
    if not path.is_file():
        raise ValueError(f"from must be a CSV or MAT file, but is {path}; leave --from away, and answer the questions")
    if path.suffix.lower() == ".mat":
        if step is None:
            raise ValueError(f"{path} must be a CSV file to tell the step, but is a MAT file; add --step SECONDS")
        rig = Rig(step, input=Channel(column=source), output=Channel(column=sink))
        read(path, rig)
        return text_of(rig, f", from {printable(path.name)}"), _taken(step, "--step")
    table = read_table(path, source, sink)
    own = table.step()
    if step is None and own is None:
        raise ValueError(
            f"{path} must have a column of times, such as 'time [s]', but has {list(table.names)}; rename one, or add "
            f"--step SECONDS"
        )
    if step is not None and own is not None and abs(own / step - 1) > 0.01:
        raise ValueError(f"{path}: times are {own:.6g} s apart, but the step is {step:.6g} s; mend one of them")
    by = "--step"
    if step is None:
        # Times are written with some digits, and their mean difference is off by the last of them.
        step = float(f"{own:.6g}")
        by = f"the times in {table.names[table.time or 0]:.60}" if table.names else "the first column"
    said = [_taken(step, by)]
    unit, seen = (None if place is None else table.unit(place) for place in (table.u, table.y))
    # A name that says nothing was taken by its place, and stands in the file to be seen.
    shown = [None if place is None or table.is_known(place) else table.names[place] for place in (table.u, table.y)]
    # A g of an input may be one of weight.
    bases = [one if one in (None, "g") and k == 0 else coherent(one or "1")[1] for k, one in enumerate((unit, seen))]
    output = Channel(bases[1] or "1", kind=table.kind() or "displacement", column=sink or shown[1])
    rig = Rig(step, input=Channel(bases[0] or "1", column=source or shown[0]), output=output)
    for name, one, base in zip(("input", "output"), (unit, seen), bases, strict=True):
        if one and base and conversion(one, base) != 1.0:
            said.append(f"The {name} is in {one}, and is taken in {base}: results are in units of SI.")
    guessed = "" if table.names else ", which names no column: units, kind and times in seconds are guessed"
    return text_of(rig, f", from {printable(path.name)}{guessed}"), "\n".join(said)


def _taken(step: float, source: str) -> str:
    """The step that was taken, in words."""
    return f"The sampling step is {step:.6g} s ({1 / step:.6g} Hz), by {source}."


def ask() -> Rig:
    """A rig from answers to questions on the terminal.

    Raises:
        ValueError: where nobody answers.
    """
    print("An empty answer takes what stands in parentheses; Ctrl-C ends it.")
    try:
        step = _answer("Sampling step in seconds, or rate such as 1000 Hz", None, _step)
        interpolation = _answer(
            f"Input between samples: {', '.join(INTERPOLATIONS)}", "zero_order", _of(INTERPOLATIONS)
        )
        source = Channel(_answer("Unit of the input", "N", lambda words: Channel(words).unit))
        limit = _answer("Largest input, in either direction", _UNKNOWN, _positive)
        kind = _answer(f"Output: {', '.join(KINDS)}", "displacement", _of(KINDS))
        unit = _answer("Unit of the output", ("m", "m/s", "m/s²")[KINDS[kind]], lambda words: Channel(words).unit)
        widest = _answer("Largest output before an experiment must stop", _UNKNOWN, _positive)
        rig = Rig(step, interpolation, 0, Channel(source.unit, limit=limit), Channel(unit, kind=kind, range=widest))
        print("What you believe of m, c, a and b: two numbers, which hold it with 90 %.")
        guess = {}
        for name in "mcab":
            ends = _answer(
                f"{name} [{rig.scales.unit(rig.model.dimensions[name])}]", _UNKNOWN, _mass if name == "m" else _interval
            )
            if ends is None:
                return rig
            guess[name] = ends
    except EOFError:
        raise ValueError("rig init asks, but nobody answers; run it in a terminal, or add --from data.csv") from None
    return Rig.from_dict({**rig.to_dict(), "guess": guess})


def _answer(question: str, default: str | None, taken: Callable[[str], Any]) -> Any:
    """Ask until the answer can be taken."""
    shown = f"{question} ({default}): " if default is not None else f"{question}: "
    while True:
        words = input(shown).strip() or default
        try:
            if words:
                return taken(words)
        except ValueError as error:
            print(f"  {error}")


def _number(words: str) -> float:
    try:
        return float(words)
    except ValueError:
        raise ValueError(f"must be a number, but is {words!r:.40}") from None


def _step(words: str) -> float:
    per_second = words.lower().endswith("hz")
    value = _positive(words[:-2] if per_second else words) or 0.0
    return 1 / value if per_second else value


def _positive(words: str) -> float | None:
    if words == _UNKNOWN:
        return None
    value = _number(words)
    if not 0 < value < math.inf:
        raise ValueError(f"must be positive, but is {words}")
    return value


def _interval(words: str) -> list[float] | None:
    if words == _UNKNOWN:
        return None
    ends = [_number(word) for word in words.replace(",", " ").split()]
    if len(ends) != 2 or not ends[0] < ends[1]:
        raise ValueError(f"must be two numbers, the lower one first, but is {words}")
    return ends


def _mass(words: str) -> list[float] | None:
    ends = _interval(words)
    if ends is not None and ends[0] <= 0:
        raise ValueError(f"must be positive, but begins at {ends[0]:g}")
    return ends


def _of(known: dict[str, int]) -> Callable[[str], str]:
    def taken(words: str) -> str:
        if words not in known:
            raise ValueError(f"must be one of {', '.join(known)}, but is {words}")
        return words

    return taken
