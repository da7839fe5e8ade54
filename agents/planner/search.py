"""The planner's search, compiled for a model: the best ways through the map of its state, and small changes of them.

The teaching of a plan has many summits, and changing a long plan here and there finds a poor one, even of a system that
is known. So the plan is built sample by sample, as by dynamic programming: of all ways that lead into the same cell of
the plane of the first two states only the best is followed, with the highest input, the lowest, none, and half of
either, since near its limit a signal may be led too far by a whole push and not far enough by none. Far ahead, where
the plan will be made anew, only the highest and the lowest are tried. A way's score is what it has taught together with
what the rest of the episode will teach anyway, at the rate of the last plans. Without the latter a way would be praised
for what every way teaches sooner or later.

The plane is that of (x_t, x_{t-1}) for Eq. (2), of displacement and velocity for Eq. (1); a model with one state has a
line. Each state is measured by its size when the first sensor is at its limit (`agents.planner.motion.Swing`). Other
states, and older inputs, are followed with their way, and do not tell ways apart. An input is held for
`agents.planner.imagination.Terms.pace` samples, a *move*. Towards the end of an episode moves become shorter: a plan
comes near to the end then, too, and is as fine as it can be.

The best way is then compared with the last plan, begun one sample ago, and with changed copies of the better one, by
what is known, on average, when parts of them have been followed: judged by its end alone, the best plan may be to wait
for a move, and so at every decision anew. The first part is as long as a third of what it takes to swing to the limit.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np

from agents.planner.candidates import CHOICES, bound, change, choose, uniform
from agents.planner.design import factorise
from agents.planner.imagination import mind
from estimator.arrays import copy, fill, highest
from estimator.lanes import LANES, jit, kernel, part
from estimator.models.model import Model

#: Cells of the map along each axis, from minus a state's scale to plus: for so many first moves, and for those after
#: them, which are planned again before they are played. A plan that looks far on a coarse map is better than one that
#: looks less far on a fine one, in less time.
_CELLS, _NEAR, _FAR_CELLS = 24, 10, 12

#: Towards the end of an episode, when so many moves are left, no later plan mends what a plan misses: the map is then
#: finer everywhere, the rounds are more by this factor, and plans look no further than so many moves.
_LATE, _LATE_CELLS, _LATE_ROUNDS, _LATE_HORIZON = 48, 32, 4, 20

#: For so many first moves all inputs are tried, and for those after them only so many.
_FINE, _COARSE_CHOICES = 7, 2

#: A way this much [nats] worse than the best of its length is followed no further.
_HOPELESS = 0.5

#: Part of what a plan teaches per sample that goes into the running mean.
_REFRESHED = 0.2


class Search(NamedTuple):
    """The search for a model, compiled.

    Attributes:
        plan: ``plan(records, left, horizon, rounds, terms, lasts, plans, rates, words, actions, held)`` searches the
            best next inputs of n environments:

            - ``records`` (n, size): their beliefs;
            - ``left`` (n,): samples left in their episodes;
            - ``horizon``: moves to plan, at most;
            - ``rounds``: of `LANES` changed copies each;
            - ``terms``: `agents.planner.imagination.Terms`;
            - ``lasts`` (n, 2): the inputs that were applied last, newest first;
            - ``plans`` (n, horizon): the last plans, begun one move ago; overwritten by the new ones;
            - ``rates`` (n, K, K): information per sample that plans have brought, a running mean; zeros where there was
              none yet; overwritten;
            - ``words`` (n, 4): streams of random numbers; overwritten;
            - ``actions`` (n,): receives the first input of the best plan;
            - ``held`` (n,): receives the samples of its first move.
        play: ``play(record, first, horizon, rounds, terms, u, words)`` plans the inputs u (T,) from sample ``first``
            on, where the means of the belief are the truth. The inputs before it are followed as they are. Arguments as
            of ``plan``; ``words`` is (4,), and the record is overwritten.
        through: ``through(record, cells, terms, rate, words, u)`` finds all inputs u (T,) of an episode, where the
            means of the belief are the truth, as the best way through so many cells along each axis. ``rate`` (K, K) is
            the information per sample that is expected of the rest of the way.
    """

    plan: Any
    play: Any
    through: Any


class Memory(NamedTuple):
    """What a search writes on.

    Attributes:
        ways: blocks of the ways that are followed.
        continued: blocks of their continuations.
        origins: (horizon, ways) of which way each continues.
        inputs: (horizon, ways) with which input.
        candidates: (LANES, horizon) plans that compete.
    """

    ways: Any
    continued: Any
    origins: Any
    inputs: Any
    candidates: Any


class Task(NamedTuple):
    """What is searched for, of one environment.

    Attributes:
        record: the belief.
        left: samples left in the episode.
        steps: moves of the plan.
        pace: samples of a move.
        terms: `agents.planner.imagination.Terms`.
        lasts: (2,) the inputs that were applied last, newest first.
        M: (K, K) factor of the information per sample that is to come.
        cells: of the map along each axis.
        far_cells: the same after the first moves.
        fine: moves for which all inputs are tried.
    """

    record: Any
    left: int
    steps: int
    pace: int
    terms: Any
    lasts: Any
    M: Any
    cells: int
    far_cells: int
    fine: int


@cache
def search(model: Model, degree: int = 0, lag: int = 0) -> Search:
    """The search for a model; arguments as `estimator.engine.imagination.imagination`."""
    size, kept, U, SCORE, begin, collect, advance, appraise, precision = mind(model, degree, lag)
    k, is_plane = model.n_coefficients, model.n_states > 1
    kind = f"{model.name}_{model.digest}_{degree}_{lag}"
    inner, entry = part(kind), kernel(kind=kind)

    @inner
    def memory(horizon, cells):
        blocks = -(-(cells * cells if is_plane else cells) // LANES)
        most = blocks * LANES
        ways, continued = np.empty((blocks, size)), np.empty((len(CHOICES) * blocks, size))
        origins, inputs = np.empty((horizon, most), np.int64), np.empty((horizon, most))
        return Memory(ways, continued, origins, inputs, np.empty((LANES, horizon)))

    @inner
    def gather(memory, h, best, ends):
        """Make the best continuations the new ways, and note where they come from; gives their number.

        ``best``, the scores of the cells, becomes that of the ways.
        """
        ways, continued = memory.ways, memory.continued
        enough = best[highest(best, len(best))] - _HOPELESS
        count = 0
        for cell in range(len(best)):
            if best[cell] >= enough and best[cell] > -np.inf:
                b, j = ends[cell] // LANES, ends[cell] % LANES
                memory.origins[h, count] = b // len(CHOICES) * LANES + j
                memory.inputs[h, count] = continued[b, U + j]
                best[count] = best[cell]
                way, lane = ways[count // LANES], count % LANES
                for row in range(0, kept, LANES):
                    way[row + lane] = continued[b, row + j]
                count += 1
        # Lanes beyond the last way do the same work as the others, so that none of them runs wild.
        for lane in range(count, -(-count // LANES) * LANES):
            for row in range(0, kept, LANES):
                ways[lane // LANES, row + lane % LANES] = ways[lane // LANES, row]
        return count

    @inner
    def find_way(memory, task, found, words):
        """Build a plan by the best ways into the cells of the map, which is laid anew at random every time."""
        ways, continued, terms = memory.ways, memory.continued, task.terms
        most = task.cells * task.cells if is_plane else task.cells
        best, ends = np.empty(most), np.empty(most, np.int64)
        right, up = uniform(words), uniform(words)
        begin(ways[0], task.record, task.lasts)
        count = 1
        for h in range(task.steps):
            cells = task.cells if h < _NEAR else task.far_cells
            fill(best, -np.inf)
            tried = len(CHOICES) if h < task.fine else _COARSE_CHOICES
            for i in range(tried * (-(-count // LANES))):
                block, choice = i // tried, i % tried
                b = block * len(CHOICES) + choice
                W = continued[b]
                copy(W, 0, ways[block], kept)
                for j in range(LANES):
                    W[U + j] = choose(choice, W[U + j], terms)
                for _ in range(task.pace):
                    advance(W, task.record, terms)
                appraise(W, task.M, np.sqrt(max(0, task.left - (h + 1) * task.pace)))
                for j in range(min(LANES, count - block * LANES)):
                    cell = place(W[j], terms.scales[0], cells, right)
                    if is_plane:
                        cell = cell * cells + place(W[LANES + j], terms.scales[1], cells, up)
                    if W[SCORE + j] > best[cell]:
                        best[cell] = W[SCORE + j]
                        ends[cell] = b * LANES + j
            count = gather(memory, h, best, ends)
        way = highest(best, count)
        for h in range(task.steps - 1, -1, -1):
            found[h] = memory.inputs[h, way]
            way = memory.origins[h, way]

    @inner
    def weigh(W, task, candidates, worths):
        """What candidates (LANES, horizon) are worth (LANES,).

        That is what is known at the end of the episode; of plans that do not reach it, the sum of what is known after
        ``terms.soon`` moves, or half of them, after twice as many, and so on, and at the end.
        """
        steps = task.steps
        mark = steps if task.left <= steps * task.pace else max(1, min(task.terms.soon, steps // 2))
        begin(W, task.record, task.lasts)
        fill(worths, 0.0)
        for h in range(steps):
            for j in range(LANES):
                W[U + j] = candidates[j, h]
            for _ in range(task.pace):
                advance(W, task.record, task.terms)
            if h + 1 == mark or h + 1 == steps:
                mark *= 2
                appraise(W, task.M, np.sqrt(max(0, task.left - (h + 1) * task.pace)))
                for j in range(LANES):
                    worths[j] += W[SCORE + j]

    @inner
    def refresh(W, task, best, rate):
        """Let the information per sample of a plan into the running mean; the first one is taken as it is."""
        before, after = np.empty((k, k)), np.empty((k, k))
        begin(W, task.record, task.lasts)
        precision(W, before)
        for h in range(task.steps):
            for j in range(LANES):
                W[U + j] = best[h]
            for _ in range(task.pace):
                advance(W, task.record, task.terms)
        precision(W, after)
        share, is_finite = _REFRESHED if rate[0, 0] > 0.0 else 1.0, True
        for a in range(k):
            for b in range(k):
                is_finite = is_finite and np.isfinite(after[a, b] - before[a, b])
        for a in range(k):
            for b in range(k):
                if is_finite:
                    rate[a, b] += share * ((after[a, b] - before[a, b]) / (task.steps * task.pace) - rate[a, b])

    @inner
    def improve(memory, record, left, rounds, terms, lasts, best, rate, words):
        """Improve the plan ``best`` (horizon,), begun one move ago, and ``rate``; gives the samples of a move."""
        candidates, last = memory.candidates, lasts[0]
        moves = min(len(best), _LATE_HORIZON)
        cells, far, pace = _CELLS, _FAR_CELLS, min(terms.pace, max(1, int(left / moves + 0.5)))
        steps = min(len(best), -(-left // pace))  # to the end, and a bit beyond: no limit is left unseen
        if left <= _LATE * pace:
            cells = far = _LATE_CELLS
            steps, rounds = min(steps, _LATE_HORIZON), _LATE_ROUNDS * rounds
        M = np.zeros((k, k))
        factorise(rate, M)
        task = Task(record, left, steps, pace, terms, lasts, M, cells, far, _FINE)
        turned = -best[0]
        for h in range(len(best) - 1):
            best[h] = best[h + 1]
        best[steps - 1] = turned
        bound(best, steps, last, terms)
        copy(candidates[0], 0, best, len(best))
        fill(candidates[1], 0.0)
        bound(candidates[1], steps, last, terms)
        find_way(memory, task, candidates[2], words)
        for j in range(3, LANES):
            copy(candidates[j], 0, candidates[2 * (j % 2)], len(best))
            change(candidates[j], steps, terms.amplitude, words)
            bound(candidates[j], steps, last, terms)
        W, worths, score = memory.ways[0], np.empty(LANES), -np.inf
        for round_ in range(rounds):
            for j in range(LANES if round_ > 0 else 0):
                copy(candidates[j], 0, best, len(best))
                change(candidates[j], steps, terms.amplitude, words)
                bound(candidates[j], steps, last, terms)
            weigh(W, task, candidates, worths)
            for j in range(LANES):
                if worths[j] > score:
                    score = worths[j]
                    copy(best, 0, candidates[j], len(best))
        # Where the coefficients walk, what is learned later does not add to what is learned now.
        if not (terms.walk > 0.0).any():
            refresh(W, task, best, rate)
        return pace

    @inner
    def go_on(W, record, u, lasts, terms):
        """Let the record follow an input over a sample; the input becomes the newest of the last ones."""
        begin(W, record, lasts)
        for j in range(LANES):
            W[U + j] = u
        advance(W, record, terms)
        collect(W, record)
        lasts[1], lasts[0] = lasts[0], u

    @entry
    def plan(records, left, horizon, rounds, terms, lasts, plans, rates, words, actions, held):
        kept_memory = memory(horizon, _LATE_CELLS)
        for i in range(len(records)):
            held[i] = improve(
                kept_memory, records[i], max(1, left[i]), rounds, terms, lasts[i], plans[i], rates[i], words[i]
            )
            actions[i] = plans[i, 0]

    @entry
    def play(record, first, horizon, rounds, terms, u, words):
        kept_memory = memory(horizon, _LATE_CELLS)
        best, rate, W = np.zeros(horizon), np.zeros((k, k)), np.empty(size)
        lasts, held = np.zeros(2), 0
        for t in range(len(u)):
            if t >= first:
                if held == 0:
                    held = improve(kept_memory, record, len(u) - t, rounds, terms, lasts, best, rate, words)
                u[t] = best[0]
                held -= 1
            go_on(W, record, u[t], lasts, terms)

    @entry
    def through(record, first, cells, terms, rate, words, u):
        M, W, lasts = np.zeros((k, k)), np.empty(size), np.zeros(2)
        factorise(rate, M)
        for t in range(first):
            go_on(W, record, u[t], lasts, terms)
        left = len(u) - first
        task = Task(record, left, left, 1, terms, lasts, M, cells, cells, left)
        find_way(memory(left, cells), task, u[first:], words)

    return Search(plan, play, through)


@jit
def place(x, scale, cells, offset):
    """The cell of a state along one axis; the first for one that is not a number."""
    where = (x / scale + 1.0) * 0.5 * (cells - 1) + offset
    if not where > 0.0:
        return 0
    return np.int64(min(where, cells - 1.0))
