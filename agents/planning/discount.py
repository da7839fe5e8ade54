"""Discount of a plan's information: later moves count less, as a plan is made anew at each move.

The information after move h of a plan counts

    w_h = exp(-h / discount_moves)

and the score of a plan is the mean of the information after each of its moves, with weight w_h - w_{h+1} after move h
and the remaining weight at its end. If all moves counted alike, the best plan could be to wait for a move, at every
decision anew. In plans that reach the end of the episode all do count alike: ``discount_moves`` is infinite.
"""

from __future__ import annotations

import numpy as np

from agents.planning.time_scales import TimeScales
from estimator.compilation.simd import jit

#: Moves after which information counts e times less, at least.
_MIN_DISCOUNT_MOVES = 6.0

#: The same in parts of the moves in which an oscillation rises to the limit: a slow rise pays late.
_RISE_TIME_FRACTION = 1 / 3.5

#: The same at most, in moves.
_MAX_DISCOUNT_MOVES = 36.0

#: Samples of additional delay per sample over which the filter averages outputs: a noisy sensor delays information.
_DELAY_FACTOR = 4.0


def discount_moves_for(time_scales: TimeScales) -> float:
    """Moves after which information counts e times less, with a sensor without noise."""
    return float(
        np.clip(
            _RISE_TIME_FRACTION * time_scales.rise_time / time_scales.hold_samples,
            _MIN_DISCOUNT_MOVES,
            _MAX_DISCOUNT_MOVES,
        )
    )


@jit
def filter_delay(process_variance, sensor_variance):
    """Samples by which a noisy sensor delays information, from the variances of process noise and sensor.

    A filter averages outputs over about the fourth root of their ratio, in samples.

    Example:
        >>> [round(filter_delay(1.0, ratio), 1) for ratio in (0.0, 1.0, 625.0)]
        [0.0, 4.0, 20.0]
    """
    return _DELAY_FACTOR * (sensor_variance / max(process_variance, 1e-300)) ** 0.25


@jit
def filter_delay_in_moves(record, noise_index, hold_samples):
    """Moves of ``hold_samples`` samples by which the noises of a belief delay information.

    ``noise_index`` is where the record has the shape of the sensor's precision
    (`agents.planning.belief_rollout.BeliefRollout`).
    """
    process_variance, sensor_variance = (
        record[noise_index - 1] / record[noise_index - 2],
        record[noise_index + 1] / record[noise_index],
    )
    return filter_delay(process_variance, sensor_variance) / hold_samples


@jit
def fill_discount_weights(weights, n_moves, discount_moves):
    """Fill in the weights of a plan's moves.

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
    """The weight of the information after a move, as part of the sum of all.

    Example:
        >>> weights = np.array([1.0, 0.6, 0.4, 0.0])
        >>> [round(discount_weight_drop(weights, h, 3), 1) for h in range(3)]
        [0.4, 0.2, 0.4]
    """
    return weights[move] - (weights[move + 1] if move + 1 < n_moves else 0.0)
