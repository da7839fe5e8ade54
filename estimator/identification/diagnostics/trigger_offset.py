"""By how many samples outputs answer late, or early, where channels were triggered apart: found without a start."""

from __future__ import annotations

import numpy as np

from estimator.identification.fitting.weak_form import delay_misfits
from estimator.identification.likelihood.identification_problem import IdentificationProblem
from estimator.rigs.rig import MAX_DELAY

#: Delays are tried up to this part of a record, and early answers up to this many samples.
_MAX_DELAY_FRACTION, _MAX_ADVANCE = 0.25, 60

#: Steps between the delays that are tried first, in parts of a period, and about the best of them.
_COARSE_PERIOD_FRACTION = 1 / 16

#: Part of the misfit at the rig's own delay that another must leave, at most, and part of that beside it.
_MAX_MISFIT_TO_STATED, _MAX_MISFIT_TO_MEDIAN = 0.5, 0.9


def find_trigger_offset(problem: IdentificationProblem) -> int | None:
    """Samples by which the input acts later than the rig says, of an equation that is linear in its coefficients.

    None where no other delay is far better, or the best is no sharp one. Early answers are negative.
    """
    problem = problem.resampled_evenly()
    longest = int(min(_MAX_DELAY_FRACTION * min(map(len, problem.u)), MAX_DELAY))
    step = max(1, round(_COARSE_PERIOD_FRACTION * 2 * np.pi / problem.mean_frequency))
    delays = np.arange(-_MAX_ADVANCE // step * step, longest + 1, step)
    if len(delays) < 5:
        return None
    stated_misfit, coarse_misfits = (
        float(delay_misfits(problem, np.zeros(1, dtype=int))[0]),
        delay_misfits(problem, delays),
    )
    middle = int(delays[np.argmin(coarse_misfits)])
    fine_delays = np.arange(middle - step, middle + step + 1)
    fine_misfits = delay_misfits(problem, fine_delays)
    best = int(fine_delays[np.argmin(fine_misfits)])
    median_misfit = np.median(coarse_misfits)
    if (
        not (
            fine_misfits.min() < _MAX_MISFIT_TO_STATED * stated_misfit
            and fine_misfits.min() < _MAX_MISFIT_TO_MEDIAN * median_misfit
        )
        or abs(best) <= 3
    ):
        return None
    return best
