"""The planner's search under a limit of energy, compiled: the whole rest of the episode, by gradient.

When energy is short, what matters is when to spend it: the best input rests, and then drives the oscillator up at its
own frequency in one burst. No short horizon sees that. So the plan is for all samples that are left, and climbs the
worth (`agents.design`) of what follows from the belief: its means as the truth, its covariance as Λ⁻¹, and the state's
part in that as the sensitivities and the filter's covariance to start with. By the Kalman filter's separation of state
and parameters this is the same belief propagation as that of `agents.policies.planning`.
"""

from __future__ import annotations

import numpy as np

from agents.ascent import ascend, project
from agents.design import START_SIZE, half_log_det, invert
from agents.policies.planning import uniform
from estimator.lanes import jit, kernel
from estimator.record import COEFFICIENTS, RECORD

_X0, _X1, _T1, _NOISES = (RECORD.index(name) for name in ("x0", "x1", "t1", "g_shape"))
_STATES = np.array([RECORD.index(f"P_{pair}") for pair in ("x0_x0", "x0_x1", "x1_x1")])
_CROSS = np.array([[RECORD.index(f"P_{x}_{c}") for c in COEFFICIENTS] for x in ("x0", "x1")])
_COVARIANCE = np.array(
    [
        [RECORD.index(f"P_{'_'.join(sorted((a, b), key=COEFFICIENTS.index))}") for a in COEFFICIENTS]
        for b in COEFFICIENTS
    ]
)

#: Input before and after a burst, in parts of that within.
_WEAK = 0.2

#: Steps of the gradient for the plan, and for a challenger before it is compared.
_STEPS, _TRIAL = 8, 3

#: Length of these steps in parts of what the energy allows.
_RATE = 0.2


@kernel
def pursue(records, left, energies, amplitude, limit, margin, plans, words, actions, scores):
    """Improve the plans of n environments by some gradient steps.

    Args:
        records: (n, RECORD_SIZE) their beliefs.
        left: (n,) samples left in their episodes.
        energies: (n,) energy left [V²].
        amplitude: largest input [V].
        limit: of the displacement [V].
        margin: predictive standard deviations of a settled filter that a plan keeps from it.
        plans: (n, T) the last plans, begun one sample ago [V]; all zeros where there is none. Overwritten.
        words: (n, 4) streams of random numbers; overwritten.
        actions: (n,) receives the first input of the plan [V].
        scores: (n,) receives the plan's worth [nats].
    """
    T = plans.shape[1]
    start, theta = np.empty(START_SIZE), np.empty(4)
    precision, F = np.empty((4, 4)), np.empty((4, 4))
    tape = np.empty((T + 1, START_SIZE))
    challenger = np.empty(T)
    for i in range(len(records)):
        steps = max(1, min(T, left[i]))
        q = records[i, _NOISES + 1] / records[i, _NOISES]
        r = records[i, _NOISES + 3] / records[i, _NOISES + 2]
        begin(records[i], theta, precision, start, F)
        aim = limit - margin * np.sqrt(start[2] + q + r)
        u, other = plans[i, :steps], challenger[:steps]
        fresh = not np.any(plans[i])
        plans[i, :-1] = plans[i, 1:].copy()
        plans[i, -1] = 0.0
        project(u, amplitude, energies[i])
        swing(theta, start, energies[i], fresh, other, words[i])
        project(other, amplitude, energies[i])
        told = (theta, precision, q, r, aim, np.inf, amplitude, energies[i], _RATE)
        scores[i] = ascend(*told, _STEPS, start, u, tape, F)
        if fresh or ascend(*told, _TRIAL, start, other, tape, F) > scores[i]:
            u[:] = other
            scores[i] = ascend(*told, _STEPS, start, u, tape, F)
        actions[i] = u[0]


@jit
def begin(record, theta, precision, start, work):
    """From a belief: means, precision of the coefficients, and what a trajectory starts with (`agents.design`)."""
    for j in range(4):
        theta[j] = record[_T1 + j]
        for k in range(4):
            work[j, k] = record[_COVARIANCE[j, k]]
    half_log_det(work)
    invert(work, precision)
    start[0], start[1] = record[_X0], record[_X1]
    # State = S (coefficients' error) + what is left of it, with S = P_xc Λ.
    for s in range(2):
        for j in range(4):
            total = 0.0
            for k in range(4):
                total += record[_CROSS[s, k]] * precision[k, j]
            start[5 + 4 * s + j] = total
    for p in range(3):
        first, second = p // 2, 1 if p > 0 else 0
        value = record[_STATES[p]]
        for k in range(4):
            value -= start[5 + 4 * first + k] * record[_CROSS[second, k]]
        start[2 + p] = max(0.0, value) if p != 1 else value


@jit
def swing(theta, start, energy, late, u, words):
    """A burst (T,) that pushes as the believed oscillator moves, from a random sample on; weak before and after it.

    ``late`` is the first plan of an episode: not random, and late enough that the burst finds a better belief.
    """
    T = len(u)
    begun = int(T * (0.35 if late else 0.6 * uniform(words)))
    length = 1 + int(T * (0.4 if late else 0.2 + 0.6 * uniform(words)))
    strength = np.sqrt(energy / length)
    x, last_x = start[0], start[1]
    for t in range(T):
        strong = begun <= t < begun + length
        u[t] = (strength if strong else _WEAK * strength) * (1.0 if x >= last_x else -1.0)
        moved = theta[0] * x + theta[1] * x * x * x + theta[2] * last_x + theta[3] * u[t]
        x, last_x = moved if abs(moved) < 1.0 else 0.0, x


@kernel
def swings(theta, energy, inputs, words):
    """Fill inputs (n, T) with such bursts of a system (4,) at rest."""
    for i in range(len(inputs)):
        swing(theta, np.zeros(START_SIZE), energy, False, inputs[i], words)
