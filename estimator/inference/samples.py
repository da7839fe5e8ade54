"""One compiled function that takes samples, for any model: the loop of the online estimator.

A block ``W`` holds one system, or `LANES` hypotheses about the noises of one. Each sample lets the coefficients walk,
puts the inputs into their rows, updates, and judges every member by its free energy.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from estimator.engine import tasks
from estimator.engine.cache import digest_of
from estimator.engine.free_energy import free_energies
from estimator.engine.rows import belief_names
from estimator.inference import mean_field
from estimator.inference.mixture import foretell, leave_out, switch, weigh
from estimator.lanes import LANES, kernel, part
from estimator.models.difference_equation import difference
from estimator.models.model import Model


@dataclass(frozen=True)
class Loop:
    """A compiled loop over samples, and its block.

    Attributes:
        run: ``run(W, backup, weights, begun, inputs, outputs, stencil, steps, walk, energies, forecasts)``, which
            returns -1, or the number of the sample at which the numbers overflowed; then nothing has changed.

            - W: (blocks, rows * lanes), the members' systems one after the other.
            - backup: (blocks, record * lanes), memory.
            - weights: (members,) of the hypotheses.
            - begun: (1,) 0 before the first sample ever.
            - inputs: those that still act, then a new one for each sample; the former are moved on.
            - outputs: (samples, sensors), with the one that waits in front; NaN where missing.
            - stencil: of `estimator.inputs.Feed`.
            - steps: its stride, past, waits and fills, as int64.
            - walk: (K,) variances of the coefficients' random walk per sample.
            - energies: (samples, iterations) receives the free energies [nats]; where it is empty nothing is judged.
            - forecasts: (samples, sensors, 2) receives mean and variance of each output before it was seen.
        layout: rows of the block.
        lanes: systems in a block.
    """

    run: Any
    layout: Mapping[str, int]
    lanes: int


@cache
def structured(model: Model, degree: int, iterations: int, expectations: str = "first_order", members: int = 1) -> Loop:
    """The structured factorisation, with a lane for each member where there are several."""
    lanes = 1 if members == 1 else LANES
    task = tasks.structured(
        model, degree, iterations=iterations, lanes=lanes, trace=True, missing=True, expectations=expectations
    )
    place, update = task.layout, task.update
    energies_of = free_energies(model, iterations, lanes, place)
    kind = f"{model.name}_{digest_of(model.digest, degree, iterations, lanes, expectations)}"
    unsound = place.get("UNSOUND", -1) * lanes

    @part(kind)
    def take(W, before):
        if unsound >= 0:
            for j in range(lanes):
                W[unsound + j] = 0.0
        update(W)
        energies_of(W, before)

    sensors = model.n_outputs
    means = tuple(place[f"TRACE_{k}_mean"] * lanes for k in range(sensors))
    parts = tuple(
        tuple(place[f"TRACE_{k}_{what}"] * lanes for what in ("variance", f"q_{iterations - 1}", f"r_{iterations - 1}"))
        for k in range(sensors)
    )

    @part(kind)
    def judge(W, j, before, values, forecasts):
        for i in range(iterations):
            values[i] = np.nan if unsound >= 0 and W[unsound + j] > 0.0 else before[i * lanes + j]
        for k in range(sensors):
            forecasts[k, 0] = W[means[k] + j]
            forecasts[k, 1] = W[parts[k][0] + j] + W[parts[k][1] + j] + W[parts[k][2] + j]

    return Loop(_loop(kind, model, place, lanes, iterations * lanes, take, judge), place, lanes)


@cache
def published(iterations: int, as_published: bool) -> Loop:
    """The paper's mean field, with or without the departures of the published run. It makes no forecasts."""
    model = difference()
    place = mean_field.layout()
    begin, iterate, end, energy = mean_field.pieces(place, lanes=1)
    kind = f"mean_field_{digest_of(model.digest, iterations, as_published)}"

    @part(kind)
    def take(W, before):
        begin(W)
        for i in range(iterations):
            iterate(W, as_published)
            before[i] = energy(W, 0)
        end(W)

    @part(kind)
    def judge(W, j, before, values, forecasts):
        for i in range(iterations):
            values[i] = before[i]
        forecasts[0, 0] = forecasts[0, 1] = np.nan

    return Loop(_loop(kind, model, place, 1, iterations, take, judge), place, 1)


