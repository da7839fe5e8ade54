"""Ways to go on, imagined from a belief: simple ones, and the best of them with small changes.

A *push* is an input as large as is allowed. A *move* is an input that is held for as many samples as
`agents.planner.motion.Swing` says. A *way* is a sequence of moves, as long as `agents.policies.imagined.look_ahead`
says, or to the end of the episode. Ways are imagined side by side, one in a lane.

There are 64 ways of each first move: a push up, none, or a push down. Thirty of them try the next five pushes with
mixed signs, and go on with pushes along the motion, but against it where these would lead beyond the limit. Thirty more
try the same signs, and then rest. Two make the next five pushes all up, or all down, and go on along the motion. All of
these compete. The last two tell of themselves: *brake* pushes against the motion, *rest* does nothing.

What the best way teaches depends on how hard it pushes where it turns. So it is changed a little in some rounds, as the
planner changes its plans: some pushes are turned over, or one or two become harder or softer, the first ones more often
than those far ahead. The first push keeps its direction.

What a way is worth is in nats, as the planner imagines it: by belief propagation (`agents.planner.imagination`), so
that what one sample teaches is not counted again by the next, with what the rest of the episode will bring anyway. It
is the mean of what is known when a half, three quarters and all of it have been followed. Judged only at its end,
waiting for a move can look best at every decision, for ever. A way that reaches the end of the episode is worth what is
known then.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np

from agents.planner.imagination import mind
from agents.planner.motion import View
from estimator.arrays import copy, fill
from estimator.engine.imagination import imagination
from estimator.engine.motion import motion
from estimator.lanes import LANES, part
from estimator.parameters import FloatArray

#: The first moves, in parts of a push: up, none, down.
FIRST = (1.0, 0.0, -1.0)

#: Blocks of ways for a first move, and all of its ways.
_BLOCKS = 2
WAYS = _BLOCKS * LANES

#: The last of the ways of a first move: two whose next pushes are all alike, brake, and rest.
_LAST = 4

#: Parts of a way after which it counts what is known; the first is what is known when half of it has been followed.
_MARKS = (0.5, 0.75, 1.0)

#: Moves in which an output can still be kept within the limit: nearly a period.
_IN_REACH = 8

#: Rounds of changes of a way that begins with a push, and fewer where bursts say how hard to push. One that begins with
#: none has one round.
ROUNDS, BESIDE_BURSTS = 12, 2

#: The part of the changes that turn pushes over, and how many pushes at most.
_TURN, _MOST_TURNED = 0.5, 3

#: By how much of a push the others change it at most, and the power of a uniform number that says where in the way.
_BY, _SOON = 0.3, 3

#: The least part of a push that is one.
_LEAST = 0.02


class Task(NamedTuple):
    """What ways are imagined for, of one belief.

    Attributes:
        record: the belief.
        lasts: (2,) the inputs that were applied last, newest first.
        push: how hard pushes are.
        moves: of a way.
        rounds: of changes.
        pace: samples of a move.
        left: samples left in the episode.
        to_come: samples that bring information at the usual rate from now on.
        M: (K, K) factor of that rate.
        terms: `agents.planner.imagination.Terms`.
    """

    record: Any
    lasts: Any
    push: float
    moves: int
    rounds: int
    pace: int
    left: float
    to_come: float
    M: Any
    terms: Any


class Changes(NamedTuple):
    """Changes of ways, (ROUNDS, LANES) each; in every round the first lane is left as it is.

    Attributes:
        where: the first move that is changed, in parts of a way.
        turned: moves that are turned over.
        moved: (ROUNDS, LANES, 2) how much harder that push becomes and the next one, in parts of a push.
    """

    where: FloatArray
    turned: Any
    moved: FloatArray


def _draw_changes() -> Changes:
    """They are always the same."""
    rng = np.random.default_rng(5)
    turns = rng.random((ROUNDS, LANES)) < _TURN
    where = rng.random((ROUNDS, LANES)) ** np.where(turns, 1, _SOON)
    turned = turns * rng.integers(1, _MOST_TURNED + 1, turns.shape)
    moved = _BY * rng.uniform(-1.0, 1.0, (*turns.shape, 2)) * ~turns[..., None]
    moved[..., 1] *= rng.random(turns.shape) < 0.5
    turned[:, 0], moved[:, 0] = 0, 0.0
    return Changes(where, turned, moved)


CHANGES = _draw_changes()


class Ways(NamedTuple):
    """Compiled functions of one model.

    Attributes:
        explore: ``explore(W, still, task, worths, peaks, plans, free)``: the simple ways.

            - ``W``, ``still``: to write on, as `agents.planner.imagination` and `estimator.engine.motion` lay them out;
            - ``worths`` (2, 3 WAYS): receives what they are worth when half was followed, and all in all;
            - ``peaks`` (3 WAYS,): receives how near to the limit they lead, margin and all;
            - ``plans`` (3 WAYS, moves): receives their inputs;
            - ``free`` (3, 3): receives what the first sensor shows after the first three moves of those that rest.
        refine: ``refine(W, task, plan, direction, sign, candidates, known)``: the changes of one.

            - ``plan`` (moves,): its inputs; becomes the best;
            - ``direction``: 1.0, 0.0 or -1.0, what its first push keeps to;
            - ``sign``: 1.0 if the motion is upwards without input, or -1.0, so that changes are turned over with it;
            - ``candidates`` (LANES, moves): to write on;
            - ``known`` (3,): receives the two worths, and how near to the limit it leads.
    """

    explore: Any
    refine: Any


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

    @inner
    def along(W, j, still, task):
        """The push of lane j along its motion, and the same or against it where that would lead beyond the limit."""
        for a in range(n):
            still[a] = W[a * LANES + j]
        for a in range(len(olders)):
            still[last_input + a] = W[olders[a] + j]
        sense(still)
        way = task.push if still[velocity] >= 0.0 else -task.push
        still[u] = way
        glance(still)
        ahead = still[later] + (task.pace - 1) * (still[later] - still[now])
        return way, -way if abs(ahead) > task.terms.limit - W[MARGIN + j] else way

    @inner
    def choose(W, c, first, t, still, task):
        """Put the inputs of move t into all lanes of block c, whose first move is ``first``.

        The signs of pushes are the digits of a way's number plus one: ways then go on along the motion, or rest.
        """
        half = WAYS // 2 - _LAST // 2
        is_tried = WAYS // 2 >> t > 0
        for j in range(LANES):
            way = c * LANES + j
            last = way - 2 * half
            if t == 0:
                W[U + j] = FIRST[first] * task.push
            elif last == 3:
                W[U + j] = 0.0
            elif last < 0 and is_tried:
                W[U + j] = task.push if ((way % half + 1) >> (t - 1)) & 1 else -task.push
            elif 0 <= last < 2 and is_tried:
                W[U + j] = task.push if last == 0 else -task.push
            elif half <= way < 2 * half:
                W[U + j] = 0.0
            else:
                onward, pump = along(W, j, still, task)
                W[U + j] = pump if last < 2 else -onward

    @inner
    def go_on(W, t, task, worths, peaks):
        """Let all lanes follow their inputs over move t: what they are worth (2, LANES), and their peaks (LANES,)."""
        if t == 0:
            fill(worths[1], 0.0)
            fill(peaks, 0.0)
        for _ in range(task.pace):
            advance(W, task.record, task.terms)
            if t < _IN_REACH:
                for j in range(LANES):
                    peaks[j] = max(peaks[j], abs(W[shown + j]) + W[MARGIN + j])
        for mark in range(len(_MARKS)):
            if t + 1 == int(_MARKS[mark] * task.moves + 0.5):
                appraise(W, task.M, np.sqrt(max(0.0, task.to_come - (t + 1) * task.pace)))
                ends = task.left <= task.moves * task.pace
                weight = 1.0 / len(_MARKS) if not ends else 1.0 if mark == len(_MARKS) - 1 else 0.0
                for j in range(LANES):
                    worths[1, j] += weight * W[SCORE + j]
                    if mark == 0:
                        worths[0, j] = W[SCORE + j]

    @inner
    def explore(W, still, task, worths, peaks, plans, free):
        for first in range(len(FIRST)):
            for c in range(_BLOCKS):
                lane = first * WAYS + c * LANES
                lanes = slice(lane, lane + LANES)
                begin(W, task.record, task.lasts)
                for t in range(task.moves):
                    choose(W, c, first, t, still, task)
                    for j in range(LANES):
                        plans[lane + j, t] = W[U + j]
                    go_on(W, t, task, worths[:, lanes], peaks[lanes])
                    if t < 3:
                        free[t, first] = W[shown + LANES - 1]  # at last that of rest

    @inner
    def change(plan, r, j, push):
        """Change the inputs of lane j in round r a little; ``push`` is turned over where the motion is downwards."""
        h, size = int(where[r, j] * len(plan)), abs(push)
        for t in range(max(1, h), min(len(plan), h + turned[r, j])):
            plan[t] = -plan[t] if plan[t] != 0.0 else push
        for t in range(h, min(len(plan), h + 2)):
            plan[t] = max(-size, min(plan[t] + push * moved[r, j, t - h], size))

    @inner
    def refine(W, task, plan, direction, sign, candidates, known):
        least, worths, peaks = _LEAST * task.push, np.empty((2, LANES)), np.empty(LANES)
        known[1] = -np.inf
        for r in range(task.rounds if direction != 0.0 else 1):
            for j in range(LANES):
                copy(candidates[j], 0, plan, task.moves)
                change(candidates[j, : task.moves], r, j, sign * task.push)
                candidates[j, 0] = direction * max(least, direction * candidates[j, 0])
            begin(W, task.record, task.lasts)
            for t in range(task.moves):
                for j in range(LANES):
                    W[U + j] = candidates[j, t]
                go_on(W, t, task, worths, peaks)
            for j in range(LANES):
                if worths[1, j] > known[1]:
                    known[0], known[1], known[2] = worths[0, j], worths[1, j], peaks[j]
                    copy(plan, 0, candidates[j], task.moves)

    return Ways(explore, refine)
