"""What a plan teaches counts the less, the later it teaches it.

A plan is made anew at each move, and its later moves will be others. So what move h of a plan teaches counts

    w_h = exp(-h / faded)

and a plan is worth the mean of what is known after each of its moves, after move h with the weight w_h - w_{h+1}, and
with the rest of the weight at its end. Were all moves to count alike, the best plan might be to wait for a move, and so
at every decision anew. Of plans that reach the end of the episode all do count alike: ``discount_moves`` is infinite.
"""

from __future__ import annotations

import numpy as np

from agents.planning.time_scales import TimeScales
from estimator.compilation.simd import jit

#: What a plan teaches counts e times less so many moves later, or so much of the moves that a swing takes to come near
#: the limit, and at most so many: where a swing has to be built for long, it pays late. Chosen on `validation`.
_MIN_DISCOUNT_MOVES, _RISE_TIME_FRACTION, _MAX_DISCOUNT_MOVES = 6.0, 1 / 3.5, 36.0

#: The same so many moves later still, for each sample over which the filter averages its outputs: with a noisy sensor,
#: what a move teaches comes late. Chosen on the branch `validation`.
_DELAY_FACTOR = 4.0


def discount_moves_for(time_scales: TimeScales) -> float:
    """Moves in which what a plan teaches fades by e, with a sensor without noise."""
    return float(
        np.clip(
            _RISE_TIME_FRACTION * time_scales.rise_time / time_scales.hold_samples,
            _MIN_DISCOUNT_MOVES,
            _MAX_DISCOUNT_MOVES,
        )
    )


@jit
def filter_delay(process_variance, sensor_variance):
    """Samples that a noisy sensor delays what a plan teaches by, from the variances of process noise and sensor.

    A filter averages outputs over about the fourth root of their ratio.

    Example:
        >>> [round(filter_delay(1.0, ratio), 1) for ratio in (0.0, 1.0, 625.0)]
        [0.0, 4.0, 20.0]
    """
    return _DELAY_FACTOR * (sensor_variance / max(process_variance, 1e-300)) ** 0.25


@jit
def filter_delay_in_moves(record, noise_index, hold_samples):
    """Moves of so many samples that the noises of a belief delay what a plan teaches by.

    ``noise_index`` is where its record has the shape of the sensor's precision (`agents.planning.belief_rollout.BeliefRollout`).
    """
    process_variance, sensor_variance = (
        record[noise_index - 1] / record[noise_index - 2],
        record[noise_index + 1] / record[noise_index],
    )
    return filter_delay(process_variance, sensor_variance) / hold_samples


@jit
def fill_discount_weights(weights, n_moves, discount_moves):
    """Write the weights of so many moves.

    Example:
        >>> weights = np.zeros(4)
        >>> fill_discount_weights(weights, 3, 2.0)
        >>> weights.round(2)
        array([1.  , 0.61, 0.37, 0.  ])
    """
    for h in range(n_moves):
        weights[h] = np.exp(-h / discount_moves)


@jit
def discount_weight_drop(weights, move, n_moves):
    """What is known after move h of so many counts for this part of the sum of all.

    Example:
        >>> weights = np.array([1.0, 0.6, 0.4, 0.0])
        >>> [round(discount_weight_drop(weights, h, 3), 1) for h in range(3)]
        [0.4, 0.2, 0.4]
    """
    return weights[move] - (weights[move + 1] if move + 1 < n_moves else 0.0)
