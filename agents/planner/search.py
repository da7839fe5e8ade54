"""The planner's search, compiled for a model: the best ways through the map of its state, and small changes of them.

The teaching of a plan has many summits, and changing a long plan here and there finds a poor one, even of a system that
is known. So the plan is built move by move, as the best way through the map of the model's state
(`agents.planner.mapped`). An input is held for `agents.planner.imagination.Terms.pace` samples, a *move*. Towards the
end of an episode moves become shorter, by whole numbers: so the last plan, which kept the limit, can go on as it was.

The best way, the last plan and the next best one then, both begun one sample ago, each lead to a summit of their own:
by rounds of steps that change all of a plan (`agents.planner.steps`) and of small changes at random, until a round
brings little. The highest summit is followed. Were only the best of the three improved, the last plan would nearly
always be, as it has been improved before, and the search would keep to its summit. Those behind are given up as soon as
they do not catch up at the pace of their last round. Where plans reach the end of the episode there are two maps, and
the best way of each climbs.

What a move teaches counts the less the later it is in the plan (`agents.planner.fading`).
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np

from agents.planner.candidates import bound, change, follow_up, pace_for
from agents.planner.design import factorise
from agents.planner.fading import delay_with, fade, share_of
from agents.planner.imagination import mind, terms_of
from agents.planner.mapped import Task, mapped
from agents.planner.steps import nudge, rivals_for, step
from estimator.arrays import copy, fill, highest
from estimator.lanes import LANES, jit, kernel, part
from estimator.models.model import Model

#: Of so many cells of the map, one way that leads into them is followed, in so many blocks at least, and at most. Far
#: ahead a block less tells as much. On rigs it does not, and as many ways as may be are followed throughout.
_CELLS_PER_WAY, _FEWEST_BLOCKS, _MOST_BLOCKS = 10, 2, 4

#: Towards the end of an episode, when so many moves are left, no later plan mends what a plan misses: so many ways are
#: followed then, and plans look no further than so many moves.
_LATE, _LATE_WAYS, _LATE_HORIZON = 48, 6 * LANES, 24

#: All inputs are tried for so many first moves, over the map's cells along an axis, and some of them for so many: the
#: coarser a map, the fewer ways lead through it, and the more can be tried of each.
_FINEST, _FINE = 125, 250

#: Plans that are improved in a decision, one after the other: so many that are kept, the last one and the next best,
#: and the best way through a map, or through so many maps where plans reach the end of the episode.
_KEPT, _LATE_MAPS = 2, 2

#: One this much [nats] worse than the best of them is not improved at all.
_HOPELESS = 0.05

#: A round of steps and changed copies that brings less [nats] is the last one of a plan.
_LITTLE = 0.00005

#: A plan is given up that so many rounds as good as its last would not make the best.
_PATIENCE = 0.7

#: The next best plan has an input that differs by so much of the largest, among the first so many moves.
_APART, _NEAR = 0.3, 20

#: Part of what a plan teaches per sample that goes into the running mean; and of how many of its last moves. Before
#: them a swing may still have to be built.
_REFRESHED, _LAST = 0.05, 25


class Search(NamedTuple):
    """The search for a model, compiled.

    Attributes:
        plan: ``plan(records, left, horizon, rounds, terms, lasts, plans, others, rates, words, actions, paces)``
            searches the best next inputs of n environments:

            - ``records`` (n, size): their beliefs;
            - ``left`` (n,): samples left in their episodes;
            - ``horizon``: moves to plan, at most;
            - ``rounds``: of steps and changed copies of each plan that is improved, at most, two blocks of `LANES`
              each; one that brings little is the last;
            - ``terms``: `agents.planner.imagination.Terms` of the whole episode;
            - ``lasts`` (n, 2): the inputs that were applied last, newest first;
            - ``plans`` (n, horizon): the last plans, begun one move ago; overwritten by the new ones;
            - ``others`` (n, horizon): the next best ones then; overwritten as well;
            - ``rates`` (n, K, K): information per sample of the last moves of plans, a running mean; zeros where there
              was none yet; overwritten;
            - ``words`` (n, 4): streams of random numbers; overwritten;
            - ``actions`` (n,): receives the first input of the best plan;
            - ``paces`` (n,): samples of a move of the last plans; overwritten by those of the new ones.
        play: ``play(record, first, horizon, rounds, terms, u, words)`` plans the inputs u (T,) from sample ``first``
            on, where the means of the belief are the truth. The inputs before it are followed as they are. Arguments as
            of ``plan``, but the terms are of all samples alike; ``words`` is (4,), and the record is overwritten.
        through: ``through(record, first, cells, terms, rate, words, u)`` finds the inputs u (T,) from sample ``first``
            on, where the means of the belief are the truth, as the best way through so many cells along each axis.
            ``rate`` (K, K) is the information per sample that is expected of the rest of the way.
    """

    plan: Any
    play: Any
    through: Any


@cache
def search(model: Model, degree: int = 0, lag: int = 0) -> Search:
    """The search for a model; arguments as `estimator.engine.imagination.imagination`."""
    imagined = mind(model, degree, lag)
    size, U, SCORE, NEAR, NOISE = imagined.size, imagined.u, imagined.score, imagined.near, imagined.noise
    begin, advance, appraise = imagined.fill, imagined.advance, imagined.appraise
    collect, precision = imagined.collect, imagined.precision
    memory, find_way = mapped(model, degree, lag)
    k = model.n_coefficients
    kind = f"{model.name}_{model.digest}_{degree}_{lag}"
    inner, entry = part(kind), kernel(kind=kind)

    @inner
    def weigh(W, task, rivals):
        """Find what rivals are worth, and how near to the limit they lead.

        They are worth the mean of what is known after each move, with the weights by which what moves teach fades.
        """
        steps, (candidates, worths, near, weights, _, _) = task.steps, rivals
        record, terms, M, pace = task.record, task.terms, task.M, task.pace  # once: each time they would be counted
        begin(W, record, task.lasts)
        fill(worths, 0.0)
        for h in range(steps):
            for j in range(LANES):
                W[U + j] = candidates[j, h]
                near[h, j] = -np.inf
            for _ in range(pace):
                advance(W, record, terms)
                for j in range(LANES):
                    near[h, j] = max(near[h, j], W[NEAR + j])
            share = share_of(weights, h, steps)
            if share > 0.0:
                appraise(W, M, np.sqrt(max(0, task.left - (h + 1) * pace)))
                for j in range(LANES):
                    worths[j] += share * W[SCORE + j]

    @inner
    def compete(W, task, rivals, first, best, score, after, words):
        """Weigh the rivals, from lane ``first`` on changed copies of the best; gives the score of the winner.

        A new winner's precision (K, K) at the end of its plan comes into ``after``.
        """
        candidates, terms = rivals.candidates, task.terms
        for j in range(LANES):
            if j >= first:
                copy(candidates[j], 0, best, len(best))
                change(candidates[j], task.steps, terms.amplitude, words)
            bound(candidates[j], task.steps, task.lasts[0], terms)
        weigh(W, task, rivals)
        winner = highest(rivals.worths, LANES)
        if not rivals.worths[winner] > score:
            return score
        copy(best, 0, candidates[winner], len(best))
        precision(W, winner, after)
        return rivals.worths[winner]

    @inner
    def ascend(W, task, rivals, plan, score, after, rounds, top, words):
        """Improve a plan (horizon,) in rounds, until one brings little, or it is given up; gives its score."""
        for _ in range(rounds):
            so_far = score
            first = nudge(rivals, plan, task.steps, task.terms.amplitude)
            score = compete(W, task, rivals, first, plan, score, after, words)
            first = step(rivals, task.steps, task.terms.amplitude)
            score = compete(W, task, rivals, first, plan, score, after, words)
            gained = score - so_far
            if gained < _LITTLE or score + _PATIENCE * gained < top:
                break
        return score

    @inner
    def lead(W, task, rivals, starts, scores, afters, words):
        """Replace each start by the best of its changed copies, and find its score and the precision at its end."""
        candidates = rivals.candidates
        for j in range(LANES):
            copy(candidates[j], 0, starts[j % len(starts)], len(starts[0]))
            if j >= len(starts):
                change(candidates[j], task.steps, task.terms.amplitude, words)
        fill(candidates[LANES - 1], 0.0)  # rest keeps the limit, where nothing else may
        for j in range(LANES):
            bound(candidates[j], task.steps, task.lasts[0], task.terms)
        weigh(W, task, rivals)
        for s in range(len(starts)):
            leader = s
            for j in range(s, LANES, len(starts)):
                if rivals.worths[j] > rivals.worths[leader]:
                    leader = j
            scores[s] = rivals.worths[leader]
            copy(starts[s], 0, candidates[leader], len(starts[0]))
            precision(W, leader, afters[s])

    @inner
    def refresh(W, task, plan, after, rate):
        """Let the information per sample of a plan into the running mean; the first one is taken as it is."""
        before, built = np.empty((k, k)), max(0, task.steps - _LAST)
        begin(W, task.record, task.lasts)
        for h in range(built):
            for j in range(LANES):
                W[U + j] = plan[h]
            for _ in range(task.pace):
                advance(W, task.record, task.terms)
        precision(W, 0, before)
        samples = (task.steps - built) * task.pace
        share, is_finite = _REFRESHED if rate[0, 0] > 0.0 else 1.0, True
        for a in range(k):
            for b in range(k):
                is_finite = is_finite and np.isfinite(after[a, b] - before[a, b])
        for a in range(k):
            for b in range(k):
                if is_finite:
                    rate[a, b] += share * ((after[a, b] - before[a, b]) / samples - rate[a, b])

    @inner
    def improve(memory, rivals, record, left, rounds, terms, lasts, best, other, rate, words, before):
        """Improve the plans ``best`` and ``other`` (horizon,), and ``rate``; gives the samples of their moves.

        They began one move of so many samples ago.
        """
        W = memory.ways[0]
        moves = min(len(best), _LATE_HORIZON)
        ways, fewer = ways_for(terms.cells, terms.firm > 0.0)
        pace = pace_for(left, moves, terms.pace)
        steps = min(len(best), -(-left // pace))  # to the end, and a bit beyond: no limit is left unseen
        if left <= _LATE * pace:
            ways, fewer, steps = _LATE_WAYS, _LATE_WAYS, min(steps, _LATE_HORIZON)
        M = np.zeros((k, k))
        factorise(rate, M)
        faded = terms.faded + delay_with(record, NOISE, pace)
        fade(rivals.weights, steps, np.inf if left <= steps * pace else faded)
        sizes = terms.cells, _FINEST // terms.cells, _FINE // terms.cells, ways, fewer
        task = Task(record, left, steps, pace, terms, lasts, M, *sizes, np.nan, 1.0)
        follow_up(best, steps, before, pace)
        follow_up(other, steps, before, pace)
        n = _KEPT + (_LATE_MAPS if left <= _LATE_HORIZON * pace else 1)
        starts, scores, afters = np.zeros((n, len(best))), np.empty(n), np.zeros((n, k, k))
        copy(starts[0], 0, best, len(best))
        copy(starts[1], 0, other, len(best))
        for s in range(_KEPT, n):
            find_way(memory, task, starts[s], words)
        lead(W, task, rivals, starts, scores, afters, words)
        waiting, top = scores.copy(), -np.inf
        for _ in range(n):
            s = highest(waiting, n)
            if waiting[s] < top - _HOPELESS:
                break
            waiting[s] = -np.inf
            scores[s] = ascend(W, task, rivals, starts[s], scores[s], afters[s], rounds, top, words)
            top = max(top, scores[s])
        winner = highest(scores, n)
        copy(best, 0, starts[winner], len(best))
        fill(other, 0.0)
        second = -np.inf
        for s in range(n):
            if scores[s] > second and gap(starts[s], best, min(steps, _NEAR)) > _APART * terms.amplitude:
                copy(other, 0, starts[s], len(best))
                second = scores[s]
        # Where the coefficients walk, what is learned later does not add to what is learned now.
        if not (terms.walk > 0.0).any():
            refresh(W, task, best, afters[winner], rate)
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
    def plan(records, left, horizon, rounds, terms, lasts, plans, others, rates, words, actions, paces):
        kept_memory, rivals = memory(horizon, _LATE_WAYS), rivals_for(horizon)
        for i in range(len(records)):
            own = rounds, terms_of(terms, left[i]), lasts[i], plans[i], others[i], rates[i], words[i], paces[i]
            paces[i] = improve(kept_memory, rivals, records[i], max(1, left[i]), *own)
            actions[i] = plans[i, 0]

    @entry
    def play(record, first, horizon, rounds, terms, u, words):
        kept_memory, rivals = memory(horizon, _LATE_WAYS), rivals_for(horizon)
        best, other, rate, W = np.zeros(horizon), np.zeros(horizon), np.zeros((k, k)), np.empty(size)
        lasts, held, pace = np.zeros(2), 0, 1
        for t in range(len(u)):
            if t >= first:
                if held == 0:
                    own = rounds, terms, lasts, best, other, rate, words, pace
                    held = pace = improve(kept_memory, rivals, record, len(u) - t, *own)
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
        ways = -(-cells * cells // LANES) * LANES
        task = Task(record, left, left, 1, terms, lasts, M, cells, 0, left, ways, ways, np.nan, 1.0)
        find_way(memory(left, ways), task, u[first:], words)

    return Search(plan, play, through)


@jit
def ways_for(cells, is_firm):
    """How many ways are followed through a map with so many cells along an axis, and how many far ahead: whole blocks.

    Example:
        >>> [ways_for(cells, False) for cells in (22, 25, 35, 38)], ways_for(25, True)
        ([(64, 32), (64, 32), (128, 96), (128, 96)], (128, 128))
    """
    if is_firm:
        return LANES * _MOST_BLOCKS, LANES * _MOST_BLOCKS
    blocks = round(cells * cells / (_CELLS_PER_WAY * LANES))
    ways = LANES * max(_FEWEST_BLOCKS, min(blocks, _MOST_BLOCKS))
    return ways, ways - LANES


@jit
def gap(one, other, moves):
    """By how much the inputs of two plans differ, at most, among so many first moves."""
    largest = 0.0
    for h in range(moves):
        largest = max(largest, abs(one[h] - other[h]))
    return largest
