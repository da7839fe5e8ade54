"""Belief updates: what one sample (u, y) does to a belief, for each recognition factorisation."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from estimator.inference import mean_field, structured
from estimator.lanes import alone, jit, lanewise
from estimator.record import LAYOUT

#: Name of a factorisation to the iterations it uses by default: the paper's 10, and 3 where they are scalars.
DEFAULT_ITERATIONS = {"structured": 3, "mean_field": 10}


@lanewise(LAYOUT, "P_t1_t1 P_t2_t2 P_t3_t3 P_e_e", uniform="walk_t1 walk_t2 walk_t3 walk_e")
def walk(P_t1_t1, P_t2_t2, P_t3_t3, P_e_e, walk_t1, walk_t2, walk_t3, walk_e):
    """Let the coefficients walk at random before a sample, by these variances."""
    return P_t1_t1 + walk_t1, P_t2_t2 + walk_t2, P_t3_t3 + walk_t3, P_e_e + walk_e


def _updating(on: Callable[[Any], Any]) -> Any:
    """The updates with each of their loops over the lanes turned into something else by ``on``."""
    predict, learn_noise, correct = on(structured.predict), on(structured.learn_noise), on(structured.correct)
    begin, iterate, end = on(mean_field.begin), on(mean_field.iterate), on(mean_field.end)

    @jit
    def update_structured(W, iterations, trace):
        predict(W)
        for i in range(iterations):
            learn_noise(W)
            if trace.size:
                trace[i] = structured.free_energy(W, 0)
        correct(W)

    @jit
    def update_mean_field(W, iterations, as_published, trace):
        begin(W)
        for i in range(iterations):
            iterate(W, as_published)
            if trace.size:
                trace[i] = mean_field.free_energy(W, 0)
        end(W)

    @jit
    def update(W, is_structured, iterations, as_published, trace):
        if is_structured:
            update_structured(W, iterations, trace)
        else:
            update_mean_field(W, iterations, as_published, trace)

    return update_structured, update_mean_field, update


#: ``update(W, is_structured, iterations, as_published, trace)`` updates every lane's belief with its rows ``u``, ``y``.
#:
#: - W: block, (rows * LANES,).
#: - is_structured: factorisation; mean field where False.
#: - iterations: number of variational iterations, at least 1.
#: - as_published: mean field with the two departures of the published run.
#: - trace: (iterations,) receives lane 0's free energy after each iteration [nats]; of size 0 to skip it.
#:
#: The two before it are the one and the other, with the arguments that it needs.
update_structured, update_mean_field, update = _updating(lambda loop: loop)

#: The same for the first lane alone, for a single system: a quarter of the time, and other last digits.
_, _, update_alone = _updating(alone)


@jit
def free_energy(W, j, is_structured):
    """Free energy [nats] that the last update left lane ``j`` with."""
    if is_structured:
        return structured.free_energy(W, j)
    return mean_field.free_energy(W, j)
