"""One channel of a rig, its input or its output: unit, limit or range, noise, offset and lag."""

from __future__ import annotations

from dataclasses import dataclass

from estimator.models.duffing import DERIVATIVE_ORDER_OF_SENSOR
from estimator.rigs.units import MAGNITUDE_BOUNDS
from estimator.support.argument_checks import check_choice, check_number, mask_control_codes


@dataclass(frozen=True)
class Channel:
    """The input or the output of a rig.

    Attributes:
        unit: such as ``"N"``, ``"V"``, ``"mm"`` or ``"m/s"``; ``"1"`` is a pure number.
        limit: limit of an input, never exceeded in either direction. None: unknown.
        range: range of an output, in either direction; an experiment stops outside of it. None: unknown.
        kind: kind of an output: ``displacement``, ``velocity`` or ``acceleration``.
        noise: standard deviation per sample: of an output, of the sensor's noise; of an input, of the disturbance of
            the force. It is the prior guess of an unknown noise. None: unknown.
        offset: prior guess of the unknown offset. `identify` takes outputs far from 0 as they are; a rig in a closed
            loop has a range about 0.
        column: name of the column in CSV files, with or without the unit, or of the variable in MAT files. None: one of
            the usual names (`estimator.identification.data.text_tables.read_table`).
        lag: time constant of a first-order lag between recorded and acting input [s], such as of a voice coil; for
            `identify` alone. None: no lag.

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
        # The unit is a part of headings in CSV files.
        if mask_control_codes(self.unit) != self.unit or set(self.unit) & set(',;"[]'):
            raise ValueError(f"unit must hold no control codes, commas, quotes or brackets, but is {self.unit!r:.60}")
        for name in ("limit", "range", "noise", "lag"):
            value = getattr(self, name)
            if value is not None:
                of = {"limit": " of an input", "range": " of an output"}.get(name, "")
                check_number(f"{name}{of}", value, *MAGNITUDE_BOUNDS, "leave it out where it is unknown")
        check_choice("kind", self.kind, DERIVATIVE_ORDER_OF_SENSOR)
        check_number("offset", self.offset, -MAGNITUDE_BOUNDS[1], MAGNITUDE_BOUNDS[1], "0 where it is unknown")
        if self.column is not None:
            if not isinstance(self.column, str) or not 0 < len(self.column.strip()) <= 80:
                raise ValueError(f"column must be a name in the files of the records, but is {self.column!r:.60}")
            if mask_control_codes(self.column) != self.column or set(self.column) & set(',;"'):
                raise ValueError(f"column must hold no control codes, commas or quotes, but is {self.column!r:.60}")
