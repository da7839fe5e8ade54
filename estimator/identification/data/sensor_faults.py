"""Faults of sensors and converters: bursts of stale outputs, repeated values, and a high-pass."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from estimator.support.array_types import FloatArray

#: Samples for which the output stands still in a burst, at least.
_MIN_STALE_SAMPLES = 4

#: The jump that ends a burst, in usual changes of the output, at least.
_MIN_JUMP_FACTOR = 4.0

#: Bursts from which they are no coincidence.
_MIN_BURSTS = 3

#: Fraction of all changes that lie on every n-th sample, where a sensor repeats each value n times.
_MIN_REGULAR_FRACTION = 0.98

#: Largest such n [samples].
_MAX_REPEATS = 64


class StaleOutputs(NamedTuple):
    """Outputs that are no measurements of their own.

    Attributes:
        is_stale: (T,) whether an output is stale.
        n_bursts: number of bursts of stale outputs.
        samples_per_value: samples for which the sensor repeats each value; 1 without repetition.
    """

    is_stale: npt.NDArray[np.bool_]
    n_bursts: int
    samples_per_value: int


def find_stale_outputs(y: FloatArray) -> StaleOutputs:
    """Find outputs that a sensor only held, or gave as zero.

    The first sample of a held value counts as measured. The coarse levels of a converter are no bursts: at a turn of
    the motion the output stays on one level, but leaves it by a small step.

    Args:
        y: (T,) outputs; NaN where one is missing.
    """
    no_flags = np.zeros(len(y), dtype=np.bool_)
    observed = np.flatnonzero(np.isfinite(y))
    values = y[observed]
    if len(values) < 50:
        return StaleOutputs(no_flags, 0, 1)
    changes = np.flatnonzero(np.diff(values)) + 1
    if not len(changes):
        return StaleOutputs(no_flags, 0, 1)
    repeats = _samples_per_value(changes)
    if repeats > 1:
        held = np.ones(len(values), dtype=np.bool_)
        held[changes] = False
        held[0] = False
        no_flags[observed[held]] = True
        return StaleOutputs(no_flags, 0, repeats)
    usual_change = float(np.median(np.abs(np.diff(values)[changes - 1])))
    begins, ends = np.append(0, changes), np.append(changes, len(values))
    long = np.flatnonzero(ends - begins >= _MIN_STALE_SAMPLES)
    flags, bursts = no_flags.copy(), 0
    levels: dict[float, int] = {}
    for run in long:
        levels[float(values[begins[run]])] = levels.get(float(values[begins[run]]), 0) + 1
    for run in long:
        begin, end = int(begins[run]), int(ends[run])
        after = abs(values[end] - values[begin]) if end < len(values) else 0.0
        before = abs(values[begin] - values[begin - 1]) if begin else 0.0
        same = levels[float(values[begin])] > 1
        # A value that other bursts repeat is the sensor's code for no signal; else the first sample was measured.
        if max(after, before if same else 0.0) > _MIN_JUMP_FACTOR * usual_change:
            flags[observed[begin if same else begin + 1 : end]] = True
            bursts += 1
    return StaleOutputs(flags, bursts, 1) if bursts >= _MIN_BURSTS else StaleOutputs(no_flags, 0, 1)


def _samples_per_value(changes: npt.NDArray[np.intp]) -> int:
    """Samples for which each value is repeated, where values change at every n-th sample alone; else 1."""
    if len(changes) < 20:
        return 1
    steps = np.diff(changes)
    n = int(np.gcd.reduce(steps[steps > 0][:200]))
    if n < 2:  # a few changes are off the grid, such as after two frames in quick succession
        n = int(np.median(steps))
    if not 2 <= n <= _MAX_REPEATS:
        return 1
    counts = np.bincount(changes % n, minlength=n)
    # The outputs under a held input change at every sample; repeated outputs hardly ever between the grid points.
    return n if counts.max() > _MIN_REGULAR_FRACTION * len(changes) and np.median(steps) == n else 1


def undo_high_pass(y: FloatArray, corner_frequency: float) -> FloatArray:
    """Undo a first-order high-pass by integrating its equation, z' = y' - corner z, for y.

    Args:
        y: (T,) outputs z of the high-pass; missing ones stay missing, and count as 0.
        corner_frequency: angular corner frequency [rad per sample].
    """
    filled = np.nan_to_num(y)
    total = corner_frequency * (np.cumsum(filled) - 0.5 * filled)
    restored = filled + total
    return np.where(np.isfinite(y), restored - restored.mean(), np.nan)
