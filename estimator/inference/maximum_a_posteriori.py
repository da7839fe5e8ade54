"""Maximum a posteriori: what a whole record says of the coefficients, to one who knows the noises and has time.

An auditor for the online estimators, and for whoever chooses their inputs: it shares neither their updates nor their
beliefs. With the Kalman filter's innovations ν_t and their variances S_t at the coefficients ψ of a model it minimises

    L(ψ) = ½ Σ_t (ν_t² / S_t + log S_t) + ½ (ψ - ψ0)ᵀ Λ0 (ψ - ψ0)

by Gauss-Newton steps (Λ0 + F)⁻¹, damped after Levenberg and Marquardt, with the sensitivities and the information F of
`estimator.inference.fisher_information`. They begin at the prior's mean, and at other points where such are given: where the prior is
wide, L has minima far from the truth, and the deepest that is found is kept. The inverse of Λ0 + F at the minimum is
the posterior's covariance by Laplace's approximation.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from estimator.belief import Belief
from estimator.engine.input_hold import input_degree
from estimator.inference.record_filter import (
    filter_records,
    inputs_by_sample,
    noise_variances,
    outputs_by_sensor,
)
from estimator.models.model import Model
from estimator.support.argument_checks import to_float_array
from estimator.support.array_types import FloatArray

#: Steps at most, and the step at which the search ends, in standard deviations of the posterior.
_MAX_STEPS, _STEP_TOLERANCE = 60, 1e-6
#: Damping at the start, its change after a step that fails or succeeds, and where a system is given up.
_INITIAL_DAMPING, _DAMPING_INCREASE, _DAMPING_DECREASE, _MAX_DAMPING = 1e-4, 10.0, 0.1, 1e12
#: Two minima whose depths differ by less are one.
_MIN_LOSS_DIFFERENCE = 1e-3


@dataclass(frozen=True)
class MapEstimate:
    """The posterior's mode and curvature, for n records.

    Attributes:
        mean: (n, K) the most probable coefficients.
        cov: (n, K, K) inverse of Λ0 + F there.
        converged: (n,) whether the last step was small; where not, ``mean`` is the best point that was seen.
    """

    mean: FloatArray
    cov: FloatArray
    converged: npt.NDArray[np.bool_]


def maximum_a_posteriori(
    model: Model,
    u: npt.ArrayLike,
    y: npt.ArrayLike,
    prior: Belief,
    process_noise: npt.ArrayLike,
    measurement_noise: npt.ArrayLike,
    interpolation: str = "zero_order",
    starts: Sequence[FloatArray] = (),
) -> MapEstimate:
    """Fit a model's coefficients to whole records, each from rest.

    Model, noises and interpolation are as `estimator.inference.fisher_information.fisher_information` takes them.

    Args:
        model: the equation.
        u: (n, T) inputs, likewise.
        y: (n, T) the outputs that followed them, or (n, T, p) those of p sensors.
        prior: of the coefficients, in the model's order, and of the state about rest. Its belief in the noises is not
            used. A coefficient of variance 0 is known.
        process_noise: standard deviation; (n,) of each record.
        measurement_noise: the sensors' standard deviations; (n, p) of each record.
        interpolation: of the input between samples.
        starts: (n, K) coefficients each, from which the records are fitted besides the prior's mean; of each record the
            fit with the smallest L is kept. One that is not finite leads nowhere.

    Raises:
        ValueError: naming the argument, for shapes that do not fit, or a number that is out of range.
    """
    inputs = to_float_array("u", u)
    if inputs.ndim != 2:
        raise ValueError(f"u must have shape (n, T), but has {inputs.shape}")
    outputs = np.array(outputs_by_sensor(model, inputs, y))
    noises = noise_variances(model, process_noise, measurement_noise)
    sample_inputs = inputs_by_sample(model, inputs, input_degree(model, interpolation))
    center, cov = prior.coefficients_mean, prior.coefficients_cov
    if center.shape != (model.n_coefficients,):
        raise ValueError(f"prior must be of {list(model.coefficients)}, but its means have shape {center.shape}")
    free = np.flatnonzero(np.diag(cov))
    free_block = np.ix_(free, free)
    scale = np.sqrt(np.diag(cov)[free])  # all is solved in units of the prior, for its condition's sake
    precision = np.linalg.inv(cov[free_block] / np.outer(scale, scale))

    def coefficients_at(points: FloatArray) -> FloatArray:
        coefficients = np.tile(center, (len(points), 1))
        coefficients[:, free] += scale * points
        return coefficients

    def loss_and_derivatives(points: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        filtered = filter_records(model, coefficients_at(points), sample_inputs, outputs, noises, prior.state_cov)
        prior_gradient = points @ precision
        loss = filtered.loss + 0.5 * (points * prior_gradient).sum(axis=1)
        curvature = filtered.information[:, free[:, None], free] * np.outer(scale, scale) + precision
        return loss, scale * filtered.gradient[:, free] + prior_gradient, curvature

    begins = [to_float_array(f"starts[{i}]", start) for i, start in enumerate(starts)]
    for i, begin in enumerate(begins):
        if begin.shape != (len(inputs), len(center)):
            raise ValueError(
                f"starts[{i}] must be coefficients of every record, of shape {(len(inputs), len(center))}, but has "
                f"shape {begin.shape}"
            )
    points, loss, curvature, converged = _levenberg_marquardt(loss_and_derivatives, np.zeros((len(inputs), len(free))))
    for begin in begins:
        others = _levenberg_marquardt(loss_and_derivatives, (begin[:, free] - center[free]) / scale)
        deeper = others[1] < loss - _MIN_LOSS_DIFFERENCE
        points[deeper], loss[deeper], curvature[deeper], converged[deeper] = (filtered[deeper] for filtered in others)
    posterior = np.zeros((len(inputs), *cov.shape))
    posterior[:, free[:, None], free] = np.linalg.inv(curvature) * np.outer(scale, scale)
    return MapEstimate(coefficients_at(points), posterior, converged)


def _levenberg_marquardt(
    loss_and_derivatives: Callable[[FloatArray], tuple[FloatArray, FloatArray, FloatArray]], points: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, npt.NDArray[np.bool_]]:
    """Go downhill from points (n, free).

    Args:
        loss_and_derivatives: loss, slope and curvature at points.
        points: to begin with.

    Returns:
        Where it ended, the loss and the curvature there, and whether the last step was small.
    """
    points = points.copy()
    loss, gradient, curvature = loss_and_derivatives(points)
    damping = np.full(len(points), _INITIAL_DAMPING)
    converged = np.zeros(len(points), dtype=np.bool_)
    for _ in range(_MAX_STEPS):
        damped = curvature + damping[:, None, None] * curvature * np.eye(points.shape[1])
        step = -np.linalg.solve(damped, gradient[:, :, None])[:, :, 0]
        step[converged | (damping > _MAX_DAMPING)] = 0.0
        new_loss, new_gradient, new_curvature = loss_and_derivatives(points + step)
        better = new_loss <= loss  # False for what is not finite
        points[better] += step[better]
        loss, gradient = np.where(better, new_loss, loss), np.where(better[:, None], new_gradient, gradient)
        curvature = np.where(better[:, None, None], new_curvature, curvature)
        damping = np.where(
            better,
            np.maximum(_DAMPING_DECREASE * damping, 1e-12),
            np.minimum(_DAMPING_INCREASE * damping, 10 * _MAX_DAMPING),
        )
        size = np.sqrt(np.einsum("ni,nij,nj->n", step, curvature, step))
        converged |= better & (size < _STEP_TOLERANCE)
        if (converged | (damping > _MAX_DAMPING)).all():
            break
    return points, loss, curvature, converged
