"""What a network sees of an observation, its features, and the shield: functions of the observation alone.

An observation holds a Gaussian belief, the state, and what is left of the episode. From its means the believed model is
rolled out without noise, after a first input up, none or down, and then

- *at rest*: no further input,
- *braking*: pushes against the motion.

`NAMES` has what the network sees of the rollouts. Where the model is odd, all of it is turned upright, so that the
motion is upwards. The *shield* is the interval of choices after which braking still keeps the first sensor within its
limit, with a margin of some predictive standard deviations; between the three first inputs the peaks are taken to be
linear. Where no choice does, it is the one that leads beyond the limit the least.

What inputs *teach* is Σ_t φ_tᵀ W φ_t / (2 σ²), with φ the derivatives by the coefficients of what the first sensor
shows after a sample, and σ² the variance of an output. W = (C⁻¹ + J)⁻¹ is what will be unknown at the end of the
episode, with C the coefficients' covariance and J the information that the rest of the episode brings at the rate of a
swing at the limit. To first order it is the growth of what is known at the end, in nats.
"""

from __future__ import annotations

from functools import cache
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from agents.planner.design import half_log_det, invert
from agents.planner.motion import View, limit_of, places, shaken_of, swing_of
from estimator.arrays import copy, copy_scaled, fill
from estimator.checks import shown
from estimator.engine.motion import motion
from estimator.lanes import jit, kernel, part
from estimator.models.model import Model
from estimator.parameters import FloatArray

FIRST_INPUTS = ("up", "none", "down")

#: What every network sees. ``next``: what the first sensor shows after a move; ``rest`` and ``peak``: the highest that
#: it shows at rest and braking; ``reach``: the highest while braking, with its margin. ``taught`` and ``braked``
#: compare what three moves teach at rest and braking: ``up`` is up less down, and ``none`` is none less the better of
#: both, in parts of the most; ``down`` is the logarithm of the most over the samples left.
NAMES = (
    "log_std_mean", "log_std_max", "log_gamma", "log_xi", "time_left", "thrift", "reserve", "push",
    "last_input", "last_output", "now", "velocity", "log_deviation", "lowest", "highest",
    *(f"{what}_{first}" for what in ("next", "rest", "peak", "reach", "taught", "braked") for first in FIRST_INPUTS),
    "free_2", "free_3", "free_4", "to_come", "still_open",
)  # fmt: skip

#: Largest size of a feature.
BOUND = 10.0

#: Moves that a rollout looks ahead, the first input's among them.
_MOVES = 5

#: Predictive standard deviations that the shield keeps from the limit: where the noises are known, and where they are
#: not, so that these deviations are themselves believed. The same on all tracks; chosen on the branch `validation`.
MARGIN, UNKNOWN_MARGIN = 8.0, 10.0

#: Where the energy is limited, a push changes the height of a swing by this part of it in a sample: to push in
#: proportion to the motion takes least energy.
GROWTH = 0.15

#: No episode is longer, and no move.
_MOST = {"samples": 1e9, "pace": 1e3}

#: Of a setting, what may be 0.
_MAY_BE_ZERO = ("rate", "process", "sensor", "shaken", "margin")

#: By how much covariances of float32 correlations are made positive definite.
_RIDGE = 1e-6


