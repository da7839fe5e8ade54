"""What a belief expects of some simple inputs, compiled: the numbers behind `agents.policies.foresight`.

From the means of a belief the oscillator is imagined for `HORIZONS`[-1] samples without noise. The first input is a
push up, none, or a push down; then follows one of `CONTINUATIONS`:

- ``best``: those signs of the next three pushes that bring most, and then ``pump``,
- ``pump``: pushes along the motion, but against it where they would lead beyond the limit,
- ``brake``: pushes against the motion,
- ``rest``: none.

What a sequence of inputs *brings* is Σ_t φ_tᵀ W φ_t / (2 σ²) with φ = (x_t, x_t³, x_{t-1}, u_t) and the variance σ² of
an output: to first order the growth of ½ log det(C⁻¹ + J), with C the coefficients' covariance, J what the rest of the
episode will tell anyway, and W = (C⁻¹ + J)⁻¹. So it counts what will be lacking at the end. A displacement whose margin
of `MARGIN` standard deviations reaches beyond the limit takes away more than anything brings.
"""

from __future__ import annotations

from itertools import combinations
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from agents.design import half_log_det, invert
from duffing_env.layout import OBSERVATION
from estimator.lanes import inlined, jit, kernel
from estimator.parameters import FloatArray
from estimator.record import COEFFICIENTS

CONTINUATIONS = ("best", "pump", "brake", "rest")
HORIZONS = (4, 8, 16)
FIRST_INPUTS = ("up", "none", "down")

#: Predictive standard deviations that a displacement is to keep from the limit.
MARGIN = 4.0

#: What an observation becomes: itself, turned upright, and then what is expected.
FEATURES = (
    *OBSERVATION,
    *(
        f"{continuation}_{name}"
        for continuation in CONTINUATIONS
        for name in (
            *(f"{which}_{horizon}" for horizon in HORIZONS for which in ("up", "none")),
            *(f"peak_{first}" for first in FIRST_INPUTS),
        )
    ),
    *("best_16", "free_1", "free_2", "free_3", "push", "to_come", "still_open"),
)

#: Largest size of a feature.
BOUND = 10.0

# Places in the observation.
_PLACE = {name: i for i, name in enumerate(OBSERVATION)}
_LOG_STD, _CORRELATION = _PLACE["log_std_t1"], _PLACE["corr_12"]
_X0, _X1, _TIME_LEFT, _BUDGET_LEFT = (_PLACE[name] for name in ("state_x0", "state_x1", "time_left", "budget_left"))
_ODD = tuple(_PLACE[name] for name in ("state_x0", "state_x1", "last_input", "last_output"))
_PAIRS = tuple(combinations(range(len(COEFFICIENTS)), 2))
_OWN = len(OBSERVATION)

#: Pushes of ``best`` after the first input; all of their signs are tried.
_TRIED = 3

#: Samples in which a displacement can still be kept within the limit: half a period, where the oscillator is slowest.
_IN_REACH = 8

#: Where ``pump`` turns, in parts of the limit.
_TURN = 0.95

#: What a displacement of twice the limit takes away, in parts of what a whole episode brings.
_BEYOND = 500.0

#: Covariances of float32 correlations are made positive definite by this much.
_RIDGE = 1e-6

#: A push lasts at most so many times longer than the energy that is left allows for the samples that are left.
_THRIFT = 3.0


class Outlook(NamedTuple):
    """What an observation is relative to, and what is ahead.

    Attributes:
        center: (4,) prior means of (θ1, θ2, θ3, η).
        std: (4,) their standard deviations.
        max_input: amplitude limit [V].
        max_output: limit of the displacement [V].
        samples: of an episode.
        energy: limit of Σ u² [V²]; inf where there is none.
        variance: σ² of an output about its prediction [V²].
        rate: (4, 4) information about the coefficients that a sample brings.
    """

    center: FloatArray
    std: FloatArray
    max_input: float
    max_output: float
    samples: float
    energy: float
    variance: float
    rate: FloatArray


@kernel
def look(observations, outlook, features, safe, signs, motions):
    """What n observations become.

    Args:
        observations: (n, N_OBSERVATION).
        outlook: see there.
        features: (n, len(FEATURES)) float32, receives the features, all finite and at most `BOUND` in size.
        safe: (n, 3) bool, receives which first inputs need not lead beyond the limit; one of them is the safest.
        signs: (n,) receives -1.0 where the observation was turned over, so that x_t is not negative.
        motions: (n,) receives what an input that is all of the motion would be [V], upright.
    """
    center, std, max_input, limit, samples, energy, variance, rate = outlook
    theta, scale = np.empty(4), np.empty(4)
    C, W, work = np.empty((4, 4)), np.empty((4, 4)), np.empty((4, 4))
    for i in range(len(observations)):
        seen, shown = observations[i].astype(np.float64), features[i]
        for j in range(4):
            theta[j] = center[j] + std[j] * seen[j]
            scale[j] = std[j] * np.exp(seen[_LOG_STD + j])
            C[j, j] = (1.0 + _RIDGE) * scale[j] * scale[j]
        for k in range(len(_PAIRS)):
            a, b = _PAIRS[k]
            C[b, a] = C[a, b] = seen[_CORRELATION + k] * scale[a] * scale[b]
        left = max(1.0, seen[_TIME_LEFT] * samples)
        share, push = seen[_TIME_LEFT], max_input
        if energy < np.inf:
            # What is still to come takes time and energy.
            share = 0.5 * (share + seen[_BUDGET_LEFT])
            push = min(push, _THRIFT * np.sqrt(max(0.0, seen[_BUDGET_LEFT]) * energy / left))
        to_come = _weigh(C, rate, share * samples, W, work)
        weight = samples / (8.0 * variance)
        W *= weight
        sign = -1.0 if seen[_X0] < 0.0 else 1.0
        for j in _ODD:
            seen[j] *= sign
        signs[i] = sign
        x0, x1 = limit * seen[_X0], limit * seen[_X1]
        shown[:_OWN] = seen
        _try(x0, x1, theta, C, W, variance, push, limit, shown, safe[i])
        place = len(FEATURES) - 6
        motions[i] = (_move(theta, x0, x1, 0.0) - x1) / max(theta[3], 0.1 * center[3])
        for _ in range(3):
            x0, x1 = max(-2.0 * limit, min(_move(theta, x0, x1, 0.0), 2.0 * limit)), x0
            shown[place] = x0 / limit
            place += 1
        shown[place] = 5.0 * theta[3] * push / limit
        shown[place + 1] = to_come
        total = 0.0
        for j in range(4):
            for k in range(4):
                total += W[j, k] * rate[j, k]
        shown[place + 2] = np.log(0.25 * samples / weight * total + 1e-3)
        for j in range(len(shown)):
            # A number that is none, of a belief that is none, becomes 0.
            shown[j] = max(-BOUND, min(shown[j], BOUND)) if shown[j] == shown[j] else 0.0


