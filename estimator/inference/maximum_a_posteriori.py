"""Maximum a posteriori estimate of the coefficients from whole records, with known noise variances.

It audits the online estimators, and shares neither their updates nor their beliefs. With the innovations ν_t of the
Kalman filter and their variances S_t at the coefficients ψ it minimises

    L(ψ) = ½ Σ_t (ν_t² / S_t + log S_t) + ½ (ψ - ψ0)ᵀ Λ0 (ψ - ψ0)

by Levenberg-Marquardt steps with the gradient and the information F of `estimator.inference.record_filter`, which hold
gains fixed. The search begins at the prior's mean and at further given points, and keeps the deepest minimum: with a
wide prior, L has minima far from the truth. From there the same steps go on with the exact gradient of
`estimator.inference.likelihood_gradient`, which costs more, to where the slope of L vanishes; not for a model of more
than 10 states, whose exact gradient compiles for minutes. The inverse of Λ0 + F there is the covariance of Laplace's
approximation.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt

from estimator.belief import Belief
from estimator.engine.input_hold import input_degree
from estimator.inference.likelihood_gradient import likelihood_gradients
from estimator.inference.record_arrays import inputs_by_channel, outputs_by_sensor
from estimator.inference.record_filter import inputs_by_sample, noise_variances, record_likelihoods
from estimator.models.model import Model
from estimator.support.argument_checks import to_float_array
from estimator.support.array_types import FloatArray

#: Upper limit of the steps of a search.
_MAX_STEPS = 60

#: States of a model up to which the search ends with exact gradients.
_MAX_EXACT_STATES = 10

#: Length of a step at which the search has converged [standard deviations of the posterior].
_STEP_TOLERANCE = 1e-6

#: Damping at the start, as a fraction of the curvature's diagonal [1].
_INITIAL_DAMPING = 1e-4

#: Factor on the damping after a step that raises the loss.
_DAMPING_INCREASE = 10.0

#: Factor on the damping after a step that lowers the loss.
_DAMPING_DECREASE = 0.1

#: Damping at which the search of a record fails [1].
_MAX_DAMPING = 1e12

#: Difference of the losses below which two minima count as one [nats].
_MIN_LOSS_DIFFERENCE = 1e-3


@dataclass(frozen=True)
class MapEstimate:
    """The posterior's mode and curvature, for n records.

    Attributes:
        mean: (n, K) most probable coefficients.
        cov: (n, K, K) inverse of Λ0 + F there.
        converged: (n,) whether the search converged; if not, ``mean`` is the best point found.
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
    process_ratios: Mapping[str, npt.ArrayLike] | None = None,
) -> MapEstimate:
    """Fit a model's coefficients to whole records, each from rest, or from `Model.initial_states`.

    Model, noises and interpolation are as `estimator.inference.fisher_information.fisher_information` takes them.

    Args:
        model: the equation.
        u: (n, T) inputs, or (n, T, inputs) of several or none, likewise.
        y: (n, T) outputs, or (n, T, p) of p sensors.
        prior: belief in the coefficients and in the state about rest. Its noises are not used. A coefficient of
            variance 0 is fixed.
        process_noise: standard deviation; (n,) of each record.
        measurement_noise: the sensors' standard deviations; (n, p) of each record.
        interpolation: interpolation of the input between samples.
        starts: further starting points, each (n, K) coefficients; the fit with the smallest L is kept for each record.
            A start that is not finite is ignored.
        process_ratios: state with independent noise to the factor on its strength, 1 by default; (n,) of each record.

    Raises:
        ValueError: naming the argument, if its shape does not fit or a number is out of range.
    """
    inputs = inputs_by_channel(model, u)
    if inputs.ndim != 3:
        raise ValueError(f"u must be of n records, but has shape {np.shape(u)}; pass u[None] for one")
    outputs = np.array(outputs_by_sensor(model, inputs, y))
    noises = noise_variances(model, process_noise, measurement_noise, process_ratios)
    sample_inputs = inputs_by_sample(model, inputs, input_degree(model, interpolation))
    center, cov = prior.coefficients_mean, prior.coefficients_cov
    if center.shape != (model.n_coefficients,):
        raise ValueError(
            f"prior must have the coefficients {list(model.coefficients)}, but its means have shape {center.shape}"
        )
    free = np.flatnonzero(np.diag(cov))
    free_block = np.ix_(free, free)
    scale = np.sqrt(np.diag(cov)[free])  # in units of the prior, for a good condition number
    precision = np.linalg.inv(cov[free_block] / np.outer(scale, scale))

    def coefficients_at(points: FloatArray) -> FloatArray:
        coefficients = np.tile(center, (len(points), 1))
        coefficients[:, free] += scale * points
        return coefficients

    def loss_and_derivatives(points: FloatArray, is_exact: bool = False) -> tuple[FloatArray, FloatArray, FloatArray]:
        arguments = model, coefficients_at(points), sample_inputs, outputs, noises, prior.state_cov
        filtered = record_likelihoods(*arguments)
        gradient = likelihood_gradients(*arguments) if is_exact else filtered.gradient
        prior_gradient = points @ precision
        loss = filtered.loss + 0.5 * (points * prior_gradient).sum(axis=1)
        curvature = filtered.information[:, free[:, None], free] * np.outer(scale, scale) + precision
        return loss, scale * gradient[:, free] + prior_gradient, curvature

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
    if model.n_states <= _MAX_EXACT_STATES:
        points, _, curvature, converged = _levenberg_marquardt(partial(loss_and_derivatives, is_exact=True), points)
    posterior = np.zeros((len(inputs), *cov.shape))
    posterior[:, free[:, None], free] = np.linalg.inv(curvature) * np.outer(scale, scale)
    return MapEstimate(coefficients_at(points), posterior, converged)


def _levenberg_marquardt(
    loss_and_derivatives: Callable[[FloatArray], tuple[FloatArray, FloatArray, FloatArray]], points: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, npt.NDArray[np.bool_]]:
    """Minimise the losses of n records from points (n, free).

    Args:
        loss_and_derivatives: loss, gradient and curvature at points.
        points: starting points.

    Returns:
        The minima, the losses and curvatures there, and whether the searches converged.
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
        better = new_loss <= loss  # False for NaN
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
