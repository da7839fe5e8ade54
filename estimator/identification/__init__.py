"""Identification of a user's own oscillator from recorded inputs and outputs: `identify`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from estimator.identification.beliefs import contraction, foreseen, posterior
from estimator.identification.checks import examine
from estimator.identification.problem import JUDGED, LATEST, Problem, explicable
from estimator.identification.records import Record, records_of
from estimator.identification.result import Result, deviations_of
from estimator.identification.search import search, spread
from estimator.models.duffing import KINDS
from estimator.parameters import FloatArray
from estimator.progress import progress as shown
from estimator.progress import untold
from estimator.rig import Rig
from estimator.units import Scales


def identify(rig: Rig | Mapping[str, Any] | str | Path, records: Any, progress: bool = False) -> Result:
    """Identify m, c, a and b of Eq. (1), with offsets and noises, from records.

    The coefficients are the most probable ones under the Kalman filter's likelihood of all records, with a Gaussian
    about them (variational Laplace: `estimator.identification.fit`). The two noises are unknown: hypotheses about their
    ratio, each at its best level, are weighed by their free energies, on a grid that is refined. Without a guess in the
    rig the search begins at the equation tested with smooth bumps (`estimator.identification.start`), and where that
    leads nowhere at coefficients that are drawn, always the same.

    Args:
        rig: a `Rig`, a dictionary, or the name of a rig file.
        records: pairs (u, y) of arrays (T,) in the rig's units, paired by index, or names of CSV or MAT files; one or a
            list. Before its first sample a record may have been in any motion; its first outputs, three, as many as the
            input is late, and one more of an accelerometer, are left out, because inputs before the record may still
            act. An output that is NaN is missing; a record is cut where an input is.
        progress: tell on stderr how far it is, where it takes more than 5 seconds.

    Where no input varies, or a file has none, the oscillator decays freely: c/m, a/m and b/m are then what is told.

    Returns:
        Parameters with intervals, warnings of the checks, forecasts, and the belief to go on with.

    Raises:
        ValueError: naming the rig's key or the record (and the line of its file), the value and the remedy.
        FileNotFoundError: for a file that is not there.

    Example:
        >>> import numpy as np
        >>> from estimator import Channel, Rig, identify
        >>> rng = np.random.default_rng(0)
        >>> u = 6.0 * np.repeat(rng.choice([-1.0, 1.0], 128), 8)  # N, held by the amplifier
        >>> y, v = np.zeros(1024), 0.0  # m: a mass of 0.4 kg on a hardening spring, by small explicit steps
        >>> for k in range(1023):
        ...     x = y[k]
        ...     for _ in range(100):
        ...         v += 1e-5 / 0.4 * (u[k] - 0.6 * v - 2500.0 * x - 4e7 * x**3)
        ...         x += 1e-5 * v
        ...     y[k + 1] = x
        >>> rig = Rig(step=1e-3, input=Channel("N"), output=Channel("m"))
        >>> result = identify(rig, (u, y + 5e-6 * rng.standard_normal(1024)))
        >>> m, std = result.parameters["m"]
        >>> bool(abs(m - 0.4) < 0.004), result.units["m"]
        (True, 'kg')
    """
    rig = Rig.of(rig)
    read = records_of(records, rig)
    is_free = not any(one.u.any() for one in read)
    rig = replace(rig, guess=None) if is_free else rig
    with shown("Identifying") if progress else nullcontext(untold) as tell:
        scales = _scales(rig, read)
        u = tuple(one.u / scales.input for one in read)
        y = tuple(explicable(one.y, rig, LATEST) / scales.output for one in read)
        origin = _origin(rig, y)
        times = None if all(one.times is None for one in read) else tuple(one.counted(rig.step) for one in read)
        found = search(Problem(rig, scales, u, tuple(one - origin for one in y), origin, times=times), tell)
        problem = found.fitter.problem
        # Forecasts, and checks that compare the equation with others, are of the most probable place of a ridge.
        along = found if is_free else spread(found, JUDGED)
        belief, noises = posterior(problem, along)
        tell(0.9, "checking the result")
        forecasts = foreseen(found, belief)
        parameters = deviations_of(belief, along.ridges)
        warnings = examine(problem, found, along.ridges, belief, parameters, noises["input"], read, forecasts)
    history = partial(contraction, problem, along, parameters)
    foresee = partial(foreseen, found, belief)
    return Result(rig, belief, warnings, tuple(read), forecasts, noises, history, foresee, along.ridges)


def _scales(rig: Rig, records: list[Record]) -> Scales:
    """The rig's, and the records' largest where the rig has none."""
    largest = max(float(np.abs(one.u).max()) for one in records)
    is_free = largest == 0.0
    largest = largest or 1.0
    widest = max(float(np.nanmax(np.abs(one.y))) for one in records)
    scales = rig.scales
    if is_free:  # of these scales a mass of 1 has the gain 1
        scales = replace(scales, output=scales.output if rig.output.range else widest)
        return replace(scales, input=scales.displacement / rig.step**2)
    return replace(
        scales, input=scales.input if rig.input.limit else largest, output=scales.output if rig.output.range else widest
    )


def _origin(rig: Rig, outputs: Sequence[FloatArray]) -> float:
    """Where to count outputs from: their mean, of a displacement that is farther from 0 than it moves; else 0."""
    seen = np.concatenate(outputs)
    mean = float(np.nanmean(seen))
    return mean if KINDS[rig.output.kind] == 0 and abs(mean) > np.nanstd(seen) else 0.0
