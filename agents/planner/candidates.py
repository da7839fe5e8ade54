"""Inputs that the search tries: of the last plan, chosen, changed at random, and kept within their limits."""

from __future__ import annotations

import numpy as np

from duffing_env.storage.random_streams import sfc64_next, to_uniform
from estimator.lanes import jit

#: Inputs to choose from, in parts of the largest. Of what is further off in a plan, the first five will do, then two.
CHOICES = (1.0, -1.0, 0.0, 0.5, -0.5, 0.75, -0.75, 0.25, -0.25)

#: Of small changes, so many move an input by up to so much of the largest; the higher the power, the sooner in a plan.
_MOVED, _BY, _SOON = 0.5, 0.3, 3


@jit
def pace_for(left, moves, longest):
    """Samples of a move, where so many are left in an episode of which the rest should take so many moves.

    Each is a divisor of the longer one before it.

    Example:
        >>> [pace_for(left, 24, 6) for left in (256, 84, 83, 36, 35)]
        [6, 6, 3, 3, 1]
    """
    wanted, pace, factor = int(left / moves + 0.5), longest, 2
    while pace > 1:
        while pace % factor:
            factor += 1
        if wanted > pace // factor:
            break
        pace //= factor
    return pace


@jit
def follow_up(plan, steps, before, pace):
    """Take off the first move of a plan, which was played, and divide the others where moves are shorter than before.

    A plan of so many steps that is not divided ends with what was taken off, turned over.

    Example:
        >>> plan = np.array([1.0, 0.5, -1.0, 0.0])
        >>> follow_up(plan, 4, 6, 3)
        >>> plan
        array([ 0.5,  0.5, -1. , -1. ])
        >>> follow_up(plan, 4, 3, 3)
        >>> plan
        array([ 0.5, -1. , -1. , -0.5])
    """
    turned = -plan[0]
    for h in range(len(plan) - 1):
        plan[h] = plan[h + 1]
    if before > pace:
        for h in range(len(plan) - 1, -1, -1):
            plan[h] = plan[h * pace // before]
    else:
        plan[steps - 1] = turned


@jit
def choose(choice, last, terms):
    """The input nearest to one of `CHOICES` that is allowed after ``last``."""
    return max(last - terms.slew, min(CHOICES[choice] * terms.amplitude, last + terms.slew))


@jit
def bound(candidate, steps, last, terms):
    """Cut changes of the input beyond the slew limit, where there is one, as the environment does."""
    if terms.slew == np.inf:
        return
    for h in range(steps):
        candidate[h] = max(last - terms.slew, min(candidate[h], last + terms.slew))
        last = candidate[h]


@jit
def change(candidate, steps, amplitude, words):
    """Change a candidate a little: move one input or two, turn one, two or a run of them over, or shift it."""
    if uniform(words) < _MOVED:
        h = np.int64(uniform(words) ** _SOON * steps)
        move(candidate, h, amplitude, words)
        if h + 1 < steps and uniform(words) < 0.5:
            move(candidate, h + 1, amplitude, words)
        return
    kind = uniform(words)
    h = np.int64(uniform(words) * steps)
    if kind < 0.35:
        candidate[h] = -amplitude if candidate[h] > 0.0 else amplitude
    elif kind < 0.55:
        other = np.int64(uniform(words) * steps)
        candidate[h] = -amplitude if candidate[h] > 0.0 else amplitude
        candidate[other] = -amplitude if candidate[other] > 0.0 else amplitude
    elif kind < 0.75:
        stop = min(steps, h + 2 + np.int64(4.0 * uniform(words)))
        for k in range(h, stop):
            candidate[k] = -candidate[k]
    elif kind < 0.85:
        for k in range(h, steps - 1):
            candidate[k] = candidate[k + 1]
    elif kind < 0.92:
        for k in range(steps - 1, h, -1):
            candidate[k] = candidate[k - 1]
    else:
        candidate[h] = amplitude * (2.0 * uniform(words) - 1.0)


@jit
def move(candidate, h, amplitude, words):
    """Move an input a little: how near to its limit a signal turns depends on little."""
    moved = candidate[h] + _BY * amplitude * (2.0 * uniform(words) - 1.0)
    candidate[h] = max(-amplitude, min(moved, amplitude))


@jit
def uniform(words):
    """A number in (0, 1) from a stream (4,), which moves on."""
    value, words[0], words[1], words[2], words[3] = sfc64_next(words[0], words[1], words[2], words[3])
    return to_uniform(value)
