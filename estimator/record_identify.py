"""Many records at once: the belief that each of them leaves, in a lane of its own.

The beliefs are those that an environment's estimator, or `OnlineEstimator`, would end with; a batch of records takes a
fraction of the time that they take one by one.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
import numpy.typing as npt

from estimator.belief import Belief, RecordBelief
from estimator.continuous import ContinuousBelief
from estimator.inference import DEFAULT_ITERATIONS, update
from estimator.inference import continuous as ode
from estimator.lanes import LANES, jit, kernel
from estimator.record import LAYOUT, N_ROWS, RECORD_SIZE

_U, _Y, _LAST_U = (LAYOUT[name] * LANES for name in ("u", "y", "last_u"))

AnyBelief = TypeVar("AnyBelief", bound=RecordBelief)


def identify_records(u: npt.ArrayLike, y: npt.ArrayLike, prior: AnyBelief) -> list[AnyBelief]:
    """Identify an oscillator from each of n records, sample by sample, from rest.

    Args:
        u: (n, T) inputs [V]. With a `Belief` the t-th acts on the displacement of the sample before; with a
            `ContinuousBelief` it is the input at the sample, to which the input goes linearly from the one before. A
            record ends before its first NaN, so that episodes of different lengths fit into one array.
        y: (n, T) the outputs that followed [V].
        prior: what is believed before the first sample, of all records: a `Belief`, whose factorisation is that of the
            updates, or a `ContinuousBelief`.

    Returns:
        The n posteriors, each after the last sample of its record.

    Raises:
        ValueError: for shapes that are not (n, T), or a prior of another kind.
    """
    inputs, outputs = np.array(u, dtype=np.float64), np.array(y, dtype=np.float64)
    if inputs.ndim != 2 or inputs.shape != outputs.shape:
        raise ValueError(f"u and y must have one shape (n, T), but have {inputs.shape} and {outputs.shape}")
    start: RecordBelief = prior
    if not isinstance(start, Belief | ContinuousBelief):
        raise ValueError(f"prior must be a Belief or a ContinuousBelief, but is {prior!r:.60}; pass one of the two")
    ended = np.isnan(inputs)
    lengths = np.where(ended.any(axis=1), ended.argmax(axis=1), inputs.shape[1])
    records = np.repeat(start.record[None], len(inputs), axis=0)
    if isinstance(start, ContinuousBelief):
        iterations = DEFAULT_ITERATIONS["structured"]
        _run_continuous(inputs, outputs, lengths, start.record.copy(), iterations, records)
    else:
        structured, iterations = start.factorisation == "structured", DEFAULT_ITERATIONS[start.factorisation]
        _run_difference(inputs, outputs, lengths, start.record.copy(), structured, iterations, records)
    records.flags.writeable = False
    return prior.with_records(records)


@jit
def _begin(W, prior):
    """Put every lane to the prior (RECORD_SIZE,)."""
    W[:] = 0.0
    for i in range(RECORD_SIZE):
        for j in range(LANES):
            W[i * LANES + j] = prior[i]


@jit
def _feed(W, u, y, lengths, first, t):
    """The samples t of the records from ``first`` on; silence where a record is over, and in spare lanes."""
    for j in range(LANES):
        i = first + j
        sounds = i < len(u) and t < lengths[i]
        W[_LAST_U + j] = W[_U + j]
        W[_U + j] = u[i, t] if sounds else 0.0
        W[_Y + j] = y[i, t] if sounds else 0.0


@jit
def _keep(W, lengths, first, t, records):
    """Write the beliefs of the records whose last sample is t to ``records`` (n, RECORD_SIZE)."""
    for j in range(min(LANES, len(lengths) - first)):
        if lengths[first + j] == t + 1:
            for i in range(RECORD_SIZE):
                records[first + j, i] = W[i * LANES + j]


@kernel
def _run_difference(u, y, lengths, prior, is_structured, iterations, records):
    """By Eq. (2), in either factorisation."""
    W = np.empty(N_ROWS * LANES)
    for first in range(0, len(u), LANES):
        _begin(W, prior)
        for t in range(u.shape[1]):
            _feed(W, u, y, lengths, first, t)
            update(W, is_structured, iterations, False, W[:0])
            _keep(W, lengths, first, t, records)


@kernel
def _run_continuous(u, y, lengths, prior, iterations, records):
    """By Eq. (1)."""
    W = np.empty(N_ROWS * LANES)
    for first in range(0, len(u), LANES):
        _begin(W, prior)
        for t in range(u.shape[1]):
            _feed(W, u, y, lengths, first, t)
            ode.update(W, iterations, ode.SUBSTEPS)
            _keep(W, lengths, first, t, records)
