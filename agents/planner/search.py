"""The planner's search, compiled for a model: the best ways through the map of its state, and small changes of them.

The teaching of a plan has many summits, and changing a long plan here and there finds a poor one, even of a system that
is known. So the plan is built move by move, as the best way through the map of the model's state
(`agents.planner.mapped`). An input is held for `agents.planner.imagination.Terms.pace` samples, a *move*. Towards the
end of an episode moves become shorter, by whole numbers: so the last plan, which kept the limit, can go on as it was.

The best way is then compared with the last plan, begun one sample ago. The better one is improved in rounds, by steps
that change all of it (`agents.planner.steps`), and by small changes at random, until a round brings little. Plans are
compared by what is known, on average, when parts of them have been followed: judged by its end alone, the best plan may
be to wait for a move, and so at every decision anew. The first part is as long as a third of what it takes to swing to
the limit.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np

from agents.planner.candidates import bound, change, follow_up, pace_for
from agents.planner.design import factorise
from agents.planner.imagination import mind, terms_of
from agents.planner.mapped import Task, mapped
from agents.planner.steps import nudge, rivals_for, step
from estimator.arrays import copy, fill, highest
from estimator.lanes import LANES, kernel, part
from estimator.models.model import Model

#: Ways through the map that are followed, at most, and far ahead: there fewer tell as much, but not on rigs.
_WAYS, _FEWER = 3 * LANES, 2 * LANES

#: Towards the end of an episode, when so many moves are left, no later plan mends what a plan misses: so many ways are
#: followed then, and plans look no further than so many moves.
_LATE, _LATE_WAYS, _LATE_HORIZON = 48, 6 * LANES, 24

#: For so many first moves all inputs are tried, and up to so many some of them.
_FINEST, _FINE = 3, 7

#: A round of steps and changed copies that brings less [nats] is the last one of a decision.
_LITTLE = 0.001

#: Part of what a plan teaches per sample that goes into the running mean.
_REFRESHED = 0.2


class Search(NamedTuple):
    """The search for a model, compiled.

    Attributes:
        plan: ``plan(records, left, horizon, rounds, terms, lasts, plans, rates, words, actions, paces)`` searches the
            best next inputs of n environments:

            - ``records`` (n, size): their beliefs;
            - ``left`` (n,): samples left in their episodes;
            - ``horizon``: moves to plan, at most;
            - ``rounds``: of steps and changed copies, at most, two blocks of `LANES` each; one that brings little is
              the last;
            - ``terms``: `agents.planner.imagination.Terms` of the whole episode;
            - ``lasts`` (n, 2): the inputs that were applied last, newest first;
            - ``plans`` (n, horizon): the last plans, begun one move ago; overwritten by the new ones;
            - ``rates`` (n, K, K): information per sample that plans have brought, a running mean; zeros where there was
              none yet; overwritten;
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
    size, U, SCORE, NEAR = imagined.size, imagined.u, imagined.score, imagined.near
    begin, advance, appraise = imagined.fill, imagined.advance, imagined.appraise
    collect, precision = imagined.collect, imagined.precision
    memory, find_way = mapped(model, degree, lag)
    k = model.n_coefficients
    kind = f"{model.name}_{model.digest}_{degree}_{lag}"
    inner, entry = part(kind), kernel(kind=kind)

    @inner
    def weigh(W, task, rivals):
        """Find what rivals are worth, and how near to the limit they lead.

        They are worth what is known at the end of the episode; if they do not reach it, the sum of what is known after
        ``terms.soon`` moves, or half of them, after twice as many, and so on, and at the end.
        """
        steps, (candidates, worths, near, weights, _, _) = task.steps, rivals
        record, terms, M, pace = task.record, task.terms, task.M, task.pace  # once: each time they would be counted
        mark = steps if task.left <= steps * pace else max(1, min(terms.soon, steps // 2))
        begin(W, record, task.lasts)
        fill(worths, 0.0)
        for h in range(steps):
            weights[h] = 0.0
            for j in range(LANES):
                W[U + j] = candidates[j, h]
                near[h, j] = -np.inf
            for _ in range(pace):
                advance(W, record, terms)
                for j in range(LANES):
                    near[h, j] = max(near[h, j], W[NEAR + j])
            if h + 1 == mark or h + 1 == steps:
                mark *= 2
                weights[h] = 1.0
                appraise(W, M, np.sqrt(max(0, task.left - (h + 1) * pace)))
                for j in range(LANES):
                    worths[j] += W[SCORE + j]
        for h in range(steps - 2, -1, -1):
            weights[h] += weights[h + 1]

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
    def refresh(W, task, after, rate):
        """Let the information per sample of a plan into the running mean; the first one is taken as it is."""
        before = np.empty((k, k))
        begin(W, task.record, task.lasts)
        precision(W, 0, before)
        share, is_finite = _REFRESHED if rate[0, 0] > 0.0 else 1.0, True
        for a in range(k):
            for b in range(k):
                is_finite = is_finite and np.isfinite(after[a, b] - before[a, b])
        for a in range(k):
            for b in range(k):
                if is_finite:
                    rate[a, b] += share * ((after[a, b] - before[a, b]) / (task.steps * task.pace) - rate[a, b])

    @inner
    def improve(memory, rivals, record, left, rounds, terms, lasts, best, rate, words, before):
        """Improve the plan ``best`` (horizon,), begun one move of so many samples ago, and ``rate``; gives its pace."""
        candidates, W = rivals.candidates, memory.ways[0]
        moves = min(len(best), _LATE_HORIZON)
        ways, fewer = _WAYS, _WAYS if terms.firm > 0.0 else _FEWER
        pace = pace_for(left, moves, terms.pace)
        steps = min(len(best), -(-left // pace))  # to the end, and a bit beyond: no limit is left unseen
        if left <= _LATE * pace:
            ways, fewer, steps = _LATE_WAYS, _LATE_WAYS, min(steps, _LATE_HORIZON)
        M = np.zeros((k, k))
        factorise(rate, M)
        sizes = terms.cells, _FINEST, _FINE, ways, fewer
        task = Task(record, left, steps, pace, terms, lasts, M, *sizes, np.nan, 1.0)
        follow_up(best, steps, before, pace)
        copy(candidates[0], 0, best, len(best))
        fill(candidates[1], 0.0)
        find_way(memory, task, candidates[2], words)
        for j in range(3, LANES):
            copy(candidates[j], 0, candidates[2 * (j % 2)], len(best))
            change(candidates[j], steps, terms.amplitude, words)
        after = np.zeros((k, k))
        score = compete(W, task, rivals, LANES, best, -np.inf, after, words)
        for _ in range(rounds):
            so_far = score
            first = nudge(rivals, best, steps, terms.amplitude)
            score = compete(W, task, rivals, first, best, score, after, words)
            first = step(rivals, steps, terms.amplitude)
            score = compete(W, task, rivals, first, best, score, after, words)
            if score < so_far + _LITTLE:
                break
        # Where the coefficients walk, what is learned later does not add to what is learned now.
        if not (terms.walk > 0.0).any():
            refresh(W, task, after, rate)
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
    def plan(records, left, horizon, rounds, terms, lasts, plans, rates, words, actions, paces):
        kept_memory, rivals = memory(horizon, max(_WAYS, _LATE_WAYS)), rivals_for(horizon)
        for i in range(len(records)):
            others = rounds, terms_of(terms, left[i]), lasts[i], plans[i], rates[i], words[i], paces[i]
            paces[i] = improve(kept_memory, rivals, records[i], max(1, left[i]), *others)
            actions[i] = plans[i, 0]

    @entry
    def play(record, first, horizon, rounds, terms, u, words):
        kept_memory, rivals = memory(horizon, max(_WAYS, _LATE_WAYS)), rivals_for(horizon)
        best, rate, W = np.zeros(horizon), np.zeros((k, k)), np.empty(size)
        lasts, held, pace = np.zeros(2), 0, 1
        for t in range(len(u)):
            if t >= first:
                if held == 0:
                    others = rounds, terms, lasts, best, rate, words, pace
                    held = pace = improve(kept_memory, rivals, record, len(u) - t, *others)
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
