"""Ways to go on, imagined from a belief: three simple ones of every first move, and the best that is found.

A *push* is an input as large as is allowed. A *move* is an input that is held for as many samples as
`agents.planner.motion.Swing` says. A *way* is a sequence of moves, as long as `agents.policies.imagined.look_ahead`
says, or to the end of the episode. Ways are imagined side by side, one in a lane.

The first move is a push up, none, or a push down. Then *pump* pushes along the motion, but against it where that would
lead beyond the limit; *brake* pushes against the motion, and *rest* does nothing.

The best way of a first move begins as the best through the map of the state (`agents.planner.mapped`), or as one of
these. On the map several sizes of the first push are tried, each with what then follows best: near the limit a push
that is right together with the next ones is not found by changing it alone. The best of all is changed a little in some
rounds: some pushes are turned over, or one or two become harder or softer, the first ones more often than those far
ahead. The first push keeps its direction; where a move lasts several samples it is played in full, and stays so. The
longer ways are, the more of them are followed on the map, and the more rounds there are. Where bursts
(`agents.policies.bursts`) say how hard to push, there is no map.

What a way is worth is in nats, as the planner imagines it: by belief propagation (`agents.planner.imagination`), so
that what one sample teaches is not counted again by the next, with what the rest of the episode will bring anyway. What
a move teaches counts the less the later it is (`agents.planner.fading`), so that waiting for a move does not look best
at every decision, for ever. Near the end of the episode all moves count alike.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np

from agents.planner import mapped
from agents.planner.fading import share_of
from agents.planner.imagination import mind
from agents.planner.motion import View
from estimator.arrays import copy, fill
from estimator.engine.imagination import imagination
from estimator.engine.motion import motion
from estimator.lanes import LANES, part
from estimator.parameters import FloatArray

#: The first moves, in parts of a push: up, none, down.
FIRST = (1.0, 0.0, -1.0)

#: How simple ways go on; that of first move f is in lane ``len(SIMPLE) f`` and the next ones.
SIMPLE = ("pump", "brake", "rest")

#: Moves of the longest pace in which an output can still be kept within the limit: nearly a period.
_IN_REACH = 8

#: Moves of the longest way, and of a *stretch* of a way, of which the last may be shorter.
LONGEST, _STRETCH = 36, 12

#: For each stretch, rounds of changes of a way that begins with a push; and rounds, fewer, where bursts say how hard to
#: push. One that begins with none has one round.
ROUNDS, _BESIDE_BURSTS = 8, 2

#: Cells of the map along each axis, moves for which half pushes are tried, and ways that are followed for each stretch;
#: so many times as many at most where a noisy sensor makes it look that much further.
_CELLS, _FINE, _FOLLOWED, FURTHER = 35, 7, LANES, 3

#: The part of the changes that turn pushes over, and how many pushes at most.
_TURN, _MOST_TURNED = 0.5, 3

#: By how much of a push the others change it at most, and the power of a uniform number that says where in the way.
_BY, _SOON = 0.3, 3

#: The least part of a push that is one. A first push that is held for several samples is played in full.
_LEAST = 0.02


class Task(NamedTuple):
    """What ways are imagined for, of one belief.

    Attributes:
        record: the belief.
        lasts: (2,) the inputs that were applied last, newest first.
        moves: of a way.
        further: how many times more these are than with a sensor without noise, whole and at most `FURTHER`.
        has_bursts: whether these say how hard to push (`agents.policies.bursts`).
        pace: samples of a move.
        left: samples left in the episode.
        to_come: samples that bring information at the usual rate from now on.
        M: (K, K) factor of that rate.
        weights: (moves,) how much what a move teaches counts.
        terms: `agents.planner.imagination.Terms`, whose amplitude is how hard pushes are.
    """

    record: Any
    lasts: Any
    moves: int
    further: int
    has_bursts: bool
    pace: int
    left: float
    to_come: float
    M: Any
    weights: Any
    terms: Any


class Changes(NamedTuple):
    """Changes of ways, (rounds, LANES) each.

    In every round the first lane is left as it is, and in the first one the simple ways are, too.

    Attributes:
        where: the first move that is changed, in parts of a way.
        turned: moves that are turned over.
        moved: (rounds, LANES, 2) how much harder that push becomes and the next one, in parts of a push.
    """

    where: FloatArray
    turned: Any
    moved: FloatArray


def _draw_changes() -> Changes:
    """For the longest way; they are always the same."""
    rng = np.random.default_rng(5)
    each = [_changes_of_stretch(rng) for _ in range(LONGEST // _STRETCH)]
    where, turned, moved = (np.concatenate(parts) for parts in zip(*each, strict=True))
    turned[:, 0], moved[:, 0] = 0, 0.0
    turned[0, : len(SIMPLE) + 1], moved[0, : len(SIMPLE) + 1] = 0, 0.0
    return Changes(where, turned, moved)


def _changes_of_stretch(rng: np.random.Generator) -> tuple[FloatArray, Any, FloatArray]:
    """Those of so many rounds as a stretch has."""
    turns = rng.random((ROUNDS, LANES)) < _TURN
    where = rng.random((ROUNDS, LANES)) ** np.where(turns, 1, _SOON)
    turned = turns * rng.integers(1, _MOST_TURNED + 1, turns.shape)
    moved = _BY * rng.uniform(-1.0, 1.0, (*turns.shape, 2)) * ~turns[..., None]
    moved[..., 1] *= rng.random(turns.shape) < 0.5
    return where, turned, moved


CHANGES = _draw_changes()

#: The stream by which the map is laid: always the same.
WORDS = np.random.SFC64(5).state["state"]["state"]


class Best(NamedTuple):
    """The best way of a first move, and what finds it writes on.

    Attributes:
        memory: `agents.planner.mapped.Memory`.
        words: (4,) a stream of random numbers.
        candidates: (LANES, moves) changed ways.
        plan: (moves,) inputs of the best one.
        known: (3,) what that is worth when half was followed, and all in all; and how near to the limit it leads.
    """

    memory: Any
    words: Any
    candidates: Any
    plan: Any
    known: Any


class Ways(NamedTuple):
    """Compiled functions of one model.

    Attributes:
        best: ``best(moves)``: a `Best` for ways of so many moves.
        follow: ``follow(W, still, task, worths, peaks, plans, free)``: the simple ways.

            - ``W``, ``still``: to write on, as `agents.planner.imagination` and `estimator.engine.motion` lay them out;
            - ``worths`` (2, LANES): receives what they are worth when half was followed, and all in all;
            - ``peaks`` (LANES,): receives how near to the limit they lead until the episode ends, margin and all;
            - ``plans`` (LANES, moves): receives their inputs;
            - ``free`` (3, 3): receives what the first sensor shows after the first three moves of those that rest.
        find: ``find(W, task, first, sign, simple, best)``: the best way of a first move.

            - ``first``: which of `FIRST`;
            - ``sign``: 1.0 if the motion is upwards without input, or -1.0, so that map and changes are turned over
              with it;
            - ``simple`` (len(`SIMPLE`), moves): inputs of the simple ones;
            - ``best``: receives it.
    """

    best: Any
    follow: Any
    find: Any


@cache
def ways(view: View) -> Ways:
    """Those of a model."""
    model = view.model
    mine = mind(*view)
    U, SCORE, MARGIN, begin, advance, appraise = mine.u, mine.score, mine.margin, mine.fill, mine.advance, mine.appraise
    found, place = motion(*view), imagination(*view).layout
    row, sense, glance = found.layout, found.sense, found.glance
    shown, n = place["SHOWN"] * LANES, model.n_states
    u, now, velocity, later = (row[name] for name in ("INPUT", "NOW", "VELOCITY", "SHOWN"))
    last_input = row["LAST_INPUT"]
    # An array, because an empty tuple has no type.
    olders = np.array([place[x] * LANES for x in ("LAST_INPUT", "OLDER_INPUT") if x in place], dtype=np.int64)
    inner = part(f"{model.name}_{model.digest}_{view.degree}_{view.lag}")
    where, turned, moved = CHANGES
    map_memory, find_way = mapped.mapped(*view)

    @inner
    def stretches_in(moves):
        return -(-moves // _STRETCH)

    @inner
    def best(moves):
        kept, words = map_memory(moves, stretches_in(moves) * FURTHER * _FOLLOWED), np.empty(4, np.uint64)
        return Best(kept, words, np.empty((LANES, moves)), np.empty(moves), np.empty(3))

    @inner
    def along(W, j, still, task):
        """The push of lane j along its motion, and the same or against it where that would lead beyond the limit."""
        for a in range(n):
            still[a] = W[a * LANES + j]
        for a in range(len(olders)):
            still[last_input + a] = W[olders[a] + j]
        sense(still)
        push = task.terms.amplitude
        way = push if still[velocity] >= 0.0 else -push
        still[u] = way
        glance(still)
        ahead = still[later] + (task.pace - 1) * (still[later] - still[now])
        return way, -way if abs(ahead) > task.terms.limit - W[MARGIN + j] else way

    @inner
    def go_on(W, t, task, worths, peaks):
        """Let all lanes follow their inputs over move t: what they are worth (2, LANES), and their peaks (LANES,)."""
        if t == 0:
            fill(worths[1], 0.0)
            fill(peaks, 0.0)
        for sample in range(t * task.pace, (t + 1) * task.pace):
            advance(W, task.record, task.terms)
            if sample < min(task.left, _IN_REACH * task.terms.pace):
                for j in range(LANES):
                    peaks[j] = max(peaks[j], abs(W[shown + j]) + W[MARGIN + j])
        share, is_half = share_of(task.weights, t, task.moves), 2 * (t + 1) == task.moves + task.moves % 2
        if share > 0.0 or is_half:
            appraise(W, task.M, np.sqrt(max(0.0, task.to_come - (t + 1) * task.pace)))
            for j in range(LANES):
                worths[1, j] += share * W[SCORE + j]
                if is_half:
                    worths[0, j] = W[SCORE + j]

    @inner
    def follow(W, still, task, worths, peaks, plans, free):
        begin(W, task.record, task.lasts)
        for t in range(task.moves):
            for j in range(LANES):
                # Lanes beyond the last way do the same as those before.
                first, simple = j // len(SIMPLE) % len(FIRST), j % len(SIMPLE)
                W[U + j] = FIRST[first] * task.terms.amplitude if t == 0 else 0.0
                if t > 0 and simple < 2:
                    onward, pump = along(W, j, still, task)
                    W[U + j] = pump if simple == 0 else -onward
                plans[j, t] = W[U + j]
            go_on(W, t, task, worths, peaks)
            for first in range(len(FIRST)):
                if t < len(free):
                    free[t, first] = W[shown + (first + 1) * len(SIMPLE) - 1]

    @inner
    def change(plan, r, j, push):
        """Change the inputs of lane j in round r a little; ``push`` is turned over where the motion is downwards."""
        h, size = int(where[r, j] * len(plan)), abs(push)
        for t in range(max(1, h), min(len(plan), h + turned[r, j])):
            plan[t] = -plan[t] if plan[t] != 0.0 else push
        for t in range(h, min(len(plan), h + 2)):
            plan[t] = max(-size, min(plan[t] + push * moved[r, j, t - h], size))

    @inner
    def find(W, task, first, sign, simple, best):
        _, words, candidates, plan, known = best
        t, direction, push = task, FIRST[first], task.terms.amplitude
        stretches = stretches_in(t.moves)
        for a in range(4):
            words[a] = WORDS[a]
        copy(plan, 0, simple[0], t.moves)
        if not t.has_bursts:
            to_come, ways = int(t.to_come + 0.5), stretches * t.further * _FOLLOWED
            sizes = _CELLS, 0, _FINE, ways, ways, direction, sign
            through = mapped.Task(t.record, to_come, t.moves, t.pace, t.terms, t.lasts, t.M, *sizes)
            find_way(best.memory, through, plan[: t.moves], words)
        rounds = 1 if direction == 0.0 else _BESIDE_BURSTS if t.has_bursts else stretches * ROUNDS
        least, worths, peaks = _LEAST * push if t.pace == 1 else push, np.empty((2, LANES)), np.empty(LANES)
        known[1] = -np.inf
        for r in range(rounds):
            for j in range(LANES):
                copy(candidates[j], 0, plan, t.moves)
                if r == 0 and 0 < j <= len(SIMPLE):
                    copy(candidates[j], 0, simple[j - 1], t.moves)
                change(candidates[j, : t.moves], r, j, sign * push)
                candidates[j, 0] = direction * max(least, direction * candidates[j, 0])
            begin(W, t.record, t.lasts)
            for h in range(t.moves):
                for j in range(LANES):
                    W[U + j] = candidates[j, h]
                go_on(W, h, t, worths, peaks)
            for j in range(LANES):
                if worths[1, j] > known[1]:
                    known[0], known[1], known[2] = worths[0, j], worths[1, j], peaks[j]
                    copy(plan, 0, candidates[j], t.moves)

    return Ways(best, follow, find)