@jit
def _weigh(C, rate, count, W, work):
    """W = (C⁻¹ + count rate)⁻¹, and ½ log det(I + count rate C) [nats], which is still to come."""
    work[:] = C
    known = half_log_det(work)
    if known == -np.inf:  # rounding has made correlations impossible; without them the covariance is one again
        for j in range(4):
            for k in range(4):
                work[j, k] = C[j, k] if j == k else 0.0
        known = half_log_det(work)
    invert(work, W)
    work[:] = W + count * rate
    known += half_log_det(work)
    invert(work, W)
    return known


@jit
def _try(x0, x1, theta, C, W, variance, push, limit, shown, safe):
    """Play all first inputs and continuations; fills their features, and which first inputs are safe."""
    played, brought, best = np.empty(len(HORIZONS)), np.empty((3, len(HORIZONS))), np.empty(3)
    lowest = np.full(3, np.inf)
    place = _OWN
    for continuation in range(len(CONTINUATIONS)):
        for first in range(3):
            brought[first], best[first] = -np.inf, np.inf
            for code in range(1 << _TRIED if continuation == 0 else 1):
                peak = _play(
                    x0, x1, theta, C, W, variance, push, limit, (1.0 - first) * push, continuation, code, played
                )
                best[first] = min(best[first], peak)
                for h in range(len(HORIZONS)):
                    brought[first, h] = max(brought[first, h], played[h])
            lowest[first] = min(lowest[first], best[first])
        for h in range(len(HORIZONS)):
            up, none, down = brought[0, h], brought[1, h], brought[2, h]
            shown[place] = np.arcsinh(up - down)
            shown[place + 1] = np.arcsinh(none - max(up, down))
            place += 2
        for first in range(3):
            shown[place] = best[first] / limit
            place += 1
        if continuation == 0:
            most = max(0.0, brought[:, -1].max())
    shown[place] = np.log(most + 1e-3)
    for first in range(3):
        safe[first] = lowest[first] <= limit or lowest[first] == lowest.min()


@jit
def _play(x0, x1, theta, C, W, variance, push, limit, first, continuation, code, brought):
    """Play one sequence: fills what it has brought by each horizon, and gives the highest |x| with its margin [V]."""
    total, peak, h = 0.0, 0.0, 0
    for t in range(HORIZONS[-1]):
        if t == 0:
            u = first
        elif continuation == 0 and t <= _TRIED:
            u = push if (code >> (t - 1)) & 1 else -push
        elif continuation == 3:
            u = 0.0
        else:
            u = push if x0 >= x1 else -push
            if continuation == 2 or abs(_move(theta, x0, x1, u)) > _TURN * limit:
                u = -u
        total += _square(W, x0, x1, u)
        margin = MARGIN * np.sqrt(_square(C, x0, x1, u) + variance)
        x0, x1 = max(-2.0 * limit, min(_move(theta, x0, x1, u), 2.0 * limit)), x0
        reach = abs(x0) + margin
        if t < _IN_REACH:
            peak = max(peak, reach)
        total -= _BEYOND * max(0.0, reach / limit - 1.0)
        if t + 1 == HORIZONS[h]:
            brought[h] = total
            h += 1
    return peak


@inlined
def _move(theta, x0, x1, u):
    """The displacement that is expected next."""
    return theta[0] * x0 + theta[1] * x0 * x0 * x0 + theta[2] * x1 + theta[3] * u


@inlined
def _square(A, x0, x1, u):
    """φᵀ A φ."""
    c = x0 * x0 * x0
    return (
        A[0, 0] * x0 * x0 + A[1, 1] * c * c + A[2, 2] * x1 * x1 + A[3, 3] * u * u
        + 2.0 * (A[0, 1] * x0 * c + A[0, 2] * x0 * x1 + A[0, 3] * x0 * u)
        + 2.0 * (A[1, 2] * c * x1 + A[1, 3] * c * u + A[2, 3] * x1 * u)
    )  # fmt: skip


def look_at(
    observations: npt.ArrayLike, outlook: Outlook
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_], FloatArray, FloatArray]:
    """Features, safe, signs and motions of observations (n, N_OBSERVATION); see `look`."""
    seen = np.ascontiguousarray(observations, dtype=np.float32)
    n = len(seen)
    features, safe = np.empty((n, len(FEATURES)), dtype=np.float32), np.empty((n, 3), dtype=np.bool_)
    signs, motions = np.empty(n), np.empty(n)
    look(seen, outlook, features, safe, signs, motions)
    return features, safe, signs, motions