class Setting(NamedTuple):
    """What observations are relative to, and what is ahead.

    Attributes:
        center: (K,) prior means of the coefficients.
        std: (K,) their standard deviations.
        rate: (K, K) information about the coefficients that a sample of a swing at the limit brings, times the variance
            of an output.
        scales: (n,) sizes of the states when the first sensor is at its limit.
        max_input: amplitude limit.
        max_output: limit that the observations of the first sensor are relative to.
        limit: that the shield keeps.
        samples: of an episode.
        energy: limit of Σ u²; inf where there is none.
        process: variance that the observation's log E[γ] is relative to.
        sensor: that of the first sensor's log E[ξ].
        shaken: variance by which process noise moves the first sensor before anything can be done about it, in parts of
            what it does in a sample.
        pace: samples of a move.
        margin: predictive standard deviations that the shield keeps from the limit.
        moved: by how much the largest input over a sample from rest moves what the first sensor shows, in parts of the
            limit.
        growth: where the energy is limited, a push changes the height of a swing by this part of it in a sample, but
            has no less than the size that what is left would last for.
    """

    center: FloatArray
    std: FloatArray
    rate: FloatArray
    scales: FloatArray
    max_input: float
    max_output: float
    limit: float
    samples: float
    energy: float
    process: float
    sensor: float
    shaken: float
    pace: float
    margin: float
    moved: float
    growth: float


class Features(NamedTuple):
    """What n observations become.

    Attributes:
        values: (n, features) float32 what a network sees: all finite and at most `BOUND` in size.
        signs: (n,) float32, -1 where the observation was turned over.
        spans: (n, 2) float32 the lowest and the highest choice that the shield allows, upright.
        pushes: (n,) float32 the action that a choice of 1 stands for, upright: 1, or less where energy is scarce.
        to_come: (n,) float32 what is still to come, ½ log det(I + C J) [nats].
    """

    values: npt.NDArray[np.float32]
    signs: npt.NDArray[np.float32]
    spans: npt.NDArray[np.float32]
    pushes: npt.NDArray[np.float32]
    to_come: npt.NDArray[np.float32]

    def act(self, choices: npt.ArrayLike) -> npt.NDArray[np.float32]:
        """The actions (n, 1) of choices (n,) in [-1, 1], upright: the nearest that the shield allows, turned back."""
        lowest, highest = self.spans.T
        kept = np.minimum(np.maximum(np.asarray(choices, dtype=np.float32), lowest), highest)
        return (kept * self.pushes * self.signs)[:, None]


@jit
def _foresee(C, rate, count, W, work):
    """W = (C⁻¹ + count rate)⁻¹, and ½ log det(I + count rate C) [nats]."""
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
    growth = half_log_det(work)
    if growth == -np.inf:  # of a limit so far that numbers end before it: nothing is foreseen
        return 0.0
    invert(work, W)
    return known + growth


