"""The planner's search, compiled: the best way through the map of (x_t, x_{t-1}), and small changes of it.

The teaching of a plan has many summits, and changing a long plan here and there finds a poor one, even of a system that
is known. So the plan is built sample by sample, as by dynamic programming: of all ways that lead into the same cell of
the plane (x_t, x_{t-1}) only the best is followed, with the highest input, the lowest, and the one nearest to zero. A
way's score is what it has taught together with what the rest of the episode will teach anyway, at the rate of the last
plans. Without the latter a way would be praised for what every way teaches sooner or later.

The best way is then compared with the last plan, begun one sample ago, and with changed copies of the better one.
"""

from __future__ import annotations

import numpy as np

from agents.design import half_log_det
from agents.policies.imagination import SCORE, SIZE, X0, X1, U, advance, appraise, collect, fill, precision
from duffing_env.noise import draw, to_unit
from estimator.lanes import LANES, jit, kernel

#: Cells of the map along each axis, from minus the displacement limit to plus.
_CELLS = 24

#: Towards the end of an episode, when so many samples are left, no later plan mends what a plan misses: the map is then
#: finer, the rounds are more by this factor, and plans look no further than so many samples.
_LATE, _LATE_CELLS, _LATE_ROUNDS, _LATE_HORIZON = 48, 32, 4, 20

#: Inputs that are tried at every cell.
_CHOICES = 3

#: A way this much [nats] worse than the best of its length is followed no further.
_HOPELESS = 1.0

#: Part of what a plan teaches per sample that goes into the running mean.
_REFRESHED = 0.2

