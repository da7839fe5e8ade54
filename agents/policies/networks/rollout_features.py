"""Rollout features of an observation, and the shield's allowed actions: functions of the observation alone.

An observation holds a Gaussian belief, the state, and the time and energy left. The model at the means of the belief is
rolled out without noise, after a first input up, none or down, and then *free*, without further input, or *braked*, by
inputs against the motion. `FEATURE_NAMES` lists the features of these rollouts. For an odd model all of them are
mirrored so that the motion is upwards.

The *shield* is the interval of actions after which braking keeps the first sensor within its limit, with a margin of
some predictive standard deviations; peaks are interpolated linearly between the three first inputs. Where no action
keeps it, the interval is the action with the lowest peak.

The *information* of inputs is Σ_t φ_tᵀ W φ_t / (2 σ²) [nats], with φ the derivatives of the first sensor's output after
a sample by the coefficients, and σ² the variance of an output. W = (C⁻¹ + J)⁻¹ is the covariance at the end of the
episode, with C the coefficients' covariance and J the information of the rest of the episode, at the rate of an
oscillation at the limit. To first order this is the growth of the information at the end.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from agents.planning.d_optimality import half_log_det, invert_from_cholesky
from agents.planning.model_probe import ModelView, observation_layout
from agents.policies.networks.feature_names import (
    BRAKED,
    FEATURE_NAMES,
    FREE,
    MAX_FEATURE,
    NEXT,
    OTHERS,
    PEAK,
    REACH,
    REST,
    TAUGHT,
)
from agents.policies.networks.rollout_rows import rollout_rows
from estimator.compilation.array_operations import copy, copy_scaled, fill
from estimator.compilation.simd import jit, jit_closure
from estimator.engine.noise_free_step import compile_noise_free_step

#: Moves of a rollout, with the first input's.
_N_LOOKAHEAD_MOVES = 5

#: Relative addition to variances that makes covariances of float32 correlations positive definite.
_RIDGE = 1e-6


@jit
def _covariance_at_end(C, information_rate, n_samples, W, work):
    """Fill in W = (C⁻¹ + n_samples rate)⁻¹; return ½ log det(I + n_samples rate C) [nats]."""
    copy_scaled(work, 1.0, C)
    half_log_det_now = half_log_det(work)
    if half_log_det_now == -np.inf:  # rounding made the correlations impossible: leave them out
        for i in range(len(C)):
            for j in range(len(C)):
                work[i, j] = C[i, j] if i == j else 0.0
        half_log_det_now = half_log_det(work)
    invert_from_cholesky(work, W)
    for i in range(len(C)):
        for j in range(len(C)):
            work[i, j] = W[i, j] + n_samples * information_rate[i, j]
    growth = half_log_det(work)
    if growth == -np.inf:  # numbers overflow before so far a limit: nothing is predicted
        return 0.0
    invert_from_cholesky(work, W)
    return half_log_det_now + growth


@cache
def _compile_decoding(view: ModelView) -> tuple[Any, Any]:
    """``decode_belief`` and ``mirror``."""
    sense, layout, rows = (
        compile_noise_free_step(*view).output_now,
        observation_layout(view.model),
        rollout_rows(view),
    )
    n, k, last, older, pairs = rows.n, rows.k, rows.last, rows.older, rows.pairs
    compile_inner = jit_closure(view.compile_key)

    @compile_inner
    def decode_belief(o, s, start, C):
        """Fill in means and covariance of the coefficients, states and last inputs."""
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
        """Mirror the state and the inputs."""
        for i in range(n):
            start[i] = -start[i]
        for i in (last, older):
            start[i] = -start[i]
        sense(start)

    return decode_belief, mirror


@cache
def _compile_roll_out(view: ModelView) -> Any:
    """``roll_out``, as below."""
    free_response, rows = compile_noise_free_step(*view), rollout_rows(view)
    sense, step = free_response.output_now, free_response.step
    size, n, k, u, velocity, signal, phi = (
        rows.size, rows.n, rows.k, rows.u, rows.velocity, rows.signal, rows.phi
    )  # fmt: skip
    compile_inner = jit_closure(view.compile_key)

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
        """Clip diverging states to finite numbers."""
        for i in range(n):
            W[i] = max(-2.0 * scales[i], min(W[i], 2.0 * scales[i]))

    @compile_inner
    def roll_out(s, start, W, C, final_covariance, noise, action_scale, is_braking, f, first_input):
        """Roll out a first input, and write its features."""
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
                    # The uncertainty of the coefficients adds up over a move.
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

    return roll_out


@jit
def allowed_interval(up, none, down, span):
    """Fill in the interval of actions whose peaks, linear between the three of ``up, none, down``, are at most 1."""
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


@cache
def _compile_writing(view: ModelView) -> tuple[Any, Any, Any]:
    """``write_uncertainty``, ``write_motion`` and ``append_observation``."""
    layout, rows = observation_layout(view.model), rollout_rows(view)
    k, now, velocity, velocity_state, odd = rows.k, rows.now, rows.velocity, rows.velocity_state, rows.odd
    entries, n_features, compile_inner = layout.size, len(FEATURE_NAMES), jit_closure(view.compile_key)

    @compile_inner
    def write_uncertainty(f, o, left, variance, limit):
        """Write the uncertainties, and compare the information of the first inputs."""
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
        f[12] = 0.5 * np.log(variance / limit**2) + 7.0

    @compile_inner
    def write_motion(f, o, s, start, sign):
        """Write the last input and output, the output and the velocity."""
        f[8], f[9] = sign * o[layout.last_input], sign * o[layout.last_output]
        f[10], f[11] = start[now] / s.limit, start[velocity] * s.hold_samples / s.limit
        if velocity_state >= 0:
            f[11] = start[velocity] / s.scales[velocity_state]

    @compile_inner
    def append_observation(f, o, sign):
        """Append the observation, mirrored with the motion."""
        copy(f, n_features, o, entries)
        if sign < 0.0:
            for j in odd:
                f[n_features + j] = -f[n_features + j]

    return write_uncertainty, write_motion, append_observation


@cache
def compile_features(view: ModelView) -> tuple[Any, Any]:
    """``workspace()`` and ``encode(observation, settings, with_observation, work, features, interval)``, compiled.

    ``encode`` fills in the features and the allowed interval of one observation, and returns the mirror sign, the
    action scale and the remaining information, as `agents.policies.networks.feature_encoder.ShieldedFeatures` has
    them. With ``with_observation`` the observation follows the features. ``work`` is a ``workspace()``.
    """
    layout, rows = observation_layout(view.model), rollout_rows(view)
    size, k, velocity, is_odd = rows.size, rows.k, rows.velocity, compile_noise_free_step(*view).is_odd
    decode_belief, mirror = _compile_decoding(view)
    write_uncertainty, write_motion, append_observation = _compile_writing(view)
    roll_out, compile_inner = _compile_roll_out(view), jit_closure(view.compile_key)

    @compile_inner
    def workspace():
        return np.empty(size), np.empty(size), np.empty((k, k)), np.empty((k, k)), np.empty((k, k))

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
        n_samples_left, energy_left_ratio, energy_left, action_scale = left, 1.0, 1.0, 1.0
        if s.energy < np.inf:
            # The remaining information takes time and energy.
            n_samples_left = 0.5 * (n_samples_left + o[layout.budget_left] * s.samples)
            energy_left = np.sqrt(max(0.0, o[layout.budget_left]) * s.energy) / s.max_input
            energy_left_ratio = min(1.0, energy_left / np.sqrt(left))
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
        write_uncertainty(f, o, left, variance, s.limit)
        f[4], f[5], f[6], f[7] = o[layout.time_left], energy_left_ratio, energy_left, action_scale
        write_motion(f, o, s, start, sign)
        f[13], f[14] = span[0], span[1]
        f[OTHERS] = remaining_information / k
        total = 0.0
        for a in range(k):
            for b in range(k):
                total += final_covariance[a, b] * s.information_rate[a, b]
        f[OTHERS + 1] = np.log(total * s.samples + 1e-6)
        if with_observation:
            append_observation(f, o, sign)
        for j in range(len(f)):
            # NaN becomes 0.
            f[j] = max(-MAX_FEATURE, min(f[j], MAX_FEATURE)) if f[j] == f[j] else 0.0
        return sign, action_scale, remaining_information

    return workspace, encode
