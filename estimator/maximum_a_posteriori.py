"""Maximum a posteriori: what a whole record says of the coefficients, to one who knows the noises and has time.

An auditor for the online estimators, and for whoever chooses their inputs: it shares neither their updates nor their
beliefs. With the Kalman filter's innovations ν_t and their variances S_t at the coefficients ψ of a model it minimises

    L(ψ) = ½ Σ_t (ν_t² / S_t + log S_t) + ½ (ψ - ψ0)ᵀ Λ0 (ψ - ψ0)

by Gauss-Newton steps (Λ0 + F)⁻¹, damped after Levenberg and Marquardt, with the sensitivities and the information F of
`estimator.information`. They begin at the prior's mean, and at other points where such are given: where the prior is
wide, L has minima far from the truth, and the deepest that is found is kept. The inverse of Λ0 + F at the minimum is
the posterior's covariance by Laplace's approximation.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from estimator.belief import Belief
from estimator.engine.feeding import input_degree
from estimator.information import follow, outputs_of, sampled, variances
from estimator.models.model import Model
from estimator.support.argument_checks import to_float_array
from estimator.support.array_types import FloatArray

#: Steps at most, and the step at which the search ends, in standard deviations of the posterior.
_STEPS, _SMALL = 60, 1e-6
#: Damping at the start, its change after a step that fails or succeeds, and where a system is given up.
_DAMPING, _UP, _DOWN, _STUCK = 1e-4, 10.0, 0.1, 1e12
#: Two minima whose depths differ by less are one.
_SAME = 1e-3


@dataclass(frozen=True)
class Fit:
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
) -> Fit:
    """Fit a model's coefficients to whole records, each from rest.

    Model, noises and interpolation are as `estimator.information.fisher_information` takes them.

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
    outputs = np.array(outputs_of(model, inputs, y))
    noises = variances(model, process_noise, measurement_noise)
    taken = sampled(model, inputs, input_degree(model, interpolation))
    center, cov = prior.coefficients_mean, prior.coefficients_cov
    if center.shape != (model.n_coefficients,):
        raise ValueError(f"prior must be of {list(model.coefficients)}, but its means have shape {center.shape}")
    free = np.flatnonzero(np.diag(cov))
    inner = np.ix_(free, free)
    scale = np.sqrt(np.diag(cov)[free])  # all is solved in units of the prior, for its condition's sake
    precision = np.linalg.inv(cov[inner] / np.outer(scale, scale))

    def at(points: FloatArray) -> FloatArray:
        coefficients = np.tile(center, (len(points), 1))
        coefficients[:, free] += scale * points
        return coefficients

    def appraise(points: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        found = follow(model, at(points), taken, outputs, noises, prior.state_cov)
        pull = points @ precision
        loss = found.loss + 0.5 * (points * pull).sum(axis=1)
        curvature = found.information[:, free[:, None], free] * np.outer(scale, scale) + precision
        return loss, scale * found.slope[:, free] + pull, curvature

    begins = [to_float_array(f"starts[{i}]", start) for i, start in enumerate(starts)]
    for i, begin in enumerate(begins):
        if begin.shape != (len(inputs), len(center)):
            raise ValueError(
                f"starts[{i}] must be coefficients of every record, of shape {(len(inputs), len(center))}, but has "
                f"shape {begin.shape}"
            )
    points, loss, curvature, converged = _search(appraise, np.zeros((len(inputs), len(free))))
    for begin in begins:
        others = _search(appraise, (begin[:, free] - center[free]) / scale)
        deeper = others[1] < loss - _SAME
        points[deeper], loss[deeper], curvature[deeper], converged[deeper] = (found[deeper] for found in others)
    posterior = np.zeros((len(inputs), *cov.shape))
    posterior[:, free[:, None], free] = np.linalg.inv(curvature) * np.outer(scale, scale)
    return Fit(at(points), posterior, converged)


def _search(
    appraise: Callable[[FloatArray], tuple[FloatArray, FloatArray, FloatArray]], points: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, npt.NDArray[np.bool_]]:
    """Go downhill from points (n, free).

    Args:
        appraise: loss, slope and curvature at points.
        points: to begin with.

    Returns:
        Where it ended, the loss and the curvature there, and whether the last step was small.
    """
    points = points.copy()
    loss, slope, curvature = appraise(points)
    damping = np.full(len(points), _DAMPING)
    converged = np.zeros(len(points), dtype=np.bool_)
    for _ in range(_STEPS):
        damped = curvature + damping[:, None, None] * curvature * np.eye(points.shape[1])
        step = -np.linalg.solve(damped, slope[:, :, None])[:, :, 0]
        step[converged | (damping > _STUCK)] = 0.0
        new_loss, new_slope, new_curvature = appraise(points + step)
        better = new_loss <= loss  # False for what is not finite
        points[better] += step[better]
        loss, slope = np.where(better, new_loss, loss), np.where(better[:, None], new_slope, slope)
        curvature = np.where(better[:, None, None], new_curvature, curvature)
        damping = np.where(better, np.maximum(_DOWN * damping, 1e-12), np.minimum(_UP * damping, 10 * _STUCK))
        size = np.sqrt(np.einsum("ni,nij,nj->n", step, curvature, step))
        converged |= better & (size < _SMALL)
        if (converged | (damping > _STUCK)).all():
            break
    return points, loss, curvature, converged
