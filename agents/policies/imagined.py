"""What the beliefs of all oscillators have in common: what they expect of simple ways to go on, imagined exactly.

From the belief the oscillator is imagined for as many moves as `look_ahead` says, each held for as many samples as
`agents.planner.motion.Swing` says. The first move is a push up, none, or a push down, or half of either: near the limit
a whole push may lead beyond it, where none falls short of it. Then follows one of

- the signs of the next five or six pushes, and then pushes along the motion, but against it where they would lead
  beyond the limit; or the same signs, and then none; or all of these pushes up, or down, and then along (the *best* of
  these ways counts),
- *brake*: pushes against the motion,
- *rest*: none.

The ways of a first move lie side by side in the lanes of two or four blocks, and are imagined as the planner imagines
its own: by belief propagation (`agents.planner.imagination`), so that what one sample teaches is not counted again by
the next, and with what the rest of the episode will bring anyway, at the rate at which the episode has taught so far.
What a way is worth is in nats: what is known when *half* of it has been followed, and the mean of that and of what is
known after the *whole*. By its end alone the best way may be to wait for a move, and so at every decision anew.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np

from agents.planner.imagination import MOST_MARGIN, mind
from agents.planner.motion import View, places
from agents.planner.search import factorise
from estimator.arrays import copy, fill
from estimator.engine.imagination import imagination
from estimator.engine.motion import motion
from estimator.engine.rows import belief_names
from estimator.lanes import LANES, kernel, part
from estimator.parameters import FloatArray

CONTINUATIONS = ("best", "brake", "rest")
PARTS = ("half", "whole")
FIRST_INPUTS = ("up", "none", "down")

#: The first inputs in parts of a push; the last two are halves of the first and of the third.
_FIRST = (1.0, 0.0, -1.0, 0.5, -0.5)

#: What all observations become.
FEATURES = (
    "log_std_mean", "log_std_max", "last_input", "last_output", "log_gamma", "log_xi", "time_left", "thrift",
    *(f"{c}_{way}_{part}" for c in CONTINUATIONS for part in PARTS for way in ("up", "none")),
    *(f"{c}_peak_{first}" for c in CONTINUATIONS for first in FIRST_INPUTS),
    "free_1", "free_2", "free_3", "pushed_1", "pushed_2", "brings", "to_come",
)  # fmt: skip

#: Largest size of a feature; what a difference of one nat counts for before arcsinh.
BOUND, _NAT = 10.0, 20.0

#: Moves that are looked ahead, at least and at most; in parts of what a swing takes to build, and of the episode.
_LEAST, _MOST, _BUILT, _PART = 8, 24, 2 / 3, 1 / 3

#: Blocks of ways for a first move, by the moves that are looked ahead at most. Near the limit many ways are tried, far
#: from it long ones: in about the same time.
_BLOCKS = {12: 4, _MOST: 2}

#: Of ways that lie behind one another, the last: two whose first pushes are all alike, brake, and rest.
_LAST = 4

#: Moves in which an output can still be kept within the limit: nearly a period.
_IN_REACH = 8

#: Samples of an episode that the usual rate of information stands for, before the episode has told its own.
_USUALLY = 32.0

#: Where the energy is limited a push has at most so many times the size that what is left would last for to the end.
HASTE = 2.0


class Ahead(NamedTuple):
    """What is ahead.

    Attributes:
        push: largest push; no more than what moves the first sensor by a part of its limit in a move.
        moves: that are looked ahead, an even number.
        samples: of an episode.
        energy: limit of Σ u²; inf where there is none.
        rate: (K, K) information about the coefficients that a sample usually brings.
        known: (K, K) what is known of them before the episode, the inverse of their covariance.
    """

    push: float
    moves: int
    samples: float
    energy: float
    rate: FloatArray
    known: FloatArray

    @property
    def blocks(self) -> int:
        """Blocks of ways for a first move."""
        return next(blocks for moves, blocks in _BLOCKS.items() if self.moves <= moves)


def look_ahead(built: float, moves: float) -> int:
    """How many moves to look ahead in an episode, where a swing takes ``built`` moves to come near the limit, or inf.

    Where the limit is near, ways that go on for long lead beyond it, and what they would teach says little. Where it is
    far, a swing has to be built, and pays late.

    Example:
        >>> look_ahead(5.0, 256), look_ahead(18.0, 256), look_ahead(float("inf"), 256), look_ahead(float("inf"), 48)
        (8, 12, 24, 16)
    """
    return 2 * int(np.clip(min(_BUILT * built, _PART * moves), _LEAST, _MOST) / 2)


def as_feature(nats: FloatArray) -> FloatArray:
    """Differences of what ways bring, in nats, as features are: bounded, and fine where they are small."""
    return np.clip(np.arcsinh(_NAT * nats), -BOUND, BOUND)


@cache
def imaginer(view: View) -> Any:
    """``look(records, observations, ahead, blocks, terms, features, safe, signs, shares, pushes)``: what they become.

    n beliefs become these:

    - ``records`` (n, size): the beliefs, as `estimator.Belief` keeps them;
    - ``observations`` (n, entries) float32, as they were shown with them;
    - ``ahead``: `Ahead`, and its ``blocks``; ``terms``: `agents.planner.imagination.Terms`;
    - ``features`` (n, len(FEATURES)) float32, receives the features, upright, all finite and at most `BOUND` in size;
    - ``safe`` (n, 3) bool, receives which of up, none and down need not lead beyond the limit; one is the safest;
    - ``signs`` (n,) receives -1.0 where up and down changed places, so that the motion is upwards without input;
    - ``shares`` (n, 2) receives how much of a push up, and of one down, to play: of all and half, what is safe, or if
      both are, what brings more;
    - ``pushes`` (n,): how hard pushes are at least; receives how hard they are, no less than the energy allows for.
    """
    model = view.model
    size, _, U, SCORE, begin, _, advance, appraise, precision = mind(*view)
    found, at, place = motion(*view), places(model), imagination(*view).layout
    row, sense, glance = found.layout, found.sense, found.glance
    shown, spread = place["SHOWN"] * LANES, place["SPREAD"] * LANES
    n, k, width, noise = model.n_states, model.n_coefficients, len(row), belief_names(model).index("GAMMA_SHAPE")
    d = n + k
    u, now, velocity, later = (row[name] for name in ("INPUT", "NOW", "VELOCITY", "SHOWN"))
    last = row["LAST_INPUT"]
    # An array, because an empty tuple has no type.
    olders = np.array([place[x] * LANES for x in ("LAST_INPUT", "OLDER_INPUT") if x in place], dtype=np.int64)
    kind = f"{model.name}_{model.digest}_{view.degree}_{view.lag}"
    inner, entry = part(kind), kernel(kind=kind)

    @inner
    def room(W, j, unforeseen, terms):
        """How far from the limit lane j has to stay."""
        return min(terms.margin * np.sqrt(W[spread + j] + unforeseen), MOST_MARGIN * terms.limit)

    @inner
    def along(W, j, still, push, unforeseen, terms):
        """The push of lane j along its motion, or against it where that would lead beyond the limit."""
        for a in range(n):
            still[a] = W[a * LANES + j]
        for a in range(len(olders)):
            still[last + a] = W[olders[a] + j]
        sense(still)
        way = push if still[velocity] >= 0.0 else -push
        still[u] = way
        glance(still)
        ahead = still[later] + (terms.pace - 1) * (still[later] - still[now])
        return way, -way if abs(ahead) > terms.limit - room(W, j, unforeseen, terms) else way

    @inner
    def choose(W, c, blocks, first, t, still, push, unforeseen, terms):
        """Put the inputs of move t into all lanes of block c, whose first move is ``first``.

        The signs of pushes are the digits of a way's number plus one: ways then go on along the motion, or rest.
        """
        half = blocks * LANES // 2 - _LAST // 2
        is_tried = blocks * LANES // 2 >> t > 0
        for j in range(LANES):
            way = c * LANES + j
            last = way - 2 * half
            if t == 0:
                W[U + j] = _FIRST[first] * push
            elif last == 3:
                W[U + j] = 0.0
            elif last < 0 and is_tried:
                W[U + j] = push if ((way % half + 1) >> (t - 1)) & 1 else -push
            elif 0 <= last < 2 and is_tried:
                W[U + j] = push if last == 0 else -push
            elif half <= way < 2 * half:
                W[U + j] = 0.0
            else:
                onward, pump = along(W, j, still, push, unforeseen, terms)
                W[U + j] = pump if last < 2 else -onward

    @inner
    def best(values, blocks, first, group):
        """The best of a first move's ways in a group of continuations, which are 0 best, 1 brake, 2 rest."""
        ways = blocks * LANES
        begin_at = first * ways + (0 if group == 0 else ways - 3 + group)
        found = values[begin_at]
        for j in range(begin_at + 1, begin_at + (ways - 2 if group == 0 else 1)):
            found = max(found, values[j])
        return found

    @inner
    def better(values, blocks, first, group):
        """The same, or that of half a push where it is better: of the best ways, the others tell of whole ones."""
        found = best(values, blocks, first, group)
        return max(found, best(values, blocks, 3 + first // 2, 0)) if first != 1 and group == 0 else found

    @inner
    def nearest(heights, blocks, first):
        """How near to the limit the way of a first move leads that stays furthest from it; heights are negative."""
        return -max(best(heights, blocks, first, 0), best(heights, blocks, first, 1), best(heights, blocks, first, 2))

    @inner
    def learn_rate(W, ahead, elapsed, now, rate, M):
        """The factor M of the information per sample, of the usual one and of what the episode has told so far."""
        precision(W, now)
        for a in range(k):
            for b in range(k):
                told = now[a, b] - ahead.known[a, b]
                rate[a, b] = (_USUALLY * ahead.rate[a, b] + told) / (_USUALLY + elapsed)
        factorise(rate, M)
        if not M[0, 0] > 0.0:
            factorise(ahead.rate, M)

    @entry
    def look(records, observations, ahead, blocks, terms, features, safe, signs, shares, pushes):
        W, still = np.zeros(size), np.zeros(width)
        M, none, lasts, peaks = np.zeros((k, k)), np.zeros((k, k)), np.zeros(2), np.empty(len(_FIRST) * blocks * LANES)
        brought = np.empty((len(PARTS), len(peaks)))
        free, now, rate = np.empty((3, 3)), np.empty((k, k)), np.empty((k, k))
        for i in range(len(observations)):
            record, seen, told = records[i], observations[i], features[i]
            lasts[0] = lasts[1] = terms.amplitude * seen[at.last_input]
            copy(still, 0, record, d)
            share, thrift = seen[at.time_left], 1.0
            if ahead.energy < np.inf:
                # What is still to come takes time and energy.
                left = max(1.0, share * ahead.samples)
                share = 0.5 * (share + seen[at.budget_left])
                thrift = min(1.0, np.sqrt(max(0.0, seen[at.budget_left]) * ahead.energy / left) / ahead.push)
            push = pushes[i] = max(pushes[i], ahead.push * min(1.0, HASTE * thrift))
            begin(W, record, lasts)
            learn_rate(W, ahead, (1.0 - seen[at.time_left]) * ahead.samples, now, rate, M)
            appraise(W, none, 0.0)
            known = W[SCORE]
            appraise(W, M, np.sqrt(share * ahead.samples))
            to_come = W[SCORE]
            fill(peaks, 0.0)
            unforeseen = terms.shaken * record[noise + 1] / record[noise]
            for lane in range(0, len(peaks), LANES):
                first, c = lane // LANES // blocks, lane // LANES % blocks
                begin(W, record, lasts)
                for t in range(ahead.moves):
                    choose(W, c, blocks, first, t, still, push, unforeseen, terms)
                    for _ in range(terms.pace):
                        advance(W, record, terms)
                        if t < _IN_REACH:
                            for j in range(LANES):
                                peak = abs(W[shown + j]) + room(W, j, unforeseen, terms)
                                peaks[lane + j] = max(peaks[lane + j], peak)
                    if t < 3 and first < 3:
                        free[t, first] = W[shown + LANES - 1]  # at last that of rest
                    if 2 * (t + 1) % ahead.moves == 0:
                        appraise(W, M, np.sqrt(max(0.0, share * ahead.samples - (t + 1) * terms.pace)))
                        for j in range(lane, lane + LANES):
                            score = W[SCORE + j - lane]
                            if t + 1 < ahead.moves:
                                brought[0, j] = score
                            else:
                                brought[1, j] = 0.5 * (brought[0, j] + score)
            sign = 1.0 if free[0, 1] >= 0.0 else -1.0
            signs[i] = sign
            up, down = (0, 2) if sign > 0.0 else (2, 0)
            mean = widest = seen[at.log_std]
            for a in range(1, k):
                mean += seen[at.log_std + a]
                widest = max(widest, seen[at.log_std + a])
            told[0], told[1] = mean / k, widest
            told[2], told[3] = sign * seen[at.last_input], sign * seen[at.last_output]
            told[4], told[5] = seen[at.noise], seen[at.noise + 1]
            told[6], told[7] = seen[at.time_left], thrift
            to = 8
            for group in range(3):
                for h in range(len(PARTS)):
                    rise = better(brought[h], blocks, up, group)
                    fall = better(brought[h], blocks, down, group)
                    calm = best(brought[h], blocks, 1, group)
                    told[to] = np.arcsinh(_NAT * (rise - fall))
                    told[to + 1] = np.arcsinh(_NAT * (calm - max(rise, fall)))
                    to += 2
            for j in range(len(peaks)):
                peaks[j] = -peaks[j]
            for group in range(3):
                for first in (up, 1, down):
                    told[to] = -best(peaks, blocks, first, group) / terms.limit
                    to += 1
            for t in range(3):
                told[to + t] = sign * free[t, 1] / terms.limit
            for t in range(2):
                told[to + 3 + t] = (free[t, 0] - free[t, 2]) / terms.limit
            most = -np.inf
            for first in range(len(_FIRST)):
                most = max(most, best(brought[-1], blocks, first, 0))
            told[to + 5] = np.arcsinh(_NAT * (most - to_come))
            told[to + 6] = to_come - known
            lowest = np.inf
            for first in range(3):
                lowest = min(lowest, -best(peaks, blocks, first, 0))
            for first in range(3):
                peak, share = nearest(peaks, blocks, first), 1.0
                is_safe = peak <= terms.limit
                if first != 1 and nearest(peaks, blocks, 3 + first // 2) <= terms.limit:
                    half = best(brought[-1], blocks, 3 + first // 2, 0)
                    share = 0.5 if not is_safe or half > best(brought[-1], blocks, first, 0) else 1.0
                    is_safe = is_safe or terms.pace == 1  # a longer one is chosen anew before it is played
                place_at = first if sign > 0.0 else 2 - first
                safe[i, place_at] = is_safe or peak <= lowest
                if first != 1:
                    shares[i, place_at // 2] = share
            for j in range(len(told)):
                # NaN becomes 0.
                told[j] = max(-BOUND, min(told[j], BOUND)) if told[j] == told[j] else 0.0

    return look
