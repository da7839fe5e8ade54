"""The planner's search, compiled: what each of many candidate sequences of inputs would teach, and mutations of them.

A candidate is imagined by the structured update (`estimator.inference.structured`) with E[γ] and E[ξ] fixed and every
output as it is expected: the means follow the trajectory without noise, and the joint covariance of (x_t, x_{t-1}) and
(θ, η) contracts as it would. So what one sample teaches is not counted again by the next.

Candidates lie in the lanes of a block, so that the compiler imagines several at a time.
"""

from __future__ import annotations

import numpy as np

from duffing_env.noise import draw, to_unit
from estimator.elementary import log
from estimator.lanes import LANES, jit, kernel, lanewise, rows
from estimator.record import COEFFICIENTS, RECORD

_JOINT = ("x0", "x1", *COEFFICIENTS)
_PAIRS = [(i, j) for n, i in enumerate(_JOINT) for j in _JOINT[n:]]
_COVARIANCES = " ".join(f"P_{i}_{j}" for i, j in _PAIRS)
LAYOUT = rows("x0 x1", _COVARIANCES, "u cost score")

# Where the record's entries go in a block.
_LOADED = np.array([(RECORD.index(name), LAYOUT[name]) for name in ("x0", "x1", *_COVARIANCES.split())])
_COEFFICIENTS = RECORD.index("t1")
_NOISES = RECORD.index("g_shape")
_SIZE = len(LAYOUT) * LANES
_U, _COST, _SCORE = (LAYOUT[name] * LANES for name in ("u", "cost", "score"))

#: Nats that a displacement beyond its limit costs, per limit that it is beyond: more than any plan can teach.
_BEYOND = 1e4


@lanewise(LAYOUT, f"x0 x1 {_COVARIANCES} cost", uniform="t1 t2 t3 e q r limit margin price goal goal_weight")
def imagine(
    x0, x1, u,
    P_x0_x0, P_x0_x1, P_x0_t1, P_x0_t2, P_x0_t3, P_x0_e,
    P_x1_x1, P_x1_t1, P_x1_t2, P_x1_t3, P_x1_e,
    P_t1_t1, P_t1_t2, P_t1_t3, P_t1_e, P_t2_t2, P_t2_t3, P_t2_e, P_t3_t3, P_t3_e, P_e_e, cost,
    t1, t2, t3, e, q, r, limit, margin, price, goal, goal_weight,
):  # fmt: skip
    """One expected sample: the structured update of an output that is what was predicted, and what it costs."""
    cube = x0 * x0 * x0
    a = t1 + 3 * t2 * x0 * x0
    c_x0 = a * P_x0_x0 + t3 * P_x0_x1 + x0 * P_x0_t1 + cube * P_x0_t2 + x1 * P_x0_t3 + u * P_x0_e
    c_x1 = a * P_x0_x1 + t3 * P_x1_x1 + x0 * P_x1_t1 + cube * P_x1_t2 + x1 * P_x1_t3 + u * P_x1_e
    c_t1 = a * P_x0_t1 + t3 * P_x1_t1 + x0 * P_t1_t1 + cube * P_t1_t2 + x1 * P_t1_t3 + u * P_t1_e
    c_t2 = a * P_x0_t2 + t3 * P_x1_t2 + x0 * P_t1_t2 + cube * P_t2_t2 + x1 * P_t2_t3 + u * P_t2_e
    c_t3 = a * P_x0_t3 + t3 * P_x1_t3 + x0 * P_t1_t3 + cube * P_t2_t3 + x1 * P_t3_t3 + u * P_t3_e
    c_e = a * P_x0_e + t3 * P_x1_e + x0 * P_t1_e + cube * P_t2_e + x1 * P_t3_e + u * P_e_e
    predicted = t1 * x0 + t2 * cube + t3 * x1 + e * u
    variance = a * c_x0 + t3 * c_x1 + x0 * c_t1 + cube * c_t2 + x1 * c_t3 + u * c_e + q
    w = 1.0 / (variance + r)
    keep = r * w
    over = abs(predicted) + margin * np.sqrt(variance + r) - limit
    over = over if over > 0.0 else 0.0
    off = predicted - goal
    cost += _BEYOND / limit * over + price * u * u + goal_weight * (off * off + variance)
    return (
        predicted, x0,
        keep * variance, keep * c_x0, keep * c_t1, keep * c_t2, keep * c_t3, keep * c_e,
        P_x0_x0 - w * c_x0 * c_x0, P_x0_t1 - w * c_x0 * c_t1, P_x0_t2 - w * c_x0 * c_t2,
        P_x0_t3 - w * c_x0 * c_t3, P_x0_e - w * c_x0 * c_e,
        P_t1_t1 - w * c_t1 * c_t1, P_t1_t2 - w * c_t1 * c_t2, P_t1_t3 - w * c_t1 * c_t3, P_t1_e - w * c_t1 * c_e,
        P_t2_t2 - w * c_t2 * c_t2, P_t2_t3 - w * c_t2 * c_t3, P_t2_e - w * c_t2 * c_e,
        P_t3_t3 - w * c_t3 * c_t3, P_t3_e - w * c_t3 * c_e, P_e_e - w * c_e * c_e, cost,
    )  # fmt: skip


