"""Hypotheses about the noises in an environment: several beliefs learn side by side, and the mixture is what is seen.

Their priors and their weights are those of `estimator.ensemble`. A *member* is one of these beliefs. Those of a
block's environments lie in ``ceil(M n / LANES)`` blocks of their own, of M hypotheses and n environments `abreast`:
member m of environment j in lane m n + j. So what is done member by member is done for n environments at once. Only
what a member goes on from stands there, its record and its weight. The rest of an update is scratch, which stays in the
nearest cache.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from duffing_env.layout import Kind, layout_of
from estimator.arrays import copy_lanes
from estimator.engine.free_energy import free_energies
from estimator.engine.rows import belief_names, input_rows
from estimator.engine.tasks import structured
from estimator.inference.mixture import mixing, switch, weigh
from estimator.lanes import LANES, part


def abreast(environments: int) -> int:
    """Environments of a block whose members lie beside each other: a power of two, so that `LANES` is a multiple."""
    return min(LANES, 1 << (environments - 1).bit_length())


def blocks_of_members(environments: int, hypotheses: int) -> int:
    """Blocks that their members take."""
    return -(-environments // LANES) * -(-hypotheses * abreast(environments) // LANES)


class Members(NamedTuple):
    """What environments do with ``members`` (blocks, (size + 1) * LANES), those of a whole batch.

    Attributes:
        begin: ``begin(members, environment, setup)`` puts those of an environment to their priors.
        learn: ``learn(W, members, block, setup)`` updates those of a block's environments with its inputs and outputs,
            and the environments' beliefs to their mixtures.

    Lanes of a block behind ``setup.abreast`` have none, and keep their beliefs.
    """

    begin: Any
    learn: Any


#: Those of a single belief, which has none.
NONE = Members(None, None)


def members_of(kind: Kind) -> Members:
    """Compile them for a kind of experiment."""
    place, model = layout_of(kind), kind.belief
    expectations = "sigma_points" if kind.points else "first_order"
    task = structured(model, kind.degree, iterations=kind.iterations, trace=True, expectations=expectations)
    update, own, size = task.update, task.layout, len(belief_names(model))
    mix = mixing(len(model.names)).mix
    given = [*input_rows(model, kind.degree), *(f"Y_{sensor}" for sensor in model.outputs)]
    fed = tuple((own[row] * LANES, place[row] * LANES) for row in given)
    walks = tuple(own[f"P_{c}_{c}"] * LANES for c in model.coefficients)
    weight, scratch, free_energy = size * LANES, (max(own.values()) + 1) * LANES, place.get("FREE_ENERGY", -1) * LANES
    unsound = own.get("UNSOUND", -1) * LANES
    energies_of = free_energies(model, kind.iterations, LANES, own, every=False)
    inner = part(kind.name)

    @inner
    def begin(members, environment, setup):
        count, n = len(setup.hypotheses), setup.abreast
        first = environment // LANES * -(-count * n // LANES)
        for m in range(count if environment % LANES < n else 0):
            at = m * n + environment % LANES
            U, lane = members[first + at // LANES], at % LANES
            for i in range(size - 4):
                U[i * LANES + lane] = setup.prior[i]
            for i in range(5):
                U[(size - 4 + i) * LANES + lane] = setup.hypotheses[m, i]

    @inner
    def update_block(U, V, W, n, setup, found):
        """Update the members in a block U, by way of a whole block V; ``found`` receives their free energies."""
        copy_lanes(V, 0, U, 0, weight)
        for to, source in fed:
            for lane in range(0, LANES, n):
                copy_lanes(V, to + lane, W, source, n)
        for c in range(len(walks) if setup.drifts else 0):
            for j in range(LANES):
                V[walks[c] + j] += setup.walk[c]
        for j in range(LANES if unsound >= 0 else 0):
            V[unsound + j] = 0.0
        update(V)
        energies_of(V, found)
        for j in range(LANES if unsound >= 0 else 0):
            found[j] = np.nan if V[unsound + j] > 0.0 else found[j]
        copy_lanes(U, 0, V, 0, weight)

    @inner
    def learn(W, members, block, setup):
        count, n = len(setup.hypotheses), setup.abreast
        stop = -(-count * n // LANES)
        first, V, found = block * stop, np.zeros(scratch), np.empty(stop * LANES)
        weights, shares, energies = np.empty(count * n), np.empty(count * n), np.empty(n)
        for b in range(stop):
            update_block(members[first + b], V, W, n, setup, found[b * LANES : (b + 1) * LANES])
        for m in range(0, count * n, n):
            copy_lanes(weights, m, members[first + m // LANES], weight + m % LANES, n)
        by_member, each = weights.reshape((count, n)), found[: count * n].reshape((count, n))
        switch(by_member, each)
        weigh(by_member, each, energies)
        for m in range(0, count * n, n):
            copy_lanes(members[first + m // LANES], weight + m % LANES, weights, m, n)
        mix(members, first, by_member, shares, W, LANES)
        if free_energy >= 0:
            copy_lanes(W, free_energy, energies, 0, n)

    return Members(begin, learn)
