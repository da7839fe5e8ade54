"""What a plan teaches counts the less, the later it teaches it.

A plan is made anew at each move, and its later moves will be others. So what move h of a plan teaches counts

    w_h = exp(-h / faded)

and a plan is worth the mean of what is known after each of its moves, after move h with the weight w_h - w_{h+1}, and
with the rest of the weight at its end. Were all moves to count alike, the best plan might be to wait for a move, and so
at every decision anew. Of plans that reach the end of the episode all do count alike: ``faded`` is infinite.
"""

from __future__ import annotations

import numpy as np

from agents.planner.motion import Swing
from estimator.lanes import jit

#: What a plan teaches counts e times less so many moves later, or so much of the moves that a swing takes to come near
#: the limit, and at most so many: where a swing has to be built for long, it pays late. Chosen on `validation`.
_FADED, _BUILT, _MOST_FADED = 6.0, 1 / 3.5, 36.0

#: The same so many moves later still, for each sample over which the filter averages its outputs: with a noisy sensor,
#: what a move teaches comes late. Chosen on the branch `validation`.
_AVERAGED = 4.0


def faded_of(swing: Swing) -> float:
    """Moves in which what a plan teaches fades by e, with a sensor without noise."""
    return float(np.clip(_BUILT * swing.built / swing.pace, _FADED, _MOST_FADED))


@jit
def delayed_by(process, sensor):
    """Samples that a noisy sensor delays what a plan teaches by, from the variances of process noise and sensor.

    A filter averages outputs over about the fourth root of their ratio.

    Example:
        >>> [round(delayed_by(1.0, ratio), 1) for ratio in (0.0, 1.0, 625.0)]
        [0.0, 4.0, 20.0]
    """
    return _AVERAGED * (sensor / max(process, 1e-300)) ** 0.25


@jit
def delay_with(record, noise, pace):
    """Moves of so many samples that the noises of a belief delay what a plan teaches by.

    ``noise`` is where its record has the shape of the sensor's precision (`agents.planner.imagination.Mind`).
    """
    process, sensor = record[noise - 1] / record[noise - 2], record[noise + 1] / record[noise]
    return delayed_by(process, sensor) / pace


@jit
def fade(weights, moves, faded):
    """Write the weights of so many moves.

    Example:
        >>> weights = np.zeros(4)
        >>> fade(weights, 3, 2.0)
        >>> weights.round(2)
        array([1.  , 0.61, 0.37, 0.  ])
    """
    for h in range(moves):
        weights[h] = np.exp(-h / faded)


@jit
def share_of(weights, h, moves):
    """What is known after move h of so many counts for this part of the sum of all.

    Example:
        >>> weights = np.array([1.0, 0.6, 0.4, 0.0])
        >>> [round(share_of(weights, h, 3), 1) for h in range(3)]
        [0.4, 0.2, 0.4]
    """
    return weights[h] - (weights[h + 1] if h + 1 < moves else 0.0)