@lanewise(LAYOUT, "score")
def judge(P_t1_t1, P_t1_t2, P_t1_t3, P_t1_e, P_t2_t2, P_t2_t3, P_t2_e, P_t3_t3, P_t3_e, P_e_e, cost):
    """Minus the expected free energy, up to a constant: -½ log det of the coefficients' covariance, less the cost."""
    d1 = P_t1_t1
    l2, l3, le = P_t1_t2 / d1, P_t1_t3 / d1, P_t1_e / d1
    d2 = P_t2_t2 - l2 * P_t1_t2
    w23, w2e = P_t2_t3 - l2 * P_t1_t3, P_t2_e - l2 * P_t1_e
    m3, me = w23 / d2, w2e / d2
    d3 = P_t3_t3 - l3 * P_t1_t3 - m3 * w23
    w3e = P_t3_e - l3 * P_t1_e - m3 * w2e
    de = P_e_e - le * P_t1_e - me * w2e - w3e * w3e / d3
    determinant = d1 * d2 * d3 * de
    return -0.5 * log(determinant) - cost if determinant > 0.0 else -1e300


@kernel
def plan(
    records, left, horizon, rounds, amplitude, limit, margin, price, goal, goal_weight, plans, words, actions, scores
):  # fmt: skip
    """Search the best next inputs of n environments.

    Args:
        records: (n, RECORD_SIZE) their beliefs.
        left: (n,) samples left in their episodes.
        horizon: samples to plan for, at most.
        rounds: of `LANES` candidates each.
        amplitude: largest input [V].
        limit: of the displacement [V].
        margin: predictive standard deviations that a plan keeps from it.
        price: nats for a V² of input energy.
        goal: mean of the goal prior of the displacement [V].
        goal_weight: half its precision [1/V²]; 0 for no goal.
        plans: (n, horizon) the last plans, begun one sample ago [V]; overwritten by the new ones.
        words: (n, 4) streams of random numbers; overwritten.
        actions: (n,) receives the first input of the best plan [V].
        scores: (n,) receives the best plan's score [nats].
    """
    W = np.empty(_SIZE)
    candidates = np.empty((LANES, horizon))
    for i in range(len(records)):
        steps = max(1, min(horizon, left[i]))
        scores[i] = _search(
            W, candidates, records[i], steps, rounds, amplitude, limit, margin, price, goal, goal_weight,
            plans[i], words[i],
        )  # fmt: skip
        actions[i] = plans[i, 0]


@kernel
def play(record, first, horizon, rounds, amplitude, limit, margin, u, words):
    """Plan the inputs u (T,) from sample ``first`` on, where the means of the belief are the truth.

    The inputs before it are followed as they are. Arguments as `plan`; ``words`` is (4,), the record is overwritten.
    """
    W = np.empty(_SIZE)
    candidates = np.empty((LANES, horizon))
    best = np.zeros(horizon)
    lane = np.empty((1, 1))
    for t in range(len(u)):
        if t >= first:
            steps = min(horizon, len(u) - t)
            _search(W, candidates, record, steps, rounds, amplitude, limit, margin, 0.0, 0.0, 0.0, best, words)
            u[t] = best[0]
        lane[0, 0] = u[t]
        _imagine_all(W, record, lane, 1, limit, margin, 0.0, 0.0, 0.0)
        for place in range(len(_LOADED)):
            record[_LOADED[place, 0]] = W[_LOADED[place, 1] * LANES]


@jit
def _search(
    W, candidates, record, steps, rounds, amplitude, limit, margin, price, goal, goal_weight, best, words
):  # fmt: skip
    """Improve the plan ``best``, begun one sample ago; gives its score [nats]."""
    last = best[0]
    best[:-1] = best[1:].copy()
    best[-1] = -last
    best_score = -np.inf
    for k in range(rounds):
        for j in range(LANES):
            candidates[j] = best
            if k == 0 and j > 0:
                _compose(candidates[j], j, steps, amplitude, words)
            elif k > 0:
                _mutate(candidates[j], steps, amplitude, words)
        _imagine_all(W, record, candidates, steps, limit, margin, price, goal, goal_weight)
        for j in range(LANES):
            if W[_SCORE + j] > best_score:
                best_score = W[_SCORE + j]
                best[:] = candidates[j]
    return best_score


@jit
def _imagine_all(W, record, candidates, steps, limit, margin, price, goal, goal_weight):
    """Load the belief into every lane, and follow the candidates (LANES, horizon), or one for all lanes."""
    for place in range(len(_LOADED)):
        value = record[_LOADED[place, 0]]
        first = _LOADED[place, 1] * LANES
        for j in range(LANES):
            W[first + j] = value
    for j in range(LANES):
        W[_COST + j] = 0.0
    t1, t2, t3, e = record[_COEFFICIENTS : _COEFFICIENTS + 4]
    q = record[_NOISES + 1] / record[_NOISES]
    r = record[_NOISES + 3] / record[_NOISES + 2]
    for h in range(steps):
        for j in range(LANES):
            W[_U + j] = candidates[j % len(candidates), h]
        imagine(W, t1, t2, t3, e, q, r, limit, margin, price, goal, goal_weight)
    judge(W)


@jit
def uniform(words):
    """A number in (0, 1) from a stream (4,), which moves on."""
    value, words[0], words[1], words[2], words[3] = draw(words[0], words[1], words[2], words[3])
    return to_unit(value)


@jit
def _compose(candidate, j, steps, amplitude, words):
    """Begin anew: lane 1 ends the last plan otherwise, lane 2 rests, the others are random square waves."""
    if j == 1:
        candidate[steps - 1] = -candidate[steps - 1]
        return
    if j == 2:
        candidate[:] = 0.0
        return
    half_period = 1.0 + 5.0 * uniform(words)
    phase = 2.0 * half_period * uniform(words)
    for h in range(len(candidate)):
        turns = np.int64((h + phase) / half_period)
        candidate[h] = amplitude if turns % 2 == 0 else -amplitude


@jit
def _mutate(candidate, steps, amplitude, words):
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
