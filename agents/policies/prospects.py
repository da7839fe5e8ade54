"""What a belief expects of some simple inputs, compiled: the numbers behind `agents.policies.foresight`.

From the means of a belief the system is imagined for `HORIZONS`[-1] samples without noise. The first input is a
push up, none, or a push down; then follows one of `CONTINUATIONS`:

- ``best``: those signs of the next three pushes that bring most, and then ``pump``,
- ``pump``: pushes along the motion, but against it where they would lead beyond the limit,
- ``brake``: pushes against the motion,
- ``rest``: none.

What a sequence of inputs *brings* is Σ_t φ_tᵀ W φ_t / (2 σ²) with φ the derivative by the coefficients of what the
first sensor shows after a sample from a known state, (x_t, x_t³, x_{t-1}, u_t) for Eq. (2), and the variance σ² of an
output: to first order the growth of ½ log det(C⁻¹ + J), with C the coefficients' covariance, J what the rest of the
episode will tell anyway, and W = (C⁻¹ + J)⁻¹. So it counts what will be lacking at the end. An output whose margin of
`MARGIN` standard deviations reaches beyond the limit takes away more than anything brings.
"""

from __future__ import annotations

from functools import cache
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from agents.planner.design import half_log_det, invert
from agents.planner.motion import View, places
from duffing_env.layout import observation_bounds
from estimator.arrays import copy, copy_scaled, fill
from estimator.engine.motion import motion
from estimator.lanes import jit, kernel, part
from estimator.models.model import Model
from estimator.parameters import FloatArray

CONTINUATIONS = ("best", "pump", "brake", "rest")
HORIZONS = (4, 8, 16)
FIRST_INPUTS = ("up", "none", "down")

#: Predictive standard deviations that an output is to keep from the limit.
MARGIN = 4.0

#: What every observation becomes besides itself: what is expected.
EXPECTED = (
    *(
        f"{continuation}_{name}"
        for continuation in CONTINUATIONS
        for name in (*(f"{way}_{h}" for h in HORIZONS for way in ("up", "none")), *(f"peak_{f}" for f in FIRST_INPUTS))
    ),
    *("best_16", "free_1", "free_2", "free_3", "push", "to_come", "still_open"),
)

#: Largest size of a feature.
BOUND = 10.0


def feature_names(model: Model) -> tuple[str, ...]:
    """What an observation becomes: itself, turned upright, and then what is expected."""
    return (*observation_bounds(model), *EXPECTED)


#: Pushes of ``best`` after the first input; all of their signs are tried.
_TRIED = 3

#: Samples in which an output can still be kept within the limit: half a period of the tracks' slowest oscillators.
_IN_REACH = 8

#: Where ``pump`` turns, in parts of the limit; what twice the limit takes away, in parts of what an episode brings; by
#: how much covariances of float32 correlations are made positive definite.
_TURN, _BEYOND, _RIDGE = 0.95, 500.0, 1e-6

#: A push lasts at most so many times longer than the energy that is left allows for the samples that are left.
_THRIFT = 3.0


class Outlook(NamedTuple):
    """What an observation is relative to, and what is ahead.

    Attributes:
        center: (K,) prior means of the coefficients.
        std: (K,) their standard deviations.
        max_input: amplitude limit.
        max_output: limit of the first sensor.
        samples: of an episode.
        energy: limit of Σ u²; inf where there is none.
        process: variance that the observation's log E[γ] is relative to.
        sensor: that of the first sensor's log E[ξ].
        rate: (K, K) information about the coefficients that a sample brings, where the noises have these variances.
        scales: (n,) sizes of the states when the first sensor is at its limit.
    """

    center: FloatArray
    std: FloatArray
    max_input: float
    max_output: float
    samples: float
    energy: float
    process: float
    sensor: float
    rate: FloatArray
    scales: FloatArray


class Prospect(NamedTuple):
    """What is imagined with, of one observation.

    Attributes:
        start: (rows,) the block of the motion, at the state that is believed.
        C: (K, K) the coefficients' covariance.
        W: (K, K) what is still unknown at the end, weighted.
        push: size of a push.
        limit: of the first sensor.
        variance: σ² of the first sensor's output about its prediction, as it is believed.
        scales: see `Outlook`.
    """

    start: Any
    C: Any
    W: Any
    push: float
    limit: float
    variance: float
    scales: Any


