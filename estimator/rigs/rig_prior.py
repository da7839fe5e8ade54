"""Prior belief of a rig: moments of the coefficients from its guess, with an unknown initial state."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from estimator.belief import Belief, covariance_indices
from estimator.models.duffing import DERIVATIVE_ORDER_OF_SENSOR
from estimator.models.model import Model
from estimator.priors import add_output_offset, gauss_hermite, quadrature_moments
from estimator.rigs.rig import Rig
from estimator.rigs.units import Scales
from estimator.support.array_types import FloatArray

#: Half width of the central 90 % interval of a Gaussian, in standard deviations.
STDS_PER_90_PERCENT = 1.6448536269514722

#: Standard deviation of an offset, as a fraction of the channel's scale.
OFFSET_STD_FRACTION = 0.03

#: Standard deviation of an unstated noise, as a fraction of the channel's scale.
NOISE_STD_FRACTION = 0.001

#: Standard deviation of the initial displacement, as a fraction of the output's scale.
_INITIAL_DISPLACEMENT_FRACTION = 0.3

#: Quadrature points along each parameter.
_PARAMETER_NODES = 7

#: Quadrature points along each offset.
_OFFSET_NODES = 3


def rig_prior(rig: Rig, scales: Scales | None = None) -> Belief:
    """The belief of a rig before its first sample.

    c, a and b are Gaussian with the guess as their central 90 %; m is log-normal with the same interval, because its
    inverse must have moments; the offsets are Gaussian about the offsets of the channels. The priors of the noises are
    weak, about the noises of the channels. The input's noise f is a disturbance of the force; σ_w is the process noise
    that changes the velocity as much as f held over a sample.

    Args:
        rig: the rig, with a guess.
        scales: scales of input and output; None: the rig's.

    Raises:
        ValueError: for a rig without a guess.
    """
    if rig.guess is None:
        raise ValueError("rig must have a guess of m, c, a and b, but has none; add one, or use identify on a record")
    scales = rig.scales if scales is None else scales
    axes = {name: _quadrature_axis(name, *rig.guess[name]) for name in rig.guess}
    axes["u0"] = gauss_hermite(rig.only_input.offset, OFFSET_STD_FRACTION * scales.input, _OFFSET_NODES)
    axes["y0"] = gauss_hermite(rig.output.offset, OFFSET_STD_FRACTION * scales.output, _OFFSET_NODES)
    return belief_from_moments(rig, scales, *quadrature_moments(rig.model, axes, scales))


def belief_from_moments(rig: Rig, scales: Scales, mean: FloatArray, cov: FloatArray) -> Belief:
    """A belief with given moments of the coefficients of the rig's model, and with an unknown initial state."""
    model, coefficients = rig.model, dict(zip(rig.model.coefficients, mean, strict=True))
    joint_mean, joint = _with_unknown_state(model, DERIVATIVE_ORDER_OF_SENSOR[rig.output.kind], mean, cov)
    force, sensor = (
        (channel.noise or NOISE_STD_FRACTION * scale) / scale
        for channel, scale in ((rig.only_input, scales.input), (rig.output, scales.output))
    )
    gamma, xi = ((2.0, 2.0 * float(noise) ** 2) for noise in (coefficients["gain"] * force / np.sqrt(3), sensor))
    return Belief.of(model, joint_mean, joint, gamma, xi, scales=scales)


def reset_state(belief: Belief) -> Belief:
    """The belief with an unknown state, for a new record; coefficients and noises stay.

    The belief of a model that is no oscillator with a stiffness stays as it is.
    """
    if not _is_oscillator(belief.model) or belief.model.n_states != 2:
        return belief
    order = belief.scales.order
    mean, cov = _with_unknown_state(belief.model, order, belief.coefficients_mean, belief.coefficients_cov)
    record = belief.record.copy()
    record[: len(mean)], record[covariance_indices(belief.model)] = mean, cov
    return replace(belief, record=record).with_factorisation(belief.factorisation)


def _with_unknown_state(model: Model, order: int, mean: FloatArray, cov: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Joint mean and covariance of an unknown state and the coefficients.

    Args:
        model: the model.
        order: order of the time derivative of the displacement that the sensor measures.
        mean: (K,) mean of the coefficients.
        cov: (K, K) their covariance.
    """
    frequency = _large_motion_frequency(dict(zip(model.coefficients, mean, strict=True)))
    displacement = _INITIAL_DISPLACEMENT_FRACTION / frequency**order
    n, d = model.n_states, len(model.names)
    joint_mean, joint = np.concatenate([np.zeros(n), mean]), np.zeros((d, d))
    joint[:n, :n] = np.diag([displacement**2, (displacement * frequency) ** 2])
    joint[n:, n:] = cov
    if order == 0 and "output_offset" in model.coefficients:
        add_output_offset(model, joint_mean, joint)
    return joint_mean, joint


def equal_effect_log_ratio(belief: Belief) -> float | None:
    """log(σ_w/σ_v) at which process noise and sensor noise have about the same effect on the output.

    None for a model without stiffness, whose ratio is unknown.
    """
    if not _is_oscillator(belief.model):
        return None
    known = dict(zip(belief.model.coefficients, belief.coefficients_mean, strict=True))
    return float((2 - belief.scales.order) * np.log(_large_motion_frequency(known)))


def _is_oscillator(model: Model) -> bool:
    """Whether a model has a linear and a cubic stiffness."""
    return {"stiffness", "cubic"} <= set(model.coefficients)


def _large_motion_frequency(coefficients: Mapping[str, float]) -> float:
    """Approximate angular frequency of large motions [rad per sample]."""
    return float(
        np.clip(
            np.sqrt(abs(coefficients["stiffness"]) + abs(coefficients["cubic"]) * _INITIAL_DISPLACEMENT_FRACTION**2),
            1e-3,
            1.0,
        )
    )


def _quadrature_axis(name: str, low: float, high: float) -> tuple[FloatArray, FloatArray]:
    """Quadrature points and weights of a parameter with a 90 % interval."""
    if name != "m":
        return gauss_hermite((low + high) / 2, (high - low) / 2 / STDS_PER_90_PERCENT, _PARAMETER_NODES)
    points, weights = gauss_hermite(
        np.log(low * high) / 2, np.log(high / low) / 2 / STDS_PER_90_PERCENT, _PARAMETER_NODES
    )
    return np.exp(points), weights