def _loop(kind: str, model: Model, place: Mapping[str, int], lanes: int, scratch: int, take: Any, judge: Any) -> Any:
    """The loop of `Loop.run` around an update ``take(W, before)`` and its ``judge(W, j, before, values, forecasts)``.

    Args:
        kind: names the compiled code; see `estimator.lanes.part`.
        model: whose rows.
        place: of the rows.
        lanes: systems in a block.
        scratch: numbers that ``take`` leaves in ``before`` for ``judge``.
        take: updates a block.
        judge: free energies and forecasts of a lane.
    """
    u_row = place["U_0"] * lanes
    y_row = place[f"Y_{next(iter(model.outputs))}"] * lanes
    walks = tuple(place[f"P_{c}_{c}"] * lanes for c in model.coefficients)
    sensors, alone = model.n_outputs, lanes == 1
    size = len(belief_names(model)) * lanes

    @part(kind)
    def feed(W, inputs, start, window, stencil, output, walk, changes):
        if changes:
            for c in range(len(walks)):
                for j in range(lanes):
                    W[walks[c] + j] += walk[c]
        for i in range(len(stencil)):
            value = 0.0
            for w in range(window):
                value += inputs[start + w] * stencil[i, w]
            for j in range(lanes):
                W[u_row + i * lanes + j] = value
        for k in range(sensors):
            for j in range(lanes):
                W[y_row + k * lanes + j] = output[k]

    @part(kind)
    def keep(kept, blocks):
        """Copy the beliefs in some blocks to others."""
        for b in range(len(blocks)):
            for i in range(size):
                kept[b, i] = blocks[b, i]

    @kernel(kind=kind)
    def run(W, backup, weights, begun, inputs, outputs, stencil, steps, walk, energies, forecasts):
        stride, past, waits, fills = steps[0], steps[1], steps[2], steps[3]
        members, samples, iterations = len(weights), len(outputs) - waits, energies.shape[1]
        judged = energies.shape[0] > 0
        window, changes = stencil.shape[1], walk[0] > 0.0
        for c in range(1, len(walks)):
            changes = changes or walk[c] > 0.0
        before = np.empty(scratch)
        single, shares = np.empty((members, iterations)), np.empty((members, iterations))
        predictions = np.empty((members, sensors, 2))
        old_weights = np.empty(members)
        for m in range(members):
            old_weights[m] = weights[m]
        first = 1 if waits and begun[0] == 0.0 else 0
        if fills and begun[0] == 0.0:
            for i in range(past):
                inputs[i] = inputs[past]
        keep(backup, W)
        bad = -1
        for t in range(first, samples):
            for b in range(len(W)):
                feed(W[b], inputs, t * stride, window, stencil, outputs[t], walk, changes)
                take(W[b], before)
                for j in range(min(lanes, members - b * lanes)):
                    m = b * lanes + j
                    judge(W[b], j, before, single[m], predictions[m])
            here = t - first
            if alone or not judged:
                for k in range(sensors):
                    forecasts[here, k, 0], forecasts[here, k, 1] = predictions[0, k, 0], predictions[0, k, 1]
            else:
                for m in range(members):
                    leave_out(single[m], predictions[m])
                    for i in range(iterations):
                        shares[m, i] = weights[m]
                switch(shares, single)
                foretell(shares, predictions, forecasts[here])
                weigh(shares, single, energies[here])
                for m in range(members):
                    weights[m] = shares[m, iterations - 1]
            if not judged:
                continue
            whole = True
            for i in range(iterations):
                if alone:
                    energies[here, i] = single[0, i]
                whole = whole and np.isfinite(energies[here, i])
            if not whole:
                bad = t
                break
        if judged and bad < 0 and samples > first:
            # What the last sample left is seen by no later free energy.
            whole = False
            for m in range(members):
                finite = weights[m] > 0.0
                for i in range(m % lanes, size, lanes):
                    finite = finite and np.isfinite(W[m // lanes, i])
                whole = whole or finite
            if not whole:
                bad = samples - 1
        if bad >= 0:
            keep(W, backup)
            for m in range(members):
                weights[m] = old_weights[m]
            if fills and begun[0] == 0.0:
                for i in range(past):
                    inputs[i] = 0.0
            return bad
        for i in range(past):
            inputs[i] = inputs[i + samples]
        for i in range(waits):
            for k in range(sensors):
                outputs[i, k] = outputs[i + samples, k]
        begun[0] = 1.0
        return bad

    return run