@cache
def compiled(view: View) -> Any:
    """``look(observation, setting, own, work, features, span)``: the features of one observation, compiled.

    It fills in ``features`` and ``span``, and gives sign, push and to_come as of `Features`. ``own``: whether the
    observation itself stands behind the features; ``work``: of ``desk()``, what is written on.
    """
    model = view.model
    found, at = motion(*view), places(model)
    row, sense, step = found.layout, found.sense, found.step
    n, k, size, is_odd = model.n_states, model.n_coefficients, len(row), found.is_odd
    u, last, older, now, velocity, signal = (
        row[name] for name in ("INPUT", "LAST_INPUT", "OLDER_INPUT", "NOW", "VELOCITY", "SHOWN")
    )
    # What pumps is a push along the motion itself: along what an accelerometer sees rise, it would brake.
    rate, states, sensor = (model.rates or ("",))[0], list(model.states), next(iter(model.outputs.values()))
    aside = states.index(rate) if rate in states and sensor != states[0] else -1
    velocity = velocity if aside < 0 else row[rate]
    phi = row[f"PHI_{next(iter(model.coefficients))}"]
    pairs = tuple(combinations(range(k), 2))
    odd = (*range(at.state, at.state + n), at.last_input, *range(at.last_output, at.last_output + model.n_outputs))
    entries, n_features = at.size, len(NAMES)
    place = {name: i for i, name in enumerate(NAMES)}
    NEXT, REST, PEAK, REACH, TAUGHT, BRAKED = (
        place[f"{what}_up"] for what in ("next", "rest", "peak", "reach", "taught", "braked")
    )
    FREE, OTHERS = place["free_2"], place["to_come"]
    inner = part(view.kind)

    @inner
    def desk():
        return np.empty(size), np.empty(size), np.empty((k, k)), np.empty((k, k)), np.empty((k, k))

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
    def believe(o, s, start, C):
        """Means and covariance of the coefficients, states and last inputs."""
        for j in range(k):
            start[n + j] = s.center[j] + s.std[j] * o[at.mean + j]
            C[j, j] = s.std[j] * np.exp(o[at.log_std + j])
        for i in range(len(pairs)):
            a, b = pairs[i]
            C[b, a] = C[a, b] = o[at.correlation + i] * C[a, a] * C[b, b]
        for j in range(k):
            C[j, j] *= (1.0 + _RIDGE) * C[j, j]
        for i in range(n):
            start[i] = s.max_output * o[at.state + i]
        start[last] = start[older] = s.max_input * o[at.last_input]
        sense(start)

    @inner
    def turn(start):
        """Turn the state and the inputs over."""
        for i in range(n):
            start[i] = -start[i]
        for i in (last, older):
            start[i] = -start[i]
        sense(start)

    @inner
    def roll(s, start, W, C, unknown, noise, push, brakes, f, which):
        """One rollout: fills in what it shows of a first input."""
        copy(W, 0, start, size)
        W[u] = (1.0 - which) * push
        peak, reach, taught = 0.0, 0.0, 0.0
        pace = int(s.pace)
        for t in range(_MOVES * pace):
            if t > 0:
                W[u] = 0.0
                if brakes:
                    sense(W)
                    W[u] = -push if W[velocity] >= 0.0 else push
            step(W)
            bound(W, s.scales)
            high = min(abs(W[signal]), 2.0 * s.limit)
            peak = max(peak, high)
            if t < 3 * pace:
                taught += square(unknown, W)
            if brakes:
                if high > 0.5 * s.limit:
                    # What is not known of the coefficients adds up over a move.
                    high += s.margin * np.sqrt(pace * pace * square(C, W) + (noise[0] if t == 0 else noise[1]))
                reach = max(reach, high)
            elif which == 1 and (t + 1) % pace == 0 and pace <= t < 4 * pace:
                f[FREE + t // pace - 1] = W[signal] / s.limit
            if t + 1 == pace and not brakes:
                f[NEXT + which] = W[signal] / s.limit
        if brakes:
            f[PEAK + which], f[REACH + which], f[BRAKED + which] = peak / s.limit, reach / s.limit, taught
        else:
            f[REST + which], f[TAUGHT + which] = peak / s.limit, taught

    @inner
    def shield(up, none, down, span):
        """The interval of inputs whose peaks stay within the limit, where these are linear between three of them."""
        low, high = -1.0, 1.0
        if up > 1.0 or none > 1.0 or down > 1.0:
            if none <= 1.0:
                high = (1.0 - none) / (up - none) if up > 1.0 else 1.0
                low = -(1.0 - none) / (down - none) if down > 1.0 else -1.0
            elif down <= 1.0 and down <= up:
                high = -(none - 1.0) / (none - down)
            elif up <= 1.0:
                low = (none - 1.0) / (none - up)
            else:
                low = high = 0.0 if none <= min(up, down) else (1.0 if up <= down else -1.0)
        span[0], span[1] = low, high

    @inner
    def look(observation, s, own, work, f, span):
        start, W, C, unknown, scratch = work
        o = observation
        fill(start, 0.0)
        believe(o, s, start, C)
        sign = 1.0
        if is_odd and start[velocity] < 0.0:
            sign = -1.0
            turn(start)
        left = max(1.0, o[at.time_left] * s.samples)
        share, thrift, reserve, push = left, 1.0, 1.0, 1.0
        if s.energy < np.inf:
            # What is still to come takes time and energy.
            share = 0.5 * (share + o[at.budget_left] * s.samples)
            reserve = np.sqrt(max(0.0, o[at.budget_left]) * s.energy) / s.max_input
            thrift = min(1.0, reserve / np.sqrt(left))
        process, sensor = s.process * np.exp(-o[at.noise]), s.sensor * np.exp(-o[at.noise + 1])
        variance = process + sensor
        to_come = _foresee(C, s.rate, share / variance, unknown, scratch)
        copy_scaled(unknown, 0.5 / variance, unknown)
        noise = variance, 2.0 * variance + s.shaken * process
        roll(s, start, W, C, unknown, noise, 0.0, False, f, 1)
        if s.energy < np.inf:
            push = min(1.0, max(thrift, s.growth * f[REST + 1] / s.moved))
        for which in range(3):
            if which != 1:
                roll(s, start, W, C, unknown, noise, push * s.max_input, False, f, which)
            roll(s, start, W, C, unknown, noise, push * s.max_input, True, f, which)
        shield(f[REACH], f[REACH + 1], f[REACH + 2], span)
        for what in (TAUGHT, BRAKED):
            up, none, down = f[what], f[what + 1], f[what + 2]
            most = max(up, none, down) + 1e-12
            f[what], f[what + 1] = (up - down) / most, (none - max(up, down)) / most
            f[what + 2] = np.log(most * left + 1e-3)
        mean = widest = o[at.log_std]
        for a in range(1, k):
            mean += o[at.log_std + a]
            widest = max(widest, o[at.log_std + a])
        f[0], f[1], f[2], f[3] = mean / k, widest, o[at.noise], o[at.noise + 1]
        f[4], f[5], f[6], f[7] = o[at.time_left], thrift, reserve, push
        f[8], f[9] = sign * o[at.last_input], sign * o[at.last_output]
        f[10], f[11] = start[now] / s.limit, start[velocity] * s.pace / s.limit
        if aside >= 0:
            f[11] = start[velocity] / s.scales[aside]
        f[12], f[13], f[14] = 0.5 * np.log(variance / s.limit**2) + 7.0, span[0], span[1]
        f[OTHERS] = to_come / k
        total = 0.0
        for a in range(k):
            for b in range(k):
                total += unknown[a, b] * s.rate[a, b]
        f[OTHERS + 1] = np.log(total * s.samples + 1e-6)
        if own:
            copy(f, n_features, o, entries)
            if sign < 0.0:
                for j in odd:
                    f[n_features + j] = -f[n_features + j]
        for j in range(len(f)):
            # NaN becomes 0.
            f[j] = max(-BOUND, min(f[j], BOUND)) if f[j] == f[j] else 0.0
        return sign, push, to_come

    return desk, look


@cache
def _mapper(view: View) -> Any:
    """``map_all(observations, setting, own, *features)``: fills in the `Features` of n observations."""
    desk, look = compiled(view)

    @kernel(kind=view.kind)
    def map_all(observations, setting, own, values, signs, spans, pushes, to_come):
        work = desk()
        for i in range(len(observations)):
            signs[i], pushes[i], to_come[i] = look(observations[i], setting, own, work, values[i], spans[i])

    return map_all


class FeatureMap:
    """Turns observations of an environment into `Features`.

    Args:
        setting: what observations are relative to.
        view: how the believed model is taken.
        own: whether the observation itself stands behind the features that all models have.
    """

    def __init__(self, setting: Setting, view: View, *, own: bool = True) -> None:
        self.setting, self.view, self.own = setting, view, own

    @classmethod
    def of(cls, env: Any, *, own: bool = True) -> FeatureMap:
        """That of an unwrapped environment, single or vector.

        Raises:
            ValueError: for an environment that is not one of duffing_env, shows another observation than the
                posterior, or holds its actions for several samples.
        """
        experiment = getattr(env, "experiment", None)
        if experiment is None:
            raise ValueError(
                f"env must be one of duffing_env for a policy with features, but is {type(env).__name__}; pass that one"
            )
        if experiment.observation != "posterior":
            raise ValueError(
                f"env must show the observation 'posterior' for features, but shows {shown(experiment.observation)}; "
                "leave out the option observation"
            )
        if experiment.hold != 1:
            raise ValueError(f"hold must be 1 for features, but is {experiment.hold}; train without features")
        setup, view, prior = experiment.kernel_params, View.of(experiment), experiment.prior_belief
        center = prior.coefficients_mean
        swing = swing_of(view, center, setup.max_input, setup.max_output)
        setting = Setting(
            center=center,
            std=1.0 / setup.prior_inverse_std,
            rate=swing.taught,
            scales=swing.scales,
            max_input=float(setup.max_input),
            max_output=float(setup.max_output),
            limit=limit_of(experiment, swing.scales),
            samples=float(setup.horizon),
            energy=float(setup.budget),
            process=float(np.exp(-setup.prior_log_precisions[0])),
            sensor=float(np.exp(-setup.prior_log_precisions[1])),
            shaken=shaken_of(experiment, swing),
            pace=float(swing.pace),
            margin=MARGIN if experiment.noise_hypotheses == 1 else UNKNOWN_MARGIN,
            moved=abs(swing.moved) * float(setup.max_input) / float(setup.max_output),
            growth=GROWTH,
        )
        return cls(setting, view, own=own)

    @classmethod
    def from_tensor(cls, numbers: npt.ArrayLike, description: dict[str, Any]) -> FeatureMap:
        """That which `to_tensor` and `describe` gave.

        Raises:
            ValueError: for numbers of another count, or that are not those of a setting.
        """
        described = dict(description)
        own, view = bool(described.pop("own")), View(Model(**described.pop("model")), **described)
        k, n = view.model.n_coefficients, view.model.n_states
        flat = np.asarray(numbers, dtype=np.float64)
        sizes = (k, k, k * k, n)
        size = sum(sizes) + len(Setting._fields) - len(sizes)
        if flat.shape != (size,):
            raise ValueError(f"setting must be {size} numbers, but is {flat.tolist()!r:.200}")
        center, std, rate, scales, others = np.split(flat, np.cumsum(sizes))
        setting = Setting(center, std, rate.reshape(k, k), scales, *others.tolist())
        value: Any
        for name, value in zip(Setting._fields, setting, strict=True):
            held = np.diag(value) if name == "rate" else np.asarray(value)
            sound = np.isfinite(value).all() or (name == "energy" and value == np.inf)
            sound &= bool(name == "center" or (held > 0).all() or (name in _MAY_BE_ZERO and (held >= 0).all()))
            if not sound or (name in _MOST and not 1 <= value <= _MOST[name]):
                raise ValueError(f"{name} of setting must be positive and finite, but is {value!r:.80}; copy it anew")
        return cls(setting, view, own=own)

    def to_tensor(self) -> FloatArray:
        """The setting, flat, as a policy's file holds it."""
        return np.concatenate([np.ravel(np.asarray(value, dtype=np.float64)) for value in self.setting])

    def describe(self) -> dict[str, Any]:
        """The rest of it, as JSON can hold it."""
        return {"own": self.own, "model": self.view.model.to_dict(), "degree": self.view.degree, "lag": self.view.lag}

    @property
    def observation_size(self) -> int:
        """Entries of the observations."""
        return places(self.view.model).size

    @property
    def size(self) -> int:
        """What a network sees."""
        return len(NAMES) + self.own * self.observation_size

    def __call__(self, observations: npt.ArrayLike) -> Features:
        """The features of observations (n, entries)."""
        seen = np.ascontiguousarray(observations, dtype=np.float32)
        n = len(seen)
        found = Features(*(np.empty(shape, dtype=np.float32) for shape in ((n, self.size), n, (n, 2), n, n)))
        _mapper(self.view)(seen, self.setting, self.own, *found)
        return found
