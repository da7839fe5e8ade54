"""What a network sees of an observation, its features, and the shield: functions of the observation alone.

An observation holds a Gaussian belief, the state, and what is left of the episode. From its means the believed model is
rolled out without noise, after a first input up, none or down, and then

- *at rest*: no further input,
- *braking*: pushes against the motion.

`FEATURE_NAMES` has what the network sees of the rollouts. Where the model is odd, all of it is turned upright, so that the
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

from agents.planning.d_optimality import half_log_det, invert_from_cholesky
from agents.planning.model_probe import ModelView, observation_layout, planning_limit
from agents.planning.time_scales import kept_accumulated_noise, probe_time_scales
from estimator.compilation.array_operations import copy, copy_scaled, fill
from estimator.compilation.simd import jit, jit_closure, kernel
from estimator.engine.noise_free_response import compile_noise_free_response
from estimator.models.model import Model
from estimator.support.argument_checks import short_repr
from estimator.support.array_types import FloatArray

FIRST_INPUTS = ("up", "none", "down")

#: Features that stand for each of the first inputs.
_PER_FIRST_INPUT = (
    "next_output", "free_peak", "braked_peak", "braked_peak_with_margin", "free_information", "braked_information",
)  # fmt: skip

#: What every network sees. ``next``: what the first sensor shows after a move; ``rest`` and ``peak``: the highest that
#: it shows at rest and braking; ``peak_with_margin``: the highest while braking, with its margin. ``mean_information`` and ``braked``
#: compare what three moves teach at rest and braking: ``up`` is up less down, and ``none`` is none less the better of
#: both, in parts of the most; ``down`` is the logarithm of the most over the samples left.
FEATURE_NAMES = (
    "log_std_mean", "log_std_max", "log_gamma", "log_xi", "time_left", "energy_left_ratio", "energy_left", "action_scale",
    "last_input", "last_output", "output", "velocity", "log_deviation", "lowest_allowed", "highest_allowed",
    *(f"{what}_{first}" for what in _PER_FIRST_INPUT for first in FIRST_INPUTS),
    "free_response_2", "free_response_3", "free_response_4", "remaining_information", "open_information_rate",
)  # fmt: skip

#: Largest size of a feature.
MAX_FEATURE = 10.0

#: Moves that a rollout looks ahead, the first input's among them.
_N_LOOKAHEAD_MOVES = 5

#: Predictive standard deviations that the shield keeps from the limit: where the noises are known, and where they are
#: not, so that these deviations are themselves believed. The same on all tracks; chosen on the branch `validation`.
MARGIN_KNOWN_NOISE, MARGIN_UNKNOWN_NOISE = 8.0, 10.0

#: Where the energy is limited, a push changes the height of a swing by this part of it in a sample: to push in
#: proportion to the motion takes least energy.
AMPLITUDE_GROWTH = 0.15

#: No episode is longer, and no move.
_MAX_SETTINGS = {"samples": 1e9, "hold_samples": 1e3}

#: Of a setting, what may be 0.
_MAY_BE_ZERO = ("information_rate", "process_variance", "sensor_variance", "accumulated_noise", "margin")

#: By how much covariances of float32 correlations are made positive definite.
_RIDGE = 1e-6


class FeatureSettings(NamedTuple):
    """What observations are relative to, and what is ahead.

    Attributes:
        center: (K,) prior means of the coefficients.
        std: (K,) their standard deviations.
        information_rate: (K, K) information about the coefficients that a sample of a swing at the limit brings, times the variance
            of an output.
        scales: (n,) sizes of the states when the first sensor is at its limit.
        max_input: amplitude limit.
        max_output: limit that the observations of the first sensor are relative to.
        limit: that the shield keeps.
        samples: of an episode.
        energy: limit of Σ u²; inf where there is none.
        process_variance: variance that the observation's log E[γ] is relative to.
        sensor_variance: that of the first sensor's log E[ξ].
        accumulated_noise: variance by which process noise moves the first sensor before anything can be done about it, in parts of
            what it does in a sample.
        hold_samples: samples of a move.
        margin: predictive standard deviations that the shield keeps from the limit.
        step_response: by how much the largest input over a sample from rest moves what the first sensor shows, in parts of the
            limit.
        amplitude_growth: where the energy is limited, a push changes the height of a swing by this part of it in a sample, but
            has no less than the size that what is left would last for.
    """

    center: FloatArray
    std: FloatArray
    information_rate: FloatArray
    scales: FloatArray
    max_input: float
    max_output: float
    limit: float
    samples: float
    energy: float
    process_variance: float
    sensor_variance: float
    accumulated_noise: float
    hold_samples: float
    margin: float
    step_response: float
    amplitude_growth: float


class ShieldedFeatures(NamedTuple):
    """What n observations become.

    Attributes:
        values: (n, features) float32 what a network sees: all finite and at most `MAX_FEATURE` in size.
        mirror_signs: (n,) float32, -1 where the observation was turned over.
        allowed_intervals: (n, 2) float32 the lowest and the highest choice that the shield allows, upright.
        action_scales: (n,) float32 the action that a choice of 1 stands for, upright: 1, or less where energy is scarce.
        remaining_information: (n,) float32 what is still to come, ½ log det(I + C J) [nats].
    """

    values: npt.NDArray[np.float32]
    mirror_signs: npt.NDArray[np.float32]
    allowed_intervals: npt.NDArray[np.float32]
    action_scales: npt.NDArray[np.float32]
    remaining_information: npt.NDArray[np.float32]

    def to_actions(self, choices: npt.ArrayLike) -> npt.NDArray[np.float32]:
        """The actions (n, 1) of choices (n,) in [-1, 1], upright: the nearest that the shield allows, turned back."""
        lowest, highest = self.allowed_intervals.T
        kept = np.minimum(np.maximum(np.asarray(choices, dtype=np.float32), lowest), highest)
        return (kept * self.action_scales * self.mirror_signs)[:, None]


@jit
def _covariance_at_end(C, information_rate, n_samples, W, work):
    """W = (C⁻¹ + count rate)⁻¹, and ½ log det(I + count rate C) [nats]."""
    copy_scaled(work, 1.0, C)
    half_log_det_now = half_log_det(work)
    if (
        half_log_det_now == -np.inf
    ):  # rounding has made correlations impossible; without them the covariance is one again
        for i in range(len(C)):
            for j in range(len(C)):
                work[i, j] = C[i, j] if i == j else 0.0
        half_log_det_now = half_log_det(work)
    invert_from_cholesky(work, W)
    for i in range(len(C)):
        for j in range(len(C)):
            work[i, j] = W[i, j] + n_samples * information_rate[i, j]
    growth = half_log_det(work)
    if growth == -np.inf:  # of a limit so far that numbers end before it: nothing is foreseen
        return 0.0
    invert_from_cholesky(work, W)
    return half_log_det_now + growth


@cache
def compile_features(view: ModelView) -> Any:
    """``encode(observation, setting, own, work, features, span)``: the features of one observation, compiled.

    It fills in ``features`` and ``span``, and gives sign, push and to_come as of `ShieldedFeatures`. ``own``: whether the
    observation itself stands behind the features; ``work``: of ``workspace()``, what is written on.
    """
    model = view.model
    free_response, layout = compile_noise_free_response(*view), observation_layout(model)
    row, sense, step = free_response.layout, free_response.output_now, free_response.step
    n, k, size, is_odd = model.n_states, model.n_coefficients, len(row), free_response.is_odd
    u, last, older, now, velocity, signal = (
        row[name] for name in ("INPUT", "LAST_INPUT", "OLDER_INPUT", "NOW", "VELOCITY", "SHOWN")
    )
    # What pumps is a push along the motion itself: along what an accelerometer sees rise, it would brake.
    rate, states, sensor = (model.rates or ("",))[0], list(model.states), next(iter(model.outputs.values()))
    velocity_state = states.index(rate) if rate in states and sensor != states[0] else -1
    velocity = velocity if velocity_state < 0 else row[rate]
    phi = row[f"PHI_{next(iter(model.coefficients))}"]
    pairs = tuple(combinations(range(k), 2))
    odd = (
        *range(layout.state, layout.state + n),
        layout.last_input,
        *range(layout.last_output, layout.last_output + model.n_outputs),
    )
    entries, n_features = layout.size, len(FEATURE_NAMES)
    place = {name: i for i, name in enumerate(FEATURE_NAMES)}
    NEXT, REST, PEAK, REACH, TAUGHT, BRAKED = (place[f"{what}_up"] for what in _PER_FIRST_INPUT)
    FREE, OTHERS = place["free_response_2"], place["remaining_information"]
    compile_inner = jit_closure(view.compile_key)

    @compile_inner
    def workspace():
        return np.empty(size), np.empty(size), np.empty((k, k)), np.empty((k, k)), np.empty((k, k))

    @compile_inner
    def information_form(A, W):
        """φᵀ A φ."""
        total = 0.0
        for i in range(k):
            total += A[i, i] * W[phi + i] * W[phi + i]
            for j in range(i):
                total += 2.0 * A[i, j] * W[phi + i] * W[phi + j]
        return total

    @compile_inner
    def clip_states(W, scales):
        """Keep a state that runs away where it can be calculated with."""
        for i in range(n):
            W[i] = max(-2.0 * scales[i], min(W[i], 2.0 * scales[i]))

    @compile_inner
    def decode_belief(o, s, start, C):
        """Means and covariance of the coefficients, states and last inputs."""
        for j in range(k):
            start[n + j] = s.center[j] + s.std[j] * o[layout.mean + j]
            C[j, j] = s.std[j] * np.exp(o[layout.log_std + j])
        for i in range(len(pairs)):
            a, b = pairs[i]
            C[b, a] = C[a, b] = o[layout.correlation + i] * C[a, a] * C[b, b]
        for j in range(k):
            C[j, j] *= (1.0 + _RIDGE) * C[j, j]
        for i in range(n):
            start[i] = s.max_output * o[layout.state + i]
        start[last] = start[older] = s.max_input * o[layout.last_input]
        sense(start)

    @compile_inner
    def mirror(start):
        """Turn the state and the inputs over."""
        for i in range(n):
            start[i] = -start[i]
        for i in (last, older):
            start[i] = -start[i]
        sense(start)

    @compile_inner
    def roll_out(s, start, W, C, final_covariance, noise, action_scale, is_braking, f, first_input):
        """One rollout: fills in what it shows of a first input."""
        copy(W, 0, start, size)
        W[u] = (1.0 - first_input) * action_scale
        peak, peak_with_margin, information = 0.0, 0.0, 0.0
        hold_samples = int(s.hold_samples)
        for t in range(_N_LOOKAHEAD_MOVES * hold_samples):
            if t > 0:
                W[u] = 0.0
                if is_braking:
                    sense(W)
                    W[u] = -action_scale if W[velocity] >= 0.0 else action_scale
            step(W)
            clip_states(W, s.scales)
            high = min(abs(W[signal]), 2.0 * s.limit)
            peak = max(peak, high)
            if t < 3 * hold_samples:
                information += information_form(final_covariance, W)
            if is_braking:
                if high > 0.5 * s.limit:
                    # What is not known of the coefficients adds up over a move.
                    high += s.margin * np.sqrt(
                        hold_samples * hold_samples * information_form(C, W) + (noise[0] if t == 0 else noise[1])
                    )
                peak_with_margin = max(peak_with_margin, high)
            elif first_input == 1 and (t + 1) % hold_samples == 0 and hold_samples <= t < 4 * hold_samples:
                f[FREE + t // hold_samples - 1] = W[signal] / s.limit
            if t + 1 == hold_samples and not is_braking:
                f[NEXT + first_input] = W[signal] / s.limit
        if is_braking:
            f[PEAK + first_input], f[REACH + first_input], f[BRAKED + first_input] = (
                peak / s.limit,
                peak_with_margin / s.limit,
                information,
            )
        else:
            f[REST + first_input], f[TAUGHT + first_input] = peak / s.limit, information

    @compile_inner
    def allowed_interval(up, none, down, span):
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

    @compile_inner
    def encode(observation, s, with_observation, work, f, span):
        start, W, C, final_covariance, scratch = work
        o = observation
        fill(start, 0.0)
        decode_belief(o, s, start, C)
        sign = 1.0
        if is_odd and start[velocity] < 0.0:
            sign = -1.0
            mirror(start)
        left = max(1.0, o[layout.time_left] * s.samples)
        n_samples_left, energy_left_ratio, reserve, action_scale = left, 1.0, 1.0, 1.0
        if s.energy < np.inf:
            # What is still to come takes time and energy.
            n_samples_left = 0.5 * (n_samples_left + o[layout.budget_left] * s.samples)
            reserve = np.sqrt(max(0.0, o[layout.budget_left]) * s.energy) / s.max_input
            energy_left_ratio = min(1.0, reserve / np.sqrt(left))
        process, sensor = (
            s.process_variance * np.exp(-o[layout.noise]),
            s.sensor_variance * np.exp(-o[layout.noise + 1]),
        )
        variance = process + sensor
        remaining_information = _covariance_at_end(
            C, s.information_rate, n_samples_left / variance, final_covariance, scratch
        )
        copy_scaled(final_covariance, 0.5 / variance, final_covariance)
        noise = variance, 2.0 * variance + s.accumulated_noise * process
        roll_out(s, start, W, C, final_covariance, noise, 0.0, False, f, 1)
        if s.energy < np.inf:
            action_scale = min(1.0, max(energy_left_ratio, s.amplitude_growth * f[REST + 1] / s.step_response))
        for first_input in range(3):
            if first_input != 1:
                roll_out(s, start, W, C, final_covariance, noise, action_scale * s.max_input, False, f, first_input)
            roll_out(s, start, W, C, final_covariance, noise, action_scale * s.max_input, True, f, first_input)
        allowed_interval(f[REACH], f[REACH + 1], f[REACH + 2], span)
        for what in (TAUGHT, BRAKED):
            up, none, down = f[what], f[what + 1], f[what + 2]
            most = max(up, none, down) + 1e-12
            f[what], f[what + 1] = (up - down) / most, (none - max(up, down)) / most
            f[what + 2] = np.log(most * left + 1e-3)
        mean = max_log_std = o[layout.log_std]
        for a in range(1, k):
            mean += o[layout.log_std + a]
            max_log_std = max(max_log_std, o[layout.log_std + a])
        f[0], f[1], f[2], f[3] = mean / k, max_log_std, o[layout.noise], o[layout.noise + 1]
        f[4], f[5], f[6], f[7] = o[layout.time_left], energy_left_ratio, reserve, action_scale
        f[8], f[9] = sign * o[layout.last_input], sign * o[layout.last_output]
        f[10], f[11] = start[now] / s.limit, start[velocity] * s.hold_samples / s.limit
        if velocity_state >= 0:
            f[11] = start[velocity] / s.scales[velocity_state]
        f[12], f[13], f[14] = 0.5 * np.log(variance / s.limit**2) + 7.0, span[0], span[1]
        f[OTHERS] = remaining_information / k
        total = 0.0
        for a in range(k):
            for b in range(k):
                total += final_covariance[a, b] * s.information_rate[a, b]
        f[OTHERS + 1] = np.log(total * s.samples + 1e-6)
        if with_observation:
            copy(f, n_features, o, entries)
            if sign < 0.0:
                for j in odd:
                    f[n_features + j] = -f[n_features + j]
        for j in range(len(f)):
            # NaN becomes 0.
            f[j] = max(-MAX_FEATURE, min(f[j], MAX_FEATURE)) if f[j] == f[j] else 0.0
        return sign, action_scale, remaining_information

    return workspace, encode


@cache
def _compile_feature_batch(view: ModelView) -> Any:
    """``encode_batch(observations, setting, own, *features)``: fills in the `ShieldedFeatures` of n observations."""
    workspace, encode = compile_features(view)

    @kernel(variant=view.compile_key)
    def encode_batch(
        observations,
        setting,
        with_observation,
        values,
        mirror_signs,
        allowed_intervals,
        action_scales,
        remaining_information,
    ):
        work = workspace()
        for i in range(len(observations)):
            mirror_signs[i], action_scales[i], remaining_information[i] = encode(
                observations[i], setting, with_observation, work, values[i], allowed_intervals[i]
            )

    return encode_batch


class FeatureEncoder:
    """Turns observations of an environment into `ShieldedFeatures`.

    Args:
        setting: what observations are relative to.
        view: how the believed model is taken.
        with_observation: whether the observation itself stands behind the features that all models have.
    """

    def __init__(self, setting: FeatureSettings, view: ModelView, *, with_observation: bool = True) -> None:
        self.setting, self.model_view, self.with_observation = setting, view, with_observation

    @classmethod
    def of(cls, env: Any, *, with_observation: bool = True) -> FeatureEncoder:
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
                f"env must show the observation 'posterior' for features, but shows {short_repr(experiment.observation)}; "
                "leave out the option observation"
            )
        if experiment.hold != 1:
            raise ValueError(f"hold must be 1 for features, but is {experiment.hold}; train without features")
        setup, view, prior = experiment.kernel_params, ModelView.of(experiment), experiment.prior_belief
        center = prior.coefficients_mean
        time_scales = probe_time_scales(view, center, setup.max_input, setup.max_output)
        setting = FeatureSettings(
            center=center,
            std=1.0 / setup.prior_inverse_std,
            information_rate=time_scales.mean_information,
            scales=time_scales.scales,
            max_input=float(setup.max_input),
            max_output=float(setup.max_output),
            limit=planning_limit(experiment, time_scales.scales),
            samples=float(setup.horizon),
            energy=float(setup.budget),
            process_variance=float(np.exp(-setup.prior_log_precisions[0])),
            sensor_variance=float(np.exp(-setup.prior_log_precisions[1])),
            accumulated_noise=kept_accumulated_noise(experiment, time_scales),
            hold_samples=float(time_scales.hold_samples),
            margin=MARGIN_KNOWN_NOISE if experiment.noise_hypotheses == 1 else MARGIN_UNKNOWN_NOISE,
            step_response=abs(time_scales.step_response) * float(setup.max_input) / float(setup.max_output),
            amplitude_growth=AMPLITUDE_GROWTH,
        )
        return cls(setting, view, with_observation=with_observation)

    @classmethod
    def from_tensor(cls, numbers: npt.ArrayLike, description: dict[str, Any]) -> FeatureEncoder:
        """That which `to_tensor` and `describe` gave.

        Raises:
            ValueError: for numbers of another count, or that are not those of a setting.
        """
        described = dict(description)
        with_observation, view = bool(described.pop("own")), ModelView(Model(**described.pop("model")), **described)
        k, n = view.model.n_coefficients, view.model.n_states
        flat = np.asarray(numbers, dtype=np.float64)
        sizes = (k, k, k * k, n)
        size = sum(sizes) + len(FeatureSettings._fields) - len(sizes)
        if flat.shape != (size,):
            raise ValueError(f"setting must be {size} numbers, but is {flat.tolist()!r:.200}")
        center, std, rate, scales, others = np.split(flat, np.cumsum(sizes))
        setting = FeatureSettings(center, std, rate.reshape(k, k), scales, *others.tolist())
        value: Any
        for name, value in zip(FeatureSettings._fields, setting, strict=True):
            to_check = np.diag(value) if name == "information_rate" else np.asarray(value)
            sound = np.isfinite(value).all() or (name == "energy" and value == np.inf)
            sound &= bool(name == "center" or (to_check > 0).all() or (name in _MAY_BE_ZERO and (to_check >= 0).all()))
            if not sound or (name in _MAX_SETTINGS and not 1 <= value <= _MAX_SETTINGS[name]):
                raise ValueError(f"{name} of setting must be positive and finite, but is {value!r:.80}; copy it anew")
        return cls(setting, view, with_observation=with_observation)

    def to_tensor(self) -> FloatArray:
        """The setting, flat, as a policy's file holds it."""
        return np.concatenate([np.ravel(np.asarray(value, dtype=np.float64)) for value in self.setting])

    def describe(self) -> dict[str, Any]:
        """The rest of it, as JSON can hold it."""
        return {
            "own": self.with_observation,
            "model": self.model_view.model.to_dict(),
            "degree": self.model_view.degree,
            "lag": self.model_view.lag,
        }

    @property
    def observation_size(self) -> int:
        """Entries of the observations."""
        return observation_layout(self.model_view.model).size

    @property
    def size(self) -> int:
        """What a network sees."""
        return len(FEATURE_NAMES) + self.with_observation * self.observation_size

    def __call__(self, observations: npt.ArrayLike) -> ShieldedFeatures:
        """The features of observations (n, entries)."""
        float_observations = np.ascontiguousarray(observations, dtype=np.float32)
        n = len(float_observations)
        found = ShieldedFeatures(*(np.empty(shape, dtype=np.float32) for shape in ((n, self.size), n, (n, 2), n, n)))
        _compile_feature_batch(self.model_view)(float_observations, self.setting, self.with_observation, *found)
        return found
