"""The planner's search under a limit of energy, compiled for any model: the whole rest of the episode, by gradient.

When energy is short, what matters is when to spend it: the best input rests, and then drives the oscillator up at its
own frequency in one burst. No short horizon sees that. So the plan is for all samples that are left, and climbs the
worth (`agents.planner.design`) of what follows from the belief: its means as the truth, its covariance as Λ⁻¹, and the
state's part in that as the sensitivities and the filter's covariance to start with. By the Kalman filter's separation
of state and parameters this is the same belief propagation as that of `agents.planner.search`.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np

from agents.planner.ascent import Limits, climber, project
from agents.planner.candidates import uniform
from agents.planner.design import Known, designer, half_log_det, invert
from agents.planner.imagination import MOST_MARGIN, terms_of
from estimator.arrays import copy
from estimator.belief import covariance_places
from estimator.engine.rows import belief_names
from estimator.lanes import kernel, part
from estimator.models.model import Model

#: Input before and after a burst, in parts of that within.
_WEAK = 0.2

#: Steps of the gradient for the plan, and for a challenger before it is compared.
_STEPS, _TRIAL = 8, 3

#: Length of these steps in parts of what the energy allows.
_RATE = 0.2

#: A burst that drives the signal further than so many times its limit goes on from rest.
_FAR = 2.0

#: A plan that leads beyond the limit is halved up to so many times.
_SOFTER = 6


class Pursuit(NamedTuple):
    """Compiled functions of one model and interpolation of the input.

    Attributes:
        pursue: ``pursue(records, left, energies, terms, last, plans, words, actions)``: improve the plans of n
            environments by some gradient steps.

            - ``records`` (n, size): their beliefs, as `estimator.Belief` keeps them.
            - ``left`` (n,) samples, and ``energies`` (n,) energy, left in their episodes.
            - ``terms``: `agents.planner.imagination.Terms` of the whole episode; the margin is of the first sample's
              predictive deviations.
            - ``last`` (n,): the inputs applied last.
            - ``plans`` (n, T): the last plans, begun one sample ago; all zeros where there is none. Overwritten.
            - ``words`` (n, 4): streams of random numbers; overwritten.
            - ``actions`` (n,) receives the first input of each plan.
        begin: ``begin(record, precision, start)``: of a belief the inverse (K, K) of the coefficients' covariance, and
            the rows of a path's start (`agents.planner.design`); the older inputs in it are left as they are.
        swings: ``swings(known, limit, energy, inputs, words)``: fill inputs (k, T) with bursts from rest, which push as
            the system moves.
    """

    pursue: Any
    begin: Any
    swings: Any


@cache
def pursuit(model: Model, degree: int = 0) -> Pursuit:
    """Planning the whole rest of an episode of a model; arguments as `agents.planner.design.designer`."""
    found, ascend = designer(model, degree), climber(model, degree).ascend
    worth, memory_for, start_size, n_path = found.worth, found.memory, found.start_size, found.n_path
    begin_path, coefficients_of, lay, step = found.code.begin, found.code.coefficients, found.code.lay, found.code.step
    n, k, sensors = model.n_states, model.n_coefficients, model.n_outputs
    kind = f"{model.name}_{model.digest}_{degree}"
    first = n + n * (n + 1) // 2  # of the sensitivities in a start
    as_noises, covariance, noise = found.code.noises, covariance_places(model), belief_names(model).index("GAMMA_SHAPE")

    @part(kind)
    def begin(record, precision, start):
        work = np.empty((k, k))
        for a in range(k):
            for b in range(k):
                work[a, b] = record[covariance[n + a, n + b]]
        half_log_det(work)
        invert(work, precision)
        copy(start, 0, record, n)
        # State = Z (coefficients' error) + what is left of it, with Z = P_xc Λ.
        for a in range(n):
            for b in range(k):
                total = 0.0
                for c in range(k):
                    total += record[covariance[a, n + c]] * precision[c, b]
                start[first + k * a + b] = total
        place = n
        for a in range(n):
            for b in range(a, n):
                value = record[covariance[a, b]]
                for c in range(k):
                    value -= start[first + k * a + c] * record[covariance[b, n + c]]
                start[place] = max(0.0, value) if a == b else value
                place += 1

    @part(kind)
    def rest(known, start, last, tape):
        """The signals of two samples without input, and the first one's predictive variance."""
        C = coefficients_of(known.coefficients)
        P, F = begin_path(start)
        P, F, x, spread = step(P, F, C, lay(0.0, last, 0.0), known.noises, tape, 0)
        _, _, then, _ = step(P, F, C, lay(0.0, 0.0, last), known.noises, tape, 0)
        return x, then, spread

    @part(kind)
    def swing(known, start, limit, energy, late, u, words, tape):
        """A burst (T,) that pushes as the signal moves, from a random sample on; weak before and after it.

        ``late`` is the first plan of an episode: not random, and late enough that the burst finds a better belief.
        """
        T = len(u)
        begun = int(T * (0.35 if late else 0.6 * uniform(words)))
        length = 1 + int(T * (0.4 if late else 0.2 + 0.6 * uniform(words)))
        strength = np.sqrt(energy / length)
        last = start[n_path] if start_size > n_path else 0.0
        before, x, _ = rest(known, start, last, tape)
        older = 0.0
        C = coefficients_of(known.coefficients)
        P, F = begin_path(start)
        for t in range(T):
            strong = begun <= t < begun + length
            u[t] = (strength if strong else _WEAK * strength) * (1.0 if x >= before else -1.0)
            before = x
            P, F, x, _ = step(P, F, C, lay(u[t], last, older), known.noises, tape, 0)
            last, older = u[t], last
            if not abs(x) < _FAR * limit:
                P, F = begin_path(np.zeros(start_size))
                x = 0.0

    @kernel(kind=kind)
    def pursue(records, left, energies, terms, last, plans, words, actions):
        T = plans.shape[1]
        start, precision, coefficients = np.zeros(start_size), np.empty((k, k)), np.empty(k)
        variances, memory, challenger, best = np.empty(sensors + 1), memory_for(T), np.empty(T), np.empty(T)
        for i in range(len(records)):
            steps = max(1, min(T, left[i]))
            begin(records[i], precision, start)
            if start_size > n_path:
                start[n_path] = last[i]
            copy(coefficients, 0, records[i, n:], k)
            for a in range(sensors + 1):
                variances[a] = records[i, noise + 2 * a + 1] / records[i, noise + 2 * a]
            known = Known(coefficients, precision, as_noises(variances))
            _, _, spread = rest(known, start, last[i], memory.tape)
            margin = terms_of(terms, left[i]).margin * np.sqrt(spread + terms.shaken * variances[0])
            aim = terms.limit - min(margin, MOST_MARGIN * terms.limit)
            u, other = plans[i, :steps], challenger[:steps]
            fresh = plans[i, 0] == 0.0
            for t in range(T - 1):
                fresh = fresh and plans[i, t + 1] == 0.0
                plans[i, t] = plans[i, t + 1]
            plans[i, T - 1] = 0.0
            limits = Limits(np.inf, aim, terms.amplitude, energies[i])
            project(u, terms.amplitude, energies[i])
            swing(known, start, terms.limit, energies[i], fresh, other, words[i], memory.tape)
            project(other, terms.amplitude, energies[i])
            score = ascend(known, limits, _RATE, _STEPS, start, u, best[:steps], memory)
            if fresh or ascend(known, limits, _RATE, _TRIAL, start, other, best[:steps], memory) > score:
                copy(u, 0, other, steps)
                ascend(known, limits, _RATE, _STEPS, start, u, best[:steps], memory)
            # The gradient may not have come down from where it began.
            for _ in range(_SOFTER):
                _, peak = worth(known, aim, 0.0, start, u, memory)
                if peak <= terms.limit:
                    break
                for t in range(steps):
                    u[t] *= 0.5
            actions[i] = u[0]

    @kernel(kind=kind)
    def swings(known, limit, energy, inputs, words):
        tape, start = memory_for(1).tape, np.zeros(start_size)
        for i in range(len(inputs)):
            swing(known, start, limit, energy, False, inputs[i], words, tape)

    return Pursuit(pursue, begin, swings)
