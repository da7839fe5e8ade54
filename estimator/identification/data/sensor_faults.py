"""What a sensor or a converter did to outputs: bursts that stand still, values that are repeated, a high-pass."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from estimator.support.array_types import FloatArray

#: Samples for which the output stands still in a burst, at least.
_MIN_STALE_SAMPLES = 4

#: The jump that ends a burst, in usual changes of the output, at least.
_MIN_JUMP_FACTOR = 4.0

#: Bursts that are no chance.
_MIN_BURSTS = 3

#: Fraction of all changes that lie on every n-th sample, where a sensor repeats each value n times.
_MIN_REGULAR_FRACTION = 0.98

#: Largest such n [samples].
_MAX_REPEATS = 64


class StaleOutputs(NamedTuple):
    """Outputs that are no measurements.

    Attributes:
        is_stale: (T,) which.
        n_bursts: in which outputs stand still while the oscillator moves.
        samples_per_value: samples for which every output stands; 1 where none is repeated.
    """

    is_stale: npt.NDArray[np.bool_]
    n_bursts: int
    samples_per_value: int


def find_stale_outputs(y: FloatArray) -> StaleOutputs:
    """Outputs (T,) that a sensor only held, or gave as zero.

    Of a value that is held the first sample is taken for measured. Coarse levels of a converter are no bursts: where
    the signal turns it stands on one of them, but leaves it by a small step.
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
        # A value that comes again in other bursts is a sensor's word for nothing; else the first one was measured.
        if max(after, before if same else 0.0) > _MIN_JUMP_FACTOR * usual_change:
            flags[observed[begin if same else begin + 1 : end]] = True
            bursts += 1
    return StaleOutputs(flags, bursts, 1) if bursts >= _MIN_BURSTS else StaleOutputs(no_flags, 0, 1)


def _samples_per_value(changes: npt.NDArray[np.intp]) -> int:
    """Samples for which each value stands, where values change at every n-th sample alone; 1 otherwise."""
    if len(changes) < 20:
        return 1
    steps = np.diff(changes)
    n = int(np.gcd.reduce(steps[steps > 0][:200]))
    if n < 2:  # a few changes beside the grid, as where two frames follow each other too fast
        n = int(np.median(steps))
    if not 2 <= n <= _MAX_REPEATS:
        return 1
    counts = np.bincount(changes % n, minlength=n)
    # A held input's outputs change at every sample: here nearly none does in between.
    return n if counts.max() > _MIN_REGULAR_FRACTION * len(changes) and np.median(steps) == n else 1


def undo_high_pass(y: FloatArray, corner_frequency: float) -> FloatArray:
    """Outputs (T,) before a first-order high-pass with a corner at an angular frequency [rad per sample].

    Its equation, shown' = y' - corner shown, is integrated. Missing outputs stay missing, and count as 0.
    """
    filled = np.nan_to_num(y)
    total = corner_frequency * (np.cumsum(filled) - 0.5 * filled)
    restored = filled + total
    return np.where(np.isfinite(y), restored - restored.mean(), np.nan)
