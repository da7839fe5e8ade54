"""The prior of a rig: what its guess says of the coefficients, before a record that may begin in motion."""

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

#: Standard deviations of an interval's half width: the central 90 % of a Gaussian.
STDS_PER_90_PERCENT = 1.6448536269514722

#: Standard deviation of an offset, as a fraction of the channel's scale.
OFFSET_STD_FRACTION = 0.03

#: Standard deviation of an unstated noise, as a fraction of the channel's scale.
NOISE_STD_FRACTION = 0.001

#: Of a displacement at the start, in parts of the output's scale.
_INITIAL_DISPLACEMENT_FRACTION = 0.3

#: Quadrature points along each parameter.
_PARAMETER_NODES = 7

#: Quadrature points along each offset.
_OFFSET_NODES = 3


def rig_prior(rig: Rig, scales: Scales | None = None) -> Belief:
    """What is believed of a rig before its first sample.

    c, a and b are Gaussian with the guess as their central 90 %, m is log-normal with the same interval (its inverse
    must have moments), the offsets Gaussian about those of the channels. The noises' priors are weak, about those of
    the channels: of the input's noise f, the disturbance of the force, σ_w is what moves the velocity as much as f does
    when it is held over a sample.

    Args:
        rig: with a guess.
        scales: of input and output inside; the rig's own where they are None.

    Raises:
        ValueError: for a rig without a guess.
    """
    if rig.guess is None:
        raise ValueError("rig must have a guess of m, c, a and b, but has none; add one, or use identify on a record")
    scales = rig.scales if scales is None else scales
    axes = {name: _quadrature_axis(name, *rig.guess[name]) for name in rig.guess}
    axes["u0"] = gauss_hermite(rig.input.offset, OFFSET_STD_FRACTION * scales.input, _OFFSET_NODES)
    axes["y0"] = gauss_hermite(rig.output.offset, OFFSET_STD_FRACTION * scales.output, _OFFSET_NODES)
    return belief_from_moments(rig, scales, *quadrature_moments(rig.model, axes, scales))


def belief_from_moments(rig: Rig, scales: Scales, mean: FloatArray, cov: FloatArray) -> Belief:
    """A belief in given moments of the coefficients of the rig's model, before a record that may begin in motion."""
    model, coefficients = rig.model, dict(zip(rig.model.coefficients, mean, strict=True))
    joint_mean, joint = _with_unknown_state(model, DERIVATIVE_ORDER_OF_SENSOR[rig.output.kind], mean, cov)
    force = (rig.input.noise or NOISE_STD_FRACTION * scales.input) / scales.input
    noises = (
        coefficients["gain"] * force / np.sqrt(3),
        (rig.output.noise or NOISE_STD_FRACTION * scales.output) / scales.output,
    )
    gamma, xi = ((2.0, 2.0 * float(noise) ** 2) for noise in noises)
    return Belief.of(model, joint_mean, joint, gamma, xi, scales=scales)


def reset_state(belief: Belief) -> Belief:
    """A belief in a rig of which nobody knows what happened since, as it is before a record that may begin in motion.

    Coefficients and noises stay. So does the state of a model that is no oscillator's with a stiffness.
    """
    if not _is_oscillator(belief.model) or belief.model.n_states != 2:
        return belief
    order = belief.scales.order
    mean, cov = _with_unknown_state(belief.model, order, belief.coefficients_mean, belief.coefficients_cov)
    record = belief.record.copy()
    record[: len(mean)], record[covariance_indices(belief.model)] = mean, cov
    return replace(belief, record=record).with_factorisation(belief.factorisation)


def _with_unknown_state(model: Model, order: int, mean: FloatArray, cov: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean and covariance of states that may be in any motion, and of coefficients with the given ones.

    ``order`` is the time derivative of the displacement that the sensor shows.
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
    """log(σ_w/σ_v) at which the process noise moves the output as much as the sensor's hides it, about.

    None for a model without stiffness, of which that is not known.
    """
    if not _is_oscillator(belief.model):
        return None
    known = dict(zip(belief.model.coefficients, belief.coefficients_mean, strict=True))
    return float((2 - belief.scales.order) * np.log(_large_motion_frequency(known)))


def _is_oscillator(model: Model) -> bool:
    return {"stiffness", "cubic"} <= set(model.coefficients)


def _large_motion_frequency(coefficients: Mapping[str, float]) -> float:
    """Angular frequency of large motions [rad per sample], about."""
    return float(
        np.clip(
            np.sqrt(abs(coefficients["stiffness"]) + abs(coefficients["cubic"]) * _INITIAL_DISPLACEMENT_FRACTION**2),
            1e-3,
            1.0,
        )
    )


def _quadrature_axis(name: str, low: float, high: float) -> tuple[FloatArray, FloatArray]:
    """Points and weights of a parameter."""
    if name != "m":
        return gauss_hermite((low + high) / 2, (high - low) / 2 / STDS_PER_90_PERCENT, _PARAMETER_NODES)
    points, weights = gauss_hermite(
        np.log(low * high) / 2, np.log(high / low) / 2 / STDS_PER_90_PERCENT, _PARAMETER_NODES
    )
    return np.exp(points), weights