_MOST = _LATE_CELLS * _LATE_CELLS
_BLOCKS = -(-_MOST // LANES)


@kernel
def plan(records, left, horizon, rounds, terms, last, plans, rates, words, actions, scores):
    """Search the best next inputs of n environments.

    Args:
        records: (n, RECORD_SIZE) their beliefs.
        left: (n,) samples left in their episodes.
        horizon: samples to plan for, at most.
        rounds: of `LANES` changed copies each.
        terms: `Terms`.
        last: (n,) the inputs that were applied last [V].
        plans: (n, horizon) the last plans, begun one sample ago [V]; overwritten by the new ones.
        rates: (n, 4, 4) information per sample that plans have brought, a running mean; zeros where there was none yet.
            Overwritten.
        words: (n, 4) streams of random numbers; overwritten.
        actions: (n,) receives the first input of the best plan [V].
        scores: (n,) receives the best plan's score [nats].
    """
    memory = _memory(horizon)
    for i in range(len(records)):
        rest = max(1, left[i])
        scores[i] = _search(
            memory, records[i], rest, min(horizon, rest), rounds, terms, last[i], plans[i], rates[i], words[i]
        )  # fmt: skip
        actions[i] = plans[i, 0]


@kernel
def play(record, first, horizon, rounds, terms, u, words):
    """Plan the inputs u (T,) from sample ``first`` on, where the means of the belief are the truth.

    The inputs before it are followed as they are. Arguments as `plan`; ``words`` is (4,), the record is overwritten.
    """
    memory = _memory(horizon)
    best, rate, W = np.zeros(horizon), np.zeros((4, 4)), np.empty(SIZE)
    for t in range(len(u)):
        left = len(u) - t
        if t >= first:
            last = u[t - 1] if t > 0 else 0.0
            _search(memory, record, left, min(horizon, left), rounds, terms, last, best, rate, words)
            u[t] = best[0]
        fill(W, record)
        W[U : U + LANES] = u[t]
        advance(W, record, terms)
        collect(W, record)


@jit
def _memory(horizon):
    """What a search writes on: blocks of ways and of their continuations, where these come from, and candidates."""
    ways, continued = np.empty((_BLOCKS, SIZE)), np.empty((_CHOICES * _BLOCKS, SIZE))
    origins, inputs = np.empty((horizon, _MOST), np.int64), np.empty((horizon, _MOST))
    return ways, continued, origins, inputs, np.empty((LANES, horizon))


@jit
def _search(memory, record, left, steps, rounds, terms, last, best, rate, words):
    """Improve the plan ``best`` (horizon,), begun one sample ago, and ``rate``; gives the plan's score [nats]."""
    ways, continued, origins, inputs, candidates = memory
    cells = _CELLS
    if left <= _LATE:
        cells, steps, rounds = _LATE_CELLS, min(steps, _LATE_HORIZON), _LATE_ROUNDS * rounds
    M = np.zeros((4, 4))
    _factor(rate, M)
    turned = -best[0]
    best[:-1] = best[1:].copy()
    best[steps - 1] = turned
    _bound(best, steps, last, terms)
    candidates[0] = best
    candidates[1] = 0.0
    _bound(candidates[1], steps, last, terms)
    _find_way(cells, ways, continued, origins, inputs, record, left, steps, terms, last, M, candidates[2], words)
    for j in range(3, LANES):
        candidates[j] = candidates[2 * (j % 2)]
        _change(candidates[j], steps, terms.amplitude, words)
        _bound(candidates[j], steps, last, terms)
    W = ways[0]
    score = -np.inf
    for k in range(rounds):
        for j in range(LANES if k > 0 else 0):
            candidates[j] = best
            _change(candidates[j], steps, terms.amplitude, words)
            _bound(candidates[j], steps, last, terms)
        _follow(W, record, candidates, steps, terms)
        appraise(W, M, np.sqrt(left - steps))
        for j in range(LANES):
            if W[SCORE + j] > score:
                score = W[SCORE + j]
                best[:] = candidates[j]
    # Where the coefficients walk, what is learned later does not add to what is learned now.
    if terms.walk_t1 == 0.0:
        _refresh(W, record, best, steps, terms, rate)
    return score


@jit
def _find_way(cells, ways, continued, origins, inputs, record, left, steps, terms, last, M, found, words):
    """Build a plan (steps,) by the best ways into the cells of the map, which is laid anew at random every time."""
    best, ends = np.empty(cells * cells), np.empty(cells * cells, np.int64)
    right, up = uniform(words), uniform(words)
    fill(ways[0], record)
    ways[0, U : U + LANES] = last
    count = 1
    for h in range(steps):
        best[:] = -np.inf
        for b in range(_CHOICES * (-(-count // LANES))):
            W = continued[b]
            W[:] = ways[b // _CHOICES]
            for j in range(LANES):
                W[U + j] = _choose(b % _CHOICES, W[U + j], terms)
            advance(W, record, terms)
            appraise(W, M, np.sqrt(left - h - 1))
            for j in range(min(LANES, count - b // _CHOICES * LANES)):
                cell = _place(W[X0 + j], terms.limit, cells, right) * cells
                cell += _place(W[X1 + j], terms.limit, cells, up)
                if W[SCORE + j] > best[cell]:
                    best[cell] = W[SCORE + j]
                    ends[cell] = b * LANES + j
        count = _gather(ways, continued, best, ends, origins[h], inputs[h])
    way = np.argmax(best[:count])
    for h in range(steps - 1, -1, -1):
        found[h] = inputs[h, way]
        way = origins[h, way]


@jit
def _gather(ways, continued, best, ends, origins, inputs):
    """Make the best continuations the new ways, and note where they come from; gives their number.

    ``best``, the scores of the cells, becomes that of the ways.
    """
    enough = np.max(best) - _HOPELESS
    count = 0
    for cell in range(len(best)):
        if best[cell] >= enough and best[cell] > -np.inf:
            b, j = ends[cell] // LANES, ends[cell] % LANES
            origins[count] = b // _CHOICES * LANES + j
            inputs[count] = continued[b, U + j]
            best[count] = best[cell]
            way, lane = ways[count // LANES], count % LANES
            for row in range(0, SIZE, LANES):
                way[row + lane] = continued[b, row + j]
            count += 1
    # Lanes beyond the last way do the same work as the others, so that none of them runs wild.
    for lane in range(count, -(-count // LANES) * LANES):
        for row in range(0, SIZE, LANES):
            ways[lane // LANES, row + lane % LANES] = ways[lane // LANES, row]
    return count


@jit
def _choose(choice, last, terms):
    """The highest input after ``last``, the lowest, or the one nearest to zero."""
    if choice == 0:
        return min(terms.amplitude, last + terms.slew)
    if choice == 1:
        return max(-terms.amplitude, last - terms.slew)
    return max(last - terms.slew, min(0.0, last + terms.slew))


@jit
def _place(x, limit, cells, offset):
    """The cell of a displacement along one axis."""
    place = np.int64((x / limit + 1.0) * 0.5 * (cells - 1) + offset)
    return max(0, min(cells - 1, place))


@jit
def _bound(candidate, steps, last, terms):
    """Cut changes of the input beyond the slew limit, as the environment does."""
    for h in range(steps):
        candidate[h] = max(last - terms.slew, min(candidate[h], last + terms.slew))
        last = candidate[h]


@jit
def _follow(W, record, candidates, steps, terms):
    """Imagine the candidates (LANES, horizon) from a belief on, or one for all lanes."""
    fill(W, record)
    for h in range(steps):
        for j in range(LANES):
            W[U + j] = candidates[j % len(candidates), h]
        advance(W, record, terms)


@jit
def _refresh(W, record, best, steps, terms, rate):
    """Let the information per sample of a plan into the running mean; the first one is taken as it is."""
    before, after = np.empty((4, 4)), np.empty((4, 4))
    fill(W, record)
    precision(W, before)
    _follow(W, record, best.reshape(1, -1), steps, terms)
    precision(W, after)
    part = _REFRESHED if rate[0, 0] > 0.0 else 1.0
    rate += part * ((after - before) / steps - rate)


@jit
def _factor(information, M):
    """The factor M (4, 4) of an information M Mᵀ; zeros where there is none, or it tells nothing of a coefficient."""
    M[:] = information
    if half_log_det(M) == -np.inf:
        M[:] = 0.0


@jit
def uniform(words):
    """A number in (0, 1) from a stream (4,), which moves on."""
    value, words[0], words[1], words[2], words[3] = draw(words[0], words[1], words[2], words[3])
    return to_unit(value)


@jit
def _change(candidate, steps, amplitude, words):
    """Change a candidate a little: turn one, two or a run of inputs over, shift it, or put one anywhere."""
    kind = uniform(words)
    h = np.int64(uniform(words) * steps)
    if kind < 0.35:
        candidate[h] = -amplitude if candidate[h] > 0.0 else amplitude
    elif kind < 0.55:
        other = np.int64(uniform(words) * steps)
        candidate[h] = -amplitude if candidate[h] > 0.0 else amplitude
        candidate[other] = -amplitude if candidate[other] > 0.0 else amplitude
    elif kind < 0.75:
        stop = min(steps, h + 2 + np.int64(4.0 * uniform(words)))
        for k in range(h, stop):
            candidate[k] = -candidate[k]
    elif kind < 0.85:
        for k in range(h, steps - 1):
            candidate[k] = candidate[k + 1]
    elif kind < 0.92:
        for k in range(steps - 1, h, -1):
            candidate[k] = candidate[k - 1]
    else:
        candidate[h] = amplitude * (2.0 * uniform(words) - 1.0)
