"""One channel of a rig, its input or its output: unit, range, noise, offset and lag."""

from __future__ import annotations

from dataclasses import dataclass

from estimator.models.duffing import DERIVATIVE_ORDER_OF_SENSOR
from estimator.rigs.units import MAGNITUDE_BOUNDS
from estimator.support.argument_checks import (
    check_choice,
    check_number,
    mask_control_codes,
)


@dataclass(frozen=True)
class Channel:
    """The input or the output of a rig.

    Attributes:
        unit: such as ``"N"``, ``"V"``, ``"mm"`` or ``"m/s"``.
        limit: of an input: never exceeded, in either direction. None: not known.
        range: of an output: an experiment stops outside of it, in either direction. None: not known.
        kind: what an output shows: ``displacement``, ``velocity`` or ``acceleration``.
        noise: standard deviation, per sample: of an output its sensor's, of an input what disturbs the force. A first
            value of what stays unknown; None: nothing is known of it.
        offset: first value of the offset, which stays unknown. `identify` takes outputs that lie far from 0 as they
            are; a rig that is played has a range about 0.
        lag: of an input: time constant [s] of a first-order lag between what is recorded and what acts, such as of a
            voice coil. For `identify` alone. None: none.
        column: its name in CSV files, with or without the unit behind it, or in MAT files. None stands for the usual
            names (`estimator.identification.data.text_tables.read_table`).

    Raises:
        ValueError: naming the argument, the value and the remedy.
    """

    unit: str = "1"
    limit: float | None = None
    range: float | None = None
    kind: str = "displacement"
    noise: float | None = None
    offset: float = 0.0
    column: str | None = None
    lag: float | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.unit, str) or not self.unit.strip() or len(self.unit) > 40:
            raise ValueError(f"unit must be a short text such as 'N', but is {self.unit!r:.60}; '1' is a pure number")
        if mask_control_codes(self.unit) != self.unit or set(self.unit) & set(
            ',;"[]'
        ):  # it stands in heads of CSV files
            raise ValueError(f"unit must hold no control codes, commas, quotes or brackets, but is {self.unit!r:.60}")
        for name in ("limit", "range", "noise", "lag"):
            value = getattr(self, name)
            if value is not None:
                of = {"limit": " of an input", "range": " of an output"}.get(name, "")
                check_number(f"{name}{of}", value, *MAGNITUDE_BOUNDS, "leave it out where it is not known")
        check_choice("kind", self.kind, DERIVATIVE_ORDER_OF_SENSOR)
        check_number("offset", self.offset, -MAGNITUDE_BOUNDS[1], MAGNITUDE_BOUNDS[1], "0 where nothing is known")
        if self.column is not None:
            if not isinstance(self.column, str) or not 0 < len(self.column.strip()) <= 80:
                raise ValueError(f"column must be a name in the records' files, but is {self.column!r:.60}")
            if mask_control_codes(self.column) != self.column or set(self.column) & set(',;"'):
                raise ValueError(f"column must hold no control codes, commas or quotes, but is {self.column!r:.60}")
