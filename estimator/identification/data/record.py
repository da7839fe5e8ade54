"""`Record`: the inputs and outputs of one measurement, with the counts of missing, clipped and stale outputs."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from estimator.identification.data.column_choice import ColumnNames
from estimator.support.array_types import FloatArray


@dataclass(frozen=True, eq=False)
class Record:
    """The inputs and outputs of one measurement.

    Attributes:
        name: name of the file, or number of the record; a later piece adds the sample at which it begins.
        u: (T,) inputs.
        y: (T,) outputs; NaN where one is missing or clipped.
        n_clipped: number of clipped or over-range outputs.
        n_missing: number of missing outputs.
        n_stale: number of removed outputs that stand still while the oscillator moves, in bursts or by repetition.
        n_bursts: number of such bursts.
        samples_per_value: samples for which a sensor repeats each output; 1 without repetition.
        times: (T,) times of the samples [s]; None where they are the rig's step apart.
        step: usual step of its own times [s]; None without times.
        columns: names of its columns of input and output; None of arrays.
        is_over_range: (T,) whether an output is over range, before the record is cut.
    """

    name: str
    u: FloatArray
    y: FloatArray
    n_clipped: int = 0
    n_missing: int = 0
    n_stale: int = 0
    n_bursts: int = 0
    samples_per_value: int = 1
    times: FloatArray | None = None
    step: float | None = None
    columns: ColumnNames | None = None
    is_over_range: npt.NDArray[np.bool_] | None = field(default=None, repr=False)

    def times_in_steps(self, step: float) -> FloatArray:
        """(T,) times of the samples, in sampling steps of ``step`` seconds, from the first sample on."""
        if self.times is None:
            return np.arange(len(self.u), dtype=np.float64)
        return np.asarray((self.times - self.times[0]) / step)
