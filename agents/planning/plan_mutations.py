"""Candidate inputs of the search: shifted last plans, allowed inputs, random mutations, and the slew limit."""

from __future__ import annotations

import numpy as np

from duffing_env.storage.random_streams import sfc64_next, to_open_uniform
from estimator.compilation.simd import jit

#: Inputs to choose from, in parts of the largest. Later in a plan the first five are tried, then the first two.
INPUT_FRACTIONS = (1.0, -1.0, 0.0, 0.5, -0.5, 0.75, -0.75, 0.25, -0.25)

#: Probability that a mutation perturbs one input or two.
_PERTURB_PROBABILITY = 0.5

#: Largest perturbation in parts of the largest input.
_PERTURB_FRACTION = 0.3

#: Power of a uniform number that draws the perturbed move: the higher, the earlier.
_EARLY_POWER = 3


@jit
def hold_samples_for(samples_left, n_moves, max_hold):
    """Samples of a move, so that the samples left take about ``n_moves`` moves.

    Each value is a divisor of the longer one before it.

    Example:
        >>> [hold_samples_for(left, 24, 6) for left in (256, 84, 83, 36, 35)]
        [6, 6, 3, 3, 1]
    """
    target, hold, factor = int(samples_left / n_moves + 0.5), max_hold, 2
    while hold > 1:
        while hold % factor:
            factor += 1
        if target > hold // factor:
            break
        hold //= factor
    return hold


@jit
def drop_played_move(plan, n_moves, previous_hold, hold):
    """Drop the first move of a plan, which was played, and divide the others where moves are shorter than before.

    A plan that is not divided ends with the mirrored first move.

    Example:
        >>> plan = np.array([1.0, 0.5, -1.0, 0.0])
        >>> drop_played_move(plan, 4, 6, 3)
        >>> plan
        array([ 0.5,  0.5, -1. , -1. ])
        >>> drop_played_move(plan, 4, 3, 3)
        >>> plan
        array([ 0.5, -1. , -1. , -0.5])
    """
    mirrored = -plan[0]
    for h in range(len(plan) - 1):
        plan[h] = plan[h + 1]
    if previous_hold > hold:
        for h in range(len(plan) - 1, -1, -1):
            plan[h] = plan[h * hold // previous_hold]
    else:
        plan[n_moves - 1] = mirrored


@jit
def allowed_input(fraction_index, previous_input, objective):
    """The input nearest to one of `INPUT_FRACTIONS` within the slew limit after ``previous_input``."""
    return max(
        previous_input - objective.slew,
        min(INPUT_FRACTIONS[fraction_index] * objective.amplitude, previous_input + objective.slew),
    )


@jit
def limit_slew(plan, n_moves, previous_input, objective):
    """Clip changes of the input to the slew limit, as the environment does."""
    if objective.slew == np.inf:
        return
    for h in range(n_moves):
        plan[h] = max(previous_input - objective.slew, min(plan[h], previous_input + objective.slew))
        previous_input = plan[h]


@jit
def mutate_plan(plan, n_moves, amplitude, rng_state):
    """Mutate a plan: perturb one input or two, mirror one, two or a run of inputs, or shift it."""
    if next_uniform(rng_state) < _PERTURB_PROBABILITY:
        h = np.int64(next_uniform(rng_state) ** _EARLY_POWER * n_moves)
        perturb_input(plan, h, amplitude, rng_state)
        if h + 1 < n_moves and next_uniform(rng_state) < 0.5:
            perturb_input(plan, h + 1, amplitude, rng_state)
        return
    draw_of_mutation = next_uniform(rng_state)
    h = np.int64(next_uniform(rng_state) * n_moves)
    if draw_of_mutation < 0.35:
        plan[h] = -amplitude if plan[h] > 0.0 else amplitude
    elif draw_of_mutation < 0.55:
        other = np.int64(next_uniform(rng_state) * n_moves)
        plan[h] = -amplitude if plan[h] > 0.0 else amplitude
        plan[other] = -amplitude if plan[other] > 0.0 else amplitude
    elif draw_of_mutation < 0.75:
        stop = min(n_moves, h + 2 + np.int64(4.0 * next_uniform(rng_state)))
        for k in range(h, stop):
            plan[k] = -plan[k]
    elif draw_of_mutation < 0.85:
        for k in range(h, n_moves - 1):
            plan[k] = plan[k + 1]
    elif draw_of_mutation < 0.92:
        for k in range(n_moves - 1, h, -1):
            plan[k] = plan[k - 1]
    else:
        plan[h] = amplitude * (2.0 * next_uniform(rng_state) - 1.0)


@jit
def perturb_input(plan, move, amplitude, rng_state):
    """Perturb an input: small changes decide how near to its limit a signal turns."""
    perturbed = plan[move] + _PERTURB_FRACTION * amplitude * (2.0 * next_uniform(rng_state) - 1.0)
    plan[move] = max(-amplitude, min(perturbed, amplitude))


@jit
def next_uniform(rng_state):
    """The next number in (0, 1) of a stream (4,)."""
    value, rng_state[0], rng_state[1], rng_state[2], rng_state[3] = sfc64_next(
        rng_state[0], rng_state[1], rng_state[2], rng_state[3]
    )
    return to_open_uniform(value)
