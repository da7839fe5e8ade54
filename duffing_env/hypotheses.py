"""Hypotheses about the noises in an environment: several beliefs learn side by side, and the mixture is what is seen.

Their priors and their weights are those of `estimator.ensemble`. A *member* is one of these beliefs. The members of an
environment lie in adjacent lanes of blocks of their own, those of its neighbour behind them: where each has M,
those of a block of environments fill M blocks, and no block is shared by two.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from duffing_env.layout import Kind, layout_of
from estimator.arrays import copy
from estimator.engine.free_energy import free_energies
from estimator.engine.rows import belief_names, input_rows
from estimator.engine.tasks import structured
from estimator.inference.mixture import mixing, weigh
from estimator.inference.samples import forecaster
from estimator.lanes import LANES, part, rows


def member_layout(kind: Kind) -> Mapping[str, int]:
    """Name of a quantity to its row in a block of members."""
    place = _update(kind).layout
    return {**place, **rows("WEIGHT ENERGY", start=max(place.values()) + 1)}


def _update(kind: Kind) -> Any:
    expectations = "sigma_points" if kind.points else "first_order"
    return structured(kind.belief, kind.degree, iterations=kind.iterations, trace=True, expectations=expectations)


class Members(NamedTuple):
    """What environments do with ``members`` (blocks, rows * LANES), those of a whole batch.

    Attributes:
        begin: ``begin(members, environment, setup)`` puts those of an environment to their priors.
        learn: ``learn(W, members, block, setup)`` updates those of a block's environments with its inputs and outputs,
            and the environments' beliefs to their mixtures.

    Environments behind the last, which fill its block, may have none, and keep their beliefs.
    """

    begin: Any
    learn: Any


#: Those of a single belief, which has none.
NONE = Members(None, None)


def members_of(kind: Kind) -> Members:
    """Compile them for a kind of experiment."""
    place, own, model = layout_of(kind), member_layout(kind), kind.belief
    update, size = _update(kind).update, len(belief_names(model))
    memory_for, mix, _ = mixing(len(model.names))
    sensor = next(iter(model.outputs))
    given = [*input_rows(model, kind.degree), f"Y_{sensor}"]
    fed = tuple((own[row] * LANES, place[row] * LANES) for row in given)
    walks = tuple(own[f"P_{c}_{c}"] * LANES for c in model.coefficients)
    weight, energy, free_energy = own["WEIGHT"] * LANES, own["ENERGY"] * LANES, place.get("FREE_ENERGY", -1) * LANES
    unsound = own.get("UNSOUND", -1) * LANES
    energies_of = free_energies(model, kind.iterations, LANES, own, every=False)
    look = forecaster(kind.name, model, kind.iterations, LANES, own)
    inner = part(kind.name)

    @inner
    def begin(members, environment, setup):
        count = len(setup.hypotheses)
        first = environment * count
        for m in range(count if first + count <= len(members) * LANES else 0):
            V, j = members[(first + m) // LANES], (first + m) % LANES
            for i in range(size - 4):
                V[i * LANES + j] = setup.prior[i]
            for i in range(4):
                V[(size - 4 + i) * LANES + j] = setup.hypotheses[m, i]
            V[weight + j] = setup.hypotheses[m, 4]

    @inner
    def learn(W, members, block, setup):
        count = len(setup.hypotheses)
        first = block * LANES * count
        stop = min(first + LANES * count, len(members) * LANES)
        found = np.empty(LANES)
        for b in range(first // LANES, stop // LANES):
            V = members[b]
            owner, mate = divmod(b * LANES - first, count)
            for j in range(LANES):
                for to, source in fed:
                    V[to + j] = W[source + owner]
                mate += 1
                if mate == count:
                    owner, mate = owner + 1, 0
            if setup.drifts:
                for c in range(len(walks)):
                    for j in range(LANES):
                        V[walks[c] + j] += setup.walk[c]
            for j in range(LANES if unsound >= 0 else 0):
                V[unsound + j] = 0.0
            update(V)
            energies_of(V, found)
            copy(V, energy, found, LANES)
        weights, memory = np.empty(count), memory_for(count)
        each, predictions = np.empty((count, 1)), np.empty((count, 1, 2))
        energies, forecasts = np.empty(1), np.empty((1, 2))
        for j in range((stop - first) // count):
            start = first + j * count
            for m in range(count):
                V, k = members[(start + m) // LANES], (start + m) % LANES
                weights[m] = V[weight + k]
                each[m, 0] = V[energy + k]
                if unsound >= 0 and V[unsound + k] > 0.0:
                    each[m, 0] = np.nan
                look(V, k, predictions[m])
            weigh(weights, each, predictions, energies, forecasts)
            for m in range(count):
                members[(start + m) // LANES, weight + (start + m) % LANES] = weights[m]
            mix(members, start, weights, memory, W, j, LANES)
            if free_energy >= 0:
                W[free_energy + j] = energies[0]

    return Members(begin, learn)
