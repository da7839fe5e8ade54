"""What the beliefs of all oscillators have in common: what they expect of simple ways to go on.

The oscillator is imagined from the belief, along the ways of `agents.policies.ways`, for as many moves as `look_ahead`
says, or to the end of the episode. Where sensors are noisy and the oscillator is hardly shaken, many outputs tell of a
state together, and what a push teaches is known late: then ways are longer. A move lasts as many samples as
`agents.planner.motion.Swing` says, and fewer where the end is near.

Features are what the *best* way brings, if the first move is a push up, none, or a push down; what it brings to *brake*
and to *rest*; and how near to the limit all of that leads. Where a move is one sample, a push is
as hard as the best way's first.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np

from agents.planner.design import factorise
from agents.planner.fading import delay_with, fade
from agents.planner.imagination import Terms, mind, terms_of
from agents.planner.motion import View, places
from agents.policies.ways import FIRST, FURTHER, LONGEST, SIMPLE, Task, ways
from estimator.arrays import copy
from estimator.engine.motion import motion
from estimator.lanes import LANES, jit, kernel, part
from estimator.parameters import FloatArray

CONTINUATIONS = ("best", "brake", "rest")
PARTS = ("half", "whole")
FIRST_INPUTS = ("up", "none", "down")

#: What all observations become.
FEATURES = (
    "log_std_mean", "log_std_max", "last_input", "last_output", "log_gamma", "log_xi", "time_left", "thrift",
    *(f"{c}_{way}_{part}" for c in CONTINUATIONS for part in PARTS for way in ("up", "none")),
    *(f"{c}_peak_{first}" for c in CONTINUATIONS for first in FIRST_INPUTS),
    "free_1", "free_2", "free_3", "pushed_1", "pushed_2", "brings", "to_come",
)  # fmt: skip

#: Largest size of a feature; what a difference of one nat counts for before arcsinh.
BOUND, _NAT = 10.0, 20.0

#: Moves that are looked ahead, at least; in parts of what a swing takes to build, and of the episode.
_LEAST, _BUILT, _PART = 8, 2 / 3, 1 / 3

#: No fewer samples are looked ahead than so many times the outputs that tell of a state together.
_TOGETHER = 3.0

#: What a way teaches fades in this part of the moves in which a plan of the planner's does, and so many times as much
#: later with a noisy sensor; and by the power of a Gaussian: as ways are shorter, their first moves count alike. Of so
#: many moves at the end of an episode none fades. Chosen on the branch `validation`.
_FADED, _DELAYED, _POWER, _LAST = 0.6, 1.1, 2.0, 32

#: Moves of a way where the episode ends sooner.
_SHORTEST = 4

#: Samples of an episode that the usual rate of information stands for, before the episode has told its own.
_USUALLY = 32.0

#: Where the energy is limited a push has at most so many times the size that what is left would last for to the end.
HASTE = 2.0


class Ahead(NamedTuple):
    """What is ahead.

    Attributes:
        push: largest push; no more than what moves the first sensor by half of its limit in a move.
        moves: that are looked ahead, unless many outputs tell of a state together.
        most: of these, at most.
        samples: of an episode.
        energy: limit of Σ u²; inf where there is none.
        rate: (K, K) information about the coefficients that a sample usually brings.
        known: (K, K) what is known of them before the episode, the inverse of their covariance.
    """

    push: float
    moves: int
    most: int
    samples: float
    energy: float
    rate: FloatArray
    known: FloatArray


def look_ahead(built: float, moves: float) -> tuple[int, int]:
    """How many moves to look ahead in an episode, where a swing takes ``built`` moves to come near the limit, or inf.

    The first number is for where each output tells of a state by itself, the second the most that there are.

    Where the limit is near, ways that go on for long lead beyond it, and what they would teach says little. Where it is
    far, a swing has to be built, and pays late.

    Example:
        >>> look_ahead(5.0, 256), look_ahead(18.0, 256), look_ahead(float("inf"), 256), look_ahead(float("inf"), 48)
        ((8, 36), (12, 36), (36, 36), (16, 16))
    """
    most = int(np.clip(_PART * moves, _LEAST, LONGEST))
    return int(np.clip(_BUILT * built, _LEAST, most)), most


def as_feature(nats: FloatArray) -> FloatArray:
    """Differences of what ways bring, in nats, as features are: bounded, and fine where they are small."""
    return np.clip(np.arcsinh(_NAT * nats), -BOUND, BOUND)


@jit
def pushed(terms, push):
    """The same terms with another largest input."""
    t = terms
    judged = t.margin, t.walk, t.scales, t.pace, t.shaken, t.price, t.goal, t.goal_weight, t.firm
    return Terms(push, t.slew, t.limit, *judged, t.faded, t.cells, t.reach)


@cache
def imaginer(view: View) -> Any:
    """``look(records, observations, ahead, terms, features, safe, signs, shares, pushes)`` makes features of n beliefs.

    - ``records`` (n, size): the beliefs, as `estimator.Belief` keeps them;
    - ``observations`` (n, entries) float32, as they were shown with them;
    - ``ahead``: `Ahead`; ``terms``: `agents.planner.imagination.Terms` of the whole episode;
    - ``features`` (n, len(FEATURES)) float32, receives the features, upright, all finite and at most `BOUND` in size;
    - ``safe`` (n, 3) bool, receives which of up, none and down need not lead beyond the limit; one is the safest;
    - ``signs`` (n,) receives -1.0 where up and down changed places, so that the motion is upwards without input;
    - ``shares`` (n, 2) receives how much of a push up, and of one down, to play: as much as the best way does;
    - ``pushes`` (n,): how hard pushes are at least; receives how hard they are, no less than the energy allows for.
    """
    model = view.model
    found = mind(*view)
    size, SCORE, begin, appraise, precision = found.size, found.score, found.fill, found.appraise, found.precision
    advance, SPREAD, NOISE = found.advance, found.spread, found.noise
    best_of, follow, find = ways(view)
    at, width = places(model), len(motion(*view).layout)
    k, d = model.n_coefficients, model.n_states + model.n_coefficients
    kind = f"{model.name}_{model.digest}_{view.degree}_{view.lag}"
    inner, entry = part(kind), kernel(kind=kind)

    @inner
    def gather(first, worths, peaks, best, nats, heights):
        """What a first move's best way brings, braking, and resting, and how near to the limit each leads."""
        for c in range(len(CONTINUATIONS)):
            lane = first * len(SIMPLE) + c
            heights[c, first] = best.known[2] if c == 0 else peaks[lane]
            for h in range(len(PARTS)):
                nats[c, h, first] = best.known[h] if c == 0 else worths[h, lane]

    @inner
    def learn_rate(W, ahead, elapsed, now, rate, M):
        """The factor M of the information per sample, of the usual one and of what the episode has told so far."""
        precision(W, 0, now)
        for a in range(k):
            for b in range(k):
                told = now[a, b] - ahead.known[a, b]
                rate[a, b] = (_USUALLY * ahead.rate[a, b] + told) / (_USUALLY + elapsed)
        factorise(rate, M)
        if not M[0, 0] > 0.0:
            factorise(ahead.rate, M)

    @inner
    def together(W, record, lasts, terms):
        """How many outputs tell of the state together: the inverse of the filter's gain, by the next output."""
        begin(W, record, lasts)
        advance(W, record, terms)
        sensor = record[NOISE + 1] / record[NOISE]
        return W[SPREAD] / (W[SPREAD] - sensor)

    @entry
    def look(records, observations, ahead, whole, features, safe, signs, shares, pushes):
        W, still, best = np.zeros(size), np.zeros(width), best_of(ahead.most)
        M, none, lasts, peaks = np.zeros((k, k)), np.zeros((k, k)), np.zeros(2), np.empty(LANES)
        worths, plans = np.empty((len(PARTS), LANES)), np.empty((LANES, ahead.most))
        nats, heights = np.empty((3, len(PARTS), len(FIRST))), np.empty((3, len(FIRST)))
        weights = np.empty(ahead.most)
        shared, free, now, rate = np.empty(len(FIRST)), np.empty((3, 3)), np.empty((k, k)), np.empty((k, k))
        for i in range(len(observations)):
            record, seen, told = records[i], observations[i], features[i]
            share, thrift = seen[at.time_left], 1.0
            left = max(1.0, share * ahead.samples)
            terms = terms_of(whole, int(left + 0.5))
            lasts[0] = lasts[1] = terms.amplitude * seen[at.last_input]
            copy(still, 0, record, d)
            if ahead.energy < np.inf:
                # What is still to come takes time and energy.
                share = 0.5 * (share + seen[at.budget_left])
                thrift = min(1.0, np.sqrt(max(0.0, seen[at.budget_left]) * ahead.energy / left) / ahead.push)
            push = pushes[i] = max(pushes[i], ahead.push * min(1.0, HASTE * thrift))
            begin(W, record, lasts)
            learn_rate(W, ahead, (1.0 - seen[at.time_left]) * ahead.samples, now, rate, M)
            appraise(W, none, 0.0)
            so_far = W[SCORE]
            appraise(W, M, np.sqrt(share * ahead.samples))
            at_rate = W[SCORE]
            moves, wanted = ahead.moves, _TOGETHER * together(W, record, lasts, terms) / terms.pace
            if wanted > moves:
                moves = int(min(wanted, ahead.most))
            pace = min(terms.pace, max(1, int(left / moves + 0.5)))
            moves = max(_SHORTEST, min(moves, -(-int(left + 0.5) // pace)))
            has_bursts, to_come = ahead.energy < np.inf, share * ahead.samples
            faded = _FADED * terms.faded + _DELAYED * delay_with(record, NOISE, pace)
            fade(weights, moves, np.inf if left <= max(moves, _LAST) * pace else faded, _POWER)
            further = max(1, min(FURTHER, -(-moves // ahead.moves)))
            task = Task(record, lasts, moves, further, has_bursts, pace, left, to_come, M, weights, pushed(terms, push))
            follow(W, still, task, worths, peaks, plans, free)
            sign = 1.0 if free[0, 1] >= 0.0 else -1.0
            signs[i] = sign
            up, down = (0, 2) if sign > 0.0 else (2, 0)
            most = -np.inf
            for first in range(len(FIRST)):
                find(W, task, first, sign, plans[first * len(SIMPLE) :], best)
                gather(first, worths, peaks, best, nats, heights)
                shared[first] = abs(best.plan[0]) / push if push > 0.0 else 1.0
                most = max(most, best.known[1])
            mean = widest = seen[at.log_std]
            for a in range(1, k):
                mean += seen[at.log_std + a]
                widest = max(widest, seen[at.log_std + a])
            told[0], told[1] = mean / k, widest
            told[2], told[3] = sign * seen[at.last_input], sign * seen[at.last_output]
            told[4], told[5] = seen[at.noise], seen[at.noise + 1]
            told[6], told[7] = seen[at.time_left], thrift
            to = 8
            for c in range(len(CONTINUATIONS)):
                for h in range(len(PARTS)):
                    rise, calm, fall = nats[c, h, up], nats[c, h, 1], nats[c, h, down]
                    told[to] = np.arcsinh(_NAT * (rise - fall))
                    told[to + 1] = np.arcsinh(_NAT * (calm - max(rise, fall)))
                    to += 2
            for c in range(len(CONTINUATIONS)):
                for first in (up, 1, down):
                    told[to] = heights[c, first] / terms.limit
                    to += 1
            for t in range(3):
                told[to + t] = sign * free[t, 1] / terms.limit
            for t in range(2):
                told[to + 3 + t] = (free[t, 0] - free[t, 2]) / terms.limit
            told[to + 5] = np.arcsinh(_NAT * (most - at_rate))
            told[to + 6] = at_rate - so_far
            lowest = min(heights[0, 0], heights[0, 1], heights[0, 2])
            for first in range(len(FIRST)):
                place_at = first if sign > 0.0 else 2 - first
                nearest = min(heights[0, first], heights[1, first], heights[2, first])
                # A longer move is chosen anew before it is played in full, and of a softer push no more is known then.
                is_eased = first != 1 and pace == 1 and heights[0, first] <= terms.limit
                safe[i, place_at] = is_eased or nearest <= max(lowest, terms.limit)
                if first != 1:
                    shares[i, place_at // 2] = shared[first] if is_eased else 1.0
            for j in range(len(told)):
                # NaN becomes 0.
                told[j] = max(-BOUND, min(told[j], BOUND)) if told[j] == told[j] else 0.0

    return look