@cache
def lookout(view: View) -> Any:
    """``look(observations, outlook, features, safe, signs)``: what n observations of a model become.

    - ``observations`` (n, entries) float32;
    - ``outlook``: `Outlook`;
    - ``features`` (n, len(feature_names)) float32, receives the features, all finite and at most `BOUND` in size;
    - ``safe`` (n, 3) bool, receives which first inputs need not lead beyond the limit; one of them is the safest;
    - ``signs`` (n,) receives -1.0 where the observation was turned over, so that the first sensor shows nothing
      negative; all 1.0 for a model that is not the same turned over;
    """
    model = view.model
    found, at = motion(*view), places(model)
    row, sense, glance, step = found.layout, found.sense, found.glance, found.step
    n, k, size, is_odd = model.n_states, model.n_coefficients, len(row), found.is_odd
    u, last, older, now, velocity, gain, shown_row = (
        row[name] for name in ("INPUT", "LAST_INPUT", "OLDER_INPUT", "NOW", "VELOCITY", "GAIN", "SHOWN")
    )
    phi = row[f"PHI_{next(iter(model.coefficients))}"]
    pairs = tuple(combinations(range(k), 2))
    odd = (*range(at.state, at.state + n), at.last_input, *range(at.last_output, at.last_output + model.n_outputs))
    own, n_features = at.size, len(feature_names(model))
    kind = f"{model.name}_{model.digest}_{view.degree}_{view.lag}"
    inner, entry = part(kind), kernel(kind=kind)

    @inner
    def square(A, W):
        """φᵀ A φ."""
        total = 0.0
        for i in range(k):
            total += A[i, i] * W[phi + i] * W[phi + i]
            for j in range(i):
                total += 2.0 * A[i, j] * W[phi + i] * W[phi + j]
        return total

    @inner
    def bound(W, scales):
        """Keep a state that runs away where it can be calculated with."""
        for i in range(n):
            W[i] = max(-2.0 * scales[i], min(W[i], 2.0 * scales[i]))

    @inner
    def play(prospect, W, first, continuation, code, brought):
        """Play a sequence: fills what it has brought by each horizon, and gives the highest output with its margin."""
        push, limit = prospect.push, prospect.limit
        copy(W, 0, prospect.start, size)
        total, peak, h = 0.0, 0.0, 0
        for t in range(HORIZONS[-1]):
            if t == 0:
                W[u] = first
            elif continuation == 0 and t <= _TRIED:
                W[u] = push if (code >> (t - 1)) & 1 else -push
            elif continuation == 3:
                W[u] = 0.0
            else:
                sense(W)
                W[u] = push if W[velocity] >= 0.0 else -push
                if continuation == 2:
                    W[u] = -W[u]
                else:
                    glance(W)
                    if abs(W[shown_row]) > _TURN * limit:
                        W[u] = -W[u]
            step(W)
            bound(W, prospect.scales)
            total += square(prospect.W, W)
            reach = min(abs(W[shown_row]), 2.0 * limit) + MARGIN * np.sqrt(square(prospect.C, W) + prospect.variance)
            if t < _IN_REACH:
                peak = max(peak, reach)
            total -= _BEYOND * max(0.0, reach / limit - 1.0)
            if t + 1 == HORIZONS[h]:
                brought[h] = total
                h += 1
        return peak

    @inner
    def attempt(prospect, W, shown, safe):
        """Play all first inputs and continuations; fills their features, and which first inputs are safe."""
        played, brought, best = np.empty(len(HORIZONS)), np.empty((3, len(HORIZONS))), np.empty(3)
        lowest = np.empty(3)
        fill(lowest, np.inf)
        place, most = own, 0.0
        for continuation in range(len(CONTINUATIONS)):
            for first in range(3):
                fill(brought[first], -np.inf)
                best[first] = np.inf
                for code in range(1 << _TRIED if continuation == 0 else 1):
                    peak = play(prospect, W, (1.0 - first) * prospect.push, continuation, code, played)
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
                shown[place] = best[first] / prospect.limit
                place += 1
            if continuation == 0:
                h = len(HORIZONS) - 1
                most = max(0.0, brought[0, h], brought[1, h], brought[2, h])
        shown[place] = np.log(most + 1e-3)
        for first in range(3):
            safe[first] = lowest[first] <= prospect.limit or lowest[first] == min(lowest[0], lowest[1], lowest[2])

    @inner
    def believe(seen, outlook, start, C):
        """Put the means and the covariance that an observation tells into the block and ``C``."""
        scale = np.empty(k)
        for j in range(k):
            start[n + j] = outlook.center[j] + outlook.std[j] * seen[at.mean + j]
            scale[j] = outlook.std[j] * np.exp(seen[at.log_std + j])
            C[j, j] = (1.0 + _RIDGE) * scale[j] * scale[j]
        for i in range(len(pairs)):
            a, b = pairs[i]
            C[b, a] = C[a, b] = seen[at.correlation + i] * scale[a] * scale[b]

    @inner
    def stand(seen, outlook, start):
        """Put the state and the last inputs into the block, upright; gives the sign of what was turned."""
        sign = 1.0
        for turn in range(2):
            for i in range(n):
                start[i] = outlook.max_output * seen[at.state + i]
            start[last] = start[older] = outlook.max_input * seen[at.last_input]
            sense(start)
            if turn == 0:
                if not (is_odd and start[now] < 0.0):
                    break
                sign = -1.0
                for j in odd:
                    seen[j] = -seen[j]
        return sign

    @inner
    def drift(start, prospect, shown, place):
        """Follow the system without input; fills three features."""
        W, limit = np.empty(size), prospect.limit
        copy(W, 0, start, size)
        for t in range(3):
            W[u] = 0.0
            step(W)
            bound(W, prospect.scales)
            shown[place + t] = max(-2.0 * limit, min(W[shown_row], 2.0 * limit)) / limit

    @entry
    def look(observations, outlook, features, safe, signs):
        samples, limit, rate = outlook.samples, outlook.max_output, outlook.rate
        C, unknown, work = np.empty((k, k)), np.empty((k, k)), np.empty((k, k))
        start, W, seen = np.zeros(size), np.zeros(size), np.empty(own)
        for i in range(len(observations)):
            copy(seen, 0, observations[i], own)
            shown = features[i]
            believe(seen, outlook, start, C)
            left = max(1.0, seen[at.time_left] * samples)
            share, push = seen[at.time_left], outlook.max_input
            if outlook.energy < np.inf:
                # What is still to come takes time and energy.
                share = 0.5 * (share + seen[at.budget_left])
                push = min(push, _THRIFT * np.sqrt(max(0.0, seen[at.budget_left]) * outlook.energy / left))
            variance = outlook.process * np.exp(-seen[at.noise]) + outlook.sensor * np.exp(-seen[at.noise + 1])
            growth = (outlook.process + outlook.sensor) / variance
            to_come = weigh(C, rate, share * samples * growth, unknown, work)
            weight = samples / (2.0 * k * variance)
            copy_scaled(unknown, weight, unknown)
            signs[i] = stand(seen, outlook, start)
            copy(shown, 0, seen, own)
            prospect = Prospect(start, C, unknown, push, limit, variance, outlook.scales)
            attempt(prospect, W, shown, safe[i])
            place = n_features - 6
            drift(start, prospect, shown, place)
            shown[place + 3] = 5.0 * start[gain] * push / limit
            shown[place + 4] = to_come
            total = 0.0
            for a in range(k):
                for b in range(k):
                    total += unknown[a, b] * rate[a, b]
            shown[place + 5] = np.log(samples / k / weight * growth * total + 1e-3)
            for j in range(len(shown)):
                # NaN becomes 0.
                shown[j] = max(-BOUND, min(shown[j], BOUND)) if shown[j] == shown[j] else 0.0

    return look


@jit
def weigh(C, rate, count, W, work):
    """W = (C⁻¹ + count rate)⁻¹, and ½ log det(I + count rate C) [nats], which is still to come."""
    copy_scaled(work, 1.0, C)
    known = half_log_det(work)
    if known == -np.inf:  # rounding has made correlations impossible; without them the covariance is one again
        for i in range(len(C)):
            for j in range(len(C)):
                work[i, j] = C[i, j] if i == j else 0.0
        known = half_log_det(work)
    invert(work, W)
    for i in range(len(C)):
        for j in range(len(C)):
            work[i, j] = W[i, j] + count * rate[i, j]
    known += half_log_det(work)
    invert(work, W)
    return known


def look_at(
    observations: npt.ArrayLike, outlook: Outlook, view: View
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_], FloatArray]:
    """Features, safe and signs of observations (n, entries); see `lookout`."""
    seen = np.ascontiguousarray(observations, dtype=np.float32)
    features = np.empty((len(seen), len(feature_names(view.model))), dtype=np.float32)
    safe, signs = np.empty((len(seen), 3), dtype=np.bool_), np.empty(len(seen))
    lookout(view)(seen, outlook, features, safe, signs)
    return features, safe, signs
