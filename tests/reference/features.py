"""Features of an observation of Eq. (2) as `agents.policies.networks.rollout_features`, with matrices, one by one.

The motion is x⁺ = θ·φ with φ = (x, x³, x₋, u); the sensor shows x.
"""

from itertools import combinations

import numpy as np

from agents.policies.networks.feature_encoder import FeatureSettings
from agents.policies.networks.feature_names import MAX_FEATURE
from duffing_env.storage.kernel_spec import observation_bounds
from estimator.models.difference_equation import difference

COEFFICIENTS = ("theta1", "theta2", "theta3", "eta")
ENTRIES = tuple(observation_bounds(difference()))


def regressor(x, before, u):
    return np.array([x, x**3, before, u])


def coefficients_of(o, s):
    """Mean and covariance."""
    stds = s.std * np.exp([o[f"log_std_{name}"] for name in COEFFICIENTS])
    correlation = (1 + 1e-6) * np.eye(4)
    for i, j in combinations(range(4), 2):
        correlation[i, j] = correlation[j, i] = o[f"corr_{COEFFICIENTS[i]}_{COEFFICIENTS[j]}"]
    mean = s.center + s.std * [o[f"mean_{name}"] for name in COEFFICIENTS]
    return mean, np.diag(stds) @ correlation @ np.diag(stds)


def roll(theta, x, before, inputs, limit):
    """What five moves show, and their regressors; ``inputs(t, velocity)``."""
    shown, regressors = [], []
    for t in range(5):
        phi = regressor(x, before, inputs(t, x - before))
        x, before = np.clip(theta @ phi, -2 * limit, 2 * limit), x
        shown.append(x)
        regressors.append(phi)
    return np.array(shown), np.array(regressors)


def shield(up, none, down):
    """Lowest and highest choice where the peak, linear between down, none and up, is at most 1."""
    peaks = [down, none, up]
    if max(peaks) <= 1:
        return -1.0, 1.0
    if min(peaks) > 1:  # what leads beyond the limit the least
        best = 0.0 if none == min(peaks) else (1.0 if up <= down else -1.0)
        return best, best
    corners, within = [-1.0, 0.0, 1.0], []
    for (a, left), (b, right) in zip(zip(corners, peaks), zip(corners[1:], peaks[1:])):  # noqa: B905
        ends = [choice for choice, peak in ((a, left), (b, right)) if peak <= 1]
        if (left <= 1) != (right <= 1):
            ends.append(a + (1 - left) / (right - left) * (b - a))
        within.append(ends)
    left, right = within
    if none > 1:  # two pieces: that with the lower peak, and nothing between
        return (min(left), max(left)) if down <= min(1, up) else (min(right), max(right))
    return min(left), max(right)


def features(observation, s: FeatureSettings):
    """Values without the observation itself, sign, span, push and what is to come."""
    o = dict(zip(ENTRIES, np.float64(observation), strict=True))
    theta, C = coefficients_of(o, s)
    limit, (x, before) = s.limit, (s.max_output * o["state_x1"], s.max_output * o["state_x2"])
    sign = -1.0 if x < before else 1.0
    x, before = sign * x, sign * before
    left = max(1.0, o["time_left"] * s.samples)
    share, thrift, reserve, push = left, 1.0, 1.0, 1.0
    if np.isfinite(s.energy):
        share = (left + o["budget_left"] * s.samples) / 2
        reserve = np.sqrt(o["budget_left"] * s.energy / s.max_input**2)
        thrift = min(1.0, reserve / np.sqrt(left))
        height = np.abs(roll(theta, x, before, lambda t, velocity: 0.0, limit)[0]).max() / limit
        push = min(1.0, max(thrift, s.amplitude_growth * height / s.step_response))
    process, sensor = s.process_variance * np.exp(-o["log_gamma"]), s.sensor_variance * np.exp(-o["log_xi_y"])
    variance = process + sensor
    J = share / variance * s.information_rate
    W = np.linalg.inv(np.linalg.inv(C) + J)
    to_come = 0.5 * np.linalg.slogdet(np.eye(4) + C @ J)[1]
    noise = variance * np.array([1.0, 2.0, 2.0, 2.0, 2.0]) + s.accumulated_noise * process * np.array(
        [0.0, 1.0, 1.0, 1.0, 1.0]
    )

    free, found = None, {name: [] for name in ("next", "rest", "peak", "reach", "taught", "braked")}
    for first in (1.0, 0.0, -1.0):
        u = first * push * s.max_input

        def rest(t, velocity, u=u):
            return u if t == 0 else 0.0

        def brake(t, velocity, u=u):
            return u if t == 0 else -np.copysign(push * s.max_input, velocity + 1e-300)

        for inputs, peak, taught in ((rest, "rest", "taught"), (brake, "peak", "braked")):
            shown, phi = roll(theta, x, before, inputs, limit)
            high = np.minimum(np.abs(shown), 2 * limit)
            found[peak].append(high.max() / limit)
            found[taught].append(np.einsum("ti,ij,tj->", phi[:3], W, phi[:3]) / (2 * variance))
            if inputs is rest:
                found["next"].append(shown[0] / limit)
                free = shown[1:4] / limit if first == 0.0 else free
            else:
                margins = s.margin * np.sqrt(np.einsum("ti,ij,tj->t", phi, C, phi) + noise)
                found["reach"].append((high + np.where(high > limit / 2, margins, 0)).max() / limit)
    low, high = shield(*found["reach"])
    for name in ("taught", "braked"):
        up, none, down = found[name]
        most = max(found[name]) + 1e-12
        found[name] = [(up - down) / most, (none - max(up, down)) / most, np.log(most * left + 1e-3)]
    log_stds = [o[f"log_std_{name}"] for name in COEFFICIENTS]
    values = [np.mean(log_stds), max(log_stds), o["log_gamma"], o["log_xi_y"], o["time_left"], thrift, reserve, push]
    values += [sign * o["last_input"], sign * o["last_y"], x / limit, (x - before) / limit]
    values += [0.5 * np.log(variance / limit**2) + 7, low, high, *np.concatenate(list(found.values())), *free]
    values += [to_come / 4, np.log(np.trace(W @ s.information_rate) / (2 * variance) * s.samples + 1e-6)]
    return np.clip(values, -MAX_FEATURE, MAX_FEATURE), sign, (low, high), push, to_come
