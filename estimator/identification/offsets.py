"""By how many samples outputs answer late, or early, where channels were triggered apart: found without a start."""

from __future__ import annotations

import numpy as np

from estimator.identification.problem import Problem
from estimator.identification.start import misfits
from estimator.rig import LONGEST_DELAY

#: Delays are tried up to this part of a record, and early answers up to this many samples.
_PART, _EARLY = 0.25, 60

#: Steps between the delays that are tried first, in parts of a period, and about the best of them.
_COARSE = 1 / 16

#: Part of the misfit at the rig's own delay that another must leave, at most, and part of that beside it.
_LEFT, _BESIDE = 0.5, 0.9


def offset_of(problem: Problem) -> int | None:
    """Samples by which the input acts later than the rig says, of an equation that is linear in its coefficients.

    None where no other delay is far better, or the best is no sharp one. Early answers are negative.
    """
    problem = problem.evened()
    longest = int(min(_PART * min(map(len, problem.u)), LONGEST_DELAY))
    step = max(1, round(_COARSE * 2 * np.pi / problem.frequency))
    delays = np.arange(-_EARLY // step * step, longest + 1, step)
    if len(delays) < 5:
        return None
    own, found = float(misfits(problem, np.zeros(1, dtype=int))[0]), misfits(problem, delays)
    middle = int(delays[np.argmin(found)])
    near = np.arange(middle - step, middle + step + 1)
    fine = misfits(problem, near)
    best = int(near[np.argmin(fine)])
    beside = np.median(found)
    if not (fine.min() < _LEFT * own and fine.min() < _BESIDE * beside) or abs(best) <= 3:
        return None
    return best
