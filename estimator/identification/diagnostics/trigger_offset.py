"""Offset between separately triggered channels [samples], from the weak form of the equation, without a start value."""

from __future__ import annotations

import numpy as np

from estimator.identification.fitting.weak_form import delay_misfits
from estimator.identification.likelihood.scaled_records import MAX_UNSTATED_DELAY, ScaledRecords
from estimator.rigs.rig import MAX_DELAY

#: Longest delay that is tried, as a fraction of the shortest record.
_MAX_DELAY_FRACTION = 0.25

#: Samples by which the output may precede the input.
_MAX_ADVANCE = 60

#: Step between the delays that are tried first, in periods; the delays about the best are then tried one by one.
_COARSE_PERIOD_FRACTION = 1 / 16

#: Misfit at another delay, as a fraction of the misfit at the rig's delay, at most.
_MAX_MISFIT_TO_STATED = 0.5

#: Misfit at another delay, as a fraction of the median over all delays, at most.
_MAX_MISFIT_TO_MEDIAN = 0.9


def find_trigger_offset(problem: ScaledRecords) -> int | None:
    """Samples by which the input acts later than the rig says; negative where the output responds early.

    None where no other delay is far better, or where the misfit has no sharp minimum.
    """
    problem = problem.resampled_evenly()
    longest = int(min(_MAX_DELAY_FRACTION * min(map(len, problem.u)), MAX_DELAY))
    step = max(1, round(_COARSE_PERIOD_FRACTION * 2 * np.pi / problem.mean_frequency))
    delays = np.arange(-_MAX_ADVANCE // step * step, longest + 1, step)
    if len(delays) < 5:
        return None
    stated_misfit = float(delay_misfits(problem, np.zeros(1, dtype=int))[0])
    coarse_misfits = delay_misfits(problem, delays)
    middle = int(delays[np.argmin(coarse_misfits)])
    fine_delays = np.arange(middle - step, middle + step + 1)
    fine_misfits = delay_misfits(problem, fine_delays)
    best = int(fine_delays[np.argmin(fine_misfits)])
    is_sharp = (
        fine_misfits.min() < _MAX_MISFIT_TO_STATED * stated_misfit
        and fine_misfits.min() < _MAX_MISFIT_TO_MEDIAN * np.median(coarse_misfits)
    )
    return best if is_sharp and abs(best) > MAX_UNSTATED_DELAY else None
