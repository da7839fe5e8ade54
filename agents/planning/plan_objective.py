"""The objective of a plan besides information: input limits, margins from the output limit, costs and the horizon."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import stdtrit

from estimator.compilation.simd import jit
from estimator.support.array_types import FloatArray

#: A margin is at most this part of the limit: where noise alone leads beyond the limit, no plan is safe.
MAX_MARGIN_FRACTION = 0.5

#: Probability that an episode leaves the limit if every output is at the margin.
DEFAULT_RISK = 0.001

#: Degrees of freedom of Student's t at sample t: 4 + (`_INITIAL_CERTAINTY` + t/`_LEARNING_SAMPLES`)².
_INITIAL_CERTAINTY = 2.0

#: Samples in which the root of these degrees of freedom grows by 1.
_LEARNING_SAMPLES = 16.0


def margin_profile(n_samples: int, risk: float = DEFAULT_RISK) -> FloatArray:
    """Predictive standard deviations (samples,) to keep from the limit at each sample of an episode.

    Outputs that are all at this margin leave the limit with probability ``risk`` under Student's t: unknown
    coefficients and unknown noises make large deviations more frequent than a Gaussian does. The degrees of freedom are
    4 + 2/w where the variance of an output is known with relative variance w; they grow as the noises become known.

    Example:
        >>> margin_profile(256)[[0, 32, 255]].round(1)
        array([10.1,  6. ,  4.5])
    """
    certainty = _INITIAL_CERTAINTY + np.arange(n_samples) / _LEARNING_SAMPLES
    return np.asarray(-stdtrit(4.0 + certainty**2, risk / n_samples))


class PlanObjective(NamedTuple):
    """Costs and limits of plans, besides the belief.

    Attributes:
        amplitude: largest input.
        slew: largest change of the input from sample to sample; inf without a slew limit.
        limit: of the first sensor.
        margin: predictive standard deviations that a plan keeps from the limit: (samples,) at each sample of an
            episode; `objective_at` takes one of them.
        walk: (K,) variances of the coefficients' random walk per sample; zeros for constants.
        scales: (n,) sizes of the states when the first sensor is at its limit.
        hold_samples: samples for which a planned input is held, at most.
        accumulated_noise: multiple of the process noise's variance that a plan keeps from the limit
            (`agents.planning.time_scales`), where it exceeds the information of the output before.
        input_weight: nats per squared input.
        goal: mean of the goal prior of the first sensor's output.
        goal_weight: half the precision of the goal prior; 0 without a goal.
        hard_margin: 1 where the margin counts as the limit itself, as a shield needs it that calls unsafe the inputs
            that lead there; 0 for a soft margin.
        discount_moves: moves after which the information of a plan counts e times less, with a sensor without noise
            (`agents.planning.discount`).
        cells: of the state grid along each axis, from minus a state's scale to plus
            (`agents.planning.grid_beam_search`).
        recoverable_step: change of the first sensor's output, per unit of an input over one sample, that is counted on
            to make up for the information of the output before; 0 for none.
    """

    amplitude: float
    slew: float
    limit: float
    margin: float | FloatArray
    walk: FloatArray
    scales: FloatArray
    hold_samples: int = 1
    accumulated_noise: float = 0.0
    input_weight: float = 0.0
    goal: float = 0.0
    goal_weight: float = 0.0
    hard_margin: float = 0.0
    discount_moves: float = 6.0
    cells: int = 24
    recoverable_step: float = 0.0


@jit
def objective_at(episode, samples_left):
    """The objective of an episode with the margin of its next sample, where ``samples_left`` samples are left."""
    e, size = episode, len(episode.margin)
    margin = e.margin[min(max(0, size - samples_left), size - 1)]
    unchanged = (
        e.walk,
        e.scales,
        e.hold_samples,
        e.accumulated_noise,
        e.input_weight,
        e.goal,
        e.goal_weight,
        e.hard_margin,
        e.discount_moves,
        e.cells,
        e.recoverable_step,
    )
    return PlanObjective(e.amplitude, e.slew, e.limit, margin, *unchanged)
