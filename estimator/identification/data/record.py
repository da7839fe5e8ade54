"""`Record`: the inputs and outputs of one measurement, with the counts of missing, clipped and stale outputs."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from estimator.support.array_types import FloatArray


@dataclass(frozen=True, eq=False)
class Record:
    """One record.

    Attributes:
        name: of its file, or its number; of a later piece with the sample where it begins.
        u: (T,) inputs.
        y: (T,) outputs; NaN where one is missing or was clipped.
        n_clipped: outputs that were clipped, or over range.
        n_missing: outputs that were not there.
        n_stale: outputs that stood still while the oscillator moved, in bursts or because each was repeated, and were
            taken out.
        n_bursts: of these.
        samples_per_value: samples for which each output stood; 1 where none was repeated.
        times: (T,) of the samples [s], where these are not the rig's step apart.
        step: between most samples [s], as its own times say; None where it has none.
        is_over_range: (T,) whether an output was over range, in a record that is whole.
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
    is_over_range: npt.NDArray[np.bool_] | None = field(default=None, repr=False)

    def times_in_steps(self, step: float) -> FloatArray:
        """(T,) times in sampling steps, from the first sample on."""
        if self.times is None:
            return np.arange(len(self.u), dtype=np.float64)
        return np.asarray((self.times - self.times[0]) / step)
