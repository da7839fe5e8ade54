"""Inputs that the search tries: chosen, changed at random, and kept within their limits."""

from __future__ import annotations

import numpy as np

from duffing_env.noise import draw, to_unit
from estimator.lanes import jit


@jit
def choose(choice, last, terms):
    """The highest input after ``last``, the lowest, or the one nearest to zero."""
    if choice == 0:
        return min(terms.amplitude, last + terms.slew)
    if choice == 1:
        return max(-terms.amplitude, last - terms.slew)
    return max(last - terms.slew, min(0.0, last + terms.slew))


@jit
def bound(candidate, steps, last, terms):
    """Cut changes of the input beyond the slew limit, as the environment does."""
    for h in range(steps):
        candidate[h] = max(last - terms.slew, min(candidate[h], last + terms.slew))
        last = candidate[h]


@jit
def change(candidate, steps, amplitude, words):
    """Change a candidate a little: turn one, two or a run of inputs over, shift it, or put one anywhere."""
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
def uniform(words):
    """A number in (0, 1) from a stream (4,), which moves on."""
    value, words[0], words[1], words[2], words[3] = draw(words[0], words[1], words[2], words[3])
    return to_unit(value)
