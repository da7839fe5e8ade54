"""Belief updates: what one sample (u, y) does to a belief, for each recognition factorisation."""

from __future__ import annotations

from estimator.inference import mean_field, structured
from estimator.lanes import jit, lanewise
from estimator.record import LAYOUT

#: Name of a factorisation to the iterations it uses by default: the paper's 10, and 3 where they are scalars.
DEFAULT_ITERATIONS = {"structured": 3, "mean_field": 10}


@lanewise(LAYOUT, "P_t1_t1 P_t2_t2 P_t3_t3 P_e_e", uniform="walk_t1 walk_t2 walk_t3 walk_e")
def walk(P_t1_t1, P_t2_t2, P_t3_t3, P_e_e, walk_t1, walk_t2, walk_t3, walk_e):
    """Let the coefficients walk at random before a sample, by these variances."""
    return P_t1_t1 + walk_t1, P_t2_t2 + walk_t2, P_t3_t3 + walk_t3, P_e_e + walk_e


@jit
def update_structured(W, iterations, trace):
    """The structured update of `update`."""
    structured.predict(W)
    for i in range(iterations):
        structured.learn_noise(W)
        if trace.size:
            trace[i] = structured.free_energy(W, 0)
    structured.correct(W)


@jit
def update_mean_field(W, iterations, as_published, trace):
    """The mean-field update of `update`."""
    mean_field.begin(W)
    for i in range(iterations):
        mean_field.iterate(W, as_published)
        if trace.size:
            trace[i] = mean_field.free_energy(W, 0)
    mean_field.end(W)


@jit
def update(W, is_structured, iterations, as_published, trace):
    """Update every lane's belief with its rows ``u`` and ``y``.

    Args:
        W: block, (rows * LANES,).
        is_structured: factorisation; mean field where False.
        iterations: number of variational iterations, at least 1.
        as_published: mean field with the two departures of the published run.
        trace: (iterations,) receives lane 0's free energy after each iteration [nats]; of size 0 to skip it.
    """
    if is_structured:
        update_structured(W, iterations, trace)
    else:
        update_mean_field(W, iterations, as_published, trace)


@jit
def free_energy(W, j, is_structured):
    """Free energy [nats] that the last update left lane ``j`` with."""
    if is_structured:
        return structured.free_energy(W, j)
    return mean_field.free_energy(W, j)
